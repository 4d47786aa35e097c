"""What a call of the corrector costs on the CPU: features apart from the network.

    python benchmarks/corrector.py [--quick]

Each preset with random weights, a beam of 135 and a cross of 405 nodes, both bent; states in
float64, network in float32, without gradients, on one and two threads.

Beside them steps of the same body from the same state: ``coarse_ms`` plain, ``best_coarse_ms``
by the best coarse model, and ``correction_ms`` and ``best_correction_ms``, what `HybridStepper`
adds to each of them, with a gate.  Corrections are scaled down there until the gate lets them pass.

Times are medians of 30 calls after three that do not count (``--quick``: of three after one);
their least times are in ``least``, since other processes on the machine spoil medians.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np
import torch
from machine_file import add
from network_cost import flops

import pdcorrect as pc
from pdcorrect.corrector import features
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import PRESETS, Corrector
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, FeatureView, Snapshot
from pdcorrect.corrector.normaliser import RunningMoments
from pdcorrect.scene import trained_coarse

BODIES: dict[str, dict[str, Any]] = {
    "beam": {"shape": "beam", "cells": [14, 2, 2], "cell_size": 0.05},
    "cross": {
        "shape": "cross", "cells": [16, 2, 2], "cell_size": 0.05, "arms": 4, "arm_start": 5,
        "arm_width": 2, "arm_length": 7,
    },
}  # fmt: skip


def scene_of(body: dict[str, Any]) -> pc.Scene:
    """A soft body that is held at one end."""
    return pc.Scene(
        body=body,
        material={"young": 2e5, "poisson": 0.35, "density": 1e3},
        time={"step": 0.01, "frames": 1, "integrator": "backward-euler"},
        clamps=[{"region": {"plane": "x", "at": 0.0}}],
    )


def sample(body: dict[str, Any]) -> tuple[BodyGraph, Snapshot]:
    """A bent body in motion."""
    problem = pc.discretise(scene_of(body))
    bodies = BodyGraph.of([problem], dtype=torch.float64)
    rng = np.random.default_rng(0)

    def noise(size: float) -> torch.Tensor:
        return torch.as_tensor(size * rng.normal(size=problem.positions.shape)) * bodies.free

    start = bodies.rest + 0.01 * torch.sin(5.0 * bodies.rest[:, [1, 2, 0]]) + noise(1e-3)
    return bodies, Snapshot(start, noise(0.1), start + noise(1e-3), noise(1.0))


def fitted(name: str, view: FeatureView) -> Corrector:
    """A corrector whose normaliser has seen one view."""
    torch.manual_seed(0)
    corrector, found = Corrector(PRESETS[name]), {}
    config = corrector.config
    for table, names in (
        (NODE_FEATURES, config.node_features), (EDGE_FEATURES, config.edge_features),
    ):  # fmt: skip
        for feature, values in features.values(table, names, view).items():
            found[feature] = RunningMoments()
            found[feature].add(values)
    target = RunningMoments()
    target.add(torch.ones(1, 1))
    corrector.normaliser.fit(found, target)
    rest = {"shape": view.bodies.shapes, "time_step": view.bodies.time_steps[:, None]}
    averages = view.bodies.body_means(corrector.inputs(view)[0])
    for name, values in {"average": averages, **rest}.items():
        found[name] = RunningMoments()
        found[name].add(values)
    corrector.envelope.fit(found)
    return corrector.eval()


def measure(name: str, body: str, threads: int, calls: int, warm: int) -> dict[str, Any]:
    """One row."""
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)
    bodies, step = sample(BODIES[body])
    corrector = fitted(name, FeatureView(bodies, step))
    n, e = len(bodies.rest), bodies.edge_index.shape[1]
    with torch.inference_mode():
        nodes, edges = (x.float() for x in corrector.inputs(FeatureView(bodies, step)))
        taken: dict[str, Callable[[], object]] = {
            "features_ms": lambda: corrector.inputs(FeatureView(bodies, step)),
            "network_ms": lambda: corrector.network(nodes, edges, bodies.edge_index),
            "call_ms": lambda: corrector(bodies, step),
        }
        times = {key: timed(function, calls, warm) for key, function in taken.items()}
    times |= steps(corrector, body, step, calls, warm)
    operations = flops(corrector.config, n, e)
    row = {
        "preset": name, "body": body, "nodes": n, "edges": e, "threads": threads,
        "parameters": sum(p.numel() for p in corrector.parameters()), "flops": operations,
        **{key: middle for key, (middle, _) in times.items()},
        "network_gflops_a_second": 1e-6 * operations / times["network_ms"][0],
        **{
            f"{kind}correction_to_coarse": times[f"{kind}correction_ms"][0]
            / times[f"{kind}coarse_ms"][0]
            for kind in ("", "best_")
        },
        "least": {key: least for key, (_, least) in times.items()},
    }  # fmt: skip
    print(json.dumps(row), flush=True)
    return row


def steps(
    corrector: Corrector, body: str, step: Snapshot, calls: int, warm: int
) -> dict[str, tuple[float, float]]:
    """Of coarse steps of a body, and of what a correction adds to them."""
    with torch.no_grad():
        for weight in corrector.network.decoder[-1].parameters():
            weight *= 1e-4
    scene = scene_of(BODIES[body])
    state = pc.State(step.positions.numpy(), step.velocities.numpy())
    forces, times = step.forces.numpy(), {}
    # other velocities than those that the normaliser has seen
    gate = pc.Gate(outside=1e3)
    for kind, model in (("", scene), ("best_", trained_coarse(scene))):
        coarse = pc.ProjectiveDynamics(pc.discretise(model))
        hybrid = pc.HybridStepper(coarse, corrector, gate=gate).prepare()
        assert hybrid(state, forces).stats["correction"] > 0.0
        times[f"{kind}coarse_ms"] = timed(partial(coarse, state, forces), calls, warm)
        added = [hybrid(state, forces).stats["network_seconds"] for _ in range(calls + warm)][warm:]
        times[f"{kind}correction_ms"] = 1e3 * statistics.median(added), 1e3 * min(added)
    return times


def timed(function: Callable[[], object], calls: int, warm: int) -> tuple[float, float]:
    """Median and least milliseconds of a call."""
    taken = []
    for _ in range(calls + warm):
        started = time.perf_counter()
        function()
        taken.append(time.perf_counter() - started)
    return 1e3 * statistics.median(taken[warm:]), 1e3 * min(taken[warm:])


def main() -> None:
    """Measure; `--quick` writes nothing."""
    quick = "--quick" in sys.argv
    calls, warm = (3, 1) if quick else (30, 3)
    rows = [
        measure(name, body, threads, calls, warm)
        for name in PRESETS
        for body in BODIES
        for threads in (1, 2)
    ]
    if not quick:
        add("corrector", rows)


if __name__ == "__main__":
    main()
