"""Loads of a scene as nodal force vectors with an amplitude over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import SceneError
from pdcorrect.fem.assembly import scatter
from pdcorrect.fem.clamps import Selector
from pdcorrect.fem.operators import Space
from pdcorrect.fem.quadrature import FaceQuadrature
from pdcorrect.scene import (
    BodyForce,
    Force,
    Gravity,
    Load,
    Pressure,
    Scene,
    Torsion,
    Traction,
)

Array = NDArray[np.float64]


class Amplitude:
    """Piecewise linear factor over time, with jumps at the ends of a window."""

    def __init__(self, load: Load) -> None:
        if load.table is not None:
            self._times, self._values = np.array(load.table).T
            self._ends = self._values[0], self._values[-1]
            return
        start, end = load.window or (0.0, np.inf)
        ramp = min(load.ramp, end - start)
        self._times, self._values = np.array([start, start + ramp]), np.array([1.0, 1.0])
        if ramp:
            self._values[:] = 0.0, ramp / load.ramp
        self._ends = 0.0, self._values[1] if np.isinf(end) else 0.0
        if np.isfinite(end):
            self._times = np.append(self._times, end)
            self._values = np.append(self._values, self._values[1])

    @property
    def constant(self) -> bool:
        """Whether the amplitude is 1 at all times from zero on."""
        return self._ends == (0.0, 1.0) and not self._times.any()

    def mean(self, start: float, end: float) -> float:
        """Mean over [start, end] in seconds; the value where they are equal."""
        if self.constant:
            return 1.0
        if end <= start:
            return self._value(end)
        inner = self._times[(self._times > start) & (self._times < end)]
        ends = np.concatenate([[start], inner, [end]])
        middles = 0.5 * (ends[1:] + ends[:-1])  # the amplitude is linear in between
        values = np.array([self._value(t) for t in middles])
        return float(values @ np.diff(ends) / (end - start))

    def _value(self, time: float) -> float:
        before, after = self._ends
        return float(np.interp(time, self._times, self._values, before, after))


@dataclass(frozen=True, eq=False)
class NodalLoad:
    """One load on a mesh: ``amplitude(t) * field``.

    Attributes
    ----------
    amplitude : Amplitude
    pattern : (N, 3)
        Nodal forces at amplitude 1 on the body at rest, N.
    sample : callable or None
        For follower loads: nodal forces at given positions.
    pull : callable or None
        For follower loads: (positions, x) -> derivatives (N, 3) of x . sample(positions).
    acceleration : (3,) or None
        Of loads that are nodal mass times an acceleration, m/s2.
    """

    amplitude: Amplitude
    pattern: Array
    sample: Callable[[Array], Array] | None = None
    pull: Callable[[Array, Array], Array] | None = None
    acceleration: Array | None = None

    def forces(self, start: float, end: float, positions: Array | None) -> Array:
        """Nodal forces (N, 3), N, for the step from ``start`` to ``end`` (s)."""
        factor = self.amplitude.mean(start, end)
        if self.sample is None or positions is None or factor == 0.0:
            return factor * self.pattern
        return factor * self.sample(positions)

    def pulled(self, start: float, end: float, positions: Array, x: Array) -> Array:
        """Derivatives (N, 3) of x . `forces` by the positions, N/m, for x (N, 3)."""
        factor = self.amplitude.mean(start, end)
        if self.pull is None or factor == 0.0:
            return np.zeros_like(x)
        return factor * self.pull(positions, x)


def assemble_loads(
    scene: Scene, space: Space, selector: Selector, nodal_mass: Array, free: NDArray[np.bool_]
) -> tuple[NodalLoad, ...]:
    """All loads of a scene on one mesh; each must act on a free component."""
    loads = []
    for i, load in enumerate(scene.loads):
        key = f"loads[{i}]"
        sample, pull = _SAMPLERS[type(load)](load, space, selector, nodal_mass, f"{key}.region")
        pattern = sample(space.positions)
        if pattern.any() and not pattern[free].any():
            raise SceneError(
                f"{key} (kind = {load.kind!r}) acts only on components that clamps hold: "
                "expected at least one free component. Change its region, its direction or the "
                "clamps."
            )
        amplitude = Amplitude(load)
        if getattr(load, "follower", False):
            loads.append(NodalLoad(amplitude, pattern, sample, pull))
        else:
            acceleration = np.array(load.acceleration) if isinstance(load, Gravity) else None
            loads.append(NodalLoad(amplitude, pattern, acceleration=acceleration))
    return tuple(loads)


Sampler = tuple[Callable[[Array], Array], Callable[[Array, Array], Array]]
"""Positions -> nodal forces, and (positions, x) -> derivatives of x . forces."""


def _fixed(pattern: Array) -> Sampler:
    """Forces that do not depend on the positions."""
    return lambda positions: pattern, lambda positions, x: np.zeros_like(x)


def _gravity(
    load: Gravity, space: Space, selector: Selector, nodal_mass: Array, key: str
) -> Sampler:
    return _fixed(nodal_mass[:, None] * np.array(load.acceleration))


def _body_force(
    load: BodyForce, space: Space, selector: Selector, mass: Array, key: str
) -> Sampler:
    return _fixed(_in_cells(space, selector.cells(load.region, key), np.array(load.density)))


def _force(load: Force, space: Space, selector: Selector, mass: Array, key: str) -> Sampler:
    total = np.array(load.force)
    if load.distribution == "nodal":
        nodes = selector.coarse_nodes(load.region, key)
        pattern = np.zeros_like(space.positions)
        pattern[nodes] = total / len(nodes)
    elif load.region.nodes is not None:
        raise SceneError(
            f"{key} = {load.region.describe()} with distribution = 'consistent': a list of nodes "
            "has no area or volume to spread the force over. Use distribution = 'nodal', or a "
            "plane, box or sphere."
        )
    elif selector.is_surface(load.region, key):
        face = space.face_quadrature(selector.faces(load.region, key))
        traction = total / face.weights.sum()
        values = np.einsum("nq,nqk,i->nki", face.weights, face.values, traction)
        pattern = scatter(space.cells[face.cells], values, len(space.positions))
    else:
        cells = selector.cells(load.region, key)
        pattern = _in_cells(space, cells, total / space.volumes()[cells].sum())
    return _fixed(pattern)


def _traction(load: Traction, space: Space, selector: Selector, mass: Array, key: str) -> Sampler:
    face = space.face_quadrature(selector.faces(load.region, key))
    values = np.einsum("nq,nqk,i->nki", face.weights, face.values, np.array(load.traction))
    return _fixed(scatter(space.cells[face.cells], values, len(space.positions)))


@dataclass(frozen=True, eq=False)
class _Pressure:
    """Nanson's formula: n da = cof(F) N dA."""

    pressure: float
    face: FaceQuadrature
    nodes: NDArray[np.int64]

    def sample(self, positions: Array) -> Array:
        face, F = self.face, self._deformation(positions)
        area = np.einsum("nqij,nqj->nqi", cofactor(F), face.normals)
        values = np.einsum("nq,nqk,nqi->nki", face.weights, face.values, -self.pressure * area)
        return scatter(self.nodes, values, len(positions))

    def pull(self, positions: Array, x: Array) -> Array:
        face, F = self.face, self._deformation(positions)
        at_points = -self.pressure * np.einsum(
            "nq,nqk,nki->nqi", face.weights, face.values, x[self.nodes]
        )
        slope = tensor_cross(F, at_points[..., :, None] * face.normals[..., None, :])
        values = np.einsum("nqij,nqkj->nki", slope, face.gradients)
        return scatter(self.nodes, values, len(positions))

    def _deformation(self, positions: Array) -> Array:
        return np.einsum("nki,nqkj->nqij", positions[self.nodes], self.face.gradients)


