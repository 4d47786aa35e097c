"""Batches of scenes on one device: steps and derivatives a second, memory, scaling.

    python benchmarks/batch.py [cuda|cpu] [sizes|integrators|elements]

Cross-shaped bodies of one size, each with its own Young's modulus and gravity (so none
share a first Hessian, unless said so), to 1e-4 of the coarse cell size, float64, after
four steps from rest.  Times are the median of five steps, or of five derivatives.
"""

from __future__ import annotations

import gc
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from machine_file import add

import pdcorrect as pc

COARSE, FINE = (16, 7), (12, 5)
"""Cells along the body and along its arms: 405 coarse nodes, 10 449 fine ones."""

INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")


def scene(
    seed: int,
    shape: tuple[int, int],
    shared: bool,
    integrator: str = "backward-euler",
    element: str = "hex8",
) -> pc.Scene:
    """A cross with four arms, clamped at one end."""
    rng = np.random.default_rng(seed)
    young = 2e5 if shared else float(rng.uniform(1.5e5, 4e5))
    return pc.Scene(
        body={
            "shape": "cross", "cells": [shape[0], 2, 2], "cell_size": 0.05, "arms": 4,
            "arm_start": 5, "arm_width": 2, "arm_length": shape[1],
        },
        material={"young": young, "poisson": 0.35, "density": 1e3},
        time={"step": 0.01, "frames": 10, "integrator": integrator},
        clamps=[{"region": {"plane": "x", "at": 0.0}}],
        loads=[{"kind": "gravity", "acceleration": rng.uniform(-15, 15, 3).tolist()}],
        solver={"element": element, "mass": "lumped" if element == "hex8" else "averaged"},
    )  # fmt: skip


def measure(
    count: int,
    shape: tuple[int, int],
    refine: int,
    device: str,
    first_hessian: str = "auto",
    shared: bool = False,
    integrator: str = "backward-euler",
    element: str = "hex8",
) -> dict[str, Any]:
    """One batch: times of a step and of its derivative, and what memory they take."""
    if device == "cuda":
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    scenes = [scene(i, shape, shared, integrator, element) for i in range(count)]
    problems = [pc.discretise(s, refine=refine) for s in scenes]
    stepper = pc.BatchStepper(
        problems, 1e-4, first_hessian=first_hessian, device=device, recover=False
    )
    started = time.perf_counter()
    result = stepper(stepper.rest_state())
    prepared = synchronised(device) - started
    for _ in range(3):
        result = stepper(result.state)
    step_s, iterations = [], []
    for _ in range(5):
        before = result.state
        started = synchronised(device)
        result = stepper(before)
        step_s.append(synchronised(device) - started)
        iterations.append(float(result.iterations.mean()))
    gradient = torch.ones_like(before.positions)
    found: list[pc.BatchGradients] = []

    def backward() -> None:
        found[:] = [pc.BatchGradients(stepper, before, result, gradient, tolerance=1e-4)]

    backward_s = median(backward, device)
    sizes, step = stepper.cells.sizes, statistics.median(step_s)
    row = {
        "scenes": count,
        "nodes": sizes.nodes,
        "cells": sizes.cells,
        "integrator": integrator,
        "element": element,
        "first_hessian": stepper.first_hessian,
        "sharing": shared,
        "converged": all(s is pc.Status.CONVERGED for s in result.statuses),
        "largest_error_estimate_of_a_cell": float(
            max(result.error_estimates) / problems[0].cell_size
        ),
        "prepare_and_first_step_s": prepared,
        "step_ms": 1e3 * step,
        "step_ms_a_scene": 1e3 * step / count,
        "iterations": statistics.mean(iterations),
        "scene_steps_a_second": count / step,
        "backward_ms": 1e3 * backward_s,
        "backward_solved": bool(found[0].ok.all()),
        "forward_and_backward_a_second": count / (step + backward_s),
    }
    if device == "cuda":
        row["memory_bytes"] = torch.cuda.max_memory_allocated()
    print(json.dumps(row), flush=True)
    return row


