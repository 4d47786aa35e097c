"""The error of the time step alone on bodies of the evaluation splits, by integrator."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import common
import numpy as np

import pdcorrect as pc
from pdcorrect._environment import home_folder
from pdcorrect.data.configuration import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan

STEP, FRAMES, MESHES = 0.01, 60, 4
"""Seconds; compared frames; the first meshes of each split, the first simulation of each."""
FINE = 16
"""Steps of the reference in one of the others."""
DAMPING: dict[str, dict[str, float]] = {
    "none": {},
    "stiffness": {"stiffness": 2e-3},
    "viscosity": {"viscosity": 2e-3},
}
KINDS = {"torsion": tuple(DAMPING), "impulse": ("none",), "stretch": ("none",)}
TRAPEZOIDAL = "generalised-alpha, radius 1"
HALF = "generalised-alpha, h/2"
RUNS: dict[str, tuple[dict[str, Any], int]] = {
    "backward-euler": ({"integrator": "backward-euler"}, 1),
    "bdf2": ({"integrator": "bdf2"}, 1),
    "midpoint": ({"integrator": "midpoint"}, 1),
    TRAPEZOIDAL: ({"integrator": "generalised-alpha", "spectral_radius": 1.0}, 1),
    "generalised-alpha": ({"integrator": "generalised-alpha"}, 1),
    HALF: ({"integrator": "generalised-alpha"}, 2),
    "generalised-alpha, h/4": ({"integrator": "generalised-alpha"}, 4),
}
"""Settings of the time section, and steps in one step of the scene."""


def scene_of(kind: str, mesh: int) -> pc.Scene:
    """A simulation of the exact evaluation split on the best coarse mesh."""
    config = DatasetConfig.load(home_folder("datasets") / f"{kind}-exact" / "config.toml")
    plans = [plan for plan in make_plan(config) if plan.split == EVALUATION]
    return pc.best_coarse(draw_scene(config, plans[mesh], 0))


def positions(scene: pc.Scene, time: dict[str, Any], split: int, tolerance: float) -> np.ndarray:
    """Of the frames (T + 1, N, 3), m."""
    steps = {"step": STEP / split, "frames": FRAMES * split, "spectral_radius": 0.8}
    problem = pc.discretise(scene.with_changes(time={**steps, **time}))
    run = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=tolerance))
    return run.positions[::split]


def rms(distances: np.ndarray) -> float:
    """Over frames and nodes, m."""
    return float(np.sqrt((distances**2).sum(axis=-1).mean()))


def errors(scene: pc.Scene, names: tuple[str, ...], fine: int) -> tuple[float, list[float]]:
    """RMS displacement, m, and the errors of all runs, per cent of it."""
    exact = positions(scene, {"integrator": "generalised-alpha"}, fine, 1e-6)
    size = rms(exact - exact[0])
    found = [rms(positions(scene, *RUNS[name], 1e-5) - exact) for name in names]
    return size, [100.0 * error / size for error in found]


def motion(kind: str, quick: bool) -> common.Outcome:
    """All meshes and dampings of a kind of motion."""
    names = ("backward-euler", "generalised-alpha") if quick else tuple(RUNS)
    rows: list[tuple[Any, ...]] = []
    figures: common.Figures = {}
    for damping in KINDS[kind]:
        found = []
        for mesh in range(1 if quick else MESHES):
            scene = scene_of(kind, mesh).with_changes(damping=DAMPING[damping])
            size, shares = errors(scene, names, FINE // 2 if quick else FINE)
            found.append(shares)
            rows.append((kind, damping, float(mesh), 1e3 * size, *shares))
        means = dict(zip(names, np.mean(found, axis=0), strict=True))
        worst = dict(zip(names, np.max(found, axis=0), strict=True))
        figures |= {f"{kind}, {damping}, {n}, mean, %": float(x) for n, x in means.items()}
        figures |= {f"{kind}, {damping}, {n}, worst, %": float(x) for n, x in worst.items()}
    ours = [f"{kind}, {damping}, generalised-alpha, mean, %" for damping in KINDS[kind]]
    for damping, name in zip(KINDS[kind][1:], ours[1:], strict=True):
        figures[f"{kind}, {damping}, error over that without damping"] = (
            figures[name] / figures[ours[0]]
        )
    heads = ("motion", "damping", "mesh", "RMS displacement, mm", *names)
    table = common.Table("Errors, % of the RMS displacement", heads, tuple(rows))
    return common.Outcome(figures, (table,))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part a motion."""
    kinds = ("stretch",) if quick else tuple(KINDS)
    return {kind: partial(motion, kind, quick) for kind in kinds}


def finding(record: common.Record) -> str:
    """Means of backward Euler and generalised-alpha."""
    told = []
    for kind in KINDS:
        far, near, half = (
            record.figures[f"{kind}, none, {name}, mean, %"]
            for name in ("backward-euler", "generalised-alpha", HALF)
        )
        told.append(f"{kind} {far:.0f}, {near:.1f} and {half:.1f} %")
    return (
        "Mean errors by backward Euler, generalised-α and generalised-α at half the step: "
        f"{'; '.join(told)}."
    )
