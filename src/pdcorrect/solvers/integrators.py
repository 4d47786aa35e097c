"""Implicit time integrators, each as one equation of the same form.

A step solves

    c M (y - q) + d C (y - o) = f_int(y) + f_ext

for one unknown configuration y, so every integrator minimises the same kind of
function (thesis eq. 3-6) and projective dynamics needs no more than other factors in G.
An integrator is a function from the state to that equation, a `Stage`, which also
knows how y gives the next state.  C is Rayleigh damping, d (y - o) the velocity at y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.conjugate_gradients import conjugate_gradients
from pdcorrect.fem.problem import Problem
from pdcorrect.state import State

Array = NDArray[np.float64]

_EQUAL_STEPS = 1e-6
"""Relative difference up to which two steps count as equal."""
_MASS_TOLERANCE, _MASS_STEPS = 1e-15, 200
"""Of solving with a consistent mass matrix, whose condition does not depend on the mesh."""


@dataclass(frozen=True, eq=False)
class Stage:
    """The equation of one step, over nodal arrays (N, 3).

    Attributes
    ----------
    inertia : float
        c, 1/s2.
    target : (N, 3)
        q, m: where y would be without forces.
    rate : float
        d, 1/s.
    origin : (N, 3)
        o, m.
    start : (N, 3)
        First iterate, m; prescribed values where clamped.
    loads_over : tuple of float
        Loads are averaged over this time interval (s), or taken at its ends if
        these are equal.
    loads_at : (N, 3)
        Positions at which follower loads are sampled, m.
    finish : callable
        y -> the state after the step.
    gain : float
        dp'/dy, by which an error of y grows.
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


Integrator = Callable[[Problem, State, float, Array | None], Stage]
"""(problem, state, h, forces) -> the equation of the step from ``state`` to its time + h.

``forces`` (N, 3), N, act besides the scene's loads; only a first acceleration needs them.
"""


def integrator(name: str, spectral_radius: float = 0.8) -> Integrator:
    """An integrator by its name in a scene.

    Raises
    ------
    InputError
    """
    if name == "generalised-alpha":
        return generalised_alpha(spectral_radius)
    if name not in _INTEGRATORS:
        raise InputError(f"integrator {name!r}: expected {', '.join(INTEGRATORS)}.")
    return _INTEGRATORS[name]


def backward_euler(problem: Problem, state: State, h: float, forces: Array | None = None) -> Stage:
    """Thesis eq. 3-1 to 3-4: v' = (p' - p)/h, M (v' - v)/h = f(p').  First order."""
    p, v, end = state.positions, state.velocities, state.time + h
    target = p + h * v
    return Stage(
        1.0 / h**2, target, 1.0 / h, p,
        np.where(problem.free, target, problem.clamped_positions(end)),
        (state.time, end), p,
        lambda y: State(y, (y - p) / h, end),
    )  # fmt: skip


def bdf2(problem: Problem, state: State, h: float, forces: Array | None = None) -> Stage:
    """Two-step backward differences: p' = (4 p - p_)/3 + 2h/3 v', the same for v'.

    Second order.  Without the state one step of the same length before (in
    ``state.memory``) the step is one of backward Euler, which, at the start only, does
    not lower the order.
    """
    p, v, end = state.positions, state.velocities, state.time + h
    before = state.memory.get("previous_times")
    if before is None or abs(state.time - before[0, 0] - h) > _EQUAL_STEPS * h:
        stage = backward_euler(problem, state, h, forces)
        origin, target, rate = stage.origin, stage.target, stage.rate
    else:
        origin = (4.0 * p - state.memory["previous_positions"]) / 3.0
        drift = (4.0 * v - state.memory["previous_velocities"]) / 3.0
        rate = 1.5 / h
        target = origin + drift / rate
    memory = {
        "previous_positions": p,
        "previous_velocities": v,
        "previous_times": np.full_like(p, state.time),
    }
    return Stage(
        rate**2, target, rate, origin,
        np.where(problem.free, target, problem.clamped_positions(end)),
        (end, end), p + h * v,
        lambda y: State(y, rate * (y - origin), end, memory),
    )  # fmt: skip


def midpoint(problem: Problem, state: State, h: float, forces: Array | None = None) -> Stage:
    """Implicit midpoint: y = (p + p')/2, M (v' - v)/h = f(y), p' - p = h (v + v')/2.

    Second order, symplectic; keeps linear and angular momentum.
    """
    p, v, end = state.positions, state.velocities, state.time + h
    free = problem.free
    start = np.where(free, p + 0.5 * h * v, 0.5 * (p + problem.clamped_positions(end)))
    clamp_velocity = _clamp_velocity(problem, end, h)
    target = np.where(free, start, start - 0.25 * h * (clamp_velocity - v))

    def finish(y: Array) -> State:
        velocities = np.where(free, (4.0 / h) * (y - p) - v, clamp_velocity)
        return State(2.0 * y - p, velocities, end)

    return Stage(
        4.0 / h**2, target, 2.0 / h, p, start, (state.time, end), p + 0.5 * h * v, finish, 2.0
    )  # fmt: skip


