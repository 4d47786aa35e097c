"""Random voxel bodies on which an element is learned: shapes, held nodes, materials."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import SupportsInt

import numpy as np
import scipy.ndimage as ndi
from numpy.typing import NDArray

Array = NDArray[np.float64]
Grid = NDArray[np.bool_]

_LARGEST = (12, 6, 6)
"""Cells along the axes of the box that most bodies lie in, before its axes are permuted."""
_LONGEST = 24
"""Cells along a member: long ones part what its ends do from what its middle does."""
_FEWEST, _MOST = 4, 150
"""Cells of a body."""
_MOST_CUT = 24
"""Before each is cut into eight."""
_MOST_HELD = 0.6
"""Share of the nodes."""
_NEARLY_INCOMPRESSIBLE = 0.3
"""Share of the bodies with a Poisson's ratio from 0.45 to 0.495."""
_TWO_MATERIALS = 0.3
"""Share of the bodies."""


@dataclass(frozen=True, eq=False)
class VoxelBody:
    """A body of unit cells, its materials relative to a first one of modulus and density 1.

    Attributes
    ----------
    kind : str
        Of its shape.
    solid, young, density : (a, b, c)
    held : (a + 1, b + 1, c + 1) bool
        Of the nodes, those whose three components are clamped.
    poisson : float
    """

    kind: str
    solid: Grid
    held: Grid
    young: Array
    density: Array
    poisson: float


def draw(rng: np.random.Generator, cut: bool = False, free: bool = False) -> VoxelBody:
    """A body; the same one from a generator in the same state.

    ``cut`` is for meshes that are finer than their bodies need: cells of a small one, each in
    eight.  Nothing holds a ``free`` one.
    """
    most = _MOST_CUT if cut else _MOST
    kinds = sorted(_SHAPES)
    while True:
        kind = kinds[rng.integers(len(kinds))]
        solid = connected(_SHAPES[kind](rng))
        if not _FEWEST <= solid.sum() <= most:
            continue
        solid = _trimmed(solid.transpose(rng.permutation(3)))
        if cut:
            solid = solid.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
        held = _held(solid, rng)
        if free:
            held[:] = False
        if free or holds(held, nodes_of(solid)):
            break
    young, density = _materials(solid, rng)
    low, high = (0.45, 0.495) if rng.random() < _NEARLY_INCOMPRESSIBLE else (0.0, 0.45)
    return VoxelBody(kind, solid, held, young, density, float(rng.uniform(low, high)))


def nodes_of(cells: Grid) -> Grid:
    """Nodes (a + 1, b + 1, c + 1) that a cell touches."""
    out = np.zeros(tuple(n + 1 for n in cells.shape), dtype=bool)
    for i, j, k in np.ndindex(2, 2, 2):
        a, b, c = cells.shape
        out[i : i + a, j : j + b, k : k + c] |= cells
    return out


# --- shapes ------------------------------------------------------------------------------------


def _beam(rng: np.random.Generator) -> Grid:
    return np.ones((rng.integers(3, _LONGEST + 1), *rng.integers(1, 5, size=2)), dtype=bool)


def _elbow(rng: np.random.Generator) -> Grid:
    """Two members at right angles; the second leaves the first at its end or elsewhere."""
    long, other = rng.integers(4, 13, size=2)
    first, second, depth = rng.integers(1, 4, size=3)
    solid = np.zeros((long, first + other, depth), dtype=bool)
    solid[:, :first] = True
    start = rng.integers(0, max(1, long - second + 1)) if rng.random() < 0.5 else 0
    solid[start : start + second, :, : rng.integers(1, depth + 1)] = True
    return solid


def _prism(rng: np.random.Generator) -> Grid:
    """A section that grew cell by cell, along a straight line."""
    section = np.zeros((1, 4, 4), dtype=bool)
    section[0, rng.integers(4), rng.integers(4)] = True
    for _ in range(rng.integers(1, 9)):
        places = np.argwhere(ndi.binary_dilation(section) & ~section)
        section[tuple(places[rng.integers(len(places))])] = True
    return np.repeat(section, rng.integers(4, _LONGEST + 1), axis=0)


def _plate(rng: np.random.Generator) -> Grid:
    return np.ones((*rng.integers(3, 9, size=2), rng.integers(1, 3)), dtype=bool)


def _union(rng: np.random.Generator) -> Grid:
    solid = np.zeros(_LARGEST, dtype=bool)
    for _ in range(rng.integers(2, 5)):
        solid[_box(rng, solid.shape)] = True
    return solid


def _holed(rng: np.random.Generator) -> Grid:
    solid = np.ones((rng.integers(4, 9), rng.integers(3, 6), rng.integers(1, 5)), dtype=bool)
    for _ in range(rng.integers(1, 4)):
        size = np.minimum(rng.integers(1, 3, size=3), np.array(solid.shape) - 1)
        start = [rng.integers(0, n - s + 1) for n, s in zip(solid.shape, size, strict=True)]
        solid[box(start, np.add(start, size))] = False
    return solid


