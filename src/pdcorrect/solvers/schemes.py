"""Implicit time integrators as tables of linear combinations of nodal arrays.

A step of h seconds solves

    c M (y - q) + d C (y - o) + f_visc(y) = f_int(y) + b f_ext + g

for one unknown configuration y, so every integrator minimises the same kind of
function (thesis eq. 3-6) and projective dynamics needs no more than other factors in G.
C is Rayleigh damping, d (y - o) the velocity at y; f_visc is the force of the rate of
stretch e (S(y) - sum of a_k S(x_k)) of viscosity; b is 1 and g none but for
generalised-alpha.  Everything else in a step is a linear
combination of what is known at its start and of y, with coefficients that depend on h
alone.

Loads are averaged over intervals that follow each other without gap or overlap, centred
where the equation is.  So the momentum of a body is that of the loads at any step, and
second order is kept.  In the first step of several, whose equation weighs more, the
interval begins at its start and is as much longer.
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
        """The sum; 0.0 where there are no terms."""
        total: Any = None
        for name, c in self.coefficients.items():
            term = arrays[name] if c == 1.0 else c * arrays[name]
            total = term if total is None else total + term
        return 0.0 if total is None else total

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


_P, _V = Linear(positions=1.0), Linear(velocities=1.0)
_Y, _PRESCRIBED = Linear(y=1.0), Linear(prescribed=1.0)
_BEHIND, _AHEAD = Linear(clamp_velocity_behind=1.0), Linear(clamp_velocity_ahead=1.0)
_CLAMP_VELOCITY = 0.5 * (_BEHIND + _AHEAD)
_INTERNAL = Linear(internal_forces_after=1.0)


Strains = tuple[tuple[float, Linear], ...]


@dataclass(frozen=True)
class Scheme:
    """The equation of one step and what follows from its solution.

    The linear combinations are of ``positions``, ``velocities`` and the entries of
    `State.memory` at the start of the step; ``time``, s; ``prescribed``, the clamped
    positions at its end; ``clamp_velocity_behind`` and ``clamp_velocity_ahead``, their mean
    velocities over the step and over as long after it.  Those of what follows are of ``y`` too,
    and of ``internal_forces_after``, the forces of the body and its damping that satisfy the
    equation at y, c M (y - q) - b f_ext - g.  Those named ``clamped_…`` hold where components
    are clamped, by default as elsewhere.

    Attributes
    ----------
    inertia : float
        c, 1/s2.
    rate : float
        d, 1/s.
    target, origin : Linear
        q and o, m.
    start, foreseen : Linear
        First iterate, and a y of second order, where Rayleigh stiffness is taken, m; the
        first iterate if there is none.
    positions, velocities : Linear
        After the step.
    clamped : Linear
        The prescribed y.
    loads_over : tuple of float
        Loads are averaged over this time interval, in steps from the start, or taken at
        its ends if these are equal.
    load_factor : float
        b.
    past_forces : Linear
        g, N.
    sampled : Linear
        Where loads that follow the body are sampled.
    strain_rate : float
        e, 1/s.
    strains : tuple of (float, Linear)
        a_k and x_k, m.
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
    positions: Linear
    velocities: Linear
    clamped: Linear = _PRESCRIBED
    clamped_target: Linear | None = None
    clamped_origin: Linear | None = None
    clamped_velocities: Linear | None = None
    foreseen: Linear | None = None
    loads_over: tuple[float, float] = (0.0, 1.0)
    load_factor: float = 1.0
    past_forces: Linear = field(default_factory=Linear)
    sampled: Linear = _Y
    strain_rate: float = 0.0
    strains: Strains = ()
    gain: float = 1.0
    memory: Mapping[str, tuple[Linear, Linear]] = field(default_factory=dict)


SchemeOf = Callable[[float, frozenset[str]], Scheme]
"""(h, known) -> the scheme; ``known`` are the entries of the state's memory that it may use."""

