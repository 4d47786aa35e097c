"""What obstacles add to the function that a step minimises, see `fem.contact`.

Gaps and sliding are those at the end of the step, p'(y), so that no frame has a point inside an
obstacle: with g = dp'/dy the terms are B(p')/g and D(p')/g, whose forces are those at p'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdcorrect.fem.contact import Contact, Touching
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.solvers.integrators import StepEquation
from pdcorrect.state import State

Array = NDArray[np.float64]

_OF_GAP = 1e-3
"""Of the smallest gap: length up to which Newton steps are trusted."""
_CLEAR = 1e-6
"""Of an obstacle's distance: least gap to begin with; Newton's steps only double smaller ones."""


@dataclass(frozen=True, eq=False)
class Sliding:
    """Lagged friction of an obstacle: its coefficient times the force at points, and their planes.

    ``slip`` is e, m.
    """

    friction: float
    touching: Touching
    carried: Array
    slip: float

    @property
    def points(self) -> NDArray[np.int64]:
        return self.touching.points

    @property
    def most(self) -> Array:
        """The largest friction at each point, (m,), N."""
        return self.friction * self.touching.force

    def motions(self, x: Array) -> Array:
        """Beyond the obstacle's, of its points (m, 3) of all at x (n, 3)."""
        return np.asarray(x[self.points] - self.carried[self.points])

    def value_and_forces(self, u: Array) -> tuple[float, Array]:
        """Of motions u (m, 3) beyond the obstacle's: J, and on the points, (m, 3), N."""
        value, forces = _friction(self.most, self.touching.normals, self.slip, u)
        return value, forces

    def matrices(self, u: Array) -> Array:
        """The second derivative, (m, 3, 3), N/m."""
        return np.asarray(_friction_tangent(self.most, self.touching.normals, self.slip, u))

    def lagged_slopes(self, u: Array, z: Array) -> Array:
        """Derivatives of z . forces by the places where force and plane are taken, (m, 3)."""
        part, e, n = self.touching, self.slip, self.touching.normals
        tangent = u - np.einsum("mi,mi->m", n, u)[:, None] * n
        size = np.linalg.norm(tangent, axis=1)
        over = np.where(size < e, 2.0 / e - size / e**2, 1.0 / np.maximum(size, e))  # f'(u)/u
        along = np.einsum("mi,mi->m", z, tangent)
        un, zn = (np.einsum("mi,mi->m", v, n)[:, None] for v in (u, z))
        bend = np.where(size < e, -1.0 / e**2, -1.0 / np.maximum(size, e) ** 2)
        ratio = np.divide(bend * along, size, out=np.zeros_like(size), where=size > 0.0)
        by_normal = over[:, None] * (un * z + zn * u) + ratio[:, None] * un * u
        out = np.einsum("mij,mj->mi", part.curvatures, self.most[:, None] * by_normal)
        return out + (self.friction * over * along * part.slope)[:, None] * n


@njit(**OPTIONS)
def _tangential(n, u, t):  # type: ignore[no-untyped-def]
    """Fill t (3,) with the part of u across the unit vector n; its length."""
    along = n[0] * u[0] + n[1] * u[1] + n[2] * u[2]
    square = 0.0
    for i in range(3):
        t[i] = u[i] - along * n[i]
        square += t[i] * t[i]
    return math.sqrt(square)


@njit(**OPTIONS)
def _friction(most, normals, e, u):  # type: ignore[no-untyped-def]
    value, forces, t = 0.0, np.empty_like(u), np.empty(3)
    for a in range(len(u)):
        size = _tangential(normals[a], u[a], t)
        inner = min(size, e)
        f = inner * inner / e * (1.0 - inner / (3.0 * e)) + max(size - e, 0.0)
        over = 2.0 / e - size / (e * e) if size < e else 1.0 / size
        value += most[a] * f
        for i in range(3):
            forces[a, i] = -most[a] * over * t[i]
    return value, forces


@njit(**OPTIONS)
def _friction_tangent(most, normals, e, u):  # type: ignore[no-untyped-def]
    out, t = np.empty((len(u), 3, 3)), np.empty(3)
    for a in range(len(u)):
        n, size = normals[a], _tangential(normals[a], u[a], t)
        over = 2.0 / e - size / (e * e) if size < e else 1.0 / size
        bend = 0.0 if size == 0.0 else -1.0 / (e * e * size) if size < e else -1.0 / size**3
        for i in range(3):
            for j in range(3):
                across = (1.0 if i == j else 0.0) - n[i] * n[j]
                out[a, i, j] = most[a] * (over * across + bend * t[i] * t[j])
    return out


