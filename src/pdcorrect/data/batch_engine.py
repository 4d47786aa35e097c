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
from pdcorrect.data.engines import MOST_ITERATIONS, Steps, failure_of
from pdcorrect.fem.problem import Problem
from pdcorrect.state import State


class Batched:
    """Problems side by side, on a GPU or, for tests, on the CPU; see `OneByOne`.

    At most ``most`` single steps are taken together, of several frames of each problem.  A rollout
    of one problem is computed twice, since kernels are compiled anew for a batch of one.
    """

    def __init__(
        self, device: str, tolerance: float, most: int = 1024, adds_up: bool = False
    ) -> None:
        self._device, self._tolerance, self._most = device, tolerance, most
        self._adds_up = adds_up

    def rollouts(self, problems: Sequence[Problem], steps: int, divisor: int = 1) -> list[Steps]:
        if len(problems) == 1:
            found = self.rollouts([*problems, *problems], steps, divisor)[0]
            return [replace(found, seconds=2.0 * found.seconds)]
        started = time.perf_counter()
        stepper = self._stepper(problems, divisor)
        rest, log = stepper.rest_state(), _BatchLog(stepper, problems)
        state = stepper.initial_state()
        for _ in range(steps):
            for _ in range(divisor):
                result = stepper(state)
                log.note(result)
                state = log.without_failed(result.state, rest)
            log.frame(state)
        return log.steps(steps, time.perf_counter() - started)

    def predictions(
        self, problems: Sequence[Problem], states: Sequence[Sequence[State]]
    ) -> list[Steps]:
        started = time.perf_counter()
        frames = len(states[0])
        at_once = max(1, min(frames, self._most // len(problems)))
        every = [problem for problem in problems for _ in range(at_once)]
        stepper = self._stepper(every, 1)
        log = _BatchLog(stepper, every, at_once)
        for first in range(0, frames, at_once):
            numbers = [min(first + k, frames - 1) for k in range(at_once)]
            result = stepper(stepper.state([s[k] for s in states for k in numbers]))
            log.note(result)
            log.frame(result.state)
        return log.steps(frames, time.perf_counter() - started)

    def describe(self) -> dict[str, str]:
        return {"solver": "pd", "engine": f"batches on {torch.device(self._device).type}"}

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
    """Statistics and coarse nodes of B steps that are taken together, ``at_once`` of a problem."""

    def __init__(
        self, stepper: BatchStepper, problems: Sequence[Problem], at_once: int = 1
    ) -> None:
        self._at_once = at_once
        self._nodes = [problem.mesh.coarse_nodes for problem in problems]
        chosen = np.zeros((len(problems), max(map(len, self._nodes))), dtype=np.int64)
        for row, nodes in zip(chosen, self._nodes, strict=True):
            row[: len(nodes)] = nodes
        self._chosen = torch.as_tensor(chosen, device=stepper.device)[..., None].expand(-1, -1, 3)
        self._failed = np.zeros(len(problems), dtype=bool)
        self._frames: list[tuple[Any, ...]] = []
        self._begin()

    def _begin(self) -> None:
        count = len(self._nodes)
        self._iterations, self._estimates = np.zeros(count, dtype=np.int64), np.zeros(count)
        self._ratios, self._failures = np.full(count, np.inf), np.full(count, "", dtype=object)

    def note(self, result: BatchResult) -> None:
        """A step inside a frame."""
        self._iterations += result.iterations
        self._estimates = np.maximum(self._estimates, result.error_estimates)
        ratios = result.smallest_volume_ratios
        self._ratios = np.fmin(self._ratios, ratios)
        for i, (status, ratio) in enumerate(zip(result.statuses, ratios.tolist(), strict=True)):
            self._failures[i] = self._failures[i] or failure_of(status, ratio)
        self._failed |= self._failures != ""

    def without_failed(self, state: BatchState, rest: BatchState) -> BatchState:
        """The state with scenes that failed put back to rest, where they cost little."""
        if not self._failed.any():
            return state
        return state.where(torch.from_numpy(~self._failed).to(state.positions.device), rest)

    def frame(self, state: BatchState) -> None:
        """The end of a frame."""
        positions, velocities = (self._at_nodes(x) for x in (state.positions, state.velocities))
        self._frames.append((
            positions, velocities, self._iterations, self._estimates, self._ratios, self._failures
        ))  # fmt: skip
        self._begin()

    def _at_nodes(self, x: Tensor) -> np.ndarray:
        return x.gather(1, self._chosen).to("cpu", torch.float64).numpy()

    def steps(self, count: int, seconds: float) -> list[Steps]:
        """``count`` steps of each problem, which is charged an equal share of the time."""
        nodes, columns = self._nodes[:: self._at_once], []
        for column in zip(*self._frames, strict=True):
            apart = np.stack(column)  # (frames, problems * at_once, ...)
            apart = apart.reshape(len(apart), len(nodes), self._at_once, *apart.shape[2:])
            flat = apart.swapaxes(0, 1).reshape(len(nodes), -1, *apart.shape[3:])
            columns.append(flat[:, :count])
        out = []
        for own, x, v, iterations, estimates, ratios, failures in zip(nodes, *columns, strict=True):
            told = (f"step {k + 1}: {text}" for k, text in enumerate(failures) if text)
            x, v, share = x[:, : len(own)], v[:, : len(own)], seconds / len(nodes)
            out.append(Steps(x, v, iterations, estimates, ratios, next(told, ""), share))
        return out
