"""Bodies: voxel shapes and mesh files.

A voxel shape tells which cells of a regular grid are solid, and the index of the grid cell whose
lowest corner lies at ``origin``, so that a shape may extend to lower coordinates.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdcorrect._config import Cells, Count, FilePath, Positive, PositiveCount, Strict, Vector
from pdcorrect.errors import SceneError

_MOST_CELLS = 10**8

Occupancy = tuple[NDArray[np.bool_], tuple[int, int, int]]


def _grid(cells: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Empty grid, if it is of a size that can be meant."""
    if math.prod(cells) > _MOST_CELLS:
        raise SceneError(
            f"body: a grid of {cells[0]} x {cells[1]} x {cells[2]} cells: expected at most "
            f"{_MOST_CELLS:.0e} in all."
        )
    return np.zeros(cells, dtype=bool)


class _AnyBody(Strict):
    name: Annotated[str, Field(min_length=1)] | None = None


class _VoxelBody(_AnyBody):
    cell_size: Positive
    origin: Vector = (0.0, 0.0, 0.0)


class Beam(_VoxelBody):
    """Block of cells along x, y, z with one corner at the origin."""

    shape: Literal["beam"]
    cells: Cells

    def occupancy(self) -> Occupancy:
        """Solid cells (nx, ny, nz) and the index of the cell at the origin."""
        return _grid(self.cells) | True, (0, 0, 0)


class Cross(_VoxelBody):
    """Beam along x with symmetric perpendicular branches (thesis fig. 6.1).

    Attributes
    ----------
    cells
        Of the central beam along x, y, z; its corner is the origin.
    arms
        2: branches along +z and -z; 4: along +y and -y as well.
    arm_start, arm_width
        The branches cover the cells ``arm_start <= i < arm_start + arm_width`` along x.
    arm_length
        Cells by which each branch sticks out of the beam.
    """

    shape: Literal["cross"]
    cells: Cells
    arms: Literal[2, 4] = 4
    arm_start: Count
    arm_width: PositiveCount = 2
    arm_length: PositiveCount

    def occupancy(self) -> Occupancy:
        """Solid cells (nx, ny, nz) and the index of the cell at the origin."""
        nx, ny, nz = self.cells
        end, length = self.arm_start + self.arm_width, self.arm_length
        if end > nx:
            raise SceneError(
                f"body.arm_start + body.arm_width = {end}: expected at most the {nx} cells of the "
                "beam along x. Move the arms or lengthen the beam."
            )
        side = length if self.arms == 4 else 0
        solid = _grid((nx, ny + 2 * side, nz + 2 * length))
        beam_y, beam_z = slice(side, side + ny), slice(length, length + nz)
        arm_x = slice(self.arm_start, end)
        solid[:, beam_y, beam_z] = True
        solid[arm_x, beam_y, :] = True
        if self.arms == 4:
            solid[arm_x, :, beam_z] = True
        return solid, (0, side, length)