def generalised_alpha(spectral_radius: float) -> Integrator:
    """Chung and Hulbert (1993): second order, with chosen damping of high frequencies."""
    r = spectral_radius
    if not 0.0 <= r <= 1.0:
        raise InputError(f"spectral_radius = {r!r}: expected a number from 0 to 1.")
    alpha_m, alpha_f = (2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0)
    gamma = 0.5 - alpha_m + alpha_f
    beta = 0.25 * (1.0 - alpha_m + alpha_f) ** 2

    def stage(problem: Problem, state: State, h: float, forces: Array | None = None) -> Stage:
        p, v, end = state.positions, state.velocities, state.time + h
        a = state.memory.get("accelerations")
        if a is None:
            a = accelerations(problem, state, forces)
        scale = 1.0 / ((1.0 - alpha_f) * beta * h**2)
        at_rest = -v / (beta * h) - (0.5 / beta - 1.0) * a  # a' for y = p
        rate = gamma / (beta * h)

        def ahead(acceleration: Array) -> Array:
            return v + h * ((1.0 - gamma) * a + gamma * acceleration)

        def finish(y: Array) -> State:
            new = at_rest + scale * (y - p)
            velocity = np.where(free, ahead(new), clamp_velocity)
            return State(
                p + (y - p) / (1.0 - alpha_f), velocity, end, {"accelerations": new * free}
            )

        free, time = problem.free, state.time + (1.0 - alpha_f) * h
        inertia = (1.0 - alpha_m) * scale
        target = p - (at_rest + alpha_m / (1.0 - alpha_m) * a) / scale
        origin = p - ((1.0 - alpha_f) * ahead(at_rest) + alpha_f * v) / rate
        clamped = alpha_f * p + (1.0 - alpha_f) * problem.clamped_positions(end)
        clamp_velocity = _clamp_velocity(problem, end, h)
        acceleration = (clamp_velocity - v) / h  # mean over the step, moved to y's time:
        if "accelerations" in state.memory:
            acceleration += _clamp_acceleration(problem, time, h)
            acceleration -= _clamp_acceleration(problem, state.time + 0.5 * h, h)
        return Stage(
            inertia,
            np.where(free, target, clamped - acceleration / inertia),
            rate,
            np.where(free, origin, clamped - _clamp_velocity(problem, time, h) / rate),
            np.where(free, p + (1.0 - alpha_f) * h * v, clamped),
            (time, time), p + (1.0 - alpha_f) * h * v, finish,
            1.0 / (1.0 - alpha_f),
        )  # fmt: skip

    return stage


def quasi_static(problem: Problem, state: State, h: float, forces: Array | None = None) -> Stage:
    """Equilibrium f(p') = 0 under the loads and clamps at the end of the step."""
    p, end = state.positions, state.time + h
    start = np.where(problem.free, p, problem.clamped_positions(end))
    return Stage(
        0.0, p, 0.0, p, start, (end, end), p, lambda y: State(y, np.zeros_like(y), end)
    )  # fmt: skip


def _clamp_velocity(problem: Problem, time: float, h: float) -> Array:
    """Velocity of the prescribed positions by central differences, (N, 3), m/s.

    Inertia of clamped nodes acts on others through a mass matrix that is not diagonal.
    Velocities that only satisfy an integrator's own recursion would ring, as nothing damps
    them, and one-sided differences, put into that recursion, double the acceleration.
    """
    if not problem.clamps.moving:
        return np.zeros_like(problem.positions)
    ahead, behind = problem.clamped_positions(time + h), problem.clamped_positions(time - h)
    return (ahead - behind) / (2.0 * h)


def _clamp_acceleration(problem: Problem, time: float, h: float) -> Array:
    """Acceleration of the prescribed positions by central differences, (N, 3), m/s2."""
    if not problem.clamps.moving:
        return np.zeros_like(problem.positions)
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
    force = forces_at(problem, state, forces) * problem.free
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


_INTEGRATORS: dict[str, Integrator] = {
    "backward-euler": backward_euler,
    "bdf2": bdf2,
    "midpoint": midpoint,
    "quasi-static": quasi_static,
}
INTEGRATORS = (*_INTEGRATORS, "generalised-alpha")
"""Names of `integrator`."""
