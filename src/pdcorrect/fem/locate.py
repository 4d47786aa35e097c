"""Points of a body at rest: which cell each lies in, and where in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pdcorrect.fem.hexahedron import VTK_CORNERS

Array = NDArray[np.float64]

_CANDIDATES = 27
"""Cells whose centres are nearest: with distorted cells the right one may not be the first."""
_ROUNDING = 1e-9
"""Of the largest cell: how far off a point may be that counts as found."""
_NEWTON = 20


def locate(
    positions: Array, cells: NDArray[np.int64], points: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """The place of points (P, 3), m, in trilinear cells (C, 8) of nodes at positions (N, 3), m.

    Returns
    -------
    cells : (P,)
        Each point's cell, or the nearest one.
    local : (P, 3)
        Its place on the unit cell; of a point outside, the nearest one found.
    distances : (P,)
        From that place, m; zero up to rounding for points inside.
    """
    count = min(_CANDIDATES, len(cells))
    _, near = cKDTree(positions[cells].mean(axis=1)).query(points, k=count)
    found = _best(positions[cells], points, near.reshape(len(points), count))
    low, high = positions[cells].min(axis=1), positions[cells].max(axis=1)
    far = found[2] > _ROUNDING * np.abs(high - low).max()
    for p in np.flatnonzero(far):  # of cells of very unlike sizes
        around = np.flatnonzero(((low <= points[p]) & (points[p] <= high)).all(axis=1))
        if len(around):
            better = _best(positions[cells], points[p : p + 1], around[None])
            if better[2][0] < found[2][p]:
                for all_points, one in zip(found, better, strict=True):
                    all_points[p] = one[0]
    return found


def _best(
    corners: Array, points: Array, near: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array, Array]:
    """The same, of the cells ``near`` each point (P, c), for corners (C, 8, 3) of all cells."""
    corners = corners[near]
    local = _inverted(corners, np.broadcast_to(points[:, None], (*near.shape, 3)))
    local = np.clip(local, 0.0, 1.0)
    way = np.einsum("pck,pcki->pci", trilinear(local), corners) - points[:, None]
    distances = np.linalg.norm(way, axis=2)
    best = distances.argmin(axis=1)[:, None]
    return (
        np.take_along_axis(near, best, axis=1)[:, 0],
        np.take_along_axis(local, best[..., None], axis=1)[:, 0],
        np.take_along_axis(distances, best, axis=1)[:, 0],
    )


def trilinear(local: Array) -> Array:
    """Shape functions (..., 8) at places (..., 3) on the unit cell, VTK order."""
    x = local[..., None, :]
    return np.asarray(np.where(VTK_CORNERS == 1, x, 1.0 - x).prod(axis=-1))


def _inverted(corners: Array, points: Array) -> Array:
    """Places (..., 3) that the trilinear maps of corners (..., 8, 3) take to points (..., 3)."""
    sign, local = 2.0 * VTK_CORNERS - 1.0, np.full(points.shape, 0.5)
    for _ in range(_NEWTON):
        factors = np.where(VTK_CORNERS == 1, local[..., None, :], 1.0 - local[..., None, :])
        others = [factors[..., [j for j in range(3) if j != i]].prod(axis=-1) for i in range(3)]
        slopes = np.stack(others, axis=-1) * sign  # (..., 8, 3)
        J = np.einsum("...ki,...kj->...ij", corners, slopes)
        J[np.linalg.det(J) == 0.0] = np.eye(3)  # beyond a cell that tapers to a point there
        rest = points - np.einsum("...k,...ki->...i", factors.prod(axis=-1), corners)
        step = np.linalg.solve(J, rest[..., None])[..., 0]
        local = np.clip(local + step, -1.0, 2.0)  # cells that are far off do not matter
        if np.abs(step).max() < 1e-14:
            break
    return local
