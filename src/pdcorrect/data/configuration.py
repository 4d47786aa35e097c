"""`DatasetConfig`: everything that determines a data set, as TOML."""

from __future__ import annotations

import hashlib
import json
import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from pdcorrect._config import (
    Count,
    NonNegative,
    Poisson,
    Positive,
    PositiveCount,
    Strict,
    TomlConfig,
    as_toml,
)

FamilyName = Literal["beam", "cross", "weight"]
MotionName = Literal["torsion", "impulse", "stretch", "body-force"]


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("expected [low, high] with low <= high")
    return ends


def _plain(name: str) -> str:
    if not re.fullmatch(r"[a-z0-9][a-z0-9-]*", name):
        raise ValueError("expected lower-case letters, digits and hyphens, the first no hyphen")
    return name


_ORDERED = AfterValidator(_ordered)
Range = Annotated[tuple[Positive, Positive], _ORDERED]
Span = Annotated[tuple[NonNegative, NonNegative], _ORDERED]
PoissonRange = Annotated[tuple[Poisson, Poisson], _ORDERED]
NodeCounts = Annotated[tuple[PositiveCount, PositiveCount], _ORDERED]
Share = Annotated[float, Field(strict=True, ge=0, lt=1)]
Name = Annotated[str, Field(max_length=80), AfterValidator(_plain)]

CONVERGED_DIVISOR = 4
"""Steps of the setting "converged"'s reference in one of its coarse models."""
TRAINING, VALIDATION, EVALUATION = "training", "validation", "evaluation"
"""The splits that every data set has."""


class MaterialRange(Strict):
    """From what the material of a mesh is drawn; all its simulations share it."""

    young: Range  # Pa, log-uniform
    poisson: PoissonRange  # uniform
    density: Range  # kg/m3, uniform


class MotionRange(Strict):
    """From what a simulation's load is drawn."""

    # "torsion": the rotational field of eq. 6-1 to 6-3 about the beam's axis, constant in time.
    # "impulse": a force on the body's inflated part (or free end) during the first ``duration``
    # seconds.  "stretch": a force on that part along the axis away from the clamps, with a
    # transverse share, that rises during ``duration`` seconds and stays.  "body-force": an
    # acceleration of the whole body in a random direction that rises so, too
    kind: MotionName
    # uniform.  Torsion: the field's sigma over the density, m/s2.  Stretch: force over the mass of
    # the loaded part, m/s2.  Impulse: momentum over that mass, m/s.  Body force: m/s2
    strength: Range
    duration: Positive = 0.01  # s; not used by torsion
    attraction: Span = (0.0, 0.5)  # k of eq. 6-1, uniform
    stretch: Span = (0.5, 1.5)  # alpha of eq. 6-1 over the cell size, uniform
    transverse: Span = (0.0, 0.3)  # of stretch: transverse over axial force, uniform


class Reference(Strict):
    """What the data set takes for the truth."""

    solver: Literal["pd", "newton"] = "pd"
    # cells into which each coarse cell is cut, along each axis
    refine: Annotated[int, Field(strict=True, ge=2, le=16)] = 4


class Split(Strict):
    """How many simulations on how many meshes; each mesh gets about as many."""

    meshes: PositiveCount
    simulations: PositiveCount

    @model_validator(mode="after")
    def _enough(self) -> Split:
        if self.simulations < self.meshes:
            raise ValueError("expected at least one simulation a mesh")
        return self


class ExtraSplit(Split):
    """An evaluation split that leaves the training distribution in the named respects."""

    name: Name
    # in place of the data set's
    family: FamilyName | None = None
    young: Range | None = None
    poisson: PoissonRange | None = None
    # on its loads, its time step and its number of frames
    strength_factor: Positive = 1.0
    step_factor: Positive = 1.0
    frames_factor: PositiveCount = 1
    refine: Annotated[int, Field(strict=True, ge=2, le=16)] | None = None  # of the reference


class DatasetConfig(TomlConfig):
    """A data set, up to the machine that computes it."""

    name: Name
    seed: Annotated[int, Field(strict=True, ge=0, le=2**63)]
    family: FamilyName  # bodies, see `pdcorrect.data.families`
    # "as-published": nodal masses rho times cell volume, the published volume weight, forces on the
    # coarse nodes, plain elements on every mesh.  "exact": masses that sum to rho V, the volume
    # weight of the material asked for, loads integrated on each mesh,
    # `pdcorrect.scene.trained_coarse` beside the plain model, its element in the reference.  Both
    # step by backward Euler.  "converged": as exact, with generalised-alpha,
    # `pdcorrect.best_coarse`, and a reference at a quarter of the step; no single steps
    setting: Literal["as-published", "exact", "converged"]
    # fewest and most nodes of a coarse mesh; the family's own by default
    coarse_nodes: NodeCounts | None = None
    # m and s
    cell_size: Positive = 0.05
    step: Positive = 0.01
    frames: PositiveCount
    # of each time step, of the coarse cell size
    tolerance: Annotated[float, Field(strict=True, gt=0, lt=0.1)] = 1e-5
    dtype: Literal["float32", "float64"] = "float32"  # in which positions and forces are stored
    material: MaterialRange
    # one of them.  Of a list of motions each simulation draws one or two
    motion: MotionRange | None = None
    mixed: tuple[MotionRange, ...] | None = None
    reference: Reference = Reference()
    # steps by which the time-converged reference of the evaluation split divides ``step``; 0 leaves
    # it out
    converged_steps: Annotated[int, Field(strict=True, ge=0, le=256)] = 0
    # on so many meshes of the evaluation split, a run with cells half as long as the reference's
    # tells how exact it is
    finest_meshes: Count = 0
    training: Split
    evaluation: Split
    validation_share: Share = 0.1  # of the training meshes
    extra: tuple[ExtraSplit, ...] = ()

    @property
    def motions(self) -> tuple[MotionRange, ...]:
        """All from which loads are drawn."""
        return self.mixed or (() if self.motion is None else (self.motion,))

    @model_validator(mode="after")
    def _one_kind_of_motion(self) -> DatasetConfig:
        if (self.motion is None) == (self.mixed is None):
            raise ValueError("expected either motion or mixed")
        kinds = [motion.kind for motion in self.mixed or ()]
        if self.mixed is not None and (len(kinds) < 2 or len(set(kinds)) < len(kinds)):
            raise ValueError(
                f"mixed has kinds {as_toml(kinds)}: expected two or more, each of them once"
            )
        return self

    @model_validator(mode="after")
    def _converges(self) -> DatasetConfig:
        if self.setting == "converged" and 0 < self.converged_steps <= CONVERGED_DIVISOR:
            raise ValueError(
                f"converged_steps = {self.converged_steps}: expected 0 or more than "
                f"{CONVERGED_DIVISOR}, by which the reference divides the step already"
            )
        return self

    @model_validator(mode="after")
    def _names(self) -> DatasetConfig:
        taken = {TRAINING, VALIDATION, EVALUATION}
        for number, split in enumerate(self.extra):
            if split.name in taken:
                key = f"extra[{number}].name = {as_toml(split.name)}"
                raise ValueError(f"{key}: is taken; expected a name of its own")
            taken.add(split.name)
        return self

    def hash(self) -> str:
        """SHA-256 of the configuration's content."""
        content: Any = self.model_dump(mode="json")
        if self.mixed is None:  # as before there was such a key
            del content["mixed"]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
