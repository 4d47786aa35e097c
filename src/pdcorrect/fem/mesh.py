"""Hexahedral meshes as arrays: construction, exact refinement, quality.

All cells are in VTK order (bottom face 0-1-2-3 counter-clockwise seen from
above, then the top face 4-5-6-7).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pdcorrect.errors import MeshError, PdcorrectWarning
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.mesh_checks import (
    check_arrays,
    check_cells,
    check_connections,
    check_repetitions,
    face_groups,
    row_groups,
)


class Group(NamedTuple):
    """A named part of a mesh, such as a physical group of Gmsh or a set of Abaqus.

    Attributes
    ----------
    cells : (n,) int
    faces : (m, 2) int
        Cells, and which of their `VTK_FACES`.
    nodes : (k,) int
        Those that are not there as nodes of the cells and faces.
    """

    cells: NDArray[np.int64]
    faces: NDArray[np.int64]
    nodes: NDArray[np.int64]

    def refined(self, weights: sp.csr_matrix, k: int) -> Group:
        """The same part of the mesh refined, whose `interpolation` has these weights."""
        layer = np.moveaxis(np.indices((k, k, k)), 0, -1).reshape(-1, 3)  # (k^3, 3)
        cell, side = self.faces.T
        touching = layer[:, side // 2] == (k - 1) * (side % 2)  # (k^3, m)
        child, face = np.nonzero(touching)
        return Group(
            (self.cells[:, None] * k**3 + np.arange(k**3)).ravel(),
            np.stack([cell[face] * k**3 + child, side[face]], axis=1),
            np.flatnonzero(_all_corners(weights, self.nodes)) if len(self.nodes) else self.nodes,
        )


@dataclass(frozen=True, eq=False)
class HexMesh:
    """Nodes (N, 3) in metres and cells (C, 8) in VTK order.

    Attributes
    ----------
    coarse_nodes : (Nc,) int
        For each node of the unrefined mesh, the node at the same place here.
    groups : dict of Group
        By name, of a mesh from a file.
    from_coarse : (N, Nc) sparse, optional
        Of a refined mesh, the weights of the unrefined mesh's nodes at each node.
    """

    positions: NDArray[np.float64]
    cells: NDArray[np.int64]
    coarse_nodes: NDArray[np.int64]
    groups: Mapping[str, Group] = field(default_factory=dict)
    from_coarse: sp.csr_matrix | None = None

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

    def refined_nodes(self, coarse: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which nodes (N,) belong to ``coarse`` nodes of the unrefined mesh.

        A new node does if all corners of the cell, face or edge do in which it lies.
        """
        if self.from_coarse is not None:
            return _all_corners(self.from_coarse, coarse)
        return np.isin(np.arange(len(self.positions)), coarse)

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
    """Mesh of the ``solid`` (nx, ny, nz) cells of a regular grid of ``cell_size``, m.

    Grid node ``origin_index`` is placed at ``origin``, m.  Nodes are numbered by x, then y, then z
    (z fastest), unused ones left out.
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

    Coincident new nodes are recognised by their exact integer weights on the cells' corners,
    never by distance, so any conforming mesh refines exactly.
    """
    if k == 1:
        return mesh
    corner, weight, inverse = _lattice(mesh, k)
    weights = _interpolation(mesh, corner, weight, k)
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
        {name: group.refined(weights, k) for name, group in mesh.groups.items()},
        weights if mesh.from_coarse is None else sp.csr_matrix(weights @ mesh.from_coarse),
    )


def _interpolation(
    mesh: HexMesh, corner: NDArray[np.int64], weight: NDArray[np.int64], k: int
) -> sp.csr_matrix:
    rows, columns = np.nonzero(weight)
    values = weight[rows, columns] / k**3
    shape = (len(weight), len(mesh.positions))
    return sp.csr_matrix((values, (rows, corner[rows, columns])), shape=shape)


def _all_corners(weights: sp.csr_matrix, chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which rows (N,) of `interpolation` have weights on ``chosen`` nodes only."""
    others = np.ones(weights.shape[1])
    others[chosen] = 0.0
    return np.asarray(weights @ others == 0.0)


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
    order, starts, counts = row_groups(np.concatenate([corner + 1, weight], axis=1))
    point = np.empty(len(order), dtype=np.int64)
    point[order] = np.repeat(np.arange(len(starts)), counts)
    first = order[starts]
    return corner[first], weight[first], point.reshape(count, -1)


def boundary_faces(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces (n, 4) that belong to one cell only, seen from outside, and those cells (n,)."""
    faces, order, starts, counts = face_groups(cells)
    outer = np.sort(order[starts[counts == 1]])
    return faces[outer], outer // 6


def coincident_nodes(
    points: NDArray[np.float64], targets: NDArray[np.float64], tolerance: float
) -> NDArray[np.int64]:
    """For each of ``targets`` (n, 3) the index of the point within ``tolerance`` (m) of it.

    Raises
    ------
    MeshError
        If there is none.
    """
    distance, index = cKDTree(points).query(targets)
    if distance.max(initial=0.0) > tolerance:
        worst = int(np.argmax(distance))
        raise MeshError(
            f"node {worst} at {targets[worst]} has no coincident node in the finer mesh (the "
            f"nearest is {distance[worst]:.3g} m away): expected a refinement of the same body."
        )
    return np.asarray(index, dtype=np.int64)


_LOCKING = ("hex8", "hex8-mean")
"""Elements without incompatible modes: alone through the thickness, their cells lock in bending."""


def warn_of_thin_cells(element: str, mesh: HexMesh, free: NDArray[np.bool_]) -> None:
    """Warn once if cells of an element without incompatible modes bend alone."""
    if element not in _LOCKING:
        return
    count = int(bending_alone(mesh, free).sum())
    if count:
        warnings.warn(
            f"element {element!r}: {count} of {len(mesh.cells)} cells are alone through the "
            "thickness and much too stiff in bending: expected 'hex8-enhanced' or finer cells",
            PdcorrectWarning,
            stacklevel=3,
        )


def bending_alone(mesh: HexMesh, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which cells (C,) can bend and have no neighbour on either side along some axis of theirs.

    To bend, a cell has neighbours along another axis, and on both of its faces across this one
    corners that are ``free`` (N, 3) to move along it.
    """
    _, order, starts, counts = face_groups(mesh.cells)
    outer = np.zeros(6 * len(mesh.cells), dtype=bool)
    outer[order[starts[counts == 1]]] = True
    sides = outer.reshape(-1, 3, 2)  # the faces on both ends of each axis
    neighbours = 6 - outer.reshape(-1, 6).sum(axis=1)
    alone = (sides.sum(axis=2) == 2) * (neighbours > 0)[:, None]  # (C, axis)
    thin = np.flatnonzero(alone.any(axis=1))
    corners = mesh.cells[thin]
    axes = np.abs(np.einsum("cki,km->cmi", mesh.positions[corners], 2.0 * VTK_CORNERS - 1.0))
    along = axes > 0.5 * axes.max(axis=2, keepdims=True)  # (c, axis, component)
    may = np.einsum("cki,cmi->ckm", free[corners].astype(int), along.astype(int)) > 0
    low, high = (((end == VTK_CORNERS) * may).any(axis=1) for end in (0, 1))
    found = np.zeros(len(mesh.cells), dtype=bool)
    found[thin] = (alone[thin] * low * high).any(axis=1)
    return found