def _pressure(load: Pressure, space: Space, selector: Selector, mass: Array, key: str) -> Sampler:
    face = space.face_quadrature(selector.faces(load.region, key))
    field = _Pressure(load.pressure, face, space.cells[face.cells])
    return field.sample, field.pull


@dataclass(frozen=True, eq=False)
class _Torsion:
    """The field at some ``nodes``, or integrated over cells, ``inside`` (C, 1, 1) being 1 there."""

    load: Torsion
    centre: Array
    space: Space
    nodes: NDArray[np.int64] | None
    inside: Array | None

    def sample(self, positions: Array) -> Array:
        return self._spread(self.load.strength * torsion_field(*self._field(positions)))

    def pull(self, positions: Array, x: Array) -> Array:
        if self.inside is None:
            along = x[self.nodes]
        else:
            along = self.space.body_load_transposed(x) * self.inside
        slopes = self.load.strength * torsion_pull(*self._field(positions), along)
        if self.inside is None:
            return self._spread(slopes)
        return self.space.interpolate_transposed(slopes)

    def _field(self, positions: Array) -> tuple[Array, float, float]:
        """Points from the centre, where the field is, and its two shares."""
        if self.nodes is not None:
            points = positions[self.nodes]
        elif positions is self.space.positions:
            points = self.space.points
        else:
            points = self.space.interpolate(positions)
        return points - self.centre, self.load.attraction, self.load.stretch

    def _spread(self, field: Array) -> Array:
        if self.inside is not None:
            return self.space.body_load(field * self.inside)
        out = np.zeros_like(self.space.positions)
        out[self.nodes] = field
        return out


