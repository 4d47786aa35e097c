"""Hexahedral meshes as arrays: construction, exact refinement, quality.

All cells are in VTK order (bottom face 0-1-2-3 counter-clockwise seen from
above, then the top face 4-5-6-7).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pdcorrect.errors import MeshError
from pdcorrect.fem.hexahedron import VTK_CORNERS, VTK_EDGES, VTK_FACES, corner_jacobians
from pdcorrect.fem.mesh_checks import (
    check_arrays,
    check_cells,
    check_connections,
    check_repetitions,
    face_groups,
)

__all__ = [
    "VTK_CORNERS",
    "VTK_EDGES",
    "VTK_FACES",
    "HexMesh",
    "boundary_faces",
    "coincident_nodes",
    "corner_jacobians",
    "refine",
    "voxel_mesh",
]


@dataclass(frozen=True, eq=False)
class HexMesh:
    """Nodes (N, 3) in metres and cells (C, 8) in VTK order.

    Attributes
    ----------
    coarse_nodes : (Nc,) int
        For each node of the unrefined mesh, the node at the same place here.
    """

    positions: NDArray[np.float64]
    cells: NDArray[np.int64]
    coarse_nodes: NDArray[np.int64]

    @classmethod
    def create(cls, positions: NDArray[np.float64], cells: NDArray[np.int64]) -> HexMesh:
        """Check the arrays and build an unrefined mesh.

        Raises
        ------
        MeshError
            If shapes or indices are wrong, a cell is collapsed, repeated or
            inverted, nodes are duplicate or hanging, or cells overlap at a
            face; names the place.
        """
        positions = np.ascontiguousarray(positions, dtype=np.float64)
        cells = np.ascontiguousarray(cells, dtype=np.int64)
        check_arrays(positions, cells)
        check_repetitions(positions, cells)
        check_cells(positions, cells)
        check_connections(positions, cells)
        return cls(positions, cells, np.arange(len(positions)))

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """Mean of each cell's corners, (C, 3)."""
        centres = self.positions[self.cells].mean(axis=1)
        centres.flags.writeable = False
        return np.asarray(centres)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest coordinates, (2, 3)."""
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])


def voxel_mesh(
    solid: NDArray[np.bool_],
    origin_index: tuple[int, int, int],
    cell_size: float,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> HexMesh:
    """Mesh of the solid cells of a regular grid.

    Parameters
    ----------
    solid : (nx, ny, nz) bool
    origin_index : tuple of int
        Grid node that is placed at ``origin``.
    cell_size : float
        m.
    origin : tuple of float
        m.

    Nodes are numbered by x, then y, then z (z fastest), unused ones left out.
    """
    index = np.argwhere(solid)  # (C, 3)
    grid = np.array(solid.shape) + 1
    corners = index[:, None, :] + VTK_CORNERS  # (C, 8, 3)
    flat = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), tuple(grid))
    used, cells = np.unique(flat, return_inverse=True)
    nodes = np.stack(np.unravel_index(used, tuple(grid)), axis=1) - np.array(origin_index)
    positions = nodes * float(cell_size) + np.array(origin)
    cells = np.ascontiguousarray(cells.reshape(-1, 8), dtype=np.int64)
    # Cells of a grid are conforming by construction: only sizes can be wrong.
    check_arrays(positions, cells)
    check_cells(positions, cells, VTK_CORNERS.astype(np.float64))
    return HexMesh(positions, cells, np.arange(len(positions)))


def refine(mesh: HexMesh, k: int) -> HexMesh:
    """Cut each cell into k x k x k by its trilinear map.

    Coincident new nodes of neighbouring cells are recognised by their exact
    integer weights on the cells' corners, never by distance, so any conforming
    hexahedral mesh refines exactly.
    """
    if k == 1:
        return mesh
    corner, weight, inverse = _lattice(mesh, k)
    positions = np.einsum("nk,nki->ni", weight / k**3, mesh.positions[corner])

    is_corner = weight.max(axis=1) == k**3
    coarse_nodes = np.empty(len(mesh.positions), dtype=np.int64)
    coarse_nodes[corner[is_corner].max(axis=1)] = np.flatnonzero(is_corner)
    positions[coarse_nodes] = mesh.positions

    small = np.stack(np.meshgrid(*[np.arange(k)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = np.ravel_multi_index(
        tuple(np.moveaxis(small[:, None] + VTK_CORNERS, -1, 0)), (k + 1,) * 3
    )  # (k^3, 8)
    cells = inverse[:, local].reshape(-1, 8)
    return HexMesh(
        positions,
        np.ascontiguousarray(cells, dtype=np.int64),
        coarse_nodes[mesh.coarse_nodes],
    )


def interpolation(mesh: HexMesh, k: int) -> sp.csr_matrix:
    """Trilinear interpolation from a mesh's nodes to those of ``refine(mesh, k)``, (N, N_c)."""
    if k == 1:
        return sp.eye_array(len(mesh.positions)).tocsr()
    corner, weight, _ = _lattice(mesh, k)
    rows, columns = np.nonzero(weight)
    values = weight[rows, columns] / k**3
    shape = (len(weight), len(mesh.positions))
    return sp.csr_matrix((values, (rows, corner[rows, columns])), shape=shape)


