"""Clamps of a scene: which components move freely, and where the others are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import SceneError
from pdcorrect.fem.selection import Selector
from pdcorrect.scene import Clamp, Motion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Clamps:
    """Clamped components of all nodes.

    Attributes
    ----------
    free : (N, 3) bool
        Components that may move.
    rest : (N, 3)
        Rest positions, m.
    moving : tuple of (nodes, components, Motion)
        Clamps with a prescribed motion.
    """

    free: NDArray[np.bool_]
    rest: Array
    moving: tuple[tuple[NDArray[np.int64], NDArray[np.int64], Motion], ...]

    def positions(self, time: float) -> Array:
        """Prescribed positions (N, 3), m, at a time (s); meaningful where not free."""
        if not self.moving:
            return self.rest
        out = self.rest.copy()
        for nodes, components, motion in self.moving:
            moved = move(self.rest[nodes], motion, time)
            out[np.ix_(nodes, components)] = moved[:, components]
        return out


def resolve_clamps(clamps: tuple[Clamp, ...], selector: Selector, rest: Array) -> Clamps:
    """Find the clamped components.

    Raises
    ------
    SceneError
        If a region selects nothing or two clamps move a component differently.
    """
    owner = np.full(rest.shape, -1)
    moving = []
    for i, clamp in enumerate(clamps):
        nodes = selector.nodes(clamp.region, f"clamps[{i}].region")
        components = np.array(sorted("xyz".index(c) for c in clamp.components))
        place = np.ix_(nodes, components)
        for earlier in np.unique(owner[place][owner[place] >= 0]):
            if clamp.motion != clamps[earlier].motion:
                node = nodes[(owner[place] == earlier).any(axis=1)][0]
                raise SceneError(
                    f"clamps[{earlier}] and clamps[{i}] move node {node} at "
                    f"{rest[node].tolist()} differently: expected regions or components that do "
                    "not overlap, or the same motion."
                )
        owner[place] = i
        if clamp.motion is not None:
            moving.append((nodes, components, clamp.motion))
    free = owner < 0
    if not free.any():
        raise SceneError("clamps hold every component of every node: expected a free one.")
    return Clamps(free, rest, tuple(moving))


def move(points: Array, motion: Motion, time: float) -> Array:
    """Rotate and displace ``points`` (n, 3) as prescribed for a time (s)."""
    out = points
    if motion.rotation is not None:
        angle = math.radians(float(np.interp(time, motion.times, motion.rotation)))
        centre = np.array(motion.centre)
        out = centre + (points - centre) @ _rotation("xyz".index(motion.axis), angle).T
    if motion.displacement is not None:
        table = np.array(motion.displacement)
        out = out + [np.interp(time, motion.times, table[:, i]) for i in range(3)]
    return out


def _rotation(axis: int, angle: float) -> Array:
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i] = math.sin(angle)
    matrix[i, j] = -math.sin(angle)
    return matrix
