"""Times of methods, in rounds of all of them, so that a busy moment spoils no method alone."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pdcorrect as pc
from pdcorrect._files import write_text
from pdcorrect.errors import ConvergenceError

ROUNDS = ((40.0, 5), (150.0, 3), (math.inf, 1))
"""Rounds of methods whose first one takes at most so many ms a frame."""
MOST = max(count for _, count in ROUNDS)


@dataclass
class Timed:
    """What is found of a method, with an entry a round.

    Attributes
    ----------
    failed : bool
        Whether a step failed.
    found : mapping of str to float
        What its first run is judged by.
    wall, cpu : list of float
        ms a frame, in the mean of a rollout, by the clock and of the process.
    first : list of float
        s from the scene to the end of the first frame, by the clock.
    """

    failed: bool = False
    found: dict[str, float] = field(default_factory=dict)
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    first: list[float] = field(default_factory=list)

    def wants(self) -> int:
        """How many rounds, as far as is known."""
        if self.failed or not self.wall:
            return 0 if self.failed else 1
        return next(count for most, count in ROUNDS if self.wall[0] <= most)


def timed(
    scene: pc.Scene,
    methods: Mapping[str, Any],
    judge: Callable[[str, pc.Trajectory], dict[str, float]],
    path: Path,
) -> dict[str, Timed]:
    """Methods by name; kernels are compiled and loaded before.

    ``path`` keeps what is found until all is, for a call after one that was ended.
    """
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    out = {name: Timed(**known.get(name, {})) for name in methods}
    for name, method in methods.items():
        if len(out[name].wall) < out[name].wants():
            try:
                pc.rollout(method.stepper(scene), 1)
            except ConvergenceError:
                out[name].failed = True
    for number in range(MOST):
        for name, each in out.items():
            if len(each.wall) <= number < each.wants():
                _round(scene, name, methods[name], each, judge)
                write_text(path, json.dumps({key: asdict(value) for key, value in out.items()}))
    path.unlink(missing_ok=True)
    return out


def _round(
    scene: pc.Scene,
    name: str,
    method: Any,
    each: Timed,
    judge: Callable[[str, pc.Trajectory], dict[str, float]],
) -> None:
    try:
        started = time.perf_counter()
        stepper = method.stepper(scene)
        pc.rollout(stepper, 1)
        first = time.perf_counter() - started
        started, spent = time.perf_counter(), time.process_time()
        run = pc.rollout(stepper)
        wall, cpu = time.perf_counter() - started, time.process_time() - spent
    except ConvergenceError:
        each.failed = True
        return
    each.first.append(first)
    each.wall.append(1e3 * wall / len(run))
    each.cpu.append(1e3 * cpu / len(run))
    each.found = each.found or judge(name, run)
