"""Scenes of a batch that did not converge, tried again one at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.states import BatchResult, BatchState, state_of, with_states
from pdcorrect.errors import PdcorrectError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.integrators import solution
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.step_solution import step_solution
from pdcorrect.state import State, Status, StepResult

_WORTH_IT = (Status.ITERATION_LIMIT, Status.LINE_SEARCH)


class SingleRetry:
    """Steps single scenes with `ProjectiveDynamics` and its fallbacks, on the CPU.

    Parameters
    ----------
    cells : CellBatch
    tolerances : sequence of float
        The scenes', of their cell sizes.
    time_step, integrator
        Of the steps.
    """

    def __init__(
        self,
        cells: CellBatch,
        tolerances: Sequence[float],
        time_step: float,
        integrator: str,
    ) -> None:
        self._cells, self._tolerances = cells, tolerances
        self._time_step, self._integrator = time_step, integrator
        self._steppers: dict[int, ProjectiveDynamics] = {}

    def __call__(
        self,
        before: BatchState,
        forces: Tensor | None,
        result: BatchResult,
        problem_now: Callable[[int], Problem],
    ) -> BatchResult:
        """The result with those scenes' in it that now converged.

        ``problem_now`` gives the problem of a scene, by its number, as it is now.
        """
        failed = [i for i, status in enumerate(result.statuses) if status in _WORTH_IT]
        found = {i: self._step(i, before, forces, result, problem_now(i)) for i in failed}
        steps = {i: step for i, step in found.items() if step is not None}
        if not steps:
            return result
        statuses, y = list(result.statuses), result.y.clone()
        estimates, iterations = result.error_estimates.copy(), result.iterations.copy()
        ratios = result.smallest_volume_ratios.copy()
        for i, step in steps.items():
            converged = step.status is Status.CONVERGED
            statuses[i] = Status.RECOVERED if converged else step.status
            estimates[i] = step.error_estimate
            iterations[i] += step.iterations
            ratios[i] = step.stats["smallest_volume_ratio"]
            y[i] = self._configuration(i, state_of(self._cells, before, i), step, forces)
        return replace(
            result,
            state=with_states(
                self._cells, result.state, {i: step.state for i, step in steps.items()}
            ),
            y=y,
            statuses=statuses,
            iterations=iterations,
            error_estimates=estimates,
            smallest_volume_ratios=ratios,
        )

    def _step(
        self,
        i: int,
        before: BatchState,
        forces: Tensor | None,
        result: BatchResult,
        problem: Problem,
    ) -> StepResult | None:
        """The step of one scene; None, and the batch's own status stands, if that fails too."""
        try:
            alone = state_of(self._cells, before, i)
            found = self._stepper(i, problem)(alone, self._extra(i, forces))
        except PdcorrectError:
            return None
        return found if set(found.state.memory) == set(result.state.memory) else None

    def _extra(self, i: int, forces: Tensor | None) -> NDArray[np.float64] | None:
        if forces is None:
            return None
        rows = forces[i, : self._cells.node_counts[i]]
        return rows.detach().to("cpu", torch.float64).numpy()

    def _stepper(self, i: int, problem: Problem) -> ProjectiveDynamics:
        if i not in self._steppers or self._steppers[i].problem is not problem:
            self._steppers[i] = ProjectiveDynamics(
                problem,
                self._tolerances[i],
                time_step=self._time_step,
                integrator=self._integrator,
            )
        return self._steppers[i]

    def _configuration(
        self, i: int, before: State, step: StepResult, forces: Tensor | None
    ) -> Tensor:
        """The y of a scene that was stepped alone."""
        stepper = self._steppers[i]
        integrate, h = stepper.integrate, stepper.time_step
        if step.status is Status.SUBSTEPPED:  # has no y
            y = solution(integrate.scheme(before, h), before, step.state, stepper.problem)
        else:
            objective = stepper.objective(before, self._extra(i, forces), h)
            y = step_solution(objective, integrate, h, step)
        nothing = np.zeros((0, 3))
        every = [y if k == i else nothing for k in range(self._cells.sizes.scenes)]
        return self._cells.configurations(every)[i]
