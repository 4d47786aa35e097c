"""`DatasetConfig`: everything that determines a data set, as TOML."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from pdcorrect.scene.regions import Count, NonNegative, Poisson, Positive, PositiveCount, Strict
from pdcorrect.toml_config import TomlConfig

FamilyName = Literal["beam", "cross", "weight"]
MotionName = Literal["torsion", "impulse", "stretch"]


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("expected [low, high] with low <= high")
    return ends


Range = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]
Span = Annotated[tuple[NonNegative, NonNegative], AfterValidator(_ordered)]
PoissonRange = Annotated[tuple[Poisson, Poisson], AfterValidator(_ordered)]
Share = Annotated[float, Field(strict=True, ge=0, lt=1)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=80)]

TRAINING, VALIDATION, EVALUATION = "training", "validation", "evaluation"
"""The splits that every data set has."""


class MaterialRange(Strict):
    """From what the material of a mesh is drawn; all its simulations share it.

    Attributes
    ----------
    young
        Pa, log-uniform.
    poisson
        Uniform.
    density
        kg/m3, uniform.
    """

    young: Range
    poisson: PoissonRange
    density: Range


class MotionRange(Strict):
    """From what a simulation's load is drawn.

    Attributes
    ----------
    kind
        "torsion": the rotational field of eq. 6-1 to 6-3 about the beam's axis, constant in
        time.  "impulse": a force on the body's inflated part (or free end) during the first
        ``duration`` seconds.  "stretch": a force on that part along the axis away from the
        clamps, with a transverse share, that rises during ``duration`` seconds and stays.
    strength
        Uniform.  Torsion: the field's sigma over the density, m/s2.  Stretch: force over
        the mass of the loaded part, m/s2.  Impulse: momentum over that mass, m/s.
    duration
        s; not used by torsion.
    attraction
        k of eq. 6-1, uniform.
    stretch
        alpha of eq. 6-1 over the cell size, uniform.
    transverse
        Of stretch: transverse over axial force, uniform.
    """

    kind: MotionName
    strength: Range
    duration: Positive = 0.01
    attraction: Span = (0.0, 0.5)
    stretch: Span = (0.5, 1.5)
    transverse: Span = (0.0, 0.3)


class Reference(Strict):
    """What the data set takes for the truth.

    Attributes
    ----------
    solver
        "pd" or "newton".
    refine
        Cells into which each coarse cell is cut, along each axis.
    """

    solver: Literal["pd", "newton"] = "pd"
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
    """An evaluation split that leaves the training distribution in the named respects.

    Attributes
    ----------
    family, young, poisson
        In place of the data set's.
    strength_factor, step_factor, frames_factor
        On its loads, its time step and its number of frames.
    refine
        Of the reference.
    """

    name: Name
    family: FamilyName | None = None
    young: Range | None = None
    poisson: PoissonRange | None = None
    strength_factor: Positive = 1.0
    step_factor: Positive = 1.0
    frames_factor: PositiveCount = 1
    refine: Annotated[int, Field(strict=True, ge=2, le=16)] | None = None


class DatasetConfig(TomlConfig):
    """A data set, up to the machine that computes it.

    Attributes
    ----------
    family
        Bodies, see `pdcorrect.data.families`.
    setting
        "as-published": nodal masses rho times cell volume, the published volume weight,
        forces on the coarse nodes, plain elements on every mesh.  "exact": masses that
        sum to rho V, the volume weight of the material asked for, loads integrated on each
        mesh, the best coarse model beside the plain one, its element in the reference.
    coarse_nodes
        Fewest and most nodes of a coarse mesh; the family's own by default.
    cell_size, step
        m and s.
    tolerance
        Of each time step, of the coarse cell size.
    dtype
        In which positions and forces are stored.
    validation_share
        Of the training meshes.
    converged_steps
        Steps by which the time-converged reference of the evaluation split divides
        ``step``; 0 leaves it out.
    finest_meshes
        On so many meshes of the evaluation split, a run with cells half as long as the
        reference's tells how exact it is.
    """

    name: Name
    seed: Annotated[int, Field(strict=True, ge=0, le=2**63)]
    family: FamilyName
    setting: Literal["as-published", "exact"]
    coarse_nodes: tuple[PositiveCount, PositiveCount] | None = None
    cell_size: Positive = 0.05
    step: Positive = 0.01
    frames: PositiveCount
    tolerance: Annotated[float, Field(strict=True, gt=0, lt=0.1)] = 1e-5
    dtype: Literal["float32", "float64"] = "float32"
    material: MaterialRange
    motion: MotionRange
    reference: Reference = Reference()
    converged_steps: Annotated[int, Field(strict=True, ge=0, le=256)] = 0
    finest_meshes: Count = 0
    training: Split
    evaluation: Split
    validation_share: Share = 0.1
    extra: tuple[ExtraSplit, ...] = ()

    @model_validator(mode="after")
    def _names(self) -> DatasetConfig:
        names = [split.name for split in self.extra]
        if len(set(names)) != len(names) or set(names) & {TRAINING, VALIDATION, EVALUATION}:
            raise ValueError("expected each extra split to have a name of its own")
        return self

    def hash(self) -> str:
        """SHA-256 of the configuration's content."""
        content: Any = self.model_dump(mode="json")
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
