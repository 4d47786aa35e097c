"""L-BFGS's first Hessian: the true one of an earlier frame, factorised again when that pays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
    rule counts iterations, not seconds, and a state that does not continue the run at
    hand gets a new factor, so runs can be repeated exactly.

    Parameters
    ----------
    tangents : TangentFactory

    Attributes
    ----------
    age : int
        Steps since the factor in use was made, 0 in the step that made it;
        `INSIDE` if that was not at the start of a step.
    """

    def __init__(self, tangents: TangentFactory) -> None:
        self.tangents = tangents
        self._problem = tangents.problem
        self._factors = (0.0, 0.0)
        self._cost = self.tangents.factor_cost
        self._solver: TangentSolver | None = None
        self._time = 0.0
        self.age = INSIDE
        self._counts: list[int] = []

    def solver(self, objective: StepObjective) -> TangentSolver:
        """The factor for the step that ``objective`` belongs to."""
        other = objective.factors != self._factors or objective.state.time != self._time
        if self._solver is None or self.age == INSIDE or other or self._spent():
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

    def note(self, iterations: int, time: float) -> None:
        """What the step took, and the time that it led to (s)."""
        self._counts.append(iterations)
        self._time = time

    def restore(self, age: int, counts: list[int], objective: StepObjective, time: float) -> None:
        """Take up a factor made ``age`` steps before the last one, in the step of ``objective``.

        ``counts`` are the iterations of that step and of those since; ``time`` (s) is
        where the run goes on.
        """
        if age != INSIDE:
            self._renew(objective, self._problem.relaxed(objective.state.positions), age)
            self._counts, self._time = counts, time

    def _spent(self) -> bool:
        fewest = min(self._counts, default=0)
        return sum(n - fewest for n in self._counts) >= self._cost
