"""What damping and a first acceleration add to the derivatives of a step.

Each term is a force on the body, or what follows from one, pulled back through its own
inputs.  Internal modes at the start of the step follow the nodes and the material there.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.problem import Problem
from pdcorrect.fem.sensitivities import Following, tangent_slopes, weight_slopes
from pdcorrect.solvers.integrators import forces_at, solve_mass
from pdcorrect.solvers.step import StepDamping
from pdcorrect.state import State

Array = NDArray[np.float64]
Weights = tuple[Array, Array]


def mass_slope(problem: Problem, a: Array, b: Array) -> Array:
    """Derivatives of a . M b by the cells' densities, (C,), for nodal a and b (N, 3)."""
    return problem.space.cell_products(a, b, problem.mass_rule)


def gravity_slope(problem: Problem, x: Array, start: float, end: float) -> Array:
    """Derivatives of x . (nodal masses times acceleration) by the densities, (C,)."""
    out = np.zeros(len(problem.cells))
    rule = "per-node" if problem.mass_rule == "per-node" else "lumped"
    for load in problem.loads:
        if load.acceleration is not None:
            field = np.broadcast_to(load.amplitude.mean(start, end) * load.acceleration, x.shape)
            out += problem.space.cell_products(x, field, rule)
    return out


def follower_slope(problem: Problem, x: Array, positions: Array, start: float, end: float) -> Array:
    """Derivatives of x . (external forces) by the positions they are sampled at, (N, 3)."""
    out = np.zeros_like(positions)
    for load in problem.loads:
        out += load.pulled(start, end, positions, x)
    return out


class DampingTerm:
    """- x . d C (y - o), by what the step starts from."""

    def __init__(self, problem: Problem, damping: StepDamping, y: Array, x: Array) -> None:
        self._problem, self._damping, self._x = problem, damping, x
        self._offset = y - damping.origin
        by_origin = damping.mass * problem.mass_times(x)
        if damping.stiffness:
            by_origin = by_origin + damping.stiffness * damping.tangent.apply(x)
        self._by_origin = by_origin

    @cached_property
    def origin(self) -> Array:
        """By o, with its modes in equilibrium, (N, 3)."""
        if not self._damping.stiffness:
            return self._by_origin[: len(self._problem.positions)]
        return self._at_origin.reduced(self._by_origin)

    @cached_property
    def positions(self) -> Array:
        """By the positions at the start, through C, (N, 3)."""
        if not self._damping.stiffness:
            return np.zeros_like(self._problem.positions)
        return self._before.reduced(self._by_shape)

    @cached_property
    def weights(self) -> Weights:
        """By mu and omega, each (C,)."""
        stiffness = self._damping.stiffness
        if not stiffness:
            nothing = np.zeros(len(self._problem.cells))
            return nothing, nothing
        _, by_mu, by_omega = self._slopes
        modes = -self._before.response(self._by_shape)
        more = weight_slopes(self._problem, self._damping.before, modes)
        modes = -self._at_origin.response(self._by_origin)
        last = weight_slopes(self._problem, self._damping.origin, modes)
        return (
            more[0] + last[0] - stiffness * by_mu,
            more[1] + last[1] - stiffness * by_omega,
        )

    @property
    def density(self) -> Array:
        """By the cells' densities, (C,)."""
        count = len(self._problem.positions)
        slope = mass_slope(self._problem, self._x[:count], self._offset[:count])
        return -self._damping.mass * slope

    @cached_property
    def _at_origin(self) -> Following:
        return Following(self._problem, self._damping.origin)

    @cached_property
    def _before(self) -> Following:
        return Following(self._problem, self._damping.before)

    @cached_property
    def _slopes(self) -> tuple[Array, Array, Array]:
        return tangent_slopes(self._problem, self._damping.before, self._x, self._offset)

    @cached_property
    def _by_shape(self) -> Array:
        """By the configuration at the start."""
        return -self._damping.stiffness * self._slopes[0]


class FirstAccelerationTerm:
    """g . a for the acceleration a = M^-1 (f_int + f_ext - C v) that starts generalised-alpha.

    Attributes
    ----------
    forces : (N, 3)
        By forces on the nodes: z = M^-1 g.
    """

    def __init__(self, problem: Problem, state: State, forces: Array | None, g: Array) -> None:
        self._problem, self._state = problem, state
        self._applied = forces
        self.forces = solve_mass(problem, g * problem.free)
        self._at = problem.relaxed(state.positions)
        self._exact = Following(problem, self._at)

    @cached_property
    def positions(self) -> Array:
        """By the positions, (N, 3)."""
        problem, z, state = self._problem, self.forces, self._state
        K = problem.stiffness(state.positions)
        out = -(K @ z.ravel()).reshape(z.shape)
        out += follower_slope(problem, z, state.positions, state.time, state.time)
        if problem.scene.damping.stiffness:
            out += self._exact.reduced(self._by_shape)
        return out

    @cached_property
    def velocities(self) -> Array:
        """By the velocities, (N, 3)."""
        problem, damping = self._problem, self._problem.scene.damping
        out = -damping.mass * problem.mass_times(self.forces)
        if damping.stiffness:
            K = problem.stiffness(self._state.positions, project=True)
            out = out - damping.stiffness * (K @ self.forces.ravel()).reshape(out.shape)
        return out

    @cached_property
    def weights(self) -> Weights:
        """By mu and omega, each (C,)."""
        direction = -self._exact.lifted(self.forces)
        beta = self._problem.scene.damping.stiffness
        if not beta:
            return weight_slopes(self._problem, self._at, direction)
        direction = direction - self._exact.response(self._by_shape)
        by_mu, by_omega = weight_slopes(self._problem, self._at, direction)
        return by_mu - beta * self._slopes[1], by_omega - beta * self._slopes[2]

    @cached_property
    def density(self) -> Array:
        """By the cells' densities, (C,)."""
        problem, state, z = self._problem, self._state, self.forces
        force = forces_at(problem, state, self._applied) * problem.free
        out = -mass_slope(problem, z, solve_mass(problem, force))
        out -= problem.scene.damping.mass * mass_slope(problem, z, state.velocities)
        return out + gravity_slope(problem, z, state.time, state.time)

    @cached_property
    def _slopes(self) -> tuple[Array, Array, Array]:
        projected = Following(self._problem, self._at, project=True)
        z, v = projected.lifted(self.forces), projected.lifted(self._state.velocities)
        return tangent_slopes(self._problem, self._at, z, v)

    @cached_property
    def _by_shape(self) -> Array:
        return -self._problem.scene.damping.stiffness * self._slopes[0]
