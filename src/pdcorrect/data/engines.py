"""Who computes the runs of a data set: `OneByOne` on the CPU; batches on a GPU elsewhere.

An engine takes problems that may share meshes and materials, and gives, for each, a
rollout or single steps from given states, on chosen nodes only.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.states import BatchResult, BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.newton import Newton
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State, Status, StepResult

MOST_ITERATIONS = 300
"""Of projective dynamics in a step, without fallbacks; a load that takes more is rejected.

In `impulse-as-published` a step takes 3 to 6 on average and 91 at most.  A body that folds takes
far more, for which all others in its batch would wait.
"""

Array = NDArray[np.float64]
SolverName = Literal["pd", "newton"]


@dataclass(frozen=True, eq=False)
class Steps:
    """What came of T steps, on K of a problem's nodes.

    Attributes
    ----------
    positions, velocities : (T, K, 3)
        After each step, m and m/s.  Steps after a failure are missing.
    iterations, error_estimates, smallest_volume_ratios : (T,)
        Error estimates in m; det F at quadrature points.
    failure : str
        Why the run is of no use, with its first bad step; empty if it is fine.
    seconds : float
        The share of the wall-clock time.
    """

    positions: Array
    velocities: Array
    iterations: NDArray[np.int64]
    error_estimates: Array
    smallest_volume_ratios: Array
    failure: str
    seconds: float


@dataclass(frozen=True, eq=False)
class Job:
    """A problem to be stepped, and the nodes whose motion is wanted."""

    problem: Problem
    nodes: NDArray[np.int64]


class Engine(Protocol):
    """Computes runs."""

    def rollouts(self, jobs: Sequence[Job], steps: int, divisor: int = 1) -> list[Steps]:
        """Each problem from rest, ``steps`` time steps, each cut into ``divisor`` ones."""

    def predictions(self, jobs: Sequence[Job], states: Sequence[Sequence[State]]) -> list[Steps]:
        """One step from each state of each problem, as long as they all succeed."""

    def describe(self) -> dict[str, str]:
        """The solver and what it runs on."""


class OneByOne:
    """One problem after the other, on the CPU.

    Parameters
    ----------
    solver : {"pd", "newton"}
        "pd" without fallbacks and with at most `MOST_ITERATIONS`.
    tolerance : float
        Of the coarse cell size.
    """

    def __init__(self, solver: SolverName, tolerance: float) -> None:
        self._solver, self._tolerance = solver, tolerance

    def rollouts(self, jobs: Sequence[Job], steps: int, divisor: int = 1) -> list[Steps]:
        """See `Engine`."""
        out = []
        steppers: dict[int, Any] = {}
        for job in jobs:
            log = _Log(job.nodes)
            with log.timed():
                stepper = self._stepper(steppers, job.problem, divisor)
            state = job.problem.rest_state()
            for _ in range(steps):
                worst = log.begin()
                with log.timed():
                    for _ in range(divisor):
                        result = stepper(state, _forces(job.problem, state, stepper.time_step))
                        worst = worst.with_result(result)
                        state = result.state
                log.add(worst, state)
                if log.failure:
                    break
            out.append(log.steps())
        return out

    def predictions(self, jobs: Sequence[Job], states: Sequence[Sequence[State]]) -> list[Steps]:
        """See `Engine`."""
        out = []
        steppers: dict[int, Any] = {}
        for job, starts in zip(jobs, states, strict=True):
            log = _Log(job.nodes)
            with log.timed():
                stepper = self._stepper(steppers, job.problem, 1)
            for state in starts:
                with log.timed():
                    result = stepper(state, _forces(job.problem, state, stepper.time_step))
                log.add(log.begin().with_result(result), result.state)
                if log.failure:
                    break
            out.append(log.steps())
        return out

    def describe(self) -> dict[str, str]:
        """See `Engine`."""
        return {"solver": self._solver, "engine": "one by one on the CPU"}

    def _stepper(self, known: dict[int, Any], problem: Problem, divisor: int) -> Any:
        """One stepper, without loads, for all problems on the same mesh."""
        key = id(problem.space)
        if key not in known:
            unloaded, step = problem.with_loads([]), problem.time_step / divisor
            if self._solver == "newton":
                known[key] = Newton(unloaded, self._tolerance, time_step=step)
            else:
                known[key] = ProjectiveDynamics(
                    unloaded, self._tolerance, time_step=step, max_iterations=MOST_ITERATIONS,
                    recover=False,
                )  # fmt: skip
        return known[key]


def _forces(problem: Problem, state: State, step: float) -> Array:
    return problem.external_forces(state.time, state.time + step, state.positions)


@dataclass(frozen=True)
class _Worst:
    """Of the steps inside a frame."""

    iterations: int = 0
    error_estimate: float = 0.0
    volume_ratio: float = np.inf
    failure: str = ""

    def with_result(self, result: StepResult) -> _Worst:
        ratio = min(self.volume_ratio, result.stats["smallest_volume_ratio"])
        failure = self.failure
        if not failure and not result.status.ok:
            failure = result.status.value
        if not failure and ratio <= 0.0:
            failure = "a cell is inverted"
        return _Worst(
            self.iterations + result.iterations,
            max(self.error_estimate, result.error_estimate),
            ratio,
            failure,
        )


class _Log:
    """Rows of a `Steps` in the making."""

    def __init__(self, nodes: NDArray[np.int64]) -> None:
        self._nodes = nodes
        self._states: list[tuple[Array, Array]] = []
        self._rows: list[_Worst] = []
        self._seconds = 0.0
        self.failure = ""

    @staticmethod
    def begin() -> _Worst:
        return _Worst()

    @contextlib.contextmanager
    def timed(self) -> Iterator[None]:
        """Charge what is done within, setting up included."""
        started = time.perf_counter()
        yield
        self._seconds += time.perf_counter() - started

    def add(self, row: _Worst, state: State) -> None:
        self._rows.append(row)
        self._states.append((state.positions[self._nodes], state.velocities[self._nodes]))
        if row.failure and not self.failure:
            self.failure = f"step {len(self._rows)}: {row.failure}"

    def steps(self) -> Steps:
        positions, velocities = (np.stack(arrays) for arrays in zip(*self._states, strict=True))
        return Steps(
            positions,
            velocities,
            np.array([row.iterations for row in self._rows]),
            np.array([row.error_estimate for row in self._rows]),
            np.array([row.volume_ratio for row in self._rows]),
            self.failure,
            self._seconds,
        )


class Batched:
    """Problems side by side, on a GPU or, for tests, on the CPU.

    Parameters
    ----------
    device : str
        "cuda", "cuda:1", "cpu".
    tolerance : float
        Of the coarse cell size.
    most : int
        Single steps that are taken together: those of several frames of each problem.

    Notes
    -----
    A rollout of one problem is computed twice, since kernels are compiled anew for a batch of one.
    """

    solver = "pd"

    def __init__(self, device: str, tolerance: float, most: int = 1024) -> None:
        self._device, self._tolerance, self._most = device, tolerance, most

    def rollouts(self, jobs: Sequence[Job], steps: int, divisor: int = 1) -> list[Steps]:
        """See `Engine`."""
        if len(jobs) == 1:
            found = self.rollouts([*jobs, *jobs], steps, divisor)[0]
            return [replace(found, seconds=2.0 * found.seconds)]
        started = time.perf_counter()
        stepper = self._stepper([job.problem for job in jobs], divisor)
        rest, log = stepper.rest_state(), _BatchLog(stepper, jobs)
        state = rest
        for _ in range(steps):
            for _ in range(divisor):
                result = stepper(state)
                log.note(result)
                state = log.without_failed(result.state, rest)
            log.frame(state)
        return log.steps(time.perf_counter() - started)

    def predictions(self, jobs: Sequence[Job], states: Sequence[Sequence[State]]) -> list[Steps]:
        """See `Engine`."""
        started = time.perf_counter()
        frames = max(map(len, states))
        at_once = max(1, min(frames, self._most // len(jobs)))
        every = [job for job in jobs for _ in range(at_once)]
        stepper = self._stepper([job.problem for job in every], 1)
        parts: list[list[Steps]] = [[] for _ in jobs]
        for first in range(0, frames, at_once):
            numbers = [min(first + k, frames - 1) for k in range(at_once)]
            log = _BatchLog(stepper, every)
            result = stepper(stepper.state([s[k] for s in states for k in numbers]))
            log.note(result)
            log.frame(result.state)
            found = log.steps(0.0)
            for i, part in enumerate(parts):
                part += found[i * at_once : (i + 1) * at_once][: frames - first]
        seconds = (time.perf_counter() - started) / len(jobs)
        return [_joined(part, seconds) for part in parts]

    def describe(self) -> dict[str, str]:
        """See `Engine`."""
        kind = torch.device(self._device).type
        return {"solver": self.solver, "engine": f"batches on {kind}"}

    def _stepper(self, problems: Sequence[Problem], divisor: int) -> BatchStepper:
        if torch.device(self._device).type == "cuda":
            torch.cuda.empty_cache()  # of the last stepper, since others may share the GPU
        return BatchStepper(
            problems,
            self._tolerance,
            device=self._device,
            time_step=problems[0].time_step / divisor,
            max_iterations=MOST_ITERATIONS,
            recover=False,
        )


class _BatchLog:
    """Statistics and chosen nodes of steps that are taken together."""

    def __init__(self, stepper: BatchStepper, jobs: Sequence[Job]) -> None:
        self._stepper, self._jobs = stepper, jobs
        count = len(jobs)
        most = max(len(job.nodes) for job in jobs)
        chosen = np.zeros((count, most), dtype=np.int64)
        for i, job in enumerate(jobs):
            chosen[i, : len(job.nodes)] = job.nodes
        self._chosen = torch.as_tensor(chosen, device=stepper.device)[..., None].expand(-1, -1, 3)
        self._frames: list[tuple[Any, ...]] = []
        self.failures = [""] * count
        self._begin()

    def _begin(self) -> None:
        count = len(self._jobs)
        self._iterations = np.zeros(count, dtype=np.int64)
        self._estimates, self._ratios = np.zeros(count), np.full(count, np.inf)

    def note(self, result: BatchResult) -> None:
        """A step inside a frame."""
        self._iterations += result.iterations
        self._estimates = np.maximum(self._estimates, result.error_estimates)
        ratios = result.smallest_volume_ratios
        self._ratios = np.fmin(self._ratios, ratios)
        for i, status in enumerate(result.statuses):
            self._judge(i, status, float(ratios[i]))

    def _judge(self, i: int, status: Status, ratio: float) -> None:
        if self.failures[i]:
            return
        frame = len(self._frames) + 1
        if not status.ok:
            self.failures[i] = f"step {frame}: {status.value}"
        elif ratio <= 0.0:
            self.failures[i] = f"step {frame}: a cell is inverted"

    def without_failed(self, state: BatchState, rest: BatchState) -> BatchState:
        """The state with scenes that failed put back to rest, where they cost little."""
        if not any(self.failures):
            return state
        failed = torch.tensor([bool(f) for f in self.failures], device=state.positions.device)
        failed = failed[:, None, None]
        return BatchState(
            torch.where(failed, rest.positions, state.positions),
            torch.where(failed, rest.velocities, state.velocities),
            state.times,
            state.memory,
        )

    def frame(self, state: BatchState) -> None:
        """The end of a frame."""
        positions, velocities = (self._at_nodes(x) for x in (state.positions, state.velocities))
        self._frames.append(
            (positions, velocities, self._iterations, self._estimates, self._ratios)
        )
        self._begin()

    def _at_nodes(self, x: Tensor) -> np.ndarray:
        return x.gather(1, self._chosen).to("cpu", torch.float64).numpy()

    def steps(self, seconds: float) -> list[Steps]:
        """The scenes' steps, apart; each is charged an equal share of the time."""
        stacked = [np.stack(column) for column in zip(*self._frames, strict=True)]
        positions, velocities, iterations, estimates, ratios = stacked
        return [
            Steps(
                positions[:, i, : len(job.nodes)],
                velocities[:, i, : len(job.nodes)],
                iterations[:, i],
                estimates[:, i],
                ratios[:, i],
                self.failures[i],
                seconds / len(self._jobs),
            )
            for i, job in enumerate(self._jobs)
        ]


def _joined(parts: Sequence[Steps], seconds: float) -> Steps:
    """Single steps from successive frames as one record."""
    numbered = ((k, s.failure) for k, s in enumerate(parts) if s.failure)
    failure = next((f"step {k + 1}: {text.split(': ', 1)[1]}" for k, text in numbered), "")
    arrays = {
        name: np.concatenate([getattr(s, name) for s in parts])
        for name in (
            "positions", "velocities", "iterations", "error_estimates", "smallest_volume_ratios",
        )
    }  # fmt: skip
    return Steps(**arrays, failure=failure, seconds=seconds)
