"""Time integrators: what the tables of `schemes` make of a state.

An integrator is a function from the state to the equation of the step, a `StepEquation`, which
also knows how its solution gives the next state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.multigrid import conjugate_gradients
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers import schemes
from pdcorrect.solvers.schemes import Linear, Scheme, SchemeOf, by_component
from pdcorrect.state import State

Array = NDArray[np.float64]

_EQUAL_STEPS = 1e-6
"""Relative difference up to which two steps count as equal."""
_MASS_TOLERANCE, _MASS_STEPS = 1e-15, 200
"""Of solving with a consistent mass matrix, whose condition does not depend on the mesh."""


@dataclass(frozen=True, eq=False)
class StepEquation:
    """The equation of one step, over nodal arrays (N, 3), and what it was made of.

    Attributes
    ----------
    inertia, rate, gain : float
        See `Scheme`.
    target, origin : (N, 3)
        q and o, m.
    start : (N, 3)
        First iterate, m; prescribed values where clamped.
    loads_over : tuple of float
        Loads are averaged over this time interval (s), or taken at its ends if
        these are equal.
    loads_at : (N, 3)
        Positions at which follower loads are sampled, m.
    finish : callable
        y -> the state after the step.
    """

    inertia: float
    target: Array
    rate: float
    origin: Array
    start: Array
    loads_over: tuple[float, float]
    loads_at: Array
    finish: Callable[[Array], State]
    gain: float = 1.0


class Integrator:
    """(problem, state, h, forces) -> the stage from ``state`` to its time + h.

    ``forces`` (N, 3), N, act besides the scene's loads; only a first acceleration
    needs them.
    """

    def __init__(self, scheme_of: SchemeOf) -> None:
        self.scheme_of = scheme_of

    def scheme(self, state: State, h: float) -> Scheme:
        """The scheme of a step of h seconds from a state."""
        return _scheme(self.scheme_of, h, self._begun(state, h))

    def held(self, state: State, h: float) -> Integrator:
        """The same integrator with the scheme of that step, whatever the length of its own step.

        As if the steps before ``state`` had the same length.
        """
        started = self._begun(state, h)
        return Integrator(lambda length, _: self.scheme_of(length, started))

    def started(
        self, memory: Mapping[str, Any], h: float, is_a_step: Callable[[Any], bool]
    ) -> bool:
        """Whether a state's memory has what a step of h seconds needs; other entries do not count.

        ``is_a_step`` says of the times before, where they are needed, whether they are h earlier.
        """
        needed = _scheme(self.scheme_of, h, False).memory.keys()
        if not needed <= memory.keys():
            return False
        return "previous_times" not in needed or is_a_step(memory["previous_times"])

    def _begun(self, state: State, h: float) -> bool:
        return self.started(
            state.memory, h, lambda before: equal_steps(state.time - before[0, 0], h)
        )

    def known(
        self, problem: Problem, state: State, h: float, forces: Array | None
    ) -> dict[str, Any]:
        """What the linear combinations of a scheme combine, by name."""
        scheme, end = self.scheme(state, h), state.time + h
        known: dict[str, Any] = {
            "positions": state.positions,
            "velocities": state.velocities,
            "prescribed": problem.clamped_positions(end),
            "time": np.full_like(state.positions, state.time),
            **state.memory,
            "clamp_velocity": 0.0,
            "clamp_velocity_at_y": 0.0,
            "clamp_jump": 0.0,
        }
        if "accelerations" in scheme.memory and "accelerations" not in known:
            known["accelerations"] = accelerations(problem, state, forces)
        if problem.clamps.moving:
            at_y = state.time + scheme.loads_over[1] * h
            known["clamp_velocity"] = _clamp_velocity(problem, end, h)
            known["clamp_velocity_at_y"] = _clamp_velocity(problem, at_y, h)
            known["clamp_jump"] = _clamp_acceleration(problem, at_y, h)
            known["clamp_jump"] -= _clamp_acceleration(problem, state.time + 0.5 * h, h)
        return known

    def __call__(
        self, problem: Problem, state: State, h: float, forces: Array | None = None
    ) -> StepEquation:
        scheme, free = self.scheme(state, h), problem.free
        known = self.known(problem, state, h, forces)

        def split(on_free: Linear, on_clamped: Linear | None) -> Array:
            return np.asarray(by_component(np, free, known, on_free, on_clamped))

        def finish(y: Array) -> State:
            known["y"] = y
            memory = {name: split(*rows) for name, rows in scheme.memory.items()}
            velocities = split(scheme.velocities, scheme.clamped_velocities)
            return State(scheme.positions(known), velocities, state.time + h, memory)

        first, last = (state.time + share * h for share in scheme.loads_over)
        return StepEquation(
            scheme.inertia,
            split(scheme.target, scheme.clamped_target),
            scheme.rate,
            split(scheme.origin, scheme.clamped_origin),
            split(scheme.start, scheme.clamped),
            (first, last),
            scheme.loads_at(known),
            finish,
            scheme.gain,
        )


@lru_cache(maxsize=64)
def _scheme(scheme_of: SchemeOf, h: float, started: bool) -> Scheme:
    return scheme_of(h, started)


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


def integrator(name: str, spectral_radius: float = 0.8) -> Integrator:
    """An integrator by its name in a scene.

    Raises
    ------
    InputError
    """
    if name == "generalised-alpha":
        return Integrator(schemes.generalised_alpha(spectral_radius))
    if name not in INTEGRATORS:
        raise InputError(f"integrator {name!r}: expected {', '.join(INTEGRATORS)}.")
    return Integrator(_SCHEMES[name])


def _clamp_velocity(problem: Problem, time: float, h: float) -> Array:
    """Velocity of the prescribed positions by central differences, (N, 3), m/s.

    Inertia of clamped nodes acts on others through a mass matrix that is not diagonal.
    Velocities that only satisfy an integrator's own recursion would ring, as nothing damps
    them, and one-sided differences, put into that recursion, double the acceleration.
    """
    ahead, behind = problem.clamped_positions(time + h), problem.clamped_positions(time - h)
    return (ahead - behind) / (2.0 * h)


def _clamp_acceleration(problem: Problem, time: float, h: float) -> Array:
    """Acceleration of the prescribed positions by central differences, (N, 3), m/s2."""
    places = [problem.clamped_positions(time + k * h) for k in (-1, 0, 1)]
    return (places[0] - 2.0 * places[1] + places[2]) / h**2


def forces_at(problem: Problem, state: State, forces: Array | None = None) -> Array:
    """f_int + f_ext - C v at a state, (N, 3), N, without the clamps' forces.

    ``forces`` (N, 3), N, act besides the scene's loads.
    """
    damping = problem.scene.damping
    out = problem.forces(state.positions)
    out += problem.external_forces(state.time, None, state.positions)
    if forces is not None:
        out += forces
    if damping.mass:
        out -= damping.mass * problem.mass_times(state.velocities)
    if damping.stiffness:
        K = problem.stiffness(state.positions, project=True)
        out -= damping.stiffness * (K @ state.velocities.ravel()).reshape(out.shape)
    return out


def accelerations(problem: Problem, state: State, forces: Array | None = None) -> Array:
    """M^-1 `forces_at` a state, (N, 3), m/s2; zero where clamped.

    Raises
    ------
    ConvergenceError
        If the mass matrix could not be solved with.
    """
    return solve_mass(problem, forces_at(problem, state, forces) * problem.free)


def solve_mass(problem: Problem, force: Array) -> Array:
    """M^-1 force on the free components, for (N, 3) that is zero where clamped."""
    if problem.mass_is_diagonal:
        return force / problem.mass[:, None]
    diagonal = problem.mass_matrix.diagonal()[:, None]
    found = conjugate_gradients(
        lambda x: problem.mass_times(x) * problem.free,
        force,
        lambda r: r / diagonal,
        tolerance=_MASS_TOLERANCE,
        max_steps=_MASS_STEPS,
    )
    if not found.converged:
        raise ConvergenceError(
            f"M a = f was not solved in {found.steps} steps of conjugate gradients: expected "
            "finite forces and densities within a factor of 1e6 of each other."
        )
    return found.x


_SCHEMES: dict[str, SchemeOf] = {
    "backward-euler": schemes.backward_euler,
    "bdf2": schemes.bdf2,
    "midpoint": schemes.midpoint,
    "quasi-static": schemes.quasi_static,
}
INTEGRATORS = (*_SCHEMES, "generalised-alpha")
"""Names of `integrator`."""
