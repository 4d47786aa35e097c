"""Implicit time integrators as tables of linear combinations of nodal arrays.

A step of h seconds solves

    c M (y - q) + d C (y - o) = f_int(y) + f_ext

for one unknown configuration y, so every integrator minimises the same kind of
function (thesis eq. 3-6) and projective dynamics needs no more than other factors in G.
C is Rayleigh damping, d (y - o) the velocity at y.  Everything else in a step is a
linear combination of what is known at its start and of y, with coefficients that
depend on h alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any

from pdcorrect.errors import InputError


class Linear:
    """A sum of coefficients times arrays that are known by name.

    >>> p, v = Linear(positions=1.0), Linear(velocities=1.0)
    >>> p + 0.1 * v
    Linear(positions=1, velocities=0.1)
    >>> (p + 0.1 * v)({"positions": 2.0, "velocities": 10.0})
    3.0
    """

    def __init__(self, **coefficients: float) -> None:
        self.coefficients = {name: c for name, c in coefficients.items() if c != 0.0}

    def __repr__(self) -> str:
        terms = ", ".join(f"{name}={c:g}" for name, c in self.coefficients.items())
        return f"Linear({terms})"

    def __call__(self, arrays: Mapping[str, Any]) -> Any:
        """The sum; 0.0 where there are no terms.

        Raises
        ------
        KeyError
            If an array is missing.
        """
        total: Any = 0.0
        for name, c in self.coefficients.items():
            term = arrays[name] if c == 1.0 else c * arrays[name]
            total = term if isinstance(total, float) else total + term
        return total

    def transpose(self, x: Any, sums: MutableMapping[str, Any]) -> None:
        """Add coefficient times x to each name's entry of ``sums``."""
        for name, c in self.coefficients.items():
            sums[name] = sums[name] + c * x if name in sums else c * x

    def __add__(self, other: Linear) -> Linear:
        out = dict(self.coefficients)
        for name, c in other.coefficients.items():
            out[name] = out.get(name, 0.0) + c
        return Linear(**out)

    def __mul__(self, factor: float) -> Linear:
        return Linear(**{name: factor * c for name, c in self.coefficients.items()})

    __rmul__ = __mul__

    def __neg__(self) -> Linear:
        return self * -1.0

    def __sub__(self, other: Linear) -> Linear:
        return self + -other

    def __truediv__(self, divisor: float) -> Linear:
        return self * (1.0 / divisor)


def by_component(
    library: Any, free: Any, known: Mapping[str, Any], on_free: Linear, on_clamped: Linear | None
) -> Any:
    """One sum on free components and, if there is another, that one on clamped components.

    ``library`` is numpy or torch, whichever ``free`` (bool) and ``known``, with an entry
    "positions", belong to.
    """
    values = on_free(known)
    if isinstance(values, float):
        values = library.zeros_like(known["positions"])
    if on_clamped is None:
        return values
    return library.where(free, values, on_clamped(known))


_P, _V, _A = Linear(positions=1.0), Linear(velocities=1.0), Linear(accelerations=1.0)
_Y, _PRESCRIBED = Linear(y=1.0), Linear(prescribed=1.0)
_CLAMP_VELOCITY = Linear(clamp_velocity=1.0)


@dataclass(frozen=True)
class Scheme:
    """The equation of one step and what follows from its solution.

    The linear combinations are of ``positions``, ``velocities`` and the entries of
    `State.memory` at the start of the step; ``time``, s; ``prescribed``, the clamped
    positions at its end; ``clamp_velocity`` and ``clamp_velocity_at_y``, the clamps'
    velocities at its end and at y's time; ``clamp_jump``, the change of their
    acceleration from the middle of the step to y's time; the last ones of ``y`` too.
    Those named ``clamped_…`` hold where components are clamped, by default as elsewhere.

    Attributes
    ----------
    inertia : float
        c, 1/s2.
    rate : float
        d, 1/s.
    target, origin : Linear
        q and o, m.
    start : Linear
        First iterate, m.
    loads_at : Linear
        Positions at which follower loads are sampled, m.
    positions, velocities : Linear
        After the step.
    clamped : Linear
        The prescribed y.
    loads_over : tuple of float
        Loads are averaged over this time interval, in steps from the start, or taken at
        its ends if these are equal.
    gain : float
        dp'/dy, by which an error of y grows.
    memory : mapping of str to (Linear, Linear)
        `State.memory` after the step, on free and on clamped components.
    """

    inertia: float
    rate: float
    target: Linear
    origin: Linear
    start: Linear
    loads_at: Linear
    positions: Linear
    velocities: Linear
    clamped: Linear = _PRESCRIBED
    clamped_target: Linear | None = None
    clamped_origin: Linear | None = None
    clamped_velocities: Linear | None = None
    loads_over: tuple[float, float] = (0.0, 1.0)
    gain: float = 1.0
    memory: Mapping[str, tuple[Linear, Linear]] = field(default_factory=dict)


