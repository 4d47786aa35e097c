"""Newton's method on the assembled tangent: the trusted reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.factorisation import Backend, NotPositiveDefinite
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.implicit import ImplicitStepper, whole
from pdcorrect.solvers.lbfgs import MinimiserOptions, Minimum
from pdcorrect.solvers.newton_loop import newton_loop
from pdcorrect.solvers.step import StepObjective
from pdcorrect.solvers.tangent_solver import TangentFactory

Array = NDArray[np.float64]


class Newton(ImplicitStepper):
    """Steps a problem by Newton's method with a line search.

    The exact tangent is assembled cell by cell and factorised in each
    iteration.  Where it is not positive definite, the tangent with negative
    eigenvalues raised to zero at each quadrature point (Teran et al. 2005) takes
    its place for that iteration, with a shift if it is singular.

    Parameters
    ----------
    problem : Problem
    tolerance : float
        Of the coarse cell size: the length of the Newton step at which the
        iteration stops.
    max_iterations : int
    time_step, integrator, backend, recover
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
        integrator: str | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        super().__init__(problem, tolerance, time_step, integrator, backend, recover)
        self._options = replace(
            self._options, max_iterations=whole("max_iterations", max_iterations)
        )
        self._tangents = TangentFactory(problem, backend)

    def _prepare(self, objective: StepObjective) -> None:
        _, gradient = objective.value_and_gradient(objective.start)
        self._direction(objective, objective.start, gradient)

    def _factorisation(self) -> str:
        return self._tangents.backend

    def _minimise(self, objective: StepObjective, options: MinimiserOptions) -> Minimum:
        return newton_loop(
            objective, objective.start, lambda p, g: self._direction(objective, p, g), options
        )

    def _direction(self, objective: StepObjective, p: Array, g: Array) -> tuple[Array, bool]:
        """Minus the Newton step, and whether the exact tangent was used."""
        try:
            solver, exact = self._tangents.factorise(objective, p)
        except NotPositiveDefinite:
            return np.zeros_like(p), False  # no descent: the line search says so
        return -solver(g), exact
