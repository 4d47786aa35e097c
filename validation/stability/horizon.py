"""Errors of scenes of `validation/error_time` at their horizon and at five times it."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import common
import numpy as np
from harness import Case

import pdcorrect as pc
from pdcorrect.errors import ConvergenceError, PdcorrectWarning

error_time = Case(Path(__file__).parents[1] / "error_time").module
SCENES = ("cantilever", "angle", "portal", "plate", "impulse", "torsion")
RUNS = ("best coarse, 1", "learned, 1", "learned, 2", "hex27, 1")
LONGER = 5
TABLE = "Errors at the horizon and at five times it, %"
HEADS = (
    "scene", "run", "frames", "horizon", "five horizons", "the last fifth", "amplitude",
)  # fmt: skip


def runs_of(label: str) -> tuple[str, ...]:
    """Of a scene: of the thesis's motions the step corrector that knows it, too."""
    corrector = f"hybrid {label}-exact"
    return (*RUNS, corrector) if corrector in error_time.METHODS else RUNS


def part(label: str) -> common.Outcome:
    """A scene by all runs."""
    known = error_time.scenes()
    frames = known[label].time.frames
    scene = known[label].with_changes(
        time={"frames": LONGER * frames, "integrator": "generalised-alpha"}
    )
    figures: dict[str, Any] = {}
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PdcorrectWarning)
        motion = pc.converged(scene)
        for name in runs_of(label):
            found = of_run(name, scene, motion, frames)
            early, late, last, amplitude = found
            of = {"horizon, %": early, "five horizons, %": late, "growth": late / early,
                  "amplitude, %": amplitude}  # fmt: skip
            figures |= {f"{label}, {name}, {what}": x for what, x in of.items()}
            rows.append((label, name, float(frames), early, late, last, amplitude))
        for name in ("learned, 1", "learned, 2"):
            over = figures[f"{label}, {name}, five horizons, %"]
            over /= figures[f"{label}, {RUNS[0]}, five horizons, %"]
            figures[f"{label}, {name}, over best coarse"] = over
    return common.Outcome(figures, (common.Table(TABLE, HEADS, tuple(rows)),))


def of_run(name: str, scene: pc.Scene, motion: pc.Trajectory, frames: int) -> tuple[float, ...]:
    """Errors of the first fifth, the whole run and its last fifth, and of its amplitude, %.

    Each is over the RMS displacement of those frames of the converged motion.
    """
    try:
        run = pc.rollout(error_time.METHODS[name].stepper(scene))
    except ConvergenceError:
        return (math.nan,) * 4
    run = pc.restrict(run, to=motion)
    moved, far = (np.asarray(x) for x in (motion.positions - motion.points, run.positions))
    off = far - motion.positions

    def share(span: slice) -> float:
        return 100.0 * float(np.linalg.norm(off[span]) / np.linalg.norm(moved[span]))

    size = np.linalg.norm(far - motion.points) / np.linalg.norm(moved)
    spans = slice(1, frames + 1), slice(1, None), slice(-frames, None)
    return (*(share(span) for span in spans), 100.0 * float(size - 1.0))
