"""`Scene`: everything a simulation is told, from TOML or from memory.

A scene is plain, validated data: SI units, no arrays, no mesh.  `discretise`
turns it into a `Problem`.  Unknown keys are refused and every message names the
key, the value, and what was expected.  `docs/scene.md` lists all keys.
"""

from __future__ import annotations

import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from pdcorrect import shapes
from pdcorrect.errors import SceneError

Axis = Literal["x", "y", "z"]
Vector = tuple[float, float, float]
PositiveCount = Annotated[int, Field(ge=1)]
Cells = tuple[PositiveCount, PositiveCount, PositiveCount]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# --- regions -----------------------------------------------------------------


class Region(_Strict):
    """A set of points: exactly one of a plane, a box, a sphere, nodes, everything.

    Attributes
    ----------
    plane, at
        Points with coordinate ``plane`` equal to ``at`` (m, or "min" / "max" of
        the body).
    box
        Lowest and highest corner, m.
    sphere, radius
        Centre and radius, m.
    nodes
        Node numbers of the coarse mesh; on refined meshes the same points.
    everywhere
        The whole body.
    """

    plane: Axis | None = None
    at: Annotated[float | Literal["min", "max"] | None, Field(union_mode="left_to_right")] = None
    box: tuple[Vector, Vector] | None = None
    sphere: Vector | None = None
    radius: Positive | None = None
    nodes: tuple[Annotated[int, Field(ge=0)], ...] | None = None
    everywhere: Literal[True] | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Region:
        kinds = [k for k in ("plane", "box", "sphere", "nodes", "everywhere") if getattr(self, k)]
        if len(kinds) != 1:
            raise ValueError(
                "expected exactly one of plane (with at), box, sphere (with radius), nodes, "
                f"everywhere; got {kinds or 'none'}"
            )
        if (self.plane is None) != (self.at is None):
            raise ValueError('expected plane and at together, such as { plane = "x", at = 0.0 }')
        if (self.sphere is None) != (self.radius is None):
            raise ValueError("expected sphere and radius together")
        return self

    def contains(
        self, points: NDArray[np.float64], tolerance: float, bounds: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Which of ``points`` (n, 3) lie in a geometric region, as (n,) bool.

        ``tolerance`` (m) widens the region; ``bounds`` (2, 3) are the body's
        lowest and highest coordinates, for ``at = "min" | "max"``.  A region of
        node numbers is resolved by the caller, who knows the numbering.
        """
        if self.everywhere:
            return np.ones(len(points), dtype=bool)
        if self.plane is not None:
            axis = "xyz".index(self.plane)
            low, high = bounds[:, axis]
            at = {"min": low, "max": high}[self.at] if isinstance(self.at, str) else self.at
            return np.abs(points[:, axis] - np.float64(at)) <= tolerance
        if self.box is not None:
            low, high = np.sort(np.asarray(self.box), axis=0)
            inside = (points >= low - tolerance) & (points <= high + tolerance)
            return inside.all(axis=1)
        if self.sphere is not None and self.radius is not None:
            distance = np.linalg.norm(points - np.asarray(self.sphere), axis=1)
            return distance <= self.radius + tolerance
        raise SceneError("a region of node numbers has no geometry to test points against")

    def describe(self) -> str:
        """The region as it would stand in the file, for messages."""
        return str({k: v for k, v in self.model_dump().items() if v is not None})


# --- body --------------------------------------------------------------------


class _VoxelBody(_Strict):
    cell_size: Positive
    origin: Vector = (0.0, 0.0, 0.0)


class Beam(_VoxelBody):
    """Block of cells along x, y, z with one corner at the origin."""

    shape: Literal["beam"]
    cells: Cells

    def occupancy(self) -> shapes.Occupancy:
        """Solid cells and the index of the cell at the origin, see `shapes`."""
        return shapes.beam(self.cells)


class Cross(_VoxelBody):
    """Beam along x with two or four perpendicular branches (thesis fig. 6.1)."""

    shape: Literal["cross"]
    cells: Cells
    arms: Literal[2, 4] = 4
    arm_start: Annotated[int, Field(ge=0)]
    arm_width: PositiveCount = 2
    arm_length: PositiveCount

    def occupancy(self) -> shapes.Occupancy:
        """Solid cells and the index of the cell at the origin, see `shapes`."""
        return shapes.cross(self.cells, self.arms, self.arm_start, self.arm_width, self.arm_length)


class Weight(_VoxelBody):
    """Support beams, a pendulum, and its inflated part (thesis fig. 6.2)."""

    shape: Literal["weight"]
    support_cells: Cells
    second_support_length: Annotated[int, Field(ge=0)] = 0
    pendulum_start: Annotated[int, Field(ge=0)]
    pendulum_cells: Cells
    weight_start: Annotated[int, Field(ge=0)]
    weight_cells: Cells

    def occupancy(self) -> shapes.Occupancy:
        """Solid cells and the index of the cell at the origin, see `shapes`."""
        return shapes.weight(
            self.support_cells,
            self.second_support_length,
            self.pendulum_start,
            self.pendulum_cells,
            self.weight_start,
            self.weight_cells,
        )


class Voxels(_VoxelBody):
    """Any set of grid cells: a nested list ``occupancy[x][y][z]`` of 0 and 1."""

    shape: Literal["voxels"]
    occupancy_list: tuple[tuple[tuple[Literal[0, 1], ...], ...], ...] = Field(alias="occupancy")

    @model_validator(mode="after")
    def _rectangular(self) -> Voxels:
        widths = {len(plane) for plane in self.occupancy_list}
        depths = {len(row) for plane in self.occupancy_list for row in plane}
        if len(widths) != 1 or len(depths) != 1:
            raise ValueError("expected all planes and rows of occupancy to have the same length")
        return self

    def occupancy(self) -> shapes.Occupancy:
        """Solid cells and the index of the cell at the origin, see `shapes`."""
        return shapes.voxels(np.array(self.occupancy_list))


class MeshFile(_Strict):
    """Hexahedral mesh from a file that meshio reads (Gmsh, Abaqus, VTU)."""

    shape: Literal["file"]
    path: Path
    scale: Positive = 1.0


Body = Annotated[Union[Beam, Cross, Weight, Voxels, MeshFile], Field(discriminator="shape")]


# --- material ----------------------------------------------------------------


class EffectiveModuli(_Strict):
    """What the energy amounts to at small strain: E in Pa, Poisson's ratio."""

    young: float
    poisson: float


class Material(_Strict):
    """Elastic material: corotated energy with an independent volume term.

    The energy density is ``mu |F - R|^2 + omega/2 |F - V|^2`` (section 3 of the
    theory page) with ``mu = E / (2 (1 + nu))`` and
    ``lambda = E nu / ((1 + nu) (1 - 2 nu))``.

    Attributes
    ----------
    energy
        "corotated" (both terms), "corotated-only" or "volume-only".
    volume_weight
        "lame": omega = 3 lambda, which gives the E and nu asked for.
        "published": omega = lambda, DiffPD's rule.
    young, poisson, density
        Pa, dimensionless in [0, 0.5), kg/m3.
    """

    energy: Literal["corotated", "corotated-only", "volume-only"] = "corotated"
    volume_weight: Literal["lame", "published"] = "lame"
    young: Positive
    poisson: Annotated[float, Field(ge=0, lt=0.5)]
    density: Positive

    @property
    def mu(self) -> float:
        """Shear modulus, Pa."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def lam(self) -> float:
        """First Lame parameter, Pa."""
        return self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    @property
    def effective(self) -> EffectiveModuli:
        """Young's modulus and Poisson's ratio that the energy really has.

        For small strain ``|F - V|^2 = tr(eps)^2 / 3``, so the volume term acts
        as a first Lame parameter ``omega / 3``.
        """
        mu = 0.0 if self.energy == "volume-only" else self.mu
        lam = 0.0 if self.energy == "corotated-only" else self.lam
        lam = lam if self.volume_weight == "lame" else lam / 3
        total = lam + mu
        if total == 0:
            return EffectiveModuli(young=0.0, poisson=0.0)
        return EffectiveModuli(young=mu * (3 * lam + 2 * mu) / total, poisson=lam / (2 * total))


class MaterialRegion(_Strict):
    """Other values of the material in part of the body (cells by their centre)."""

    region: Region
    young: Positive | None = None
    poisson: Annotated[float, Field(ge=0, lt=0.5)] | None = None
    density: Positive | None = None


# --- clamps ------------------------------------------------------------------


class Motion(_Strict):
    """Prescribed motion of a clamp: piecewise linear tables over time.

    Attributes
    ----------
    times
        Increasing, s.  Before the first and after the last the motion rests.
    displacement
        One vector (m) for each time.
    rotation
        One angle (degrees) for each time, about ``axis`` through ``centre``.
    """

    times: tuple[float, ...] = Field(min_length=1)
    displacement: tuple[Vector, ...] | None = None
    rotation: tuple[float, ...] | None = None
    axis: Axis = "x"
    centre: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _tables_match(self) -> Motion:
        if any(b <= a for a, b in pairwise(self.times)):
            raise ValueError("expected motion.times to increase")
        if self.displacement is None and self.rotation is None:
            raise ValueError("expected motion.displacement or motion.rotation")
        for name in ("displacement", "rotation"):
            table = getattr(self, name)
            if table is not None and len(table) != len(self.times):
                raise ValueError(
                    f"expected motion.{name} to have the {len(self.times)} entries of "
                    f"motion.times, got {len(table)}"
                )
        return self


class Clamp(_Strict):
    """Nodes of a region whose named components are held, or moved.

    ``components = ["z"]`` makes a roller; without ``motion`` the nodes are held
    at their rest positions.
    """

    region: Region
    components: tuple[Axis, ...] = Field(default=("x", "y", "z"), min_length=1)
    motion: Motion | None = None


# --- loads -------------------------------------------------------------------


class _Load(_Strict):
    """Common to all loads: how strong they are at a time.

    The load's value is multiplied by an amplitude: 1 inside ``window`` (s) and
    0 outside, rising linearly during the first ``ramp`` seconds of the window;
    or given by ``table`` = [[time, amplitude], ...], piecewise linear.  A time
    step uses the mean amplitude over the step, so an impulse does not depend on
    the step size.
    """

    window: tuple[float, float] | None = None
    ramp: NonNegative = 0.0
    table: tuple[tuple[float, float], ...] | None = None

    @model_validator(mode="after")
    def _amplitude(self) -> _Load:
        if self.window is not None and self.window[0] >= self.window[1]:
            raise ValueError(f"expected window = [start, end] with start < end, got {self.window}")
        if self.table is not None:
            if self.window is not None or self.ramp:
                raise ValueError("expected either table, or window and ramp, not both")
            times = [row[0] for row in self.table]
            if len(times) < 2 or any(b <= a for a, b in pairwise(times)):
                raise ValueError("expected table to have two or more rows with increasing times")
        return self


class Gravity(_Load):
    """Uniform acceleration (m/s2) of the whole body."""

    kind: Literal["gravity"]
    acceleration: Vector


class BodyForce(_Load):
    """Uniform force density (N/m3) in the cells of a region."""

    kind: Literal["body-force"]
    density: Vector
    region: Region = Region(everywhere=True)


class Force(_Load):
    """Total force (N) on a region.

    ``distribution = "consistent"`` spreads it evenly over the boundary faces of
    a plane region, over the cells of any other.  ``"nodal"`` divides it equally
    among the *coarse* nodes of the region, on every mesh: the thesis's loads,
    which have no limit under refinement.
    """

    kind: Literal["force"]
    force: Vector
    region: Region
    distribution: Literal["consistent", "nodal"] = "consistent"


class Traction(_Load):
    """Force for each unit of rest area (Pa) on the boundary faces of a region."""

    kind: Literal["traction"]
    traction: Vector
    region: Region


class Pressure(_Load):
    """Pressure (Pa, positive pushes inwards) on the boundary faces of a region.

    ``follower = true`` uses the faces' current area and normal at the start of
    each step; otherwise those at rest.
    """

    kind: Literal["pressure"]
    pressure: float
    region: Region
    follower: bool = False


class Torsion(_Load):
    """The rotational field of the thesis, eq. 6-1 to 6-3, about an axis along x.

    With y and z measured from ``centre``: f = (stretch, -z - attraction y,
    y - attraction z), normalised to length ``strength`` (0 where f = 0).

    ``distribution = "consistent"``: strength is a force density, N/m3,
    integrated with Gauss points.  ``"nodal"``: strength is the force on each
    coarse node, N.  ``follower = true`` samples the field at the positions at
    the start of each step instead of at rest.
    """

    kind: Literal["torsion"]
    strength: float
    attraction: float = 0.0
    stretch: float = 0.0
    centre: Vector | None = None
    region: Region = Region(everywhere=True)
    distribution: Literal["consistent", "nodal"] = "consistent"
    follower: bool = False


Load = Annotated[
    Union[Gravity, BodyForce, Force, Traction, Pressure, Torsion], Field(discriminator="kind")
]


# --- time, solver, scene ------------------------------------------------------


class Time(_Strict):
    """Step size (s) and number of frames; one frame is one step."""

    step: Positive
    frames: PositiveCount


class Solver(_Strict):
    """Discretisation and accuracy.

    Attributes
    ----------
    mass
        "lumped" (row sums), "averaged", "consistent", or "per-node" (density
        times cell volume on every node, as DiffPD; only to reproduce published
        results).
    element
        "hex8": trilinear displacements, 2x2x2 Gauss points.
    tolerance
        Largest accepted estimate of a node's distance from the step's exact
        solution, as a fraction of the coarse cell size.
    """

    mass: Literal["lumped", "averaged", "consistent", "per-node"] = "lumped"
    element: Literal["hex8"] = "hex8"
    tolerance: Annotated[float, Field(gt=0, lt=0.1)] = 1e-5


class Scene(_Strict):
    """A body, its material, how it is held and loaded, and for how long.

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
    material: Material
    materials: tuple[MaterialRegion, ...] = ()
    time: Time
    clamps: tuple[Clamp, ...] = ()
    loads: tuple[Load, ...] = ()
    solver: Solver = Solver()
    _folder: Path = PrivateAttr(default=Path())

    def __init__(self, **data: Any) -> None:
        source = data.pop("__source__", "scene")
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise SceneError(_explain(error, source)) from None

    @field_validator("name")
    @classmethod
    def _named(cls, name: str) -> str:
        if not name.strip():
            raise ValueError("expected a name that is not empty")
        return name

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene from a TOML file; relative paths in it start at its folder.

        Raises
        ------
        SceneError
            If the file cannot be read, is not TOML, or is not a valid scene.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "not a UTF-8 text file"
            raise SceneError(f"{path}: cannot be read ({reason}).") from None
        scene = cls.from_toml(text, source=str(path))
        scene._folder = path.parent
        return scene

    @classmethod
    def from_toml(cls, text: str, source: str = "scene") -> Scene:
        """Read a scene from TOML text; ``source`` names it in messages."""
        try:
            data = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise SceneError(f"{source}: not valid TOML: {error}.") from None
        return cls(**data, __source__=source)

    def to_toml(self) -> str:
        """The scene as TOML, with every default written out."""
        data = self.model_dump(mode="json", exclude_none=True, by_alias=True)
        return tomli_w.dumps(data)

    def resolve(self, path: Path) -> Path:
        """A path of this scene, relative ones from the scene file's folder."""
        return path if path.is_absolute() else self._folder / path

    def with_changes(self, **sections: Any) -> Scene:
        """The same scene with some sections' keys replaced.

        Examples
        --------
        ``scene.with_changes(material={"poisson": 0.3}, time={"frames": 5})``
        """
        data = self.model_dump(mode="python", exclude_none=True, by_alias=True)
        for section, change in sections.items():
            if isinstance(change, dict) and isinstance(data.get(section), dict):
                data[section] = {**data[section], **change}
            else:
                data[section] = change
        changed = Scene(**data)
        changed._folder = self._folder
        return changed


def _explain(error: ValidationError, source: str) -> str:
    """One paragraph: each wrong key, its value, and what was expected."""
    sentences: list[str] = []
    for item in error.errors():
        key = _key(item["loc"])
        if item["type"] == "extra_forbidden":
            sentences.append(f"{key}: unknown key; remove it or check its spelling.")
        elif item["type"] == "missing":
            sentences.append(f"{key}: missing; a value is required.")
        else:
            message = item["msg"].removeprefix("Value error, ")
            value = repr(item["input"])
            value = value if len(value) < 80 else value[:77] + "..."
            sentences.append(f"{key} = {value}: {message[0].lower() + message[1:]}.")
    return " ".join(f"{source}: {' '.join(dict.fromkeys(sentences))}".split())


def _key(location: tuple[int | str, ...]) -> str:
    """Dotted key as the user wrote it: pydantic also names the union member it chose."""
    parts = [str(part) for part in location]
    tag_at = {"body": 1, "loads": 2}.get(parts[0], len(parts)) if parts else 0
    parts = parts[:tag_at] + parts[tag_at + 1 :]
    if len(parts) > 1 and parts[-2] == "at":
        parts.pop()
    text = "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in parts)
    return text.lstrip(".") or "the scene"