HISTORY = {
    "previous_positions", "previous_velocities", "previous_times",
    "strained", "strained_before",
}  # fmt: skip
"""Entries of a memory that are of use only to a step as long as the last one."""
WHOLE_MEMORY = frozenset(HISTORY | {"accelerations", "internal_forces"})
"""All entries that any scheme uses."""
_TIME = Linear(time=1.0)


def backward_euler(h: float, known: frozenset[str] = frozenset()) -> Scheme:
    """Thesis eq. 3-1 to 3-4: v' = (p' - p)/h, M (v' - v)/h = f(p').  First order."""
    target = _P + h * _V
    return Scheme(
        1.0 / h**2, 1.0 / h, target, _P, target, _Y, (_Y - _P) / h,
        strain_rate=1.0 / h, strains=((1.0, _P),),
    )  # fmt: skip


def bdf2(h: float, known: frozenset[str]) -> Scheme:
    """Two-step backward differences: p' = (4 p - p_)/3 + 2h/3 v', the same for v'.

    Second order.  Without the state one step of the same length before the step is one
    of backward Euler, which, at the start only, does not lower the order.
    """
    started = known >= {"previous_positions", "previous_velocities"}
    rate = (1.5 if started else 1.0) / h
    strain_rate, strains, kept = _at_ends(h, known)
    kept["previous_velocities"] = (_V, _V)
    origin = _backward(_P, "previous_positions") if started else _P
    drift = _backward(_V, "previous_velocities") if started else _V
    target = origin + drift / rate
    foreseen = _P + h * (1.5 * _V - Linear(previous_velocities=0.5)) if started else None
    return Scheme(
        rate**2, rate, target, origin, target, _Y, rate * (_Y - origin), foreseen=foreseen,
        loads_over=(0.5 if started else 0.0, 1.5), strain_rate=strain_rate, strains=strains,
        memory=kept,
    )  # fmt: skip


def _at_ends(
    h: float, known: frozenset[str]
) -> tuple[float, Strains, dict[str, tuple[Linear, Linear]]]:
    """Rate of stretch at the end of a step by backward differences, and the memory they need."""
    memory = {"previous_positions": (_P, _P), "previous_times": (_TIME, _TIME)}
    if "previous_positions" not in known:
        return 1.0 / h, ((1.0, _P),), memory
    before = Linear(previous_positions=1.0)
    return 1.5 / h, ((4.0 / 3.0, _P), (-1.0 / 3.0, before)), memory


def _backward(now: Linear, before: str) -> Linear:
    """(4 now - before)/3, see `bdf2`."""
    return (4.0 * now - Linear(**{before: 1.0})) / 3.0


def midpoint(h: float, known: frozenset[str] = frozenset(), *, viscous: bool = False) -> Scheme:
    """Implicit midpoint: y = (p + p')/2, M (v' - v)/h = f(y), p' - p = h (v + v')/2.

    Second order, symplectic; keeps linear and angular momentum.
    """
    target, clamped = _P + 0.5 * h * _V, 0.5 * (_P + _PRESCRIBED)
    rate, strains, memory = _between(h, known) if viscous else (0.0, (), {})
    return Scheme(
        4.0 / h**2, 2.0 / h, target, _P, target, 2.0 * _Y - _P, (4.0 / h) * (_Y - _P) - _V,
        clamped,
        clamped_target=clamped - 0.25 * h * (_CLAMP_VELOCITY - _V),
        clamped_velocities=_CLAMP_VELOCITY,
        strain_rate=rate, strains=strains, gain=2.0, memory=memory,
    )  # fmt: skip


def _between(
    h: float, known: frozenset[str]
) -> tuple[float, Strains, dict[str, tuple[Linear, Linear]]]:
    """Rate of stretch at a y between two frames, and the memory that it needs.

    Such a y lies on the chord of a turning node's path, so that S(y) is a little smaller
    than S at either frame.  Differences of the stretches at y alone, of this step and of
    two before, are free of that, and second order (as `bdf2`).  The first two steps have
    less to go by.
    """
    last, before = Linear(strained=1.0), Linear(strained_before=1.0)
    memory = {"strained": (_Y, _Y), "previous_times": (_TIME, _TIME)}
    if "strained" not in known:
        return 2.0 / h, ((1.0, _P),), memory
    memory["strained_before"] = (last, last)
    if "strained_before" not in known:
        return 1.0 / h, ((1.0, last),), memory
    return 1.5 / h, ((4.0 / 3.0, last), (-1.0 / 3.0, before)), memory


