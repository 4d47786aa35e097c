"""What a hexahedral mesh must satisfy; every refusal is a `MeshError` that names the place."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pdcorrect.errors import MeshError
from pdcorrect.fem.hexahedron import (
    VTK_CORNERS,
    VTK_FACES,
    gauss_points,
    jacobians,
    shortest_edges,
)

TOLERANCE = 1e-4
"""Of a cell's shortest edge: places nearer than this are the same place."""

_FARTHEST = 1e30
"""Largest coordinate, m, as of the numbers in a scene; their products stay finite."""

_CHECKED_POINTS = np.concatenate([VTK_CORNERS, gauss_points(2), gauss_points(3)])
"""Where the Jacobian must be positive: the corners and both Gauss rules, (43, 3)."""

_LEXICOGRAPHIC = [0, 1, 3, 2, 4, 5, 7, 6]
"""Corners in VTK order, of cells that count them by x, then y, then z."""

_MOST_CANDIDATES = 10**6
"""Pairs of a face and a node that are compared at a time."""


def check_arrays(positions: NDArray[np.float64], cells: NDArray[np.int64]) -> None:
    """Refuse wrong shapes, numbers that are not finite, wrong indices and unused nodes."""
    if positions.ndim != 2 or positions.shape[1] != 3 or cells.ndim != 2 or cells.shape[1] != 8:
        raise MeshError(
            f"nodes {positions.shape} and cells {cells.shape}: expected (N, 3) and (C, 8)."
        )
    if not len(cells):
        raise MeshError("the mesh has no cells: expected at least one hexahedron.")
    usable = (np.abs(positions) <= _FARTHEST).all(axis=1)
    if not usable.all():
        node = int(np.argmin(usable))
        raise MeshError(
            f"node {node} is at {positions[node]}: expected finite coordinates, at most "
            f"{_FARTHEST:g} m from the origin."
        )
    if cells.min() < 0 or cells.max() >= len(positions):
        raise MeshError(
            f"cells refer to nodes {cells.min()} to {cells.max()}: expected 0 to "
            f"{len(positions) - 1}."
        )
    unused = np.flatnonzero(np.bincount(cells.ravel(), minlength=len(positions)) == 0)
    if len(unused):
        raise MeshError(
            f"node {unused[0]} at {positions[unused[0]]} belongs to no cell: expected every "
            "node to be used."
        )


def check_repetitions(positions: NDArray[np.float64], cells: NDArray[np.int64]) -> None:
    """Refuse collapsed cells (a node twice) and cells that come twice."""
    ordered = np.sort(cells, axis=1)
    repeated = ordered[:, 1:] == ordered[:, :-1]
    collapsed = np.flatnonzero(repeated.any(axis=1))
    if len(collapsed):
        cell = int(collapsed[0])
        node = ordered[cell, np.argmax(repeated[cell])]
        raise MeshError(
            f"cell {cell} around {_centre(positions, cells, cell)} contains node {node} more than "
            f"once ({len(collapsed)} such cells): expected eight different nodes."
        )
    order, starts, counts = row_groups(ordered)
    if counts.max() > 1:
        first = starts[np.argmax(counts > 1)]
        one, other = order[first : first + 2]
        raise MeshError(
            f"cells {one} and {other} around {_centre(positions, cells, one)} have the same eight "
            f"nodes ({int((counts > 1).sum())} such places): expected every cell once."
        )


