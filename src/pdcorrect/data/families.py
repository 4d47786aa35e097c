"""Families of bodies: CrossMesh and WeightMesh of the thesis (figures 6.1 and 6.2), and beams.

A family lists the sizes that it allows and draws places on them.  Besides the body it
says how it is clamped and which part the loads of its data sets act on.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from pdcorrect._config import as_toml
from pdcorrect.data.configuration import FamilyName
from pdcorrect.errors import InputError

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
Shape = dict[str, Any]
Size = tuple[int, ...]


@dataclass(frozen=True)
class Design:
    """One body of a family, in cells: scale by the cell size for metres."""

    shape: Shape = field(hash=False)  # the scene's ``body`` without ``cell_size``
    clamps: tuple[Box, ...]  # flat boxes whose nodes are held
    loaded: Box  # the part that impulse and stretch loads act on
    # x, y, z: away from the clamps, along the beam that carries that part
    axis: tuple[float, float, float]
    nodes: int  # of the coarse mesh

    def key(self) -> str:
        """Equal for equal bodies, and for mirrored ones that are held in the same way."""
        shape = dict(self.shape)
        if shape["shape"] == "weight":
            width = shape["support_cells"][0] - shape["pendulum_cells"][0]
            shape["pendulum_start"] = min(shape["pendulum_start"], width - shape["pendulum_start"])
        return repr(sorted(shape.items()))


class NodeRange(NamedTuple):
    """Fewest and most nodes of a family's coarse meshes, and of them cut into 4 x 4 x 4."""

    coarse: tuple[int, int]
    fine: tuple[int, int]


PUBLISHED: Mapping[FamilyName, NodeRange] = {
    "beam": NodeRange((225, 513), (7857, 18225)),  # as the cross; not in the thesis
    "cross": NodeRange((225, 513), (7857, 18225)),
    "weight": NodeRange((237, 471), (8433, 16857)),
}
"""The thesis's sizes, figures 6.1 and 6.2."""


def draw(family: FamilyName, nodes: tuple[int, int], rng: np.random.Generator) -> Design:
    """A random body with between ``nodes[0]`` and ``nodes[1]`` nodes.

    Uniform over the numbers of nodes that the family can have there, then over the sizes
    that have that number, then over the places of branches and weights.
    """
    levels = node_levels(family, nodes)
    return _place(family, levels[int(rng.integers(len(levels)))], rng)


def extreme(
    family: FamilyName, nodes: tuple[int, int], largest: bool, rng: np.random.Generator
) -> Design:
    """A random body with the fewest or the most nodes in a range, also when refined."""
    sizes = node_levels(family, nodes)[-1 if largest else 0]
    end = (max if largest else min)(_count(family, size, 4) for size in sizes)
    return _place(family, tuple(s for s in sizes if _count(family, s, 4) == end), rng)


@cache
def node_levels(family: FamilyName, nodes: tuple[int, int]) -> tuple[tuple[Size, ...], ...]:
    """Sizes that a family allows in a range, grouped by their number of nodes, ascending.

    In the published range the refined mesh is in its published range too.
    """
    published = PUBLISHED[family]
    fine = published.fine if nodes == published.coarse else (0, sys.maxsize)
    levels: dict[int, list[Size]] = {}
    for size in _sizes(family):
        count = _count(family, size, 1)
        if nodes[0] <= count <= nodes[1] and fine[0] <= _count(family, size, 4) <= fine[1]:
            levels.setdefault(count, []).append(size)
    if not levels:
        raise InputError(
            f"coarse_nodes = {as_toml(nodes)}: family {family!r} has no body there; expected a "
            f"range such as {as_toml(published.coarse)}."
        )
    return tuple(tuple(levels[count]) for count in sorted(levels))


def _sizes(family: FamilyName) -> Iterator[Size]:
    """Beam: length.  Cross: length, number of branches, cells by which they stick out, less than
    the length.  Weight: lengths of the supports and the pendulum, width and height of its
    inflated part, which is shorter than the pendulum.
    """
    if family == "beam":
        return ((length,) for length in range(4, 57))
    if family == "cross":
        arms = product(range(4, 41), (2, 4), range(1, 9))
        return (size for size in arms if size[2] < size[0])
    second = (0, *range(6, 17, 2))
    every = product(range(6, 21), second, range(4, 21), (4, 6), (2, 3, 4))
    return (size for size in every if size[4] < size[2])


def _count(family: FamilyName, size: Size, k: int) -> int:
    """Nodes with each cell cut k times along each axis, by layers of 2 x 2-cell sections."""
    section = (2 * k + 1) ** 2
    if family == "beam":
        return section * (k * size[0] + 1)
    if family == "cross":
        length, arms, out = size
        return section * (k * (length + arms * out) + 1)
    support, second, pendulum, wide, high = size
    layers = k * (support + max(0, second - 2) + pendulum) + 1
    return section * layers + ((k * wide + 1) ** 2 - section) * (k * high + 1)


def _place(family: FamilyName, sizes: tuple[Size, ...], rng: np.random.Generator) -> Design:
    size = sizes[int(rng.integers(len(sizes)))]
    if family == "weight":
        return _weight(size, rng)
    length, branches = size[0], {}
    if family == "cross":
        start = int(rng.integers(1, length - 2))
        branches = {"arms": size[1], "arm_start": start, "arm_width": 2, "arm_length": size[2]}
    tip: Box = ((length - 2.0, 0.0, 0.0), (float(length), 2.0, 2.0))
    clamp: Box = ((0.0, 0.0, 0.0), (0.0, 2.0, 2.0))
    shape = {"shape": family, "cells": [length, 2, 2], **branches}
    return Design(shape, (clamp,), tip, (1.0, 0.0, 0.0), _count(family, size, 1))


def _weight(size: Size, rng: np.random.Generator) -> Design:
    support, second, pendulum, wide, high = size
    start = int(rng.integers(1, support - 2))
    below = int(rng.integers(1, pendulum - high + 1))
    shape = {
        "shape": "weight", "support_cells": [support, 2, 2], "second_support_length": second,
        "pendulum_start": start, "pendulum_cells": [2, 2, pendulum], "weight_start": below,
        "weight_cells": [wide, wide, high],
    }  # fmt: skip
    ends: list[Box] = [((x, 0.0, 0.0), (x, 2.0, 2.0)) for x in (0.0, float(support))]
    left, right = float(start), start + 2.0
    if second:
        for y in (1.0 - second / 2, 1.0 + second / 2):
            ends.append(((left, y, 0.0), (right, y, 2.0)))
    half = (wide - 2) / 2
    top = float(-below)
    inflated: Box = ((left - half, -half, top - high), (right + half, 2.0 + half, top))
    return Design(shape, tuple(ends), inflated, (0.0, 0.0, -1.0), _count("weight", size, 1))
