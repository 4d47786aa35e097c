"""`Batched`: the runs of a data set as batches of torch, on a GPU."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.states import BatchResult, BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.data.engines import MOST_ITERATIONS, Job, Steps
from pdcorrect.fem.problem import Problem
from pdcorrect.state import State


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
    adds_up : bool
        See `OneByOne`.

    Notes
    -----
    A rollout of one problem is computed twice, since kernels are compiled anew for a batch of one.
    """

    solver = "pd"

    def __init__(
        self, device: str, tolerance: float, most: int = 1024, adds_up: bool = False
    ) -> None:
        self._device, self._tolerance, self._most = device, tolerance, most
        self._adds_up = adds_up

    def rollouts(self, jobs: Sequence[Job], steps: int, divisor: int = 1) -> list[Steps]:
        """See `Engine`."""
        if len(jobs) == 1:
            found = self.rollouts([*jobs, *jobs], steps, divisor)[0]
            return [replace(found, seconds=2.0 * found.seconds)]
        started = time.perf_counter()
        stepper = self._stepper([job.problem for job in jobs], divisor)
        rest, log = stepper.rest_state(), _BatchLog(stepper, jobs)
        state = stepper.initial_state()
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
            self._tolerance / (divisor**2 if self._adds_up else 1),
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
        for i, (status, ratio) in enumerate(zip(result.statuses, ratios.tolist(), strict=True)):
            if not self.failures[i] and not (status.ok and ratio > 0.0):
                what = "a cell is inverted" if status.ok else status.value
                self.failures[i] = f"step {len(self._frames) + 1}: {what}"

    def without_failed(self, state: BatchState, rest: BatchState) -> BatchState:
        """The state with scenes that failed put back to rest, where they cost little."""
        if not any(self.failures):
            return state
        failed = torch.tensor([bool(f) for f in self.failures], device=state.positions.device)
        return state.where(~failed, rest)

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
