"""The minimisation that one implicit step is (thesis eq. 3-6), and its preconditioner G.

    gamma(p) = 1/(2 h^2) (p - q)^T M (p - q) + W(p) - f . (p - X),   q = p_t + h v_t

is backward Euler: its stationary point satisfies eq. 3-4, and M is never
inverted.  Clamped components of p are prescribed; gradients are zero there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.assembly import Linearisation
from pdcorrect.fem.factorisation import Backend, Factor, NotPositiveDefinite, factorise
from pdcorrect.fem.problem import Problem
from pdcorrect.state import State

Array = NDArray[np.float64]


class StepObjective:
    """gamma for one step, over nodal positions p (N, 3).

    Parameters
    ----------
    problem : Problem
    state : State
        At the start of the step.
    time_step : float
        h, s.
    forces : (N, 3)
        All external forces of the step, N.

    Attributes
    ----------
    start : (N, 3)
        Inertial prediction p + h v, prescribed where clamped: the first iterate.
    scale : float
        Size of the terms of gamma where it was last evaluated, J: round-off in
        gamma is relative to this.
    """

    def __init__(self, problem: Problem, state: State, time_step: float, forces: Array) -> None:
        self.problem = problem
        self.time_step = time_step
        self.free = problem.free
        self.scale = 0.0
        self._forces = forces
        self._target = state.positions + time_step * state.velocities
        prescribed = problem.clamped_positions(state.time + time_step)
        self.start = np.where(self.free, self._target, prescribed)

    def value_and_gradient(self, p: Array) -> tuple[float, Array]:
        """Gamma (J) and its gradient (N, 3), N, zero where clamped."""
        energy, elastic = self.problem.energy_and_forces(p)
        offset = p - self._target
        inertia = self.problem.mass_times(offset) / self.time_step**2
        kinetic = 0.5 * np.vdot(offset, inertia)
        work = np.vdot(self._forces, p - self.problem.positions)
        self.scale = float(energy + kinetic + abs(work))
        value = energy + kinetic - work
        gradient = inertia
        gradient -= elastic
        gradient -= self._forces
        gradient *= self.free
        return float(value), gradient

    def hessian(self, p: Array, project: bool = False) -> sp.csr_matrix:
        """Second derivative (3N, 3N), N/m, of all components."""
        inertia = sp.kron(self.problem.mass_matrix / self.time_step**2, sp.eye_array(3))
        return sp.csr_matrix(self.problem.stiffness(p, project) + inertia)

    def hessian_operator(self, p: Array) -> HessianOperator:
        """The same, restricted to free components, without assembling."""
        return HessianOperator(self, self.problem.linearise(p))


@dataclass(frozen=True, eq=False)
class HessianOperator:
    """x -> (M/h^2 + d2W/dp2) x on the free components."""

    objective: StepObjective
    tangent: Linearisation

    def __call__(self, x: Array) -> Array:
        out = self.tangent.apply(x)
        out += self.objective.problem.mass_times(x) / self.objective.time_step**2
        out *= self.objective.free
        return out


class GlobalSolver:
    """G^-1 on the free components: one factor for each distinct column of ``free``.

    Parameters
    ----------
    problem : Problem
    time_step : float
        s.
    backend : str
        See `factorise`.
    volume_scale : float
        Factor on the volume weight inside G (the energy is not changed).
    """

    def __init__(
        self,
        problem: Problem,
        time_step: float,
        backend: Backend = "auto",
        volume_scale: float = 1.0,
    ) -> None:
        matrix = problem.global_matrix(time_step, volume_scale)
        columns, group = np.unique(problem.free, axis=1, return_inverse=True)
        self._parts: list[tuple[Factor, NDArray[np.int64], NDArray[np.int64]]] = []
        for i in range(columns.shape[1]):
            nodes = np.flatnonzero(columns[:, i])
            if len(nodes):
                factor = self._factorise(matrix[nodes][:, nodes], backend, time_step)
                self._parts.append((factor, nodes, np.flatnonzero(group.ravel() == i)))
        self._all_free = bool(problem.free.all())

    @staticmethod
    def _factorise(matrix: sp.csr_matrix, backend: Backend, time_step: float) -> Factor:
        try:
            return factorise(matrix, backend)
        except NotPositiveDefinite as error:
            raise ConvergenceError(
                f"the global matrix of a step of {time_step:g} s is singular to working precision "
                f"({error}): expected clamps, or inertia that matters beside the stiffness. Use a "
                "smaller time step, more density or clamps."
            ) from None

    @property
    def backend(self) -> str:
        """Name of the factorisation in use."""
        return self._parts[0][0].backend

    def __call__(self, r: Array) -> Array:
        """X (N, 3) with G x = r on the free components, zero elsewhere."""
        if self._all_free:
            return self._parts[0][0].solve(r)
        out = np.zeros_like(r)
        for factor, nodes, axes in self._parts:
            if len(axes) == 3:
                out[nodes] = factor.solve(r[nodes])
            else:
                out[np.ix_(nodes, axes)] = factor.solve(r[np.ix_(nodes, axes)])
        return out


def check_input(problem: Problem, state: State, forces: Array | None) -> None:
    """Refuse states and forces of the wrong shape or with NaN, naming the node.

    Raises
    ------
    InputError
    """
    named = {"positions": state.positions, "velocities": state.velocities}
    if forces is not None:
        named["forces"] = np.asarray(forces, dtype=np.float64)
    for name, array in named.items():
        if array.shape != problem.positions.shape:
            raise InputError(
                f"{name} has shape {array.shape}: expected {problem.positions.shape}, one row "
                "for each node of the problem."
            )
        if not np.isfinite(array).all():
            node = int(np.argmin(np.isfinite(array).all(axis=1)))
            raise InputError(
                f"{name} of node {node} (at rest at {problem.positions[node].tolist()} m) is "
                f"{array[node].tolist()}: expected finite numbers."
            )