class ContactTerm:
    """Barrier and friction of one step.

    Attributes
    ----------
    has_friction, moves : bool
        Of any obstacle, in this step.
    """

    def __init__(self, contact: Contact, stage: StepEquation, state: State) -> None:
        self._contact, self._stage, self._state = contact, stage, state
        self._start, self._end = state.time, stage.end
        x = contact.at(state.positions)
        self._carried = [o.carried(x, self._start, self._end) for o in contact.obstacles]
        self._ways = [carried - x for carried in self._carried]
        self.has_friction = any(contact.frictions)
        self.moves = any(way.any() for way in self._ways)
        self._sliding: list[Sliding] = []
        self._last: tuple[Array, list[Touching]] | None = None
        if self.has_friction:
            self._lag(x, contact.touching(x, self._start))

    def follow(self, y: Array) -> bool:
        """Take friction's forces and planes at a configuration; whether any act or did."""
        if not self.has_friction:
            return False
        before = self._sliding
        x = self._points(y)
        self._lag(x, self._touching(x))
        return any(len(part.points) for part in (*before, *self._sliding))

    def feasible(self, start: Array, free: NDArray[np.bool_]) -> Array:
        """A first iterate (N, 3) outside all obstacles, if one is found, on the way to ``start``.

        From the positions before the step; where obstacles have moved there, nodes near them
        move with them.
        """
        wanted, before = self._stage.moved(start), self._state.positions
        first = np.where(free, before, wanted)
        for reach in (1.0, 3.0, 10.0, np.inf):
            if self._reachable(first):
                break
            for obstacle in self._contact.obstacles:
                carried = obstacle.carried(before, self._start, self._end)
                way = np.abs(carried - before).max()
                if way > 0.0:
                    near = obstacle.gaps(before, self._start) <= reach * way
                    first = np.where(free & near[:, None], carried, first)
        way = wanted - first
        share = self._contact.longest_step(
            self._contact.at(first), self._contact.at(way), self._end
        )
        return start + (first + share * way - wanted) / self._stage.gain

    def _reachable(self, nodal: Array) -> bool:
        """Whether nodes can be there at the end, and no obstacle has passed through the body."""
        contact, x = self._contact, self._contact.at(nodal)
        clear = contact.gaps_at(x, self._end) > _CLEAR * np.array(contact.distances)[:, None]
        return bool(clear.all()) and all(
            not way.any() or obstacle.first_hit(carried, x - carried, self._end) > 1.0
            for obstacle, carried, way in zip(
                contact.obstacles, self._carried, self._ways, strict=True
            )
        )

    def near(self, y: Array) -> bool:
        """Whether a point is within an obstacle's distance at a configuration."""
        gaps = self._contact.gaps_at(self._points(y), self._end)
        return bool((gaps < np.array(self._contact.distances)[:, None]).any())

    def trusted(self, y: Array) -> float:
        """Length up to which a Newton step at y tells the distance from the minimum, m.

        Far too near an obstacle such a step is about as long as the gap, however small that is.
        """
        gap = self._contact.gaps_at(self._points(y), self._end).min()
        return _OF_GAP * float(gap) / self._stage.gain

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """J and N, (N + B, 3)."""
        x, value = self._points(y), 0.0
        forces = np.zeros_like(x)
        for part in self._touching(x):
            value += part.value
            if np.isfinite(part.value):
                forces[part.points] += part.force[:, None] * part.normals
        for sliding in self._sliding:
            loss, pull = sliding.value_and_forces(sliding.motions(x))
            value += loss
            forces[sliding.points] += pull
        factor = self._stage.load_factor
        forces = -factor * self._contact.spread(forces, len(y))
        return factor * value / self._stage.gain, forces

    def tangent(self, y: Array, project: bool = False) -> ContactTangent:
        """The second derivative at y; ``project`` leaves out what is not positive."""
        factor = self._stage.load_factor * self._stage.gain
        parts = self._matrices(self._points(y), project)
        return ContactTangent(self._contact, [(p, factor * H) for p, H in parts])

    def report(self, y: Array) -> dict[str, float]:
        """Smallest gap (m); energy of the barrier, work of obstacles, loss by friction (J)."""
        x, work, loss = self._points(y), 0.0, 0.0
        touching = self._touching(x)
        for part, way in zip(touching, self._ways, strict=True):
            work += float(np.vdot(part.force[:, None] * part.normals, way[part.points]))
        for sliding, way in zip(self._sliding, self._ways, strict=False):
            u = sliding.motions(x)
            forces = sliding.value_and_forces(u)[1]
            work += float(np.vdot(forces, way[sliding.points]))
            loss -= float(np.vdot(forces, u))
        return {
            "smallest_gap": float(self._contact.gaps_at(x, self._end).min()),
            "contact_energy": sum(part.value for part in touching),
            "obstacle_work": work,
            "friction_loss": loss,
        }

    def slopes(self, y: Array, z: Array) -> tuple[Array, Array]:
        """Derivatives of z . forces (in the equation), for z (N, 3).

        By the positions of the points after the step and before it, of each obstacle: twice
        (obstacles, n, 3).
        """
        x, at = self._points(y), self._contact.at(z)
        factor, obstacles = self._stage.load_factor, self._contact.obstacles
        ends, starts = np.zeros((2, len(obstacles), *at.shape))
        for i, part in enumerate(self._touching(x)):
            H = part.matrices()
            ends[i, part.points] -= np.einsum("mij,mj->mi", H, at[part.points])
        for i, sliding in enumerate(self._sliding):
            points, u = sliding.points, sliding.motions(x)
            by_u = -np.einsum("mij,mj->mi", sliding.matrices(u), at[points])
            R = obstacles[i].turned(self._start, self._end)
            starts[i, points] -= by_u @ R
            ends[i, points] += by_u + sliding.lagged_slopes(u, at[points])
        return factor * ends, factor * starts

    def lagged_slopes(self, y: Array, z: Array) -> Array:
        """The part of the first that is lagged in a step, all obstacles', (N, 3)."""
        x, at = self._points(y), self._contact.at(z)
        out = np.zeros_like(at)
        for sliding in self._sliding:
            more = sliding.lagged_slopes(sliding.motions(x), at[sliding.points])
            out[sliding.points] += more
        return self._stage.load_factor * self.nodal(out, len(z))

    def nodal(self, values: Array, count: int) -> Array:
        """Values (n, 3) at the points as nodal ones (count, 3)."""
        return self._contact.spread(values, count)

    def friction_slopes(self, y: Array, z: Array) -> Array:
        """Derivatives of z . forces (in the equation) by the coefficients, (obstacles,)."""
        x, at = self._points(y), self._contact.at(z)
        out = np.zeros(len(self._contact.obstacles))
        for i, sliding in enumerate(self._sliding):
            if sliding.friction:
                forces = sliding.value_and_forces(sliding.motions(x))[1]
                out[i] = np.vdot(at[sliding.points], forces) / sliding.friction
        return self._stage.load_factor * out

    def _matrices(self, x: Array, project: bool) -> list[tuple[NDArray[np.int64], Array]]:
        touching = self._touching(x)
        parts = [(part.points, part.matrices(project)) for part in touching]
        return parts + [(part.points, part.matrices(part.motions(x))) for part in self._sliding]

    def longest_step(self, y: Array, direction: Array) -> float:
        """Largest share of a direction, at most 1, that crosses no obstacle."""
        way = self._stage.gain * self._contact.at(direction)
        return self._contact.longest_step(self._points(y), way, self._end)

    def _points(self, y: Array) -> Array:
        return self._contact.at(self._stage.moved(y[: len(self._state.positions)]))

    def _touching(self, x: Array) -> list[Touching]:
        """At the end of the step; those of the last x are kept."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = x, self._contact.touching(x, self._end)
        return self._last[1]

    def _lag(self, x: Array, touching: list[Touching]) -> None:
        contact, h = self._contact, self._end - self._start
        parts = zip(contact.frictions, touching, self._carried, strict=True)
        self._sliding = [
            Sliding(friction, part, carried, slip * h)
            for (friction, part, carried), slip in zip(parts, contact.slips, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class ContactTangent:
    """Second derivatives (m, 3, 3) at groups of points."""

    contact: Contact
    parts: list[tuple[NDArray[np.int64], Array]]

    def apply(self, x: Array) -> Array:
        """Times x (N + B, 3)."""
        out = np.zeros_like(x)
        for points, matrices in self.parts:
            self.contact.add_product(points, matrices, x, out)
        return out

    def add_to(self, blocks: Array) -> None:
        """Add to the cells' matrices (C, L, L, 3, 3)."""
        for points, matrices in self.parts:
            self.contact.add_to(blocks, matrices, points)
