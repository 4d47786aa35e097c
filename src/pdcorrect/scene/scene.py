"""`Scene` with its time, damping and solver sections; `best_coarse`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from pdcorrect._config import FilePath, NonNegative, Positive, PositiveCount, Strict, TomlConfig
from pdcorrect.errors import InputError, SceneError
from pdcorrect.scene.actuators import Actuator
from pdcorrect.scene.bodies import Body, MeshFile
from pdcorrect.scene.clamps import Clamp, Initial
from pdcorrect.scene.loads import Load
from pdcorrect.scene.materials import Material, MaterialRegion
from pdcorrect.scene.obstacles import Obstacle
from pdcorrect.scene.probes import Probe

Integrator = Literal["backward-euler", "bdf2", "midpoint", "generalised-alpha", "quasi-static"]


class Time(Strict):
    """Step size (s), number of frames (one step each, or its substeps), and the integrator.

    Attributes
    ----------
    substeps
        Of equal length, that a frame is made of instead of one step; a stepper's call is one.
    integrator
        "generalised-alpha" (second order, damps what the step is too long for), "bdf2"
        and "midpoint" (second order), "backward-euler" (the thesis's; first order,
        strongly damping), or "quasi-static" (no inertia; time only moves loads and clamps).
    spectral_radius
        Of generalised-alpha at infinite frequency, 0 (damps most) to 1.
    """

    step: Positive
    frames: PositiveCount
    substeps: PositiveCount = 1
    integrator: Integrator = "generalised-alpha"
    spectral_radius: Annotated[float, Field(strict=True, ge=0, le=1)] = 0.8


class Damping(Strict):
    """Damping of the material, and Rayleigh damping: forces -(mass M + stiffness K) v.

    A mode of angular frequency w loses its amplitude as exp(-r t) with
    r = (viscosity w^2 + stiffness w^2 + mass)/2.

    Attributes
    ----------
    viscosity
        s; Kelvin-Voigt: a stress of viscosity times the small-strain law of the rate
        of the right stretch tensor (`pdcorrect.fem.viscosity`), which is zero in any
        rigid motion.
    mass
        1/s.
    stiffness
        s; K is the tangent stiffness where the step is expected to lead, made positive
        semi-definite.
    """

    viscosity: NonNegative = 0.0
    mass: NonNegative = 0.0
    stiffness: NonNegative = 0.0


class Solver(Strict):
    """Discretisation and accuracy.

    Attributes
    ----------
    mass
        "lumped" (row sums), "averaged", "consistent", or "per-node" (density
        times cell volume on every node, as DiffPD; only to reproduce published
        results).
    element
        "hex8": trilinear displacements, 2x2x2 Gauss points.  "hex8-mean": its
        volume term on the cell's mean deformation, against volumetric locking.
        "hex8-bubble": three incompatible modes a cell, against shear locking.
        "hex8-bubble-mean": both.  "hex8-enhanced": the modes, and the volume term on
        the part of the deformation that is linear in the cell, against both without
        being too soft.  "hex8-learned": that one with corrections by a network
        (`pdcorrect.fem.learned`); its mass is "averaged".  "hex27": triquadratic, 3x3x3
        Gauss points.
    weights
        Of "hex8-learned": a file as ``pdcorrect tune-element`` writes; by default those of the
        package.  Other elements have none.
    tolerance
        Largest accepted estimate of a node's distance from the step's exact
        solution, as a fraction of the coarse cell size.
    """

    mass: Literal["lumped", "averaged", "consistent", "per-node"] = "lumped"
    element: Literal[
        "hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced", "hex8-learned",
        "hex27",
    ] = "hex8"  # fmt: skip
    weights: FilePath | None = None
    tolerance: Annotated[float, Field(strict=True, gt=0, lt=0.1)] = 1e-5

    @model_validator(mode="before")
    @classmethod
    def _mass_of_learned(cls, data: Any) -> Any:
        """The learned element was trained with one mass rule."""
        if not isinstance(data, dict) or data.get("element") != "hex8-learned":
            return data
        if data.get("mass", "averaged") != "averaged":
            raise ValueError(
                f"mass = {data['mass']!r} with element = 'hex8-learned': expected 'averaged'"
            )
        return {**data, "mass": "averaged"}

    @model_validator(mode="after")
    def _weights_of_learned(self) -> Solver:
        """Only the learned element has weights."""
        if self.weights is not None and self.element != "hex8-learned":
            raise ValueError(
                f"weights with element = {self.element!r}: expected 'hex8-learned', or no weights"
            )
        return self


class Scene(TomlConfig):
    """A body, its material, how it is held and loaded, and for how long, in SI units.

    The page on scenes has all keys.

    Raises
    ------
    SceneError
        If a key is missing, unknown or wrong; names it.

    Examples
    --------
    >>> scene = Scene(
    ...     body={"shape": "beam", "cells": [4, 1, 1], "cell_size": 0.1},
    ...     material={"young": 1e5, "poisson": 0.3, "density": 1e3},
    ...     time={"step": 0.01, "frames": 10},
    ...     clamps=[{"region": {"plane": "x", "at": 0.0}}],
    ...     loads=[{"kind": "gravity", "acceleration": [0, 0, -9.81]}],
    ... )
    >>> scene.material.effective.poisson
    0.3
    """

    name: str = "scene"
    body: Body
    bodies: tuple[Body, ...] = ()
    material: Material
    materials: tuple[MaterialRegion, ...] = ()
    time: Time
    initial: Initial | None = None
    damping: Damping = Damping()
    clamps: tuple[Clamp, ...] = ()
    loads: tuple[Load, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    probes: tuple[Probe, ...] = ()
    solver: Solver = Solver()

    source: ClassVar[str] = "scene"
    error: ClassVar[type[InputError]] = SceneError

    def __init__(self, /, **data: Any) -> None:
        super().__init__(**{key: _plain(value) for key, value in data.items()})

    @field_validator("name")
    @classmethod
    def _named(cls, name: str) -> str:
        if not name.strip():
            raise ValueError("expected a name that is not empty")
        return name

    @field_validator("probes")
    @classmethod
    def _told_apart(cls, probes: tuple[Probe, ...]) -> tuple[Probe, ...]:
        names = [probe.name for probe in probes]
        if len(set(names)) < len(names):
            raise ValueError("expected a name for each that no other has")
        return probes

    @model_validator(mode="after")
    def _bodies_told_apart(self) -> Scene:
        names = [body.name for body in self.all_bodies.values() if body.name is not None]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(f"bodies: two have the name {twice[0]!r}: expected names that differ")
        return self

    @model_validator(mode="after")
    def _motion_has_inertia(self) -> Scene:
        if self.initial is not None and self.time.integrator == "quasi-static":
            raise ValueError(
                'initial with time.integrator = "quasi-static", which has no inertia: expected one '
                "of them only"
            )
        return self

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene from a TOML file; relative paths in it start at its folder.

        Raises
        ------
        SceneError
            If the file cannot be read, is not TOML, or is not a valid scene.
        """
        scene = super().load(path)
        folder = Path(path).parent
        changes: dict[str, Any] = {"body": _absolute(scene.body, folder)}
        if scene.bodies:
            changes["bodies"] = tuple(_absolute(body, folder) for body in scene.bodies)
        for name in ("initial", "solver"):
            if name in scene.model_fields_set:
                changes[name] = _absolute(getattr(scene, name), folder)
        return scene.model_copy(update=changes)

    @property
    def all_bodies(self) -> dict[str, Body]:
        """``body`` and ``bodies``, by their keys in messages."""
        return {"body": self.body} | {f"bodies[{i}]": body for i, body in enumerate(self.bodies)}

    def with_changes(self, **sections: Any) -> Scene:
        """The same scene with some sections' keys replaced, as ``material={"poisson": 0.3}``.

        Another element leaves ``solver.weights`` out.
        """
        data = self.model_dump(mode="python", exclude_none=True, exclude_unset=True, by_alias=True)
        for section, change in sections.items():
            if isinstance(change, dict) and isinstance(data.get(section), dict):
                if section == "solver" and change.get("element", "hex8-learned") != "hex8-learned":
                    data[section].pop("weights", None)
                data[section] = {**data[section], **change}
            else:
                data[section] = change
        return Scene(**data)