class Weight(_VoxelBody):
    """One or two support beams and a pendulum with an inflation (thesis fig. 6.2).

    The first support lies along x with a corner at the origin.  A second one, if any, crosses it
    along y, centred on it, at the place of the pendulum.  The pendulum hangs below (towards -z)
    and carries the inflated part.

    Attributes
    ----------
    support_cells
        Of the first support along x, y, z.
    second_support_length
        Cells of the second support along y; 0 leaves it out.
    pendulum_start
        First cell of the pendulum, and of the second support, along x.
    pendulum_cells
        Of the pendulum along x, y and downwards.
    weight_start
        Cells between the support and the inflated part.
    weight_cells
        Of the inflated part along x, y and downwards, centred on the pendulum.
    """

    shape: Literal["weight"]
    support_cells: Cells
    second_support_length: Count = 0
    pendulum_start: Count
    pendulum_cells: Cells
    weight_start: Count
    weight_cells: Cells

    def occupancy(self) -> Occupancy:
        """Solid cells (nx, ny, nz) and the index of the cell at the origin."""
        self._check()
        (sx, sy, sz), (px, py, pz) = self.support_cells, self.pendulum_cells
        wx, wy, wz = self.weight_cells
        start, second = self.pendulum_start, self.second_support_length
        half_x = (wx - px) // 2
        left, right = max(0, half_x - start), max(0, start + px + half_x - sx)
        width = max(sy, py, wy, second)
        solid = _grid((left + sx + right, width, sz + pz))

        def centred(size: int) -> slice:
            first = (width - size) // 2
            return slice(first, first + size)

        x0 = left + start
        solid[left : left + sx, centred(sy), pz:] = True
        if second:
            solid[x0 : x0 + px, centred(second), pz:] = True
        solid[x0 : x0 + px, centred(py), :pz] = True
        top = pz - self.weight_start
        solid[x0 - half_x : x0 + px + half_x, centred(wy), top - wz : top] = True
        return solid, (left, (width - sy) // 2, pz)

    def _check(self) -> None:
        support, pendulum, inflated = self.support_cells, self.pendulum_cells, self.weight_cells
        end = self.pendulum_start + pendulum[0]
        if end > support[0]:
            raise SceneError(
                f"body.pendulum_start + body.pendulum_cells[0] = {end}: expected at most the "
                f"{support[0]} cells of the support along x."
            )
        end = self.weight_start + inflated[2]
        if end > pendulum[2]:
            raise SceneError(
                f"body.weight_start + body.weight_cells[2] = {end}: expected at most the "
                f"{pendulum[2]} cells of the pendulum downwards."
            )
        for axis, name in enumerate("xy"):
            excess = inflated[axis] - pendulum[axis]
            if excess < 0 or excess % 2:
                raise SceneError(
                    f"body.weight_cells[{axis}] = {inflated[axis]}: expected the pendulum's "
                    f"{pendulum[axis]} cells along {name} plus an even number, so that the "
                    "inflated part is centred."
                )
        second, wide = self.second_support_length, support[1]
        for name, size in (("pendulum_cells[1]", pendulum[1]), ("second_support_length", second)):
            if size and (size - wide) % 2:
                raise SceneError(
                    f"body.{name} = {size}: expected the support's {wide} cells along y plus or "
                    "minus an even number, so that it is centred."
                )


class Voxels(_VoxelBody):
    """Any set of grid cells: a nested list ``occupancy[x][y][z]`` of 0 and 1.

    Or the path of a NumPy file (``.npy``) of such an array, in which all but 0 is solid; the cells
    with one number are a group of that name.
    """

    shape: Literal["voxels"]
    given: tuple[tuple[tuple[Literal[0, 1], ...], ...], ...] | FilePath = Field(alias="occupancy")

    @model_validator(mode="after")
    def _rectangular(self) -> Voxels:
        if isinstance(self.given, Path):
            return self
        widths = {len(plane) for plane in self.given}
        depths = {len(row) for plane in self.given for row in plane}
        if len(widths) != 1 or len(depths) != 1:
            raise ValueError("expected all planes and rows of occupancy to have the same length")
        return self

    def occupancy(self) -> Occupancy:
        """Solid cells (nx, ny, nz), the corner at the origin."""
        if isinstance(self.given, Path):
            solid = _read(self.given)
            solid = _grid(solid.shape) | (solid != 0)
        else:
            solid = np.array(self.given, dtype=bool)
        if not solid.any():
            raise SceneError("body.occupancy has no solid cells: expected at least one 1.")
        return solid, (0, 0, 0)

    def labels(self) -> NDArray[np.integer[Any]] | None:
        """The whole numbers (nx, ny, nz) of a file; None where there are but 0 and 1."""
        labels = _read(self.given) if isinstance(self.given, Path) else None
        return None if labels is None or labels.dtype.kind == "b" else labels


def _read(path: Path) -> NDArray[Any]:
    """What a NumPy file holds, whole numbers or truth values (nx, ny, nz)."""
    try:
        array = np.load(path, allow_pickle=False, mmap_mode="r")
        shape, kind = array.shape, array.dtype.kind
    except Exception as error:  # NumPy raises nearly every type on damaged bytes
        told = getattr(error, "strerror", None) or error
        raise SceneError(
            f"body.occupancy = {str(path)!r} cannot be read ({told}): expected a NumPy file, .npy."
        ) from None
    if len(shape) != 3 or kind not in "biu":
        raise SceneError(
            f"body.occupancy = {str(path)!r} holds {array.dtype} of shape {shape}: expected whole "
            "numbers or truth values of shape (x, y, z)."
        )
    return array


class MeshFile(_AnyBody):
    """Hexahedral mesh from a file (Gmsh, Abaqus, VTK, and what meshio reads)."""

    shape: Literal["file"]
    path: FilePath
    scale: Positive = 1.0


Body = Annotated[Union[Beam, Cross, Weight, Voxels, MeshFile], Field(discriminator="shape")]
