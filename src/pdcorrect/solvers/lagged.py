"""L-BFGS's first Hessian: the true one of an earlier frame, factorised again when that pays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.factorisation import Backend
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.step import StepObjective
from pdcorrect.solvers.tangent_solver import TangentFactory, TangentSolver

Array = NDArray[np.float64]

INSIDE = -1
"""Age of a Hessian that was factorised within a step, at no frame."""


class LaggedHessian:
    """Keeps one factor, and decides at each step whether a new one pays.

    A factor's first step needs the fewest iterations; what later steps need more is
    its loss.  When the losses since the last factorisation add up to the cost of one,
    it is time for the next: this keeps the total within twice the best possible.  The
    rule counts iterations, not seconds, so runs can be repeated exactly.

    Parameters
    ----------
    problem : Problem
    backend : str
        See `TangentFactory`.

    Attributes
    ----------
    age : int
        Steps since the factor in use was made, 0 in the step that made it;
        `INSIDE` if that was not at the start of a step.
    """

    def __init__(self, problem: Problem, backend: Backend = "auto") -> None:
        self._problem = problem
        self._factors = (0.0, 0.0)
        self.tangents = TangentFactory(problem, backend)
        self._cost = self.tangents.factor_cost
        self._solver: TangentSolver | None = None
        self.age = INSIDE
        self._counts: list[int] = []

    def solver(self, objective: StepObjective) -> TangentSolver:
        """The factor for the step that ``objective`` belongs to."""
        stale = self.age == INSIDE or objective.factors != self._factors or self._spent()
        if self._solver is None or stale:
            return self._renew(objective, self._problem.relaxed(objective.state.positions), 0)
        self.age += 1
        return self._solver

    def renew(self, objective: StepObjective, y: Array) -> TangentSolver:
        """A factor at a configuration within the step, which the next step will not keep."""
        return self._renew(objective, y, INSIDE)

    def _renew(self, objective: StepObjective, y: Array, age: int) -> TangentSolver:
        self._solver, _ = self.tangents.factorise(objective, y)
        self._factors, self.age, self._counts = objective.factors, age, []
        return self._solver

    def note(self, iterations: int) -> None:
        """What the step took."""
        self._counts.append(iterations)

    def restore(self, age: int, counts: list[int], objective: StepObjective) -> None:
        """Take up a factor made ``age`` steps before the last one, in the step of ``objective``.

        ``counts`` are the iterations of that step and of those since.
        """
        if age != INSIDE:
            self._renew(objective, self._problem.relaxed(objective.state.positions), age)
            self._counts = counts

    def _spent(self) -> bool:
        fewest = min(self._counts, default=0)
        return sum(n - fewest for n in self._counts) >= self._cost
