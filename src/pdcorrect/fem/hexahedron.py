"""The trilinear hexahedron: corners, faces and edges in VTK order, its Jacobian.

Bottom face 0-1-2-3 counter-clockwise seen from above, then the top face
4-5-6-7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

VTK_CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
"""Corners of the unit cell in VTK order, (8, 3)."""

VTK_FACES = np.array(
    [[0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]]
)
"""Corners of the six faces, counter-clockwise seen from outside, (6, 4)."""

VTK_EDGES = np.array(
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]]
)
"""Corners of the twelve edges, (12, 2)."""

VTK_NODES = np.concatenate(
    [
        VTK_CORNERS,
        VTK_CORNERS[VTK_EDGES].mean(axis=1),
        VTK_CORNERS[VTK_FACES].mean(axis=1),
        [[0.5, 0.5, 0.5]],
    ]
)
"""Nodes of VTK's 27-node hexahedron on the unit cell, (27, 3)."""

_CHUNK = 4096
"""Cells whose Jacobians are computed at a time, to stay in the cache."""


def gauss_points(n: int) -> NDArray[np.float64]:
    """Points of the n x n x n Gauss rule in the unit cell, (n^3, 3)."""
    line = (np.polynomial.legendre.leggauss(n)[0] + 1) / 2
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)


def shape_derivatives(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """dN_k/dxi_j of the trilinear shape functions, (3, P, 8), at ``points`` (P, 3)."""
    at = points[:, None]  # (P, 1, 3)
    factors = np.where(VTK_CORNERS == 1, at, 1 - at)  # (P, 8, 3)
    slopes = 2.0 * VTK_CORNERS - 1
    shape = np.empty((3, len(points), 8))
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        shape[axis] = slopes[:, axis] * factors[..., others].prod(axis=-1)
    return shape


def jacobians(
    positions: NDArray[np.float64], cells: NDArray[np.int64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Determinant of the trilinear map at ``points`` (P, 3) of the unit cell, (C, P), m3."""
    shape = shape_derivatives(points)
    result = np.empty((len(cells), len(points)))
    for start in range(0, len(cells), _CHUNK):
        corners = positions[cells[start : start + _CHUNK]].transpose(2, 1, 0)  # (3, 8, c)
        a, b, c = (np.matmul(shape[axis], corners) for axis in range(3))  # (3, P, c) each
        result[start : start + _CHUNK] = (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        ).T
    return result


def corner_jacobians(
    positions: NDArray[np.float64], cells: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Determinant of the trilinear map at the corners, (C, 8), m3.

    For cubes it is the cell volume; it is positive at all corners of a usable
    cell.
    """
    return jacobians(positions, cells, VTK_CORNERS.astype(np.float64))


def shortest_edges(positions: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Length of each cell's shortest edge, (C,), m."""
    shortest = np.full(len(cells), np.inf)
    for one, other in VTK_EDGES:
        edge = positions[cells[:, one]] - positions[cells[:, other]]
        np.minimum(shortest, np.einsum("ci,ci->c", edge, edge), out=shortest)
    return np.sqrt(shortest)
