"""Newton's method on the assembled tangent: the trusted reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Self

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.fem.factorisation import Backend, NotPositiveDefinite, factorise
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.implicit import ImplicitStepper, whole
from pdcorrect.solvers.lbfgs import MinimiserOptions, Minimum
from pdcorrect.solvers.newton_loop import newton_loop
from pdcorrect.solvers.step import StepObjective

Array = NDArray[np.float64]

_SHIFTS = (1e-10, 1e-6, 1e-2)
"""Of the largest diagonal entry, tried in turn where even the projected tangent is singular."""


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
        self._free = np.flatnonzero(problem.free_unknowns.ravel())
        self._used_backend = "none yet"

    def prepare(self) -> Self:
        """Assemble and factorise once at rest, so that the first step is like the others."""
        state = self.problem.rest_state()
        stage = self._integrator(self.problem, state, self.time_step)
        objective = StepObjective(self.problem, state, stage, np.zeros_like(state.positions))
        _, gradient = objective.value_and_gradient(objective.start)
        self._direction(objective, objective.start, gradient)
        return self

    def _factorisation(self) -> str:
        return self._used_backend

    def _minimise(self, objective: StepObjective, options: MinimiserOptions) -> Minimum:
        return newton_loop(
            objective, objective.start, lambda p, g: self._direction(objective, p, g), options
        )

    def _direction(self, objective: StepObjective, p: Array, g: Array) -> tuple[Array, bool]:
        """Minus the Newton step, and whether the exact tangent was used."""
        direction = np.zeros(p.size)
        for matrix, exact in self._candidates(objective, p):
            try:
                factor = factorise(matrix, self._backend, unknowns=3)
                direction[self._free] = -factor.solve(g.ravel()[self._free])
            except NotPositiveDefinite:
                continue
            self._used_backend = factor.backend
            return direction.reshape(p.shape), exact
        return direction.reshape(p.shape), False  # no descent: the line search says so

    def _candidates(
        self, objective: StepObjective, p: Array
    ) -> Iterator[tuple[sp.csr_matrix, bool]]:
        """The exact tangent, the projected one, and that with a growing shift."""
        yield objective.hessian(p)[self._free][:, self._free], True
        matrix = objective.hessian(p, project=True)[self._free][:, self._free]
        yield matrix, False
        for shift in _SHIFTS:
            size = shift * matrix.diagonal().max()
            yield sp.csr_matrix(matrix + size * sp.eye_array(matrix.shape[0])), False
