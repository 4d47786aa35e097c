"""The graph of a hexahedral mesh: its edges, values at its nodes, its tetrahedra."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.hexahedron import VTK_EDGES, VTK_FACES

Array = NDArray[Any]


def mesh_edges(cells: Array) -> NDArray[np.int64]:
    """Edges of hexahedra (C, 8), each once in both directions, (2, E).

    Ordered by the first node, then by the second.
    """
    pairs = np.sort(np.asarray(cells, dtype=np.int64)[:, VTK_EDGES].reshape(-1, 2), axis=1)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return np.ascontiguousarray(np.unique(both, axis=0).T)


def node_means(values: Array, cells: Array, nodes: int) -> NDArray[np.float64]:
    """Mean over the cells that touch a node, (N,), of one value for each cell (C,)."""
    flat = np.asarray(cells).ravel()
    sums = np.bincount(flat, np.repeat(values, cells.shape[1]), minlength=nodes)
    means: NDArray[np.float64] = sums / np.bincount(flat, minlength=nodes)
    return means


def velocities(positions: Array, time_step: float) -> NDArray[np.float64]:
    """Backward differences of positions (T+1, N, 3), m/s; zero in frame 0."""
    moved = np.zeros(positions.shape)
    np.subtract(positions[1:], positions[:-1], out=moved[1:], dtype=np.float64)
    moved /= time_step
    return moved


def tetrahedra(cells: Array) -> NDArray[np.int32]:
    """Six tetrahedra for each hexahedron, (6C, 4), of positive volume in convex cells.

    Each face is cut from its lowest node, so neighbours cut the face between them alike.
    A cell's tetrahedra all contain its lowest node; their other sides are the triangles of
    the three faces that do not.
    """
    cells = np.asarray(cells, dtype=np.int32)
    lowest = cells.min(axis=1)
    faces = cells[:, VTK_FACES]  # (C, 6, 4), counter-clockwise seen from outside
    opposite = (faces != lowest[:, None, None]).all(axis=2)
    faces = faces[opposite].reshape(len(cells), 3, 4)
    turns = (faces.argmin(axis=2)[..., None] + np.arange(4)) % 4
    faces = np.take_along_axis(faces, turns, axis=2)
    triangles = np.stack([faces[..., [0, 1, 2]], faces[..., [0, 2, 3]]], axis=2)
    triangles = triangles.reshape(-1, 3)
    return np.column_stack([np.repeat(lowest, 6), triangles])