@dataclass(frozen=True)
class GeneralisedAlpha:
    """Second order, with chosen damping of high frequencies (Chung and Hulbert 1993).

    M ((1 - alpha_m) a' + alpha_m a) = (1 - alpha_f) f(p') + alpha_f f(p) + loads, with the
    internal forces f, damping included, of both ends.  So no force is that of a point on the
    chord of a turning node's path, where strains are other ones.  Divided by 1 - alpha_f it
    is an equation at the end of the step.  The first step has constant acceleration,
    which does not lower the order.  The spectral radius, 0 to 1, is that at infinite
    frequency; ``viscous`` steps need the rate of stretch.
    """

    spectral_radius: float
    viscous: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.spectral_radius <= 1.0:
            raise InputError(
                f"spectral_radius = {self.spectral_radius!r}: expected a number from 0 to 1."
            )

    def __call__(self, h: float, known: frozenset[str]) -> Scheme:
        """The scheme of a step of h seconds."""
        r, started = self.spectral_radius, known >= {"accelerations", "internal_forces"}
        delay = r / (r + 1.0)
        alpha_f = delay if started else 0.0
        alpha_m = (2.0 * r - 1.0) / (r + 1.0) if started else 0.0
        gamma = 0.5 - alpha_m + alpha_f if started else 1.0
        beta = 0.25 * (1.0 - alpha_m + alpha_f) ** 2 if started else 0.5
        a = Linear(accelerations=1.0) if started else Linear()
        factor = 1.0 / (1.0 - alpha_f)
        at_rest = -_V / (beta * h) - (0.5 / beta - 1.0) * a  # a' for y = p
        new = at_rest + (_Y - _P) / (beta * h**2)
        inertia = factor * (1.0 - alpha_m) / (beta * h**2)
        rate = gamma / (beta * h)

        def ahead(acceleration: Linear) -> Linear:
            return _V + h * ((1.0 - gamma) * a + gamma * acceleration)

        # the clamps' mean acceleration over the interval of the loads:
        first, last = 0.5 - delay if started else 0.0, 1.5 - delay
        clamps = (1.0 - delay) * (_AHEAD - _BEHIND) + (1.0 - 2.0 * first) * (_BEHIND - _V)
        clamps /= (last - first) * h
        strain_rate, strains, memory = _at_ends(h, known) if self.viscous else (0.0, (), {})
        start = _P + h * _V
        return Scheme(
            inertia,
            rate,
            target=_P - factor * ((1.0 - alpha_m) * at_rest + alpha_m * a) / inertia,
            origin=_P - ahead(at_rest) / rate,
            start=start,
            positions=_Y,
            velocities=ahead(new),
            clamped_target=_PRESCRIBED - factor * clamps / inertia,
            clamped_origin=_PRESCRIBED - _CLAMP_VELOCITY / rate,
            clamped_velocities=_CLAMP_VELOCITY,
            foreseen=start + 0.5 * h**2 * a,
            loads_over=(first, last),
            load_factor=factor,
            past_forces=alpha_f * factor * Linear(internal_forces=1.0),
            sampled=(1.0 - alpha_f) * _Y + alpha_f * _P,
            strain_rate=strain_rate,
            strains=strains,
            memory={
                "accelerations": (new, Linear()),
                "internal_forces": (_INTERNAL, _INTERNAL),
                **memory,
            },
        )


def quasi_static(h: float, known: frozenset[str] = frozenset()) -> Scheme:
    """Equilibrium f(p') = 0 under the loads and clamps at the end of the step."""
    return Scheme(0.0, 0.0, _P, _P, _P, _Y, Linear(), loads_over=(1.0, 1.0))
