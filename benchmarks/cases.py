"""What is timed."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdcorrect as pc
from pdcorrect.fem.factorisation import factor_bytes, factorise
from pdcorrect.solvers.integrators import backward_euler
from pdcorrect.solvers.minimise import MinimiserOptions, minimise
from pdcorrect.solvers.step import GlobalSolver, StepObjective

Array = NDArray[np.float64]
Operator = Callable[[Array], Array]

EXAMPLES = Path(__file__).parent.parent / "examples"


def seconds(command: list[str], runs: int = 7) -> dict[str, float]:
    """Median and extremes of a whole process, after one warm-up."""
    taken = []
    for _ in range(runs + 1):
        started = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        taken.append(time.perf_counter() - started)
    taken = taken[1:]
    return {"median": statistics.median(taken), "min": min(taken), "max": max(taken)}


def start_up() -> dict[str, Any]:
    """Whole-process seconds of the program's help, the import, and bare Python."""
    program = Path(sys.executable).parent / "pdcorrect"
    return {
        "pdcorrect --help": seconds([str(program), "--help"]),
        "import pdcorrect": seconds([sys.executable, "-c", "import pdcorrect"]),
        "python -c pass": seconds([sys.executable, "-c", "pass"]),
    }


def steps() -> list[dict[str, Any]]:
    """Median milliseconds a frame over the first ten frames of the twisted cross."""
    script = Path(__file__).parent / "steps.py"
    rows = []
    for threads in (1, 2):
        out = subprocess.run(
            [sys.executable, str(script), str(threads)], check=True, capture_output=True, text=True
        )
        rows += json.loads(out.stdout.splitlines()[-1])
    return rows


def threads() -> list[dict[str, Any]]:
    """Milliseconds a step by what idle threads do: OpenMP's spinning and BLAS's threads."""
    script = str(Path(__file__).parent / "threads.py")
    rows = []
    for refine, spin, blas, busy in (
        (2, "10000", "1", 0),
        (2, "system's", "1", 0),
        (2, "10000", "1", 2),
        (2, "system's", "1", 2),
        (4, "10000", "1", 0),
        (4, "10000", "all", 0),
        (4, "system's", "all", 0),
    ):
        loop = [sys.executable, "-c", "while True: pass"]
        others = [subprocess.Popen(loop) for _ in range(busy)]
        try:
            out = subprocess.run(
                [sys.executable, script, str(refine), blas, spin],
                check=True,
                capture_output=True,
                text=True,
            )
        finally:
            for other in others:
                other.kill()
                other.wait()
        rows.append(
            {
                "refine": refine,
                "GOMP_SPINCOUNT": spin,
                "BLAS threads": blas,
                "other busy processes": busy,
                "milliseconds_a_frame": json.loads(out.stdout.splitlines()[-1]),
            }
        )
    return rows


def busy() -> list[dict[str, Any]]:
    """Milliseconds a step on one and two threads beside other busy processes."""
    script = str(Path(__file__).parent / "busy.py")
    rows = []
    for others in (0, 5, 10):
        loop = [sys.executable, "-c", "while True: pass"]
        started = [subprocess.Popen(loop) for _ in range(others)]
        try:
            out = subprocess.run(
                [sys.executable, script], check=True, capture_output=True, text=True
            )
        finally:
            for other in started:
                other.kill()
                other.wait()
        found = json.loads(out.stdout.splitlines()[-1])
        rows += [{"other busy processes": others, **row} for row in found]
    return rows


def first_hessian() -> list[dict[str, Any]]:
    """Mean iterations and milliseconds over eight frames, by the first Hessian of L-BFGS."""
    rows = []
    for motion in ("twist", "bending", "flight"):
        for poisson in (0.3, 0.45):
            for young in (1e5, 1e6, 1e7):
                scene = example_beam(motion, poisson).with_changes(material={"young": young})
                problem = pc.discretise(scene, refine=2)
                row: dict[str, Any] = {"motion": motion, "poisson": poisson, "young": young}
                for kind in ("G", "G-scaled", "rest", "lagged"):
                    stepper = pc.ProjectiveDynamics(problem, first_hessian=kind).prepare()
                    run = pc.rollout(stepper, 8, state=initial_state(problem, motion))
                    row[kind] = {
                        "iterations": float(run.stats["iterations"].mean()),
                        "milliseconds": 1e3 * float(run.stats["seconds"].mean()),
                    }
                rows.append(row)
    return rows


