"""`measure_speed`: what a corrected step costs beside a coarse and a fine one of equal accuracy."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pdcorrect.batch.states import BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.evaluation.rollouts import Hybrid
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State

TOLERANCES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
"""Of the cell size, that are tried."""
_TIGHT = 1e-8
_WARM_UP = 2
"""Steps before those that are timed."""


@dataclass(frozen=True)
class SolverTime:
    """What a solver's step of a batch costs.

    Attributes
    ----------
    nodes : int
        Of all scenes together.
    tolerance : float
        Of the coarse cell size, as given to the solver.
    solver_error : float
        Largest distance of a node from the step's exact solution, over the cell size.
    seconds : float
        Median of a step of all scenes.
    """

    nodes: int
    tolerance: float
    solver_error: float
    seconds: float


@dataclass(frozen=True)
class Speed:
    """Times of one batch on one device, each solver with the same largest solver error.

    Attributes
    ----------
    device : str
    scenes, steps : int
        Batch size, and steps that were timed.
    accuracy : float
        Solver error that was allowed, over the coarse cell size.
    coarse, hybrid, fine : SolverTime
        Batches in torch; "hybrid" is "coarse" with network and gate, its solver error is that
        of the coarse solver.
    fine_one_by_one : SolverTime or None
        One scene after the other by `ProjectiveDynamics`; on the CPU only.
    """

    device: str
    scenes: int
    steps: int
    accuracy: float
    coarse: SolverTime
    hybrid: SolverTime
    fine: SolverTime
    fine_one_by_one: SolverTime | None

    @property
    def speed_up(self) -> float:
        """Time of a fine step, by the quicker solver, over that of a corrected one."""
        others = [self.fine] if self.fine_one_by_one is None else [self.fine, self.fine_one_by_one]
        return min(other.seconds for other in others) / self.hybrid.seconds

    @property
    def network_share(self) -> float:
        """Share of a corrected step that is not the coarse solver's."""
        return 1.0 - self.coarse.seconds / self.hybrid.seconds


def measure_speed(
    coarse: Sequence[Problem],
    fine: Sequence[Problem],
    hybrid: Callable[[BatchStepper], Hybrid],
    *,
    device: str = "cpu",
    accuracy: float = 1e-4,
    steps: int = 20,
) -> Speed:
    """Time coarse, corrected and fine steps of the same scenes as one batch.

    First the loosest of `TOLERANCES` is looked for, for each solver, whose steps err by no
    more than ``accuracy``: a tolerance bounds an estimate, which solvers meet by unlike
    margins.  Then ``steps`` steps from rest are timed, after two that are not.

    Parameters
    ----------
    coarse, fine : sequence of Problem
        The same scenes on coarse and fine meshes.
    hybrid : callable
        From a stepper of the coarse problems to their corrected step, see `Candidate`.
    device : str
    accuracy : float
        Of the coarse cell size.
    steps : int

    Raises
    ------
    InputError
        If there are not as many coarse as fine problems, or no step is asked for.
    ConvergenceError
        If no tolerance is accurate enough.
    """
    if len(coarse) != len(fine) or not coarse or steps < 1:
        raise InputError(
            f"{len(coarse)} coarse and {len(fine)} fine problems, {steps} steps: expected as many "
            "of both, and one step or more."
        )
    loose, loose_error = _batch_tolerance(coarse, device, accuracy, steps)
    tight, tight_error = _batch_tolerance(fine, device, accuracy, steps)
    stepper = BatchStepper(coarse, loose, device=device)
    corrected = hybrid(stepper)
    nodes, fine_nodes = (sum(len(p.positions) for p in each) for each in (coarse, fine))
    count = steps + _WARM_UP
    previous: list[Any] = [None]

    def corrected_step(state: BatchState) -> BatchState:
        result = corrected(state, previous[0])
        previous[0] = result.correction
        return result.state

    times = {
        "coarse": _seconds(lambda s: stepper(s).state, stepper.rest_state(), count, device),
        "hybrid": _seconds(corrected_step, stepper.rest_state(), count, device),
    }
    finer = BatchStepper(fine, tight, device=device)
    times["fine"] = _seconds(lambda s: finer(s).state, finer.rest_state(), count, device)
    return Speed(
        device=device,
        scenes=len(coarse),
        steps=steps,
        accuracy=accuracy,
        coarse=SolverTime(nodes, loose, loose_error, times["coarse"]),
        hybrid=SolverTime(nodes, loose, loose_error, times["hybrid"]),
        fine=SolverTime(fine_nodes, tight, tight_error, times["fine"]),
        fine_one_by_one=_one_by_one(fine, accuracy, steps) if device == "cpu" else None,
    )


def _batch_tolerance(
    problems: Sequence[Problem], device: str, accuracy: float, steps: int
) -> tuple[float, float]:
    """The loosest tolerance that is accurate enough after some steps, and its error."""
    exact = BatchStepper(problems, _TIGHT, device=device)
    state = exact.rest_state()
    for _ in range(steps // 2):
        state = exact(state).state
    truth = exact(state).state.positions
    sizes = torch.tensor([p.cell_size for p in problems], device=truth.device, dtype=truth.dtype)

    def error(tolerance: float) -> float:
        found = BatchStepper(problems, tolerance, device=device)(state).state.positions
        return float(((found - truth).norm(dim=2).amax(dim=1) / sizes).max())

    return _loosest(error, accuracy)


def _loosest(error: Callable[[float], float], accuracy: float) -> tuple[float, float]:
    for tolerance in TOLERANCES:
        found = error(tolerance)
        if found <= accuracy:
            return tolerance, found
    raise ConvergenceError(
        f"no tolerance down to {TOLERANCES[-1]:g} gives a solver error of {accuracy:g} of the cell "
        "size: expected a larger accuracy."
    )


def _one_by_one(problems: Sequence[Problem], accuracy: float, steps: int) -> SolverTime:
    states = []
    for problem in problems:
        exact, state = ProjectiveDynamics(problem, _TIGHT), problem.rest_state()
        for _ in range(steps // 2):
            state = exact(state).state
        states.append((state, exact(state).state.positions))

    def error(tolerance: float) -> float:
        largest = 0.0
        for problem, (state, truth) in zip(problems, states, strict=True):
            found = ProjectiveDynamics(problem, tolerance)(state).state.positions
            away = float(np.linalg.norm(found - truth, axis=1).max())
            largest = max(largest, away / problem.cell_size)
        return largest

    tolerance, found = _loosest(error, accuracy)
    steppers = [ProjectiveDynamics(problem, tolerance).prepare() for problem in problems]

    def step(every: list[State]) -> list[State]:
        return [one(state).state for one, state in zip(steppers, every, strict=True)]

    rest = [problem.rest_state() for problem in problems]
    seconds = _seconds(step, rest, steps + _WARM_UP, "cpu")
    return SolverTime(sum(len(p.positions) for p in problems), tolerance, found, seconds)


def _seconds(step: Callable[[Any], Any], state: Any, steps: int, device: str) -> float:
    """Median time of successive steps, those of the warm-up left out."""
    times = []
    for _ in range(steps):
        _wait(device)
        started = time.perf_counter()
        state = step(state)
        _wait(device)
        times.append(time.perf_counter() - started)
    return statistics.median(times[_WARM_UP:])


def _wait(device: str) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