def _torsion(load: Torsion, space: Space, selector: Selector, mass: Array, key: str) -> Sampler:
    rest = space.positions
    middle = 0.5 * (rest.min(axis=0) + rest.max(axis=0))
    centre = middle if load.centre is None else np.array(load.centre)
    nodes = inside = None
    if load.distribution == "nodal":
        nodes = selector.coarse_nodes(load.region, key)
    else:
        inside = _inside(space, selector.cells(load.region, key))
    field = _Torsion(load, centre, space, nodes, inside)
    return field.sample, field.pull


_SAMPLERS: dict[type, Callable[..., Sampler]] = {
    Gravity: _gravity,
    BodyForce: _body_force,
    Force: _force,
    Traction: _traction,
    Pressure: _pressure,
    Torsion: _torsion,
}


def _inside(space: Space, cells: NDArray[np.int64]) -> Array:
    """1 in some cells, 0 in the others, (C, 1, 1)."""
    inside = np.zeros((len(space.cells), 1, 1))
    inside[cells] = 1.0
    return inside


def _in_cells(space: Space, cells: NDArray[np.int64], density: Array) -> Array:
    return space.body_load(np.broadcast_to(density, space.points.shape) * _inside(space, cells))


_ON_AXIS = 1e-9
"""Distance from the axis, of the body's extent, that is taken as zero."""


def torsion_field(points: Array, attraction: float, stretch: float) -> Array:
    """Unit rotational field of the thesis, eq. 6-1 to 6-3, at ``points`` (..., 3).

    f = (stretch, -z - attraction y, y - attraction z) / |...|, and 0 where the
    numerator vanishes (on the axis with no stretch) or is only a rounding error
    of the coordinates.
    """
    f, inverse = _torsion_vectors(points, attraction, stretch)
    return f * inverse


def torsion_pull(points: Array, attraction: float, stretch: float, x: Array) -> Array:
    """Derivatives of x . `torsion_field` by the points (..., 3); zero where the field is."""
    f, inverse = _torsion_vectors(points, attraction, stretch)
    f = f * inverse
    rest = (x - f * (f * x).sum(axis=-1, keepdims=True)) * inverse  # d|f|^-1 f
    out = np.zeros_like(points)
    out[..., 1] = rest[..., 2] - attraction * rest[..., 1]
    out[..., 2] = -rest[..., 1] - attraction * rest[..., 2]
    return out


def _torsion_vectors(points: Array, attraction: float, stretch: float) -> tuple[Array, Array]:
    """The field before it is scaled, and 1 / its lengths (..., 1), 0 where it is only round-off."""
    y, z = points[..., 1], points[..., 2]
    f = np.stack([np.full_like(y, stretch), -z - attraction * y, y - attraction * z], axis=-1)
    length = np.linalg.norm(f, axis=-1, keepdims=True)
    rounding = _ON_AXIS * np.abs(points).max(initial=0.0)
    return f, np.divide(1.0, length, out=np.zeros_like(length), where=length > rounding)


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def cofactor(F: Array) -> Array:
    """Cofactor matrix det(F) F^-T of (..., 3, 3), also for singular F."""
    return np.cross(F[..., _NEXT, :], F[..., _LAST, :])


def tensor_cross(A: Array, B: Array) -> Array:
    """Derivative of `cofactor` at A in the direction B, (..., 3, 3); symmetric in both."""
    ahead = np.cross(A[..., _NEXT, :], B[..., _LAST, :])
    return ahead + np.cross(B[..., _NEXT, :], A[..., _LAST, :])