def one_at_a_time(shape: tuple[int, int], refine: int) -> dict[str, Any]:
    """The same scene on the CPU by `ProjectiveDynamics`."""
    problem = pc.discretise(scene(0, shape, False), refine=refine)
    stepper = pc.ProjectiveDynamics(problem, 1e-4).prepare()
    state = problem.rest_state()
    for _ in range(4):
        state = stepper(state).state
    step_s = median(lambda: stepper(state), "cpu")
    result = stepper(state)
    g = np.ones_like(state.positions)
    back_s = median(lambda: pc.adjoint(stepper, state, result, g, tolerance=1e-4).positions, "cpu")
    row = {
        "nodes": len(problem.positions),
        "step_ms": 1e3 * step_s,
        "backward_ms": 1e3 * back_s,
        "iterations": result.iterations,
    }
    print(json.dumps(row), flush=True)
    return row


def newton_bound(count: int = 256) -> dict[str, Any]:
    """Newton's share in factorisations alone, if each step factorised dense Hessians.

    A lower bound of a batched Newton step for the coarse scenes.
    """
    problem = pc.discretise(scene(0, COARSE, False))
    newton, state = pc.Newton(problem, 1e-4), problem.rest_state()
    for _ in range(4):
        state = newton(state).state
    iterations = newton(state).iterations
    size = 3 * int(problem.free.all(axis=1).sum())
    H = torch.eye(size, dtype=torch.float64, device="cuda").expand(count, -1, -1).clone()
    seconds = median(lambda: torch.linalg.cholesky_ex(H), "cuda")
    row = {
        "scenes": count,
        "unknowns": size,
        "newton_iterations": iterations,
        "factorisation_ms": 1e3 * seconds,
        "least_step_ms": 1e3 * seconds * iterations,
    }
    print(json.dumps(row), flush=True)
    return row


def synchronised(device: str) -> float:
    """The time when all work is done."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def median(function: Callable[[], Any], device: str, runs: int = 5) -> float:
    """Of several runs, s, after one that does not count."""
    function()
    taken = []
    for _ in range(runs):
        started = synchronised(device)
        function()
        taken.append(synchronised(device) - started)
    return statistics.median(taken)


def sizes(device: str) -> dict[str, Any]:
    """Coarse and fine batches of growing size."""
    gpu = device == "cuda"
    coarse = (1, 4, 16, 64, 256, 1024) if gpu else (1, 4, 16)
    fine = (1, 2, 4, 8, 16) if gpu else (1,)
    results: dict[str, Any] = {
        "coarse": [measure(n, COARSE, 1, device) for n in coarse],
        "fine": [measure(n, FINE, 4, device) for n in fine],
        "one at a time, CPU": [one_at_a_time(COARSE, 1), one_at_a_time(FINE, 4)],
    }
    if gpu:
        results["fine, other first Hessians"] = [
            measure(8, FINE, 4, device, "G-scaled"),
            measure(8, FINE, 4, device, shared=True),
        ]
        results["newton"] = newton_bound()
    return results


def integrators(device: str) -> list[dict[str, Any]]:
    """Coarse batches by integrator."""
    count = 256 if device == "cuda" else 4
    return [measure(count, COARSE, 1, device, integrator=name) for name in INTEGRATORS]


def elements(device: str) -> list[dict[str, Any]]:
    """Coarse batches by element, and the fine one that the learned element stands for."""
    few, many = (16, 256) if device == "cuda" else (1, 4)
    cases = [("hex8-enhanced", many, COARSE, 1), ("hex8-learned", many, COARSE, 1)]
    cases.append(("hex8-enhanced", few, FINE, 4))
    return [
        measure(n, shape, k, device, integrator="generalised-alpha", element=element)
        for element, n, shape, k in cases
    ]


def main() -> None:
    """Measure and write JSON."""
    device, kind = (sys.argv[1:] + ["cpu", "sizes"][len(sys.argv) - 1 :])[:2]
    measured = {"sizes": sizes, "integrators": integrators, "elements": elements}[kind](device)
    name = torch.cuda.get_device_name() if device == "cuda" else None
    key = "batch" if kind == "sizes" else f"batch {kind}"
    add(key, measured, name, torch_threads=torch.get_num_threads())


if __name__ == "__main__":
    main()
