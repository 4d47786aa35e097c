"""Scenes of a batch that did not converge, tried again one at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.states import BatchResult, BatchState, state_of
from pdcorrect.errors import PdcorrectError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.adjoint import step_solution
from pdcorrect.solvers.integrators import solution
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State, Status, StepResult

Array = NDArray[np.float64]
ProblemOf = Callable[[int], Problem]

_WORTH_IT = (Status.ITERATION_LIMIT, Status.LINE_SEARCH)


class SingleRetry:
    """Steps single scenes with `ProjectiveDynamics` and its fallbacks, on the CPU.

    The ``options`` are those of `ProjectiveDynamics`.
    """

    def __init__(self, cells: CellBatch, tolerances: Sequence[float], **options: Any) -> None:
        self._cells, self._tolerances, self._options = cells, tolerances, options
        self._steppers: dict[int, ProjectiveDynamics] = {}

    def __call__(
        self, before: BatchState, forces: Tensor | None, result: BatchResult, now: ProblemOf
    ) -> None:
        """Write into the result the steps of those scenes that now converge.

        ``now`` gives the problem of a scene, by its number, as it is now.
        """
        for i, status in enumerate(result.statuses):
            if status in _WORTH_IT:
                state, push = state_of(self._cells, before, i), self._push(i, forces)
                try:
                    stepper = self._stepper(i, now(i))
                    step = stepper(state, push)
                except PdcorrectError:
                    continue  # the batch's own status stands
                if set(step.state.memory) == set(result.state.memory):
                    self._write(i, step, result, _solution(stepper, state, push, step))

    def _write(self, i: int, step: StepResult, result: BatchResult, y: Array) -> None:
        converged, after = step.status is Status.CONVERGED, result.state
        result.statuses[i] = Status.RECOVERED if converged else step.status
        result.error_estimates[i] = step.error_estimate
        result.iterations[i] += step.iterations
        result.smallest_volume_ratios[i] = step.stats["smallest_volume_ratio"]
        nodes = self._cells.node_counts[i]
        rows = [(after.positions, step.state.positions), (after.velocities, step.state.velocities)]
        rows += [(x, step.state.memory[name]) for name, x in after.memory.items()]
        rows += [(result.y, y[:nodes]), (result.y[:, self._cells.sizes.nodes :], y[nodes:])]
        for x, array in rows:
            x[i, : len(array)] = self._cells.tensor(array)

    def _push(self, i: int, forces: Tensor | None) -> Array | None:
        if forces is None:
            return None
        rows = forces[i, : self._cells.node_counts[i]]
        return rows.detach().to("cpu", torch.float64).numpy()

    def _stepper(self, i: int, problem: Problem) -> ProjectiveDynamics:
        if i not in self._steppers or self._steppers[i].problem is not problem:
            self._steppers[i] = ProjectiveDynamics(problem, self._tolerances[i], **self._options)
        return self._steppers[i]


def _solution(
    stepper: ProjectiveDynamics, before: State, push: Array | None, step: StepResult
) -> Array:
    """The y of a scene that was stepped alone."""
    integrate, h = stepper.integrate, stepper.time_step
    if step.status is Status.SUBSTEPPED:  # has no y
        return solution(integrate.scheme(before, h), before, step.state, stepper.problem)
    return step_solution(stepper.objective(before, push, h), integrate, h, step)