def _lattice(
    mesh: HexMesh, k: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Points of a k x k x k cutting of all cells, each once.

    Corners (N, 8) that a point depends on, its integer weights on them (N, 8), which sum
    to k^3, and the point at each place of each cell's lattice, (C, (k + 1)^3).
    """
    steps = np.arange(k + 1)
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    factors = np.where(VTK_CORNERS[None] == 1, lattice[:, None], k - lattice[:, None])
    weights = factors.prod(axis=-1)  # (L, 8), summing to k^3
    count = len(mesh.cells)

    # A point's key: its corners with non-zero weight, sorted, each with the weight.
    corner = np.where(weights[None] > 0, mesh.cells[:, None, :], -1)  # (C, L, 8)
    weight = np.broadcast_to(weights, corner.shape)
    order = np.argsort(corner, axis=-1)
    corner = np.take_along_axis(corner, order, axis=-1).reshape(-1, 8)
    weight = np.take_along_axis(weight, order, axis=-1).reshape(-1, 8)
    first, inverse = _distinct_rows(np.concatenate([corner + 1, weight], axis=1))
    return corner[first], weight[first], inverse.reshape(count, -1)


def _distinct_rows(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each distinct row of natural numbers (m, even number) is first, and its number.

    In lexicographic order, as `numpy.unique`, but by pairs of columns, which is faster.
    """
    base = np.int64(rows.max()) + 1
    keys = [rows[:, i] * base + rows[:, i + 1] for i in range(0, rows.shape[1], 2)]
    order = np.lexsort(keys[::-1])
    new = np.ones(len(rows), dtype=bool)
    new[1:] = np.any([key[order[1:]] != key[order[:-1]] for key in keys], axis=0)
    inverse = np.empty(len(rows), dtype=np.int64)
    inverse[order] = np.cumsum(new) - 1
    return order[new], inverse


def boundary_faces(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces that belong to one cell only.

    Returns
    -------
    faces : (n, 4) int
        Node numbers, counter-clockwise seen from outside.
    owners : (n,) int
        The cell behind each face.
    """
    faces, order, starts, counts = face_groups(cells)
    outer = np.sort(order[starts[counts == 1]])
    return faces[outer], outer // 6


def coincident_nodes(
    points: NDArray[np.float64], targets: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """For each of ``targets`` (n, 3) the index of the point at the same place.

    Raises
    ------
    MeshError
        If a target has no point within ``tolerance`` (m).
    """
    distance, index = cKDTree(points).query(targets)
    if distance.max(initial=0.0) > tolerance:
        worst = int(np.argmax(distance))
        raise MeshError(
            f"node {worst} at {targets[worst]} has no coincident node in the finer mesh (the "
            f"nearest is {distance[worst]:.3g} m away): expected a refinement of the same body."
        )
    return np.asarray(index, dtype=np.int64)
