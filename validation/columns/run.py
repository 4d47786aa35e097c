"""Columns that start with bending and twisting velocities, and a cube that spins."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import common
import numpy as np

import pdcorrect as pc

HEIGHT, SIDE, SPEED, SPIN = 6.0, 1.0, 10.0, 105.0
"""m; m; of the tip at the start, m/s; of the top about the axis, rad/s."""
MATERIAL = {"energy": "neo-hookean", "young": 17e6, "poisson": 0.45, "density": 1100.0}
STEPS = {"bending": (0.01, 150), "twisting": (0.002, 150)}
"""s, and how many."""
MODELS = {
    "plain, 2 cells": ("hex8", "lumped", 2, 1),
    "best coarse, 2 cells": ("hex8-enhanced", "averaged", 2, 1),
    "best coarse, 4 cells": ("hex8-enhanced", "averaged", 4, 1),
    "hex27, 2 cells": ("hex27", "averaged", 2, 1),
    "hex27, 2 cells, h/2": ("hex27", "averaged", 2, 2),
}
"""Element, mass, cells across, and steps in one step."""
REFERENCE = "hex27, 2 cells, h/2"
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
CUBE_STEP, CUBE_TIME = 5e-4, 0.1
"""s."""


def column(motion: str, model: str, integrator: str = "generalised-alpha") -> pc.Trajectory:
    """A run of a column, all frames."""
    element, mass, across, split = MODELS[model]
    step, frames = STEPS[motion]
    initial = {}
    if motion == "bending":
        gradient = [[0.0, 0.0, SPEED / HEIGHT], [0.0] * 3, [0.0] * 3]
        initial = {"initial": {"velocity_gradient": gradient, "centre": [0.5, 0.5, 0.0]}}
    scene = pc.Scene(
        body={"shape": "beam", "cells": [across, across, 6 * across], "cell_size": SIDE / across},
        material=MATERIAL, clamps=[{"region": {"plane": "z", "at": 0.0}}],
        time={"step": step / split, "frames": frames * split, "integrator": integrator},
        solver={"element": element, "mass": mass}, **initial,
    )  # fmt: skip
    problem = pc.discretise(scene)
    start = problem.initial_state() if initial else twisting(problem)
    return pc.rollout(pc.Newton(problem), state=start)


def twisting(problem: pc.Problem) -> pc.State:
    """At rest, with the spin SPIN sin(pi z / 2 HEIGHT) about the axis."""
    x = problem.positions
    spin = SPIN * np.sin(0.5 * np.pi * x[:, 2] / HEIGHT)
    velocities = np.column_stack([-spin * (x[:, 1] - 0.5), spin * (x[:, 0] - 0.5), 0.0 * spin])
    return pc.State(x.copy(), np.where(problem.free, velocities, 0.0))


def measured(motion: str, run: pc.Trajectory) -> np.ndarray:
    """Mean x displacement of the top, m, or its mean twist, degrees, by frame."""
    problem = run.problem
    assert problem is not None
    top = common.on(problem, "z", HEIGHT)
    if motion == "bending":
        return np.asarray((run.positions[:, top, 0] - problem.positions[top, 0]).mean(axis=1))
    corner = top[problem.positions[top, :2].sum(axis=1).argmax()]
    arm = run.positions[:, corner, :2] - run.positions[:, top, :2].mean(axis=1)
    angle = np.unwrap(np.arctan2(arm[:, 1], arm[:, 0]))
    return np.degrees(angle - angle[0])


def motions(motion: str, quick: bool) -> common.Outcome:
    """Top and energy of all models."""
    models = ("best coarse, 2 cells",) if quick else tuple(MODELS)
    figures: common.Figures = {}
    rows, curves = [], []
    paths = {}
    for model in models:
        run = column(motion, model)
        every = MODELS[model][3]
        paths[model] = measured(motion, run)[::every]
        total = pc.metrics.energy_balance(run).total
        figures[f"{motion}, {model}, largest energy"] = float((total / total[0]).max())
        figures[f"{motion}, {model}, largest"] = float(paths[model].max())
        first = run.times[::every][int(paths[model].argmax())]
        rows.append([motion, model, float(paths[model].max()), float(first),
                     float((total / total[0]).max()), float(total[-1] / total[0])])  # fmt: skip
        curves += [(motion, model, float(t), float(x))
                   for t, x in zip(run.times[::every], paths[model], strict=True)]  # fmt: skip
    for row, model in zip(rows, models, strict=True):
        error = np.nan
        if not quick:
            difference, size = paths[model] - paths[REFERENCE], paths[REFERENCE]
            error = float(100.0 * np.sqrt(np.mean(difference**2) / np.mean(size**2)))
            figures[f"{motion}, {model}, difference, %"] = error
        row.append(error)
    heads = ("motion", "model", "largest, m or degrees", "at, s", "largest energy / start",
             "energy at the end / start", "difference from the last, %")  # fmt: skip
    return common.Outcome(figures, (
        common.Table("Columns", heads, tuple(map(tuple, rows))),
        common.Table("Top of the columns", ("motion", "model", "s", "m or degrees"), tuple(curves)),
    ))  # fmt: skip


def cube(integrator: str, split: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Angular momentum (T+1, 3) and energy (T+1,) of a free cube that spins about its diagonal."""
    spin = (SPIN / np.sqrt(3.0) * np.ones(3)).tolist()
    scene = pc.Scene(
        body={"shape": "beam", "cells": [2, 2, 2], "cell_size": 0.5 * SIDE},
        material={**MATERIAL, "poisson": 0.3}, initial={"angular_velocity": spin},
        time={"step": CUBE_STEP / split, "frames": round(CUBE_TIME / CUBE_STEP) * split,
              "integrator": integrator},
        solver={"tolerance": 1e-9},
    )  # fmt: skip
    problem = pc.discretise(pc.best_coarse(scene))
    run = pc.rollout(pc.Newton(problem))
    push = np.stack([problem.mass_times(v) for v in run.velocities])
    energy = pc.metrics.energy_balance(run).total
    return np.cross(run.positions, push).sum(axis=1), np.asarray(energy / energy[0])