def _frame(rng: np.random.Generator) -> Grid:
    a, b, depth = rng.integers(4, 12), rng.integers(4, 10), rng.integers(1, 4)
    wall = rng.integers(1, 3)
    solid = np.ones((a, b, depth), dtype=bool)
    solid[wall : a - wall, wall : b - wall] = False
    if rng.random() < 0.5:  # open at one side
        solid[:, b - wall :] = False
    return solid


def _stepped(rng: np.random.Generator) -> Grid:
    solid = np.zeros(_LARGEST, dtype=bool)
    start = 0
    for _ in range(rng.integers(2, 5)):
        length, height, depth = rng.integers(1, 5), rng.integers(1, 6), rng.integers(1, 5)
        solid[start : start + length, :height, :depth] = True
        start += int(length)
    return solid


def _random(rng: np.random.Generator) -> Grid:
    """A body that grew cell by cell."""
    solid = np.zeros((8, 6, 6), dtype=bool)
    solid[4, 3, 3] = True
    for _ in range(rng.integers(_FEWEST, 60)):
        places = np.argwhere(ndi.binary_dilation(solid) & ~solid)
        solid[tuple(places[rng.integers(len(places))])] = True
    return solid


_SHAPES = {
    "beam": _beam,
    "elbow": _elbow,
    "prism": _prism,
    "plate": _plate,
    "union": _union,
    "holed": _holed,
    "frame": _frame,
    "stepped": _stepped,
    "random": _random,
}


def box(low: Iterable[SupportsInt], high: Iterable[SupportsInt]) -> tuple[slice, ...]:
    """The part of a grid from one place up to another, which is not in it."""
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def _box(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[slice, ...]:
    drawn = [rng.integers(1, n + 1) if i == 0 else rng.integers(1, 4) for i, n in enumerate(shape)]
    size = [int(n) for n in rng.permutation(drawn)]
    size = [min(s, n) for s, n in zip(size, shape, strict=True)]
    start = [rng.integers(0, n - s + 1) for n, s in zip(shape, size, strict=True)]
    return box(start, np.add(start, size))


def connected(solid: Grid, start: tuple[int, ...] | None = None) -> Grid:
    """The part with a cell, by default the first one, that hangs together by faces."""
    if not solid.any():
        return solid
    parts, _ = ndi.label(solid)
    return np.asarray(parts == parts[tuple(np.argwhere(solid)[0]) if start is None else start])


def _trimmed(solid: Grid) -> Grid:
    found = np.argwhere(solid)
    return solid[box(found.min(axis=0), found.max(axis=0) + 1)]


# --- held nodes and materials --------------------------------------------------------------------


def _held(solid: Grid, rng: np.random.Generator) -> Grid:
    """Nodes of one or two faces of the body's box, or of parts of them; seldom an edge besides."""
    nodes = nodes_of(solid)
    held = np.zeros_like(nodes)
    long = int(np.argmax(solid.shape))
    axis, side = long if rng.random() < 0.4 else int(rng.integers(3)), int(rng.integers(2))
    for _ in range(1 if rng.random() < 0.7 else 2):
        held |= _on_side(nodes, axis, side, rng, least=2 if rng.random() < 0.35 else None)
        side = 1 - side
        if rng.random() < 0.5:
            axis, side = int(rng.integers(3)), int(rng.integers(2))
    if rng.random() < 0.1:
        held |= _on_side(nodes, int(rng.integers(3)), int(rng.integers(2)), rng, least=1)
    return held & nodes


def _on_side(
    nodes: Grid, axis: int, side: int, rng: np.random.Generator, least: int | None
) -> Grid:
    """Nodes of one face of the box, or of a part at least ``least`` nodes wide."""
    region = np.zeros_like(nodes)
    np.moveaxis(region, axis, 0)[-side] = True
    for other in {0, 1, 2} - {axis} if least else ():
        count = nodes.shape[other]
        width = int(rng.integers(min(least or 1, count), count + 1))
        start = int(rng.integers(0, count - width + 1))
        view = np.moveaxis(region, other, 0)
        view[:start] = False
        view[start + width :] = False
    return region


def holds(held: Grid, nodes: Grid) -> bool:
    """Whether a whole face of a cell is held, and enough is not."""
    whole = 0
    for axis in range(3):
        faces = [held]
        for other in {0, 1, 2} - {axis}:
            moved = np.moveaxis(faces[0], other, 0)
            faces = [np.moveaxis(moved[1:] & moved[:-1], 0, other)]
        whole += int(faces[0].sum())
    return whole > 0 and held.sum() <= _MOST_HELD * nodes.sum()


def _materials(solid: Grid, rng: np.random.Generator) -> tuple[Array, Array]:
    young, density = np.ones(solid.shape), np.ones(solid.shape)
    if rng.random() < _TWO_MATERIALS:
        region = np.zeros(solid.shape, dtype=bool)
        if rng.random() < 0.5:
            axis = int(np.argmax(solid.shape))
            np.moveaxis(region, axis, 0)[rng.integers(1, max(2, solid.shape[axis])) :] = True
        else:
            region[_box(rng, solid.shape)] = True
        young[region] = 10.0 ** rng.uniform(-1.0, 1.0)
        density[region] = 10.0 ** rng.uniform(-0.3, 0.3)
    return young, density