def check_cells(
    positions: NDArray[np.float64],
    cells: NDArray[np.int64],
    points: NDArray[np.float64] = _CHECKED_POINTS,
) -> None:
    """Refuse cells whose trilinear map is not orientation-preserving at ``points`` (P, 3)."""
    jacobian = jacobians(positions, cells, points)
    smallest = jacobian.min(axis=1)
    if smallest.min() > 0:
        return
    cell = int(np.argmin(smallest))
    where = np.round(points[np.argmin(jacobian[cell])], 3).tolist()
    bad = int((smallest <= 0).sum())
    text = (
        f"cell {cell} around {_centre(positions, cells, cell)} is inverted or flat (smallest "
        f"Jacobian {smallest[cell]:.3g} m3, at {where} of the unit cell): expected VTK node "
        "order and a convex cell."
    )
    if bad > 1:
        text += f" {bad} of the {len(cells)} cells are so."
    if 2 * bad > len(cells):
        lexicographic = jacobians(positions, cells[:, _LEXICOGRAPHIC], points).min() > 0
        text += (
            f" Their nodes are in lexicographic order: take {str(_LEXICOGRAPHIC)[1:-1]}."
            if lexicographic
            else " Perhaps the mesh is a mirror image: swap nodes 0-1-2-3 with 4-5-6-7."
        )
    raise MeshError(text)


