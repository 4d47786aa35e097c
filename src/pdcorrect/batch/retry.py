"""Scenes of a batch that did not converge, tried again one at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.states import BatchResult, BatchState, apart, together
from pdcorrect.errors import PdcorrectError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.integrators import solution
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State, Status, StepResult

_WORTH_IT = (Status.ITERATION_LIMIT, Status.LINE_SEARCH)


class OneByOne:
    """Steps single scenes with `ProjectiveDynamics` and its fallbacks, on the CPU.

    Parameters
    ----------
    cells : CellBatch
    problem : callable
        The problem of a scene, by its number, as it is now.
    tolerance, time_step, integrator
        Of the steps.
    """

    def __init__(
        self,
        cells: CellBatch,
        problem: Callable[[int], Problem],
        tolerance: float,
        time_step: float,
        integrator: str,
    ) -> None:
        self._cells, self._problem = cells, problem
        self._settings = (tolerance, time_step, integrator)
        self._steppers: dict[int, ProjectiveDynamics] = {}

    def __call__(
        self, before: BatchState, forces: Tensor | None, result: BatchResult
    ) -> BatchResult:
        """The result with those scenes' in it that now converged."""
        failed = [i for i, status in enumerate(result.statuses) if status in _WORTH_IT]
        if not failed:
            return result
        states, after = apart(self._cells, before), apart(self._cells, result.state)
        statuses, estimates = list(result.statuses), result.error_estimates.copy()
        iterations, y = result.iterations.copy(), result.y.clone()
        for i in failed:
            found = self._step(i, states[i], forces)
            if found is None:
                continue
            after[i], statuses[i] = found.state, found.status
            if found.status is Status.CONVERGED:
                statuses[i] = Status.RECOVERED
            estimates[i] = found.error_estimate
            iterations[i] += found.iterations
            y[i] = self._configuration(i, states[i], found.state)
        return replace(
            result,
            state=together(self._cells, after),
            y=y,
            statuses=statuses,
            iterations=iterations,
            error_estimates=estimates,
        )

    def _step(self, i: int, state: State, forces: Tensor | None) -> StepResult | None:
        problem = self._problem(i)
        if i not in self._steppers or self._steppers[i].problem is not problem:
            tolerance, h, integrator = self._settings
            self._steppers[i] = ProjectiveDynamics(
                problem, tolerance, time_step=h, integrator=integrator
            )
        extra = None
        if forces is not None:
            extra = forces[i, : len(problem.positions)].detach().to("cpu", torch.float64).numpy()
        try:
            return self._steppers[i](state, extra)
        except PdcorrectError:  # the batch's own status stands
            return None

    def _configuration(self, i: int, before: State, after: State) -> Tensor:
        """The y of a scene that was stepped alone."""
        stepper = self._steppers[i]
        scheme = stepper.integrate.scheme(before, stepper.time_step)
        y = solution(scheme, before, after, stepper.problem)
        nothing = np.zeros((0, 3))
        every = [y if k == i else nothing for k in range(self._cells.sizes.scenes)]
        return self._cells.configurations(every)[i]
