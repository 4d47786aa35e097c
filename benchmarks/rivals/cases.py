"""The scenes that contestants simulate, and their files for programs without this package.

A beam under its weight, and those of `validation/error_time`.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from case import PARTS

import pdcorrect as pc
from pdcorrect.fem.clamps import Selector
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import BodyForce, Force, Gravity, Load, Torsion

ERROR_TIME = Path(__file__).resolve().parents[2] / "validation" / "error_time"
BEAM = pc.Scene(
    body={"shape": "beam", "cells": [12, 2, 2], "cell_size": 0.04},
    material={"young": 1e6, "poisson": 0.3, "density": 1e3},
    time={"step": 0.01, "frames": 60},
    clamps=[{"region": {"plane": "x", "at": "min"}}],
    loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
)
NAME = "weight"
"""Of the beam under its weight."""


def scenes() -> dict[str, pc.Scene]:
    """All of them, by name."""
    sys.path.append(str(ERROR_TIME))
    import bodies

    return {NAME: BEAM} | bodies.scenes()


def refusal(scene: pc.Scene) -> str | None:
    """What in a scene the contestants are not given."""
    if any(clamp.motion for clamp in scene.clamps):
        return "clamps that move"
    if not all(isinstance(load, (Gravity, BodyForce, Force, Torsion)) for load in scene.loads):
        return "pressure"
    return None


def write(scene: pc.Scene, refine: int, path: Path) -> None:
    """The scene on cells cut ``refine`` times along each edge, as `case.Case` reads it."""
    problem = pc.discretise(scene, refine)
    held = ~problem.free
    if (held.any(axis=1) != held.all(axis=1)).any():
        raise NotImplementedError("rollers")
    count = len(scene.loads)
    found = [_parts(problem, load) for load in scene.loads]
    accelerations, densities, twists = (
        np.array([part[k] for part in found]).reshape(count, *shape)
        for k, shape in enumerate([(3,), (len(problem.cells), 3), (6,)])
    )
    gravity = problem.mass[:, None] * accelerations[:, None]
    patterns = np.array([load.pattern for load in problem.loads]).reshape(gravity.shape)
    times = scene.time.step / PARTS * np.arange((scene.time.frames + 1) * PARTS + 1)
    means = [[load.amplitude.mean(*ends) for ends in pairwise(times)] for load in problem.loads]
    materials = problem.materials
    np.savez(
        path, points=problem.positions, cells=problem.cells, coarse=problem.mesh.coarse_nodes,
        clamped=np.flatnonzero(held.any(axis=1)), young=materials.young,
        poisson=materials.poisson, density=materials.density,
        velocity=_velocity(scene), accelerations=accelerations,
        densities=densities, twists=twists, nodal=patterns - gravity,
        amplitudes=np.array(means).reshape(count, len(times) - 1),
        step=scene.time.step, scene=scene.to_toml(), refine=refine,
    )  # fmt: skip


def _velocity(scene: pc.Scene) -> np.ndarray:
    """Of the whole body at time 0, m/s."""
    initial = scene.initial
    if initial is None:
        return np.zeros(3)
    if initial.run or initial.region or any(initial.angular_velocity):
        raise NotImplementedError("initial states but one velocity")
    return np.array(initial.velocity)


def _parts(problem: Problem, load: Load) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Acceleration, force density in the cells, and turning field of a load."""
    acceleration, density, twist = np.zeros(3), np.zeros((len(problem.cells), 3)), np.zeros(6)
    if isinstance(load, Gravity):
        acceleration += load.acceleration
        return acceleration, density, twist
    cells = Selector(problem.mesh, problem.space, problem.cell_size).cells(load.region, "region")
    if isinstance(load, BodyForce):
        density[cells] = load.density
    elif isinstance(load, Force):
        if load.distribution == "nodal" or load.region.plane is not None:
            raise NotImplementedError("forces on nodes and faces")
        density[cells] = np.array(load.force) / problem.space.volumes()[cells].sum()
    else:
        if len(cells) != len(density) or load.follower or load.distribution == "nodal":
            raise NotImplementedError("torsion of a part, that follows, or on nodes")
        ends = problem.positions.min(axis=0), problem.positions.max(axis=0)
        centre = 0.5 * (ends[0] + ends[1]) if load.centre is None else load.centre
        twist[:] = load.strength, load.attraction, load.stretch, *centre
    return acceleration, density, twist
