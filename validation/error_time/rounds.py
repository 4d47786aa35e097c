"""Times of methods, in rounds of all of them, so that a busy moment spoils no method alone."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pdcorrect as pc
from pdcorrect.errors import ConvergenceError

ROUNDS = ((150.0, 5), (400.0, 2), (math.inf, 1))
"""Rounds of methods whose first one takes at most so many ms a frame."""


@dataclass
class Timed:
    """A method's run, None if it failed, and its times, an entry a round.

    Attributes
    ----------
    wall, cpu : list of float
        ms a frame, in the mean of a rollout, by the clock and of the process.
    first : list of float
        s from the scene to the end of the first frame, by the clock.
    """

    run: pc.Trajectory | None = None
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    first: list[float] = field(default_factory=list)

    def wants(self) -> int:
        """How many rounds."""
        return 0 if self.run is None else next(n for most, n in ROUNDS if self.wall[0] <= most)


def timed(scene: pc.Scene, methods: Mapping[str, Any]) -> dict[str, Timed]:
    """Times of methods by name; kernels are compiled and loaded before."""
    for method in methods.values():
        with contextlib.suppress(ConvergenceError):
            pc.rollout(method.stepper(scene), 1)
    found = {name: Timed() for name in methods}
    for number in range(max(n for _, n in ROUNDS)):
        for name, method in methods.items():
            if number == 0 or number < found[name].wants():
                with contextlib.suppress(ConvergenceError):
                    _round(scene, method, found[name])
    return found


def _round(scene: pc.Scene, method: Any, found: Timed) -> None:
    started = time.perf_counter()
    stepper = method.stepper(scene)
    pc.rollout(stepper, 1)
    first = time.perf_counter() - started
    started, spent = time.perf_counter(), time.process_time()
    run = pc.rollout(stepper)
    wall, cpu = time.perf_counter() - started, time.process_time() - spent
    found.run = run
    found.first.append(first)
    found.wall.append(1e3 * wall / len(run))
    found.cpu.append(1e3 * cpu / len(run))
