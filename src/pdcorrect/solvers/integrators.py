"""Time integrators: what the tables of `schemes` make of a state.

An integrator is a function from the state to the equation of the step, a `StepEquation`, which
also knows how its solution gives the next state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers import schemes
from pdcorrect.solvers.schemes import Linear, Scheme, SchemeOf, by_component
from pdcorrect.state import State

Array = NDArray[np.float64]

_EQUAL_STEPS = 1e-6
"""Relative difference up to which two steps count as equal."""


@dataclass(frozen=True, eq=False)
class StepEquation:
    """The equation of one step: a `Scheme` with nodal arrays (N, 3) in place of combinations.

    ``start`` and ``foreseen`` are prescribed where clamped, ``loads_over`` is a time interval, s,
    and ``strains`` are none in scenes without viscosity.

    Attributes
    ----------
    sampled : callable
        y -> where loads that follow the body are sampled, (N, 3).
    end : float
        Time after the step, s.
    moved : callable
        y -> positions after the step, (N, 3).
    finish : callable
        y and all forces (N, 3) of the equation, of moving clamps too -> the state after.
    """

    inertia: float
    target: Array
    rate: float
    origin: Array
    start: Array
    foreseen: Array
    loads_over: tuple[float, float]
    finish: Callable[[Array, Array], State]
    sampled: Callable[[Array], Array]
    end: float
    moved: Callable[[Array], Array]
    past_forces: Array | float = 0.0
    load_factor: float = 1.0
    strain_rate: float = 0.0
    strains: tuple[tuple[float, Array], ...] = ()
    gain: float = 1.0


class Integrator:
    """(problem, state, h) -> the equation of the step from ``state`` to its time + h."""

    def __init__(self, scheme_of: SchemeOf) -> None:
        self.scheme_of = scheme_of

    def scheme(self, state: State, h: float) -> Scheme:
        """The scheme of a step of h seconds from a state."""
        return _scheme(self.scheme_of, h, self._usable(state, h))

    def held(self, state: State, h: float) -> Integrator:
        """The same integrator with the scheme of that step, whatever the length of its own step.

        As if the steps before ``state`` had the same length.
        """
        usable = self._usable(state, h)
        return Integrator(lambda length, _: self.scheme_of(length, usable))

    @staticmethod
    def usable(memory: Mapping[str, Any], is_a_step: Callable[[Any], bool]) -> frozenset[str]:
        """The entries of a state's memory that a step may use.

        ``is_a_step`` says of the times of the state before whether they are one step earlier.
        """
        names = frozenset(memory)
        if "previous_times" in names and not is_a_step(memory["previous_times"]):
            names -= schemes.HISTORY
        return names

    def _usable(self, state: State, h: float) -> frozenset[str]:
        return self.usable(state.memory, lambda before: equal_steps(state.time - before[0, 0], h))

    def known(self, problem: Problem, state: State, h: float) -> dict[str, Any]:
        """What the linear combinations of a scheme combine, by name."""
        return {
            "positions": state.positions,
            "velocities": state.velocities,
            "prescribed": problem.clamped_positions(state.time + h),
            "time": np.full_like(state.positions, state.time),
            **state.memory,
            **clamp_rates(problem, state.time, h),
        }

    def __call__(self, problem: Problem, state: State, h: float) -> StepEquation:
        scheme, free = self.scheme(state, h), problem.free
        known = self.known(problem, state, h)

        def split(on_free: Linear, on_clamped: Linear | None) -> Array:
            return np.asarray(by_component(np, free, known, on_free, on_clamped))

        target = split(scheme.target, scheme.clamped_target)

        def finish(y: Array, forces: Array) -> State:
            known["y"] = y
            if "internal_forces" in scheme.memory:
                internal = scheme.inertia * problem.mass_times(y - target) - forces
                known["internal_forces_after"] = (
                    internal if problem.clamps.moving else internal * free
                )
            memory = {name: split(*rows) for name, rows in scheme.memory.items()}
            velocities = split(scheme.velocities, scheme.clamped_velocities)
            if problem.rollers is not None and scheme.clamped_velocities is not None:
                velocities = problem.rollers.led(velocities, state.time, state.time + 2.0 * h)
            return State(scheme.positions(known), velocities, state.time + h, memory)

        first, last = (state.time + share * h for share in scheme.loads_over)
        viscous = bool(problem.scene.damping.viscosity)
        return StepEquation(
            scheme.inertia,
            target,
            scheme.rate,
            split(scheme.origin, scheme.clamped_origin),
            split(scheme.start, scheme.clamped),
            split(scheme.foreseen or scheme.start, scheme.clamped),
            (first, last),
            finish,
            lambda y: np.asarray(scheme.sampled({**known, "y": y})),
            state.time + h,
            lambda y: np.asarray(scheme.positions({**known, "y": y})),
            scheme.past_forces(known),
            scheme.load_factor,
            scheme.strain_rate,
            tuple((a, x(known)) for a, x in scheme.strains) if viscous else (),
            scheme.gain,
        )


def clamp_rates(problem: Problem, time: float, h: float) -> dict[str, Any]:
    """Mean velocities of the prescribed positions in a step from ``time`` (s) and after it.

    The entries (N, 3), m/s, of a step's `Integrator.known` that only moving clamps have, else
    0.  Inertia of clamped nodes acts on others through a mass matrix that is not diagonal.
    Velocities that only satisfy an integrator's own recursion would ring, as nothing damps
    them.
    """
    if not problem.clamps.moving:
        return {"clamp_velocity_behind": 0.0, "clamp_velocity_ahead": 0.0}
    places = [problem.clamped_positions(time + k * h) for k in range(3)]
    behind, ahead = ((after - before) / h for before, after in pairwise(places))
    return {"clamp_velocity_behind": behind, "clamp_velocity_ahead": ahead}


@lru_cache(maxsize=64)
def _scheme(scheme_of: SchemeOf, h: float, known: frozenset[str]) -> Scheme:
    return scheme_of(h, known)


def solution(scheme: Scheme, before: State, after: State, problem: Problem) -> Array:
    """The y (N + B, 3) of a step between two states, with internal modes in equilibrium."""
    return problem.relaxed(nodal_solution(scheme, before.positions, after.positions))


def nodal_solution(scheme: Scheme, before: Any, after: Any) -> Any:
    """The nodes' part of y for positions before and after a step, arrays or tensors."""
    row = scheme.positions.coefficients
    rest = Linear(**{name: c for name, c in row.items() if name != "y"})
    return (after - rest({"positions": before})) / row["y"]


def equal_steps(a: float, b: float) -> bool:
    """Whether two lengths of time, s, count as equal."""
    return bool(abs(a - b) <= _EQUAL_STEPS * b)


backward_euler = Integrator(schemes.backward_euler)


def integrator(name: str, spectral_radius: float = 0.8, viscous: bool = False) -> Integrator:
    """An integrator by its name in a scene; ``viscous`` where the scene has a viscosity."""
    if name == "generalised-alpha":
        return Integrator(schemes.GeneralisedAlpha(spectral_radius, viscous))
    if name == "midpoint" and viscous:
        return Integrator(partial(schemes.midpoint, viscous=True))
    if name not in INTEGRATORS:
        raise InputError(f"integrator {name!r}: expected {', '.join(INTEGRATORS)}.")
    return Integrator(_SCHEMES[name])


_SCHEMES: dict[str, SchemeOf] = {
    "backward-euler": schemes.backward_euler,
    "bdf2": schemes.bdf2,
    "midpoint": schemes.midpoint,
    "quasi-static": schemes.quasi_static,
}
INTEGRATORS = (*_SCHEMES, "generalised-alpha")
"""Names of `integrator`."""
