"""Median milliseconds of a step of cantilevers on one and on two threads, in turns; prints JSON."""

from __future__ import annotations

import json
import os
import time

import numba
import numpy as np

import pdcorrect as pc

ROUNDS, STEPS = 12, 3
SCENE = pc.Scene(
    body={"shape": "beam", "cells": [12, 2, 2], "cell_size": 0.02},
    material={"young": 1e6, "poisson": 0.45, "density": 1e3},
    time={"step": 0.01, "frames": 10},
    clamps=[{"region": {"plane": "x", "at": 0.0}}],
    loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
)


def main() -> None:
    """Measure beams of growing size."""
    os.environ.setdefault("NUMBA_NUM_THREADS", "2")  # threads are as asked for, however busy
    rows = []
    for length, refine in ((12, 1), (24, 1), (48, 1), (12, 2), (24, 2)):
        problem = pc.discretise(
            pc.best_coarse(SCENE.with_changes(body={"cells": [length, 2, 2]})), refine=refine
        )
        stepper = pc.ProjectiveDynamics(problem).prepare()
        run = pc.rollout(stepper, frames=6)
        seconds: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(ROUNDS):
            for threads, found in seconds.items():
                numba.set_num_threads(threads)
                started = time.perf_counter()
                for frame in range(3, 3 + STEPS):
                    stepper(run.state(frame))
                found.append((time.perf_counter() - started) / STEPS)
        rows.append({
            "nodes": len(problem.positions),
            "points": problem.quadrature.weights.size,
            **{f"{t} threads, ms": 1e3 * float(np.median(s)) for t, s in seconds.items()},
        })  # fmt: skip
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