def check_scene(scene: object) -> None:
    """Refuse what is no scene, with the calls that make one."""
    if not isinstance(scene, Scene):
        raise InputError(
            f"scene is a {type(scene).__name__}: expected a Scene, as of Scene.load(path), "
            "Scene.from_toml(text) or Scene(**sections)."
        )


def best_coarse(scene: Scene) -> Scene:
    """The scene with the most accurate discretisation that a coarse mesh affords.

    Element "hex8-enhanced" and averaged mass: of the elements with 8 nodes the one that bends
    as beam theory says, however many cells a body is thick (`validation/cantilever`).  What is
    left of the plain coarse mesh's error is in `validation/best_coarse`.
    """
    check_scene(scene)
    return scene.with_changes(solver={"element": "hex8-enhanced", "mass": "averaged"})


def learned_coarse(scene: Scene) -> Scene:
    """The scene with element "hex8-learned", whose cells a network has written, and averaged mass.

    Cells that the network does not know keep "hex8-enhanced", and `discretise` warns of them.
    """
    check_scene(scene)
    return scene.with_changes(solver={"element": "hex8-learned", "mass": "averaged"})


def trained_coarse(scene: Scene) -> Scene:
    """The scene with the element and mass that correctors of the base "best" were trained on.

    Element "hex8-bubble-mean" and averaged mass; "hex8-bubble" for a voxel body that is one cell
    thick somewhere, where the other bends too easily.
    """
    check_scene(scene)
    thin = any(_one_cell_thick(body) for body in scene.all_bodies.values())
    element = "hex8-bubble" if thin else "hex8-bubble-mean"
    return scene.with_changes(solver={"element": element, "mass": "averaged"})


def _one_cell_thick(body: Body) -> bool:
    """Whether a voxel body has cells without neighbours on either side along some axis."""
    if isinstance(body, MeshFile):
        return False
    solid = np.pad(body.occupancy()[0], 1)
    return any(
        bool((solid & ~np.roll(solid, 1, axis) & ~np.roll(solid, -1, axis)).any())
        for axis in range(3)
    )


def _absolute(section: Strict, folder: Path) -> Strict:
    """A section with paths that no longer start at a folder."""
    found = {key: (folder / value).resolve() for key, value in section if isinstance(value, Path)}
    return section.model_copy(update=found)


def _plain(value: Any) -> Any:
    """NumPy numbers and arrays as Python ones, at any depth."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return value