def volume_scale() -> list[dict[str, Any]]:
    """Mean L-BFGS iterations over eight frames, by the scale of the volume weight in G."""
    rows = []
    for motion in ("twist", "bending", "flight"):
        for poisson in (0.3, 0.45):
            problem = pc.discretise(example_beam(motion, poisson), refine=2)
            row: dict[str, Any] = {"motion": motion, "poisson": poisson, "history": 16}
            for scale in (1.0, 0.5, 0.25, 0.1):
                row[f"scale {scale:g}"] = _scaled(problem, motion, scale)
            rows.append(row)
    return rows


def factor_size() -> list[dict[str, Any]]:
    """Bytes of a symmetric factor (12 for each entry) against the estimate, blocks and beams."""
    rows = []
    for cells in ((8, 8, 8), (16, 16, 16), (24, 24, 24), (96, 8, 8), (224, 8, 8)):
        problem = pc.discretise(example_beam("bending", 0.3, cells))
        matrix = problem.global_matrix(0.01)
        started = time.perf_counter()
        factor = factorise(matrix, "cholespy")
        factor_seconds = time.perf_counter() - started
        right = np.random.default_rng(0).normal(size=problem.positions.shape)
        solves = []
        for _ in range(5):
            started = time.perf_counter()
            factor.solve(right)
            solves.append(time.perf_counter() - started)
        entries = factorise(matrix, "splu")._lu.L.nnz
        rows.append(
            {
                "cells": cells,
                "nodes": len(problem.positions),
                "splu_factor_megabytes": 12e-6 * entries,
                "estimated_megabytes": 1e-6 * factor_bytes(matrix.shape[0]),
                "cholespy_factor_seconds": factor_seconds,
                "cholespy_solve_milliseconds": 1e3 * statistics.median(solves),
            }
        )
    return rows


def example_beam(motion: str, poisson: float, cells: tuple[int, int, int] = (12, 2, 2)) -> pc.Scene:
    """A soft beam that is twisted, bends under its weight, or flies freely."""
    loads = {
        "twist": [{"kind": "torsion", "strength": 2e5}],
        "bending": [{"kind": "gravity", "acceleration": [0, 0, -9.81]}],
        "flight": [],
    }
    return pc.Scene(
        body={"shape": "beam", "cells": cells, "cell_size": 0.02},
        material={"young": 1e6, "poisson": poisson, "density": 1e3},
        time={"step": 0.01, "frames": 8, "integrator": "backward-euler"},
        clamps=[] if motion == "flight" else [{"region": {"plane": "x", "at": 0.0}}],
        loads=loads[motion],
    )


def initial_state(problem: pc.Problem, motion: str) -> pc.State:
    """At rest, or spinning and vibrating in free flight."""
    state = problem.rest_state()
    if motion != "flight":
        return state
    spin = np.cross([5.0, 3.0, 2.0], state.positions - 0.03)
    noise = 0.3 * np.random.default_rng(0).normal(size=spin.shape)
    return pc.State(state.positions, spin + noise)


def mean_iterations(
    problem: pc.Problem,
    motion: str,
    first_hessian: Callable[[StepObjective], Operator],
    options: MinimiserOptions,
    guess: Callable[[pc.State, Array], Array] | None = None,
) -> float:
    """L-BFGS iterations a step over eight steps of backward Euler.

    Parameters
    ----------
    first_hessian : callable
        Objective -> multiplication by the inverse.
    guess : callable, optional
        (state, velocities a step before) -> where the step starts; p + h v by default.
    """
    h, state = problem.time_step, initial_state(problem, motion)
    before, counts = state.velocities, []
    for _ in range(8):
        stage = backward_euler(problem, state, h)
        if guess is not None:
            stage = replace(stage, start=np.where(problem.free, guess(state, before), stage.start))
        loads = problem.external_forces(state.time, state.time + h)
        objective = StepObjective(problem, state, stage, loads)
        found = minimise(objective, objective.start, first_hessian(objective), options)
        counts.append(found.iterations)
        before, state = state.velocities, stage.finish(found.positions[: len(state.positions)])
    return float(np.mean(counts))


def _scaled(problem: pc.Problem, motion: str, scale: float) -> float:
    """Mean iterations with G whose volume weight is scaled."""
    solve = GlobalSolver(problem, (1.0 / problem.time_step**2, 1.0), volume_scale=scale)
    options = MinimiserOptions(1e-4 * problem.cell_size, history=16, max_iterations=5000)
    return mean_iterations(problem, motion, lambda objective: solve, options)


CASES: dict[str, Callable[[], Any]] = {
    "start_up": start_up,
    "steps": steps,
    "threads": threads,
    "busy": busy,
    "first_hessian": first_hessian,
    "volume_scale": volume_scale,
    "factor_size": factor_size,
}
