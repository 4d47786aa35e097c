"""Bodies: voxel shapes and mesh files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Union

import numpy as np
from pydantic import Field, field_validator, model_validator

from pdcorrect._config import Cells, Count, Positive, PositiveCount, Strict, Vector
from pdcorrect.scene import voxels


class _VoxelBody(Strict):
    cell_size: Positive
    origin: Vector = (0.0, 0.0, 0.0)


class Beam(_VoxelBody):
    """Block of cells along x, y, z with one corner at the origin."""

    shape: Literal["beam"]
    cells: Cells

    def occupancy(self) -> voxels.Occupancy:
        """Solid cells and the index of the cell at the origin, see `pdcorrect.scene.voxels`."""
        return voxels.beam(self.cells)


class Cross(_VoxelBody):
    """Beam along x with two or four perpendicular branches (thesis fig. 6.1)."""

    shape: Literal["cross"]
    cells: Cells
    arms: Literal[2, 4] = 4
    arm_start: Count
    arm_width: PositiveCount = 2
    arm_length: PositiveCount

    def occupancy(self) -> voxels.Occupancy:
        """Solid cells and the index of the cell at the origin, see `pdcorrect.scene.voxels`."""
        return voxels.cross(self.cells, self.arms, self.arm_start, self.arm_width, self.arm_length)


class Weight(_VoxelBody):
    """Support beams, a pendulum, and its inflated part (thesis fig. 6.2)."""

    shape: Literal["weight"]
    support_cells: Cells
    second_support_length: Count = 0
    pendulum_start: Count
    pendulum_cells: Cells
    weight_start: Count
    weight_cells: Cells

    def occupancy(self) -> voxels.Occupancy:
        """Solid cells and the index of the cell at the origin, see `pdcorrect.scene.voxels`."""
        return voxels.weight(
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

    def occupancy(self) -> voxels.Occupancy:
        """Solid cells and the index of the cell at the origin, see `pdcorrect.scene.voxels`."""
        return voxels.voxels(np.array(self.occupancy_list))


class MeshFile(Strict):
    """Hexahedral mesh from a file that meshio reads (Gmsh, Abaqus, VTU)."""

    shape: Literal["file"]
    path: Path
    scale: Positive = 1.0

    @field_validator("path")
    @classmethod
    def _possible(cls, path: Path) -> Path:
        if "\0" in str(path):
            raise ValueError("expected a path without the character NUL")
        return path


Body = Annotated[Union[Beam, Cross, Weight, Voxels, MeshFile], Field(discriminator="shape")]
