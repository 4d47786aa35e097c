"""`Scene`: everything a simulation is told, from TOML or from memory.

A scene is plain, validated data: SI units, no arrays, no mesh.  `discretise`
turns it into a `Problem`.  Unknown keys are refused and every message names the
key, the value, and what was expected.  `docs/scene.md` lists all keys.
"""

from __future__ import annotations

from pdcorrect.scene.actuators import Actuator
from pdcorrect.scene.bodies import Beam, Body, Cross, MeshFile, Voxels, Weight
from pdcorrect.scene.clamps import Clamp, Initial, Motion
from pdcorrect.scene.loads import BodyForce, Force, Gravity, Load, Pressure, Torsion, Traction
from pdcorrect.scene.materials import EffectiveModuli, Material, MaterialRegion
from pdcorrect.scene.obstacles import Box, Cylinder, Obstacle, Plane, Sphere
from pdcorrect.scene.probes import Probe
from pdcorrect.scene.regions import Region
from pdcorrect.scene.scene import (
    Damping,
    Scene,
    Solver,
    Time,
    best_coarse,
    check_scene,
    learned_coarse,
    trained_coarse,
)

__all__ = [
    "Actuator",
    "Beam",
    "Body",
    "BodyForce",
    "Box",
    "Clamp",
    "Cross",
    "Cylinder",
    "Damping",
    "EffectiveModuli",
    "Force",
    "Gravity",
    "Initial",
    "Load",
    "Material",
    "MaterialRegion",
    "MeshFile",
    "Motion",
    "Obstacle",
    "Plane",
    "Pressure",
    "Probe",
    "Region",
    "Scene",
    "Solver",
    "Sphere",
    "Time",
    "Torsion",
    "Traction",
    "Voxels",
    "Weight",
    "best_coarse",
    "check_scene",
    "learned_coarse",
    "trained_coarse",
]
