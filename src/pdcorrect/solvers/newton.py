"""Newton's method on the assembled tangent: the trusted reference."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.factorisation import Backend, NotPositiveDefinite, factorise
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.implicit import ImplicitStepper
from pdcorrect.solvers.lbfgs import Minimum, largest_displacement, line_search
from pdcorrect.solvers.step import StepObjective
from pdcorrect.state import Status

Array = NDArray[np.float64]


class Newton(ImplicitStepper):
    """Steps a problem by Newton's method with a line search.

    The exact tangent is assembled cell by cell and factorised in each
    iteration.  Where it is not positive definite, the tangent with negative
    eigenvalues raised to zero at each quadrature point (Teran et al. 2005) takes
    its place for that iteration.

    Parameters
    ----------
    problem : Problem
    tolerance : float
        Of the coarse cell size: the length of the Newton step at which the
        iteration stops.
    max_iterations : int
    time_step, backend, recover
        See `ImplicitStepper`.
    """

    name = "Newton"

    def __init__(
        self,
        problem: Problem,
        tolerance: float = 1e-10,
        *,
        max_iterations: int = 100,
        time_step: float | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        super().__init__(problem, tolerance, time_step, backend, recover)
        self._options = replace(self._options, max_iterations=max_iterations)
        self._free = np.flatnonzero(problem.free.ravel())
        self._used_backend = "none yet"

    def prepare(self) -> Self:
        """Assemble and factorise once at rest, so that the first step is like the others."""
        state = self.problem.rest_state()
        objective = StepObjective(
            self.problem, state, self.time_step, np.zeros_like(state.positions)
        )
        _, gradient = objective.value_and_gradient(state.positions)
        self._direction(objective, state.positions, gradient)
        return self

    def describe(self) -> dict[str, str]:
        """Method, tolerance, step and factorisation in use."""
        return {
            "solver": self.name,
            "tolerance": f"{self.tolerance:g}",
            "time_step": f"{self.time_step:g}",
            "factorisation": self._used_backend,
        }

    def _minimise(self, objective: StepObjective) -> Minimum:
        p = objective.start
        value, gradient = objective.value_and_gradient(p)
        evaluations, estimate, status = 1, math.inf, Status.ITERATION_LIMIT
        for iteration in range(self._options.max_iterations + 1):
            if not math.isfinite(value):
                status = Status.NOT_FINITE
                break
            direction, exact = self._direction(objective, p, gradient)
            length = largest_displacement(direction)
            estimate = length if exact else math.inf
            if estimate <= self._options.tolerance:
                status = Status.CONVERGED
                break
            if iteration == self._options.max_iterations:
                break
            found = line_search(objective, p, value, gradient, direction)
            evaluations += found.evaluations
            if found.step == 0.0:
                status = Status.LINE_SEARCH
                break
            p, value, gradient = found.positions, found.value, found.gradient
        return Minimum(p, value, gradient, status, iteration, evaluations, estimate)

    def _direction(self, objective: StepObjective, p: Array, g: Array) -> tuple[Array, bool]:
        """Minus the Newton step, and whether the exact tangent was used."""
        for project in (False, True):
            matrix = objective.hessian(p, project)[self._free][:, self._free]
            try:
                factor = factorise(matrix, self._backend)
                step = factor.solve(g.ravel()[self._free])
            except NotPositiveDefinite:
                if project:
                    raise
                continue
            self._used_backend = factor.backend
            direction = np.zeros(p.size)
            direction[self._free] = -step
            return direction.reshape(p.shape), not project
        raise AssertionError("unreachable: the projected tangent is positive definite")
