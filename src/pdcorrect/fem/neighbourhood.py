"""What the learned element sees of a body: a graph of its cells, which lie on a grid.

A cell's own numbers are 2 E' / (E + E') for its modulus E and that of each of the 3 x 3 x 3 cells
about it, E': 0 where there is none, 1 for the same, 2 for rigid; 1 for each of its corners that is
held; and two of Poisson's ratio.  Its neighbours are those 27, itself among them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.fem.cube_symmetry import on_window
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.mesh_checks import connected_parts

Array = NDArray[np.float64]

NEIGHBOURS = 27
"""Cells about a cell, itself in the middle."""
SIZE = NEIGHBOURS + 8 + 2
"""Numbers of a cell."""
_OFF_GRID = 0.02
"""Of the spacing: how far corners may lie from a grid of cubes."""
_IN_WINDOW = np.argsort(VTK_CORNERS.astype(np.int64) @ [4, 2, 1])
"""Of the corners, in the order of `on_window`."""
_FLOOR = 0.01
"""Added to 1 - 2 nu, whose logarithm is a feature."""


class CellGraph(NamedTuple):
    """What the network sees: each cell's numbers (C, 37), and the neighbours (C, 27) about it.

    Where there is no neighbour, its number is C.
    """

    numbers: Array
    neighbours: NDArray[np.int64]


class Grid(NamedTuple):
    """Cells of a mesh on a grid along the axes, and whether they are its cubes.

    Corners are in the order of `VTK_CORNERS` along the axes; ``order`` has their places in the
    mesh's own (C, 8), ``place`` (C, 3) those of the cells on the grid.
    """

    cells: NDArray[np.int64]
    order: NDArray[np.int64]
    place: NDArray[np.int64]
    regular: NDArray[np.bool_]


def on_grid(positions: Array, cells: NDArray[np.int64]) -> Grid:
    """Where the cells (C, 8) of a mesh with nodes at ``positions`` (N, 3) lie on a grid of cubes.

    Its spacing is the median length of the cells along the axes, its origin where most of them are.
    """
    corners = positions[cells]
    low, high = corners.min(axis=1), corners.max(axis=1)
    size = float(np.median(high - low))
    side = (corners > 0.5 * (low + high)[:, None]).astype(np.int64)
    key = side @ [1, 2, 4]
    wanted = VTK_CORNERS.astype(np.int64) @ [1, 2, 4]
    order = np.argsort(key, axis=1)[:, wanted]
    away = (low - low.min(axis=0)) / size
    offset = np.median(away - np.round(away), axis=0)
    index = np.round(away - offset).astype(np.int64)
    ideal = low.min(axis=0) + size * (offset + index[:, None] + VTK_CORNERS)
    ordered = np.take_along_axis(corners, order[..., None], axis=1)
    regular = np.abs(ordered - ideal).max(axis=(1, 2)) <= _OFF_GRID * size
    _, inverse, counts = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    regular &= counts[inverse.ravel()] == 1
    return Grid(np.take_along_axis(cells, order, axis=1), order, index, regular)


def on_grids(positions: Array, cells: NDArray[np.int64]) -> tuple[Grid, list[NDArray[np.int64]]]:
    """The same of a mesh whose connected parts have a grid each; and the cells of each part."""
    part = connected_parts(cells, len(positions))[cells[:, 0]]
    parts = [np.flatnonzero(part == number) for number in np.unique(part)]
    grids = [on_grid(positions, cells[own]) for own in parts]
    back = np.argsort(np.concatenate(parts))
    cells, order, place, regular = (np.concatenate(x)[back] for x in zip(*grids, strict=True))
    return Grid(cells, order, place, regular), parts


def neighbours_of(cells: NDArray[np.int64], place: NDArray[np.int64]) -> NDArray[np.int64]:
    """The (C, 27) cells about each that share nodes with it; C where there is none.

    ``place`` (C, 3) is that of the cells (C, 8) on the grid.
    """
    count = len(cells)
    entries = np.ones(cells.size, dtype=np.int64), cells.ravel(), 8 * np.arange(count + 1)
    nodes = sp.csr_array(entries, shape=(count, int(cells.max()) + 1))
    one, other = (nodes @ nodes.T).tocoo().coords
    offset = place[other] - place[one]
    near = np.abs(offset).max(axis=1) <= 1
    out = np.full((count, NEIGHBOURS), count)
    out[one[near], (offset[near] + 1) @ [9, 3, 1]] = other[near]
    return out


class Images(NamedTuple):
    """A body with its mirror images at planes of symmetry, C' cells, its own C cells first.

    Of all cells the `neighbours_of` them, the ``original`` (C',) that each is an image of, and
    which corners (C', 8) are held in all components; of its own those (C,) with corners ``partly``
    held that no plane of symmetry explains.
    """

    neighbours: NDArray[np.int64]
    original: NDArray[np.int64]
    held: NDArray[np.bool_]
    partly: NDArray[np.bool_]


def mirrored(grid: Grid, free: NDArray[np.bool_], still: NDArray[np.bool_]) -> Images:
    """The body that cells on a grid are a half, quarter or eighth of, by how nodes are held.

    The outermost face of cells along an axis is a plane of symmetry where all its nodes are held
    along the axis, as by rollers that do not move, and not all of them in all components; one for
    each axis.  ``free`` and ``still`` (N, 3) are the components that may move, and those that are
    held where they are.
    """
    cells, place, count = grid.cells, grid.place, len(free)
    planes = np.zeros((count, 3), dtype=bool)
    original, mirrors = np.arange(len(cells)), []
    for axis, side in np.ndindex(3, 2):
        outermost = (place[:, axis].max if side else place[:, axis].min)()
        face = cells[place[:, axis] == outermost][:, VTK_CORNERS[:, axis] == side]
        if not (still[face, axis].all() and free[face].any()) or planes[:, axis].any():
            continue
        planes[face, axis] = True
        mirrors.append((axis, 2 * outermost + 2 * side - 1))
    at_corners: NDArray[np.bool_] = ~free.max(axis=1) & ~planes.min(axis=1)
    unexplained: NDArray[np.bool_] = (~free & ~planes).max(axis=1) & ~at_corners
    for nth, (axis, twice) in enumerate(mirrors):
        across = VTK_CORNERS ^ (np.arange(3) == axis)
        flipped = (across[:, None] == VTK_CORNERS).all(axis=2).argmax(axis=1)
        images = np.where(planes[cells % count, axis], cells, cells + 2**nth * count)
        there = place.copy()
        there[:, axis] = twice - place[:, axis]
        cells = np.concatenate([cells, images[:, flipped]])
        place, original = np.concatenate([place, there]), np.tile(original, 2)
    held = at_corners[cells % count]
    partly: NDArray[np.bool_] = unexplained[grid.cells].max(axis=1)
    return Images(neighbours_of(cells, place), original, held, partly)


def mirrored_parts(
    grid: Grid, parts: list[NDArray[np.int64]], free: NDArray[np.bool_], still: NDArray[np.bool_]
) -> Images:
    """The same of a body in several parts, each with planes of symmetry of its own."""
    cells, order, place, regular = grid
    found = [
        mirrored(Grid(cells[own], order[own], place[own], regular[own]), free, still)
        for own in parts
    ]
    count, own_count = sum(len(one.original) for one in found), len(grid.cells)
    neighbours, original = np.empty((count, NEIGHBOURS), np.int64), np.empty(count, np.int64)
    held, partly = np.empty((count, 8), dtype=bool), np.empty(own_count, dtype=bool)
    first = own_count
    for own, one in zip(parts, found, strict=True):
        last = first + len(one.original) - len(own)
        number = np.concatenate([own, np.arange(first, last)])
        neighbours[number] = np.append(number, count)[one.neighbours]
        original[number], held[number], partly[own] = own[one.original], one.held, one.partly
        first = last
    return Images(neighbours, original, held, partly)


def cell_graph(
    neighbours: NDArray[np.int64], young: Array, poisson: Array, held: Array
) -> CellGraph:
    """The graph of cells with these `neighbours_of` them, moduli (C,) and held corners.

    ``held`` (C, 8) is 1 where a corner is held, VTK order.
    """
    other = np.append(young, 0.0)[neighbours]
    share = 2.0 * other / (young[:, None] + other)
    values = np.stack([4.0 * poisson - 1.0, 0.5 * np.log(1.0 - 2.0 * poisson + _FLOOR)], axis=1)
    return CellGraph(np.concatenate([share, held[:, _IN_WINDOW], values], axis=1), neighbours)


def cell_graph_slopes(
    graph: CellGraph, young: Array, poisson: Array, slopes: Array
) -> tuple[Array, Array]:
    """Derivatives by young and poisson, (C,), of a function that has these by a graph's numbers."""
    other = np.append(young, 0.0)[graph.neighbours]
    by_share = 2.0 * slopes[:, :NEIGHBOURS] / (young[:, None] + other) ** 2
    by_other = np.bincount(
        graph.neighbours.ravel(), (by_share * young[:, None]).ravel(), len(young) + 1
    )
    by_young = by_other[:-1] - (by_share * other).sum(axis=1)
    by_poisson = 4.0 * slopes[:, -2] - slopes[:, -1] / (1.0 - 2.0 * poisson + _FLOOR)
    return by_young, by_poisson


def extremes(neighbours: NDArray[np.int64], values: Array, reach: int) -> tuple[Array, Array]:
    """Least and largest of the values (C,) of cells at most ``reach`` neighbours away."""
    least, most = values, values
    for _ in range(reach):
        least = np.append(least, np.inf)[neighbours].min(axis=1)
        most = np.append(most, -np.inf)[neighbours].max(axis=1)
    return least, most


@lru_cache(maxsize=1)
def permutations() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places (48, 37) with y = x[places] for the numbers of a cell of the turned body.

    And (48, 27), the same for its neighbours.
    """
    cells = on_window(3)
    rest = np.broadcast_to(np.arange(SIZE - 2, SIZE), (48, 2))
    return np.concatenate([cells, NEIGHBOURS + on_window(2), rest], axis=1), cells