def check_connections(positions: NDArray[np.float64], cells: NDArray[np.int64]) -> None:
    """Refuse duplicate and hanging nodes and overlapping cells, where the other checks passed."""
    shortest = shortest_edges(positions, cells)
    _check_duplicate_nodes(positions, TOLERANCE * float(shortest.min()))
    outer, faces = _check_faces(positions, cells)
    _check_hanging_nodes(positions, cells, faces, outer // 6, TOLERANCE * shortest[outer // 6])


def face_groups(
    cells: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Faces (6C, 4) of all cells, and those with the same four nodes brought together.

    Face ``f`` of cell ``c`` is row ``6 c + f``, seen from outside; the rest as of `row_groups`.
    """
    faces = cells[:, VTK_FACES].reshape(-1, 4)
    return faces, *row_groups(np.sort(faces, axis=1))


def row_groups(
    rows: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Equal rows of natural numbers (m, even number) brought together, in lexicographic order.

    Order, starts and counts of the groups; by pairs of columns, which is faster than
    `numpy.unique`.
    """
    base = np.int64(rows.max()) + 1
    keys = [rows[:, i] * base + rows[:, i + 1] for i in range(0, rows.shape[1], 2)]
    order = np.lexsort(keys[::-1])
    new = np.ones(len(rows), dtype=bool)
    new[1:] = np.any([key[order[1:]] != key[order[:-1]] for key in keys], axis=0)
    starts = np.flatnonzero(new)
    return order, starts, np.diff(starts, append=len(rows))


def _centre(positions: NDArray[np.float64], cells: NDArray[np.int64], cell: int) -> str:
    return str(positions[cells[cell]].mean(axis=0))


def _check_duplicate_nodes(positions: NDArray[np.float64], tolerance: float) -> None:
    pairs = cKDTree(positions).query_pairs(tolerance, output_type="ndarray")
    if len(pairs):
        one, other = (int(node) for node in pairs[np.lexsort(pairs.T[::-1])[0]])
        raise MeshError(
            f"nodes {one} at {positions[one]} and {other} at {positions[other]} are at the same "
            f"place ({len(pairs)} such pairs), so that the cells there are not connected: "
            "expected one node for each place. Merge them (in Gmsh: `Coherence Mesh;`), or leave "
            "a gap if a cut is meant."
        )


def _check_faces(
    positions: NDArray[np.float64], cells: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Refuse faces shared by three cells or from one side; the outer ones' rows and nodes."""
    faces, order, starts, counts = face_groups(cells)
    if counts.max() > 2:
        group = int(np.argmax(counts > 2))
        rows = order[starts[group] : starts[group] + counts[group]]
        raise MeshError(
            f"the face around {positions[faces[rows[0]]].mean(axis=0)} belongs to the "
            f"{counts[group]} cells {', '.join(str(row // 6) for row in rows)}: expected at most "
            "two, one on each side."
        )
    inner = starts[counts == 2]
    one, other = order[inner], order[inner + 1]
    # Seen from the other side, the same four nodes come in the reverse order.
    ahead = _turned(faces[one])
    folded = np.flatnonzero((ahead != _turned(faces[other])[:, [0, 3, 2, 1]]).any(axis=1))
    if len(folded):
        a, b = one[folded[0]], other[folded[0]]
        raise MeshError(
            f"cells {a // 6} and {b // 6} share the face around {positions[faces[a]].mean(axis=0)} "
            "but lie on the same side of it or join its nodes in different orders: expected one "
            "cell on each side."
        )
    outer = np.sort(order[starts[counts == 1]])
    return outer, faces[outer]


def _turned(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Faces (n, 4) turned until their lowest node comes first."""
    steps = faces.argmin(axis=1)[:, None] + np.arange(4)
    return np.take_along_axis(faces, steps % 4, axis=1)


def _check_hanging_nodes(
    positions: NDArray[np.float64],
    cells: NDArray[np.int64],
    faces: NDArray[np.int64],
    owners: NDArray[np.int64],
    tolerance: NDArray[np.float64],
) -> None:
    """Refuse outer nodes within ``tolerance`` (n,), m, of outer faces (n, 4) of other cells."""
    nodes = np.unique(faces)
    tree = cKDTree(positions[nodes])
    corners = positions[faces]
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1) + tolerance
    near = tree.query_ball_point(centres, radii, return_length=True)
    suspects = np.flatnonzero(near > 4)  # more than the face's own corners
    parts = np.cumsum(near[suspects]) // _MOST_CANDIDATES
    for part in np.unique(parts):
        chosen = suspects[parts == part]
        found = tree.query_ball_point(centres[chosen], radii[chosen])
        face = np.repeat(chosen, [len(each) for each in found])
        node = nodes[np.concatenate(found).astype(np.int64)]
        foreign = (cells[owners[face]] != node[:, None]).all(axis=1)
        face, node = face[foreign], node[foreign]
        hanging = _distances(corners[face], positions[node]) <= tolerance[face]
        if hanging.any():
            first = int(np.argmax(hanging))
            cell = int(owners[face[first]])
            raise MeshError(
                f"node {node[first]} at {positions[node[first]]} lies on a face or an edge of "
                f"cell {cell} around {_centre(positions, cells, cell)} without being one of its "
                f"corners (a hanging node; {len(np.unique(node[hanging]))} or more): expected "
                "cells that meet face to face, or a gap if a cut is meant."
            )


def _distances(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n,) of points (n, 3) from bilinear faces (n, 4, 3), m, or more, by Gauss-Newton.

    Exact for points on the face.
    """
    a, b, c, d = np.moveaxis(corners, 1, 0)
    along, across, twist = b - a, d - a, a - b + c - d
    uv = np.full((len(points), 2), 0.5)
    for _ in range(12):
        u, v = uv[:, :1], uv[:, 1:]
        du, dv = along + v * twist, across + u * twist
        gap = points - (a + u * along + v * across + u * v * twist)
        uu, vv, mixed = (du * du).sum(axis=1), (dv * dv).sum(axis=1), (du * dv).sum(axis=1)
        ru, rv = (du * gap).sum(axis=1), (dv * gap).sum(axis=1)
        determinant = np.maximum(uu * vv - mixed**2, 1e-12 * uu * vv + np.finfo(float).tiny)
        step = np.stack([vv * ru - mixed * rv, uu * rv - mixed * ru], axis=1)
        uv = np.clip(uv + step / determinant[:, None], 0, 1)
    u, v = uv[:, :1], uv[:, 1:]
    return np.linalg.norm(points - (a + u * along + v * across + u * v * twist), axis=1)


def connected_parts(cells: NDArray[np.int64], nodes: int) -> NDArray[np.int64]:
    """The number of the part of the mesh to which each node (N,) belongs; cells are (C, K)."""
    edges = np.repeat(cells[:, :1], cells.shape[1] - 1, axis=1).ravel(), cells[:, 1:].ravel()
    graph = sp.coo_array((np.ones(len(edges[0])), edges), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