def spinning(quick: bool) -> common.Outcome:
    """Largest changes of angular momentum and energy; the order is that from h/2 to h/4."""
    figures: common.Figures = {}
    rows = []
    for name in ("midpoint", "generalised-alpha") if quick else INTEGRATORS:
        drifts = []
        for split in (1,) if quick else (1, 2, 4):
            momentum, energy = cube(name, split)
            drifts.append(float(pc.metrics.relative_drift(momentum)))
            if split == 1:
                change = float(np.abs(energy - 1.0).max())
        figures[f"cube, {name}, angular momentum"] = drifts[0]
        figures[f"cube, {name}, energy"] = change
        order = np.nan if quick else float(np.log2(drifts[1] / drifts[2]))
        if not quick and name != "midpoint":
            figures[f"cube, {name}, order of the angular momentum"] = order
        rows.append((name, drifts[0], drifts[-1], order, change))
    heads = ("integrator", "change of angular momentum", "at h/4", "order", "change of energy")
    return common.Outcome(figures, (common.Table("Spinning cube", heads, tuple(rows)),))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """The columns and the cube."""
    out: dict[str, Any] = {motion: partial(motions, motion, quick) for motion in STEPS}
    return out | {"cube": partial(spinning, quick)}


def finding(record: common.Record) -> str:
    """Best coarse and plain against the finest."""
    f = record.figures
    told = [
        f"{motion} {f[f'{motion}, best coarse, 2 cells, difference, %']:.1f} % "
        f"({f[f'{motion}, plain, 2 cells, difference, %']:.1f} % plain)"
        for motion in STEPS
    ]
    return (
        f"Two best coarse cells across differ from 27-node elements at half the step by "
        f"{' and '.join(told)}. A spinning cube's angular momentum changes by "
        f"{f['cube, midpoint, angular momentum']:.0e} by midpoint, "
        f"{f['cube, generalised-alpha, angular momentum']:.0e} by generalised-α and "
        f"{f['cube, backward-euler, angular momentum']:.0e} by backward Euler."
    )
