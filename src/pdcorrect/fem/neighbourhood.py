"""What the learned element sees of a cell: its neighbours, held nodes and Poisson's ratio.

Cells lie on a grid.  A window of 7 x 7 x 7 cells about each has 2 E' / (E + E') for the modulus
E' of a neighbour and the cell's own E: 0 where there is none, 1 for the same, 2 for rigid.  A
window of 6 x 6 x 6 nodes has 1 where a node is held.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.cube_symmetry import on_window
from pdcorrect.fem.hexahedron import VTK_CORNERS

Array = NDArray[np.float64]

CELLS, NODES = 7, 6
"""Widths of the windows."""
SIZE = CELLS**3 + NODES**3 + 2
"""Numbers of a neighbourhood."""
_OFF_GRID = 0.02
"""Of the spacing: how far corners may lie from a grid of cubes."""
_FLOOR = 0.01
"""Added to 1 - 2 nu, whose logarithm is a feature."""


class Grid(NamedTuple):
    """Cells of a mesh on a grid along the axes.

    Attributes
    ----------
    cells, order : (C, 8)
        Corners in the order of `VTK_CORNERS` along the axes, and their places in the mesh's.
    place : (C, 3)
        Of the cells on the grid.
    regular : (C,) bool
        Whether the cell is a cube of the grid.
    """

    cells: NDArray[np.int64]
    order: NDArray[np.int64]
    place: NDArray[np.int64]
    regular: NDArray[np.bool_]


def on_grid(positions: Array, cells: NDArray[np.int64]) -> Grid:
    """Where the cells (C, 8) of a mesh with nodes at ``positions`` (N, 3) lie on a grid of cubes.

    Its spacing is the median length of the cells along the axes.
    """
    corners = positions[cells]
    low, high = corners.min(axis=1), corners.max(axis=1)
    size = float(np.median(high - low))
    side = (corners > 0.5 * (low + high)[:, None]).astype(np.int64)
    key = side @ [1, 2, 4]
    wanted = VTK_CORNERS.astype(np.int64) @ [1, 2, 4]
    order = np.argsort(key, axis=1)[:, wanted]
    place = (low - low.min(axis=0)) / size
    index = np.round(place).astype(np.int64)
    ideal = low.min(axis=0) + size * (index[:, None] + VTK_CORNERS)
    ordered = np.take_along_axis(corners, order[..., None], axis=1)
    regular = np.abs(ordered - ideal).max(axis=(1, 2)) <= _OFF_GRID * size
    _, inverse, counts = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    regular &= counts[inverse.ravel()] == 1
    return Grid(np.take_along_axis(cells, order, axis=1), order, index, regular)


def neighbourhoods(index: NDArray[np.int64], young: Array, poisson: Array, held: Array) -> Array:
    """Neighbourhoods (C, F) of cells on a grid.

    Parameters
    ----------
    index : (C, 3)
        Of the cells on the grid.
    young, poisson : (C,)
    held : (C, 8)
        1 where a corner is held, VTK order.
    """
    index = index - index.min(axis=0)
    reach = CELLS // 2
    stiffness = np.zeros(index.max(axis=0) + 1 + 2 * reach)
    stiffness[tuple((index + reach).T)] = young
    around = _windows(stiffness, index, CELLS)
    share = 2.0 * around / (young[:, None] + around)
    beside = (NODES - 2) // 2
    nodes = np.zeros(index.max(axis=0) + 2 + 2 * beside)
    places = (index[:, None] + VTK_CORNERS.astype(int) + beside).reshape(-1, 3)
    np.maximum.at(nodes, tuple(places.T), held.ravel())
    values = np.stack([4.0 * poisson - 1.0, 0.5 * np.log(1.0 - 2.0 * poisson + _FLOOR)], axis=1)
    return np.concatenate([share, _windows(nodes, index, NODES), values], axis=1)


def neighbourhood_slopes(
    index: NDArray[np.int64], young: Array, poisson: Array, slopes: Array
) -> tuple[Array, Array]:
    """Derivatives by young and poisson, (C,), of a function that has these by neighbourhoods."""
    index = index - index.min(axis=0) + CELLS // 2
    stiffness = np.zeros(index.max(axis=0) + 1 + CELLS // 2)
    stiffness[tuple(index.T)] = young
    low = index - CELLS // 2
    around = _windows(stiffness, low, CELLS)
    by_share = 2.0 * slopes[:, : CELLS**3] / (young[:, None] + around) ** 2
    by_young = -(by_share * around).sum(axis=1)
    offsets = np.stack(np.unravel_index(np.arange(CELLS**3), (CELLS,) * 3), axis=1)
    places = low[:, None] + offsets
    total = np.zeros(stiffness.shape)
    np.add.at(total, tuple(places.reshape(-1, 3).T), (by_share * young[:, None]).ravel())
    by_young += total[tuple(index.T)]
    by_poisson = 4.0 * slopes[:, -2] - slopes[:, -1] / (1.0 - 2.0 * poisson + _FLOOR)
    return by_young, by_poisson


def _windows(grid: Array, index: NDArray[np.int64], width: int) -> Array:
    """Cubes of numbers (C, width^3) with their low corner at ``index``."""
    every = np.lib.stride_tricks.sliding_window_view(grid, (width,) * 3)
    return every[tuple(index.T)].reshape(len(index), -1)


@lru_cache(maxsize=1)
def permutations() -> NDArray[np.int64]:
    """Places (48, F) with y = x[places] for the neighbourhood of the turned body."""
    cells, nodes = on_window(CELLS), on_window(NODES)
    rest = np.broadcast_to(np.arange(SIZE - 2, SIZE), (48, 2))
    return np.concatenate([cells, CELLS**3 + nodes, rest], axis=1)
