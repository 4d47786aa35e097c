"""Gaps between points and rigid obstacles, their derivatives, and where paths hit.

An obstacle is where all of its *coordinates* q_i are negative: one for a plane, n . (X - p), and a
ball, |X - c| - r; two for a cylinder, |P (X - c)| - r and |a . (X - c)| - l/2; three for a box.
Gradients g_i of coordinates that are positive at the same point are orthogonal, so outside

    d = |q+|,    dd/dX = sum q+_i g_i / d = n,
    d2d/dX2 = (sum over q_i > 0 of g_i g_i^T - n n^T) / d + sum q+_i / d d2q_i/dX2

with q+ = max(q, 0), and inside d = max q_i.  A straight path is inside where it is inside all
coordinates, and each of these is one interval of the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.clamps import Course
from pdcorrect.scene.obstacles import Box, Cylinder, Obstacle, Plane, Sphere
from pdcorrect.scene.regions import unit_vector

Array = NDArray[np.float64]

_REST = np.eye(3), np.zeros(3)
_SHORT = 1e-6
"""Time over which velocities are means, s."""


class _Coordinate(Protocol):
    """One q, over points X (n, 3) of the obstacle at rest."""

    def value(self, X: Array) -> Array:
        """(n,), m."""

    def slope(self, X: Array) -> Array:
        """First derivative, (n, 3) or (3,)."""

    def curvature(self, X: Array) -> Array | float:
        """Second derivative, (n, 3, 3) or 0."""

    def interval(self, X: Array, way: Array) -> tuple[Array, Array]:
        """The shares of paths X + share way between which q < 0, (n,) each; inf, -inf for none."""


@dataclass(frozen=True, eq=False)
class _Slab:
    """|a . (X - c)| - half, or without ``half`` a . (X - c)."""

    centre: Array
    axis: Array
    half: float | None = None

    def value(self, X: Array) -> Array:
        along = (X - self.centre) @ self.axis
        return along if self.half is None else np.abs(along) - self.half

    def slope(self, X: Array) -> Array:
        if self.half is None:
            return self.axis
        return np.sign((X - self.centre) @ self.axis)[:, None] * self.axis

    def curvature(self, X: Array) -> float:
        return 0.0

    def interval(self, X: Array, way: Array) -> tuple[Array, Array]:
        along, speed = (X - self.centre) @ self.axis, way @ self.axis
        low = np.full(len(X), -np.inf) if self.half is None else np.full(len(X), -self.half)
        high = 0.0 if self.half is None else self.half
        still = speed == 0.0
        safe = np.where(still, 1.0, speed)
        one, other = (low - along) / safe, (high - along) / safe
        inside = (along > low) & (along < high)
        first = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(one, other))
        last = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(one, other))
        return first, last


@dataclass(frozen=True, eq=False)
class _Radial:
    """|P (X - c)| - r with a projection P (3, 3)."""

    centre: Array
    projection: Array
    radius: float

    def value(self, X: Array) -> Array:
        return np.linalg.norm((X - self.centre) @ self.projection, axis=1) - self.radius

    def slope(self, X: Array) -> Array:
        arm = (X - self.centre) @ self.projection
        length = np.linalg.norm(arm, axis=1)[:, None]
        return np.divide(arm, length, out=np.zeros_like(arm), where=length > 0.0)

    def curvature(self, X: Array) -> Array:
        first, length = self.slope(X), self.value(X) + self.radius
        second = self.projection - first[:, :, None] * first[:, None, :]
        return np.asarray(second / np.maximum(length, 1e-300)[:, None, None])

    def interval(self, X: Array, way: Array) -> tuple[Array, Array]:
        arm, speed = (X - self.centre) @ self.projection, way @ self.projection
        a, b = (speed**2).sum(axis=1), (arm * speed).sum(axis=1)
        c = (arm**2).sum(axis=1) - self.radius**2
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        meets, still = b * b > a * c, a == 0.0
        safe = np.where(still, 1.0, a)
        first = np.where(meets, (-b - root) / safe, np.inf)
        last = np.where(meets, (-b + root) / safe, -np.inf)
        first = np.where(still, np.where(c < 0.0, -np.inf, np.inf), first)
        return first, np.where(still, np.where(c < 0.0, np.inf, -np.inf), last)


class RigidObstacle:
    """An obstacle of a scene, at any time.

    Parameters
    ----------
    declared : Obstacle
    recess : float
        How far its surface is moved in, m.
    """

    def __init__(self, declared: Obstacle, recess: float = 0.0) -> None:
        self.declared = declared
        self._course = None if declared.motion is None else Course(declared.motion)
        self._coordinates = _coordinates(declared, recess)
        self._last: tuple[float, tuple[Array, Array]] | None = None  # steps ask again and again

    @property
    def extents(self) -> list[float]:
        """Its three lengths, smallest first, m; infinite for a plane."""
        declared = self.declared
        if isinstance(declared, Plane):
            return 3 * [np.inf]
        if isinstance(declared, Box):
            low, high = np.array(declared.box)
            return sorted((high - low).tolist())
        width = 2.0 * declared.radius
        if isinstance(declared, Sphere):
            return 3 * [width]
        return sorted([width, width, declared.length or np.inf])

    def frame(self, time: float) -> tuple[Array, Array]:
        """R (3, 3) and b (3,) of x = R X + b at a time (s)."""
        if self._course is None:
            return _REST
        last = self._last
        if last is None or last[0] != time:
            self._last = last = time, self._course.frame(time)
        return last[1]

    def gaps(self, x: Array, time: float) -> Array:
        """Distances of points (n, 3) from the surface, (n,), m; negative inside."""
        q = self._values(self._local(x, time))
        if len(q) == 1:
            return np.asarray(q[0])
        outside = np.sqrt((np.maximum(q, 0.0) ** 2).sum(axis=0))
        return np.where(outside > 0.0, outside, q.max(axis=0))

    def normals(self, x: Array, time: float) -> Array:
        """First derivatives (n, 3) of the gaps of points outside."""
        X = self._local(x, time)
        shares, _ = self._shares(X)
        n = np.zeros_like(X)
        for share, coordinate in zip(shares, self._coordinates, strict=True):
            n += share[:, None] * coordinate.slope(X)
        return n if self._course is None else n @ self.frame(time)[0].T

    def curvatures(self, x: Array, time: float) -> Array:
        """Second derivatives (n, 3, 3) of the gaps of points outside."""
        X = self._local(x, time)
        shares, d = self._shares(X)
        n, H = np.zeros_like(X), np.zeros((*X.shape, 3))
        for share, coordinate in zip(shares, self._coordinates, strict=True):
            H += share[:, None, None] * coordinate.curvature(X)
            if len(shares) > 1:
                g = np.broadcast_to(coordinate.slope(X), X.shape)
                n += share[:, None] * g
                counted = ((share > 0.0) / d)[:, None, None]
                H += counted * g[:, :, None] * g[:, None, :]
        if len(shares) > 1:
            H -= n[:, :, None] * n[:, None, :] / d[:, None, None]
        R = self.frame(time)[0]
        return H if self._course is None else R @ H @ R.T

    def first_hit(self, x: Array, way: Array, time: float) -> float:
        """The share of the paths x + share way at which a point enters; infinite if none does."""
        X, (R, _) = self._local(x, time), self.frame(time)
        way = way @ R
        first, last = np.full(len(X), -np.inf), np.full(len(X), np.inf)
        for coordinate in self._coordinates:
            low, high = coordinate.interval(X, way)
            first, last = np.maximum(first, low), np.minimum(last, high)
        hit = (first < last) & (last > 0.0) & (first >= 0.0)
        return float(first[hit].min(initial=np.inf))

    def carried(self, x: Array, start: float, end: float) -> Array:
        """Where points (n, 3) fixed to the obstacle at ``start`` (s) are at ``end``."""
        if self._course is None:
            return x
        R, b = self.frame(end)
        return self._local(x, start) @ R.T + b

    def velocities(self, x: Array, time: float) -> Array:
        """Of points (n, 3) fixed to it, m/s: the mean over a short time after ``time``."""
        return (self.carried(x, time, time + _SHORT) - x) / _SHORT

    def turned(self, start: float, end: float) -> Array:
        """The rotation (3, 3) from one time to another, s."""
        return self.frame(end)[0] @ self.frame(start)[0].T

    def _shares(self, X: Array) -> tuple[Array, Array]:
        """q+ / d of each coordinate, and d, of points at X; not a number inside."""
        shares = np.maximum(self._values(X), 0.0)
        d = np.sqrt((shares**2).sum(axis=0))
        d[d == 0.0] = np.nan
        return shares / d, d

    def _values(self, X: Array) -> Array:
        return np.stack([coordinate.value(X) for coordinate in self._coordinates])

    def _local(self, x: Array, time: float) -> Array:
        if self._course is None:
            return x
        R, b = self.frame(time)
        return (x - b) @ R


def _coordinates(declared: Obstacle, less: float) -> list[_Coordinate]:
    """Those of a shape whose surface is moved in by ``less``."""
    if isinstance(declared, Plane):
        normal = unit_vector(declared.normal)
        return [_Slab(np.array(declared.point) - less * normal, normal)]
    if isinstance(declared, Box):
        low, high = np.array(declared.box)
        centre, half = 0.5 * (low + high), 0.5 * (high - low) - less
        return [_Slab(centre, axis, h) for axis, h in zip(np.eye(3), half, strict=True)]
    centre = np.array(declared.centre)
    if isinstance(declared, Sphere):
        return [_Radial(centre, np.eye(3), declared.radius - less)]
    assert isinstance(declared, Cylinder)
    axis = unit_vector(declared.axis)
    side = _Radial(centre, np.eye(3) - np.outer(axis, axis), declared.radius - less)
    if declared.length is None:
        return [side]
    return [side, _Slab(centre, axis, 0.5 * declared.length - less)]