SchemeOf = Callable[[float, bool], Scheme]
"""(h, started) -> the scheme; ``started`` says whether the state has the memory for it."""


def backward_euler(h: float, started: bool = False) -> Scheme:
    """Thesis eq. 3-1 to 3-4: v' = (p' - p)/h, M (v' - v)/h = f(p').  First order."""
    target = _P + h * _V
    return Scheme(1.0 / h**2, 1.0 / h, target, _P, target, _P, _Y, (_Y - _P) / h)


def bdf2(h: float, started: bool) -> Scheme:
    """Two-step backward differences: p' = (4 p - p_)/3 + 2h/3 v', the same for v'.

    Second order.  Without the state one step of the same length before the step is one
    of backward Euler, which, at the start only, does not lower the order.
    """
    rate, origin, drift = 1.0 / h, _P, _V
    if started:
        rate = 1.5 / h
        origin = (4.0 * _P - Linear(previous_positions=1.0)) / 3.0
        drift = (4.0 * _V - Linear(previous_velocities=1.0)) / 3.0
    target, ahead = origin + drift / rate, _P + h * _V
    kept = {
        "previous_positions": _P,
        "previous_velocities": _V,
        "previous_times": Linear(time=1.0),
    }
    return Scheme(
        rate**2, rate, target, origin, target, ahead, _Y, rate * (_Y - origin),
        loads_over=(1.0, 1.0), memory={name: (row, row) for name, row in kept.items()},
    )  # fmt: skip


def midpoint(h: float, started: bool = False) -> Scheme:
    """Implicit midpoint: y = (p + p')/2, M (v' - v)/h = f(y), p' - p = h (v + v')/2.

    Second order, symplectic; keeps linear and angular momentum.
    """
    target, clamped = _P + 0.5 * h * _V, 0.5 * (_P + _PRESCRIBED)
    return Scheme(
        4.0 / h**2, 2.0 / h, target, _P, target, target, 2.0 * _Y - _P,
        (4.0 / h) * (_Y - _P) - _V, clamped,
        clamped_target=clamped - 0.25 * h * (_CLAMP_VELOCITY - _V),
        clamped_velocities=_CLAMP_VELOCITY,
        gain=2.0,
    )  # fmt: skip


def generalised_alpha(spectral_radius: float) -> SchemeOf:
    """Chung and Hulbert (1993): second order, with chosen damping of high frequencies."""
    r = spectral_radius
    if not 0.0 <= r <= 1.0:
        raise InputError(f"spectral_radius = {r!r}: expected a number from 0 to 1.")
    alpha_m, alpha_f = (2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0)
    gamma = 0.5 - alpha_m + alpha_f
    beta = 0.25 * (1.0 - alpha_m + alpha_f) ** 2

    def scheme(h: float, started: bool) -> Scheme:
        scale = 1.0 / ((1.0 - alpha_f) * beta * h**2)
        at_rest = -_V / (beta * h) - (0.5 / beta - 1.0) * _A  # a' for y = p
        rate = gamma / (beta * h)
        inertia = (1.0 - alpha_m) * scale

        def ahead(acceleration: Linear) -> Linear:
            return _V + h * ((1.0 - gamma) * _A + gamma * acceleration)

        new = at_rest + scale * (_Y - _P)
        start = _P + (1.0 - alpha_f) * h * _V
        clamped = alpha_f * _P + (1.0 - alpha_f) * _PRESCRIBED
        # the clamps' mean acceleration over the step, moved to y's time:
        acceleration = (_CLAMP_VELOCITY - _V) / h
        if started:
            acceleration += Linear(clamp_jump=1.0)
        return Scheme(
            inertia,
            rate,
            target=_P - (at_rest + alpha_m / (1.0 - alpha_m) * _A) / scale,
            origin=_P - ((1.0 - alpha_f) * ahead(at_rest) + alpha_f * _V) / rate,
            start=start,
            loads_at=start,
            positions=_P + (_Y - _P) / (1.0 - alpha_f),
            velocities=ahead(new),
            clamped=clamped,
            clamped_target=clamped - acceleration / inertia,
            clamped_origin=clamped - Linear(clamp_velocity_at_y=1.0) / rate,
            clamped_velocities=_CLAMP_VELOCITY,
            loads_over=(1.0 - alpha_f, 1.0 - alpha_f),
            gain=1.0 / (1.0 - alpha_f),
            memory={"accelerations": (new, Linear())},
        )

    return scheme


def quasi_static(h: float, started: bool = False) -> Scheme:
    """Equilibrium f(p') = 0 under the loads and clamps at the end of the step."""
    return Scheme(0.0, 0.0, _P, _P, _P, _P, _Y, Linear(), loads_over=(1.0, 1.0))
