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

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdcorrect.fem.clamps import Course
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.scene.obstacles import Box, Cylinder, Obstacle, Plane, Sphere
from pdcorrect.scene.regions import unit_vector

Array = NDArray[np.float64]

_REST = np.eye(3), np.zeros(3)
_SHORT = 1e-6
"""Time over which velocities are means, s."""
_HALF_SPACE, _SLAB, _RADIAL = 0.0, 1.0, 2.0
"""Kinds of coordinates of points X: with a centre c, an axis a and a size s

    a . (X - c) - s,    |a . (X - c)| - s,    |X - c - a . (X - c) a| - s.

Balls are radial, of axis 0.
"""
_KIND, _CENTRE, _AXIS, _SIZE = 0, 1, 4, 7
"""Columns of a table of coordinates, one a row."""


@njit(**OPTIONS)
def _local(x, R, b, X):  # type: ignore[no-untyped-def]
    """Fill X (3,) with R^T (x - b)."""
    for i in range(3):
        X[i] = R[0, i] * (x[0] - b[0]) + R[1, i] * (x[1] - b[1]) + R[2, i] * (x[2] - b[2])


@njit(**OPTIONS)
def _coordinate(row, X, g):  # type: ignore[no-untyped-def]
    """Q of a row at X (3,), and 1 over the radius of its level set; its derivative into g (3,)."""
    along = 0.0
    for i in range(3):
        along += row[_AXIS + i] * (X[i] - row[_CENTRE + i])
    if row[_KIND] != _RADIAL:
        both = row[_KIND] == _SLAB and along < 0.0
        for i in range(3):
            g[i] = -row[_AXIS + i] if both else row[_AXIS + i]
        return (-along if both else along) - row[_SIZE], 0.0
    square = 0.0
    for i in range(3):
        g[i] = X[i] - row[_CENTRE + i] - along * row[_AXIS + i]
        square += g[i] * g[i]
    length = math.sqrt(square)
    bend = 1.0 / max(length, 1e-300)
    for i in range(3):
        g[i] *= bend
    return length - row[_SIZE], bend


@njit(**OPTIONS)
def _interval(row, X, way):  # type: ignore[no-untyped-def]
    """The shares of the path X + share way between which q < 0; inf, -inf for none."""
    along, speed = 0.0, 0.0
    for i in range(3):
        along += row[_AXIS + i] * (X[i] - row[_CENTRE + i])
        speed += row[_AXIS + i] * way[i]
    if row[_KIND] != _RADIAL:
        low, high = -row[_SIZE] if row[_KIND] == _SLAB else -math.inf, row[_SIZE]
        if speed == 0.0:
            inside = low < along < high
            return (-math.inf, math.inf) if inside else (math.inf, -math.inf)
        one, other = (low - along) / speed, (high - along) / speed
        return min(one, other), max(one, other)
    a, b, c = 0.0, 0.0, -(row[_SIZE] ** 2)
    for i in range(3):
        arm, step = (
            X[i] - row[_CENTRE + i] - along * row[_AXIS + i],
            way[i] - speed * row[_AXIS + i],
        )
        a, b, c = a + step * step, b + arm * step, c + arm * arm
    if a == 0.0:
        return (-math.inf, math.inf) if c < 0.0 else (math.inf, -math.inf)
    if not b * b > a * c:
        return math.inf, -math.inf
    root = math.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


@njit(**OPTIONS)
def _gaps(table, R, b, x):  # type: ignore[no-untyped-def]
    """Signed distances of points x (n, 3), (n,)."""
    X, g, out = np.empty(3), np.empty(3), np.empty(len(x))
    for n in range(len(x)):
        _local(x[n], R, b, X)
        square, largest = 0.0, -math.inf
        for row in table:
            q, _ = _coordinate(row, X, g)
            square += max(q, 0.0) ** 2
            largest = max(largest, q)
        out[n] = math.sqrt(square) if square > 0.0 else largest
    return out


@njit(**OPTIONS)
def _derivatives(table, R, b, x):  # type: ignore[no-untyped-def]
    """First and second derivatives (n, 3), (n, 3, 3) by X of the gaps of points x (n, 3)."""
    X, g = np.empty(3), np.empty(3)
    first, second = np.zeros((len(x), 3)), np.zeros((len(x), 3, 3))
    for p in range(len(x)):
        _local(x[p], R, b, X)
        n, H = first[p], second[p]
        square, several = 0.0, len(table) > 1
        for row in table:
            q, bend = _coordinate(row, X, g)
            if not q > 0.0:
                continue
            square += q * q
            for i in range(3):
                n[i] += q * g[i]
                for j in range(3):
                    across = (
                        (1.0 if i == j else 0.0) - row[_AXIS + i] * row[_AXIS + j] - g[i] * g[j]
                    )
                    H[i, j] += q * bend * across + (g[i] * g[j] if several else 0.0)
        d = math.sqrt(square) if square > 0.0 else math.nan
        n /= d
        H /= d
        if several:
            for i in range(3):
                for j in range(3):
                    H[i, j] -= n[i] * n[j] / d
    return first, second


@njit(**OPTIONS)
def _first_hit(table, R, b, x, way):  # type: ignore[no-untyped-def]
    """The smallest share of the paths x + share way (n, 3) at which a point enters, or infinity."""
    X, W, least = np.empty(3), np.empty(3), math.inf
    for n in range(len(x)):
        _local(x[n], R, b, X)
        _local(way[n], R, np.zeros(3), W)
        first, last = -math.inf, math.inf
        for row in table:
            low, high = _interval(row, X, W)
            first, last = max(first, low), min(last, high)
        if first < last and last > 0.0 and 0.0 <= first < least:
            least = first
    return least


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
        self._table = _coordinates(declared, recess)
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
        return np.asarray(_gaps(self._table, *self.frame(time), x))

    def derivatives(self, x: Array, time: float) -> tuple[Array, Array]:
        """First (n, 3) and second (n, 3, 3) derivatives of the gaps of points outside.

        Not numbers inside.
        """
        R, b = self.frame(time)
        first, second = _derivatives(self._table, R, b, x)
        return first @ R.T, R @ second @ R.T

    def first_hit(self, x: Array, way: Array, time: float) -> float:
        """The share of the paths x + share way at which a point enters; infinite if none does."""
        return float(_first_hit(self._table, *self.frame(time), x, way))

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

    def _local(self, x: Array, time: float) -> Array:
        if self._course is None:
            return x
        R, b = self.frame(time)
        return (x - b) @ R


def _coordinates(declared: Obstacle, less: float) -> Array:
    """The table of coordinates of a shape whose surface is moved in by ``less``."""
    if isinstance(declared, Plane):
        return np.array([[_HALF_SPACE, *declared.point, *unit_vector(declared.normal), -less]])
    if isinstance(declared, Box):
        low, high = np.array(declared.box)
        centre, half = 0.5 * (low + high), 0.5 * (high - low) - less
        return np.array([[_SLAB, *centre, *a, h] for a, h in zip(np.eye(3), half, strict=True)])
    if isinstance(declared, Sphere):
        return np.array([[_RADIAL, *declared.centre, 0.0, 0.0, 0.0, declared.radius - less]])
    assert isinstance(declared, Cylinder)
    axis = unit_vector(declared.axis)
    side = [_RADIAL, *declared.centre, *axis, declared.radius - less]
    if declared.length is None:
        return np.array([side])
    return np.array([side, [_SLAB, *declared.centre, *axis, 0.5 * declared.length - less]])
