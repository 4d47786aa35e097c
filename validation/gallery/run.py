"""The scenes of the gallery: how far runs are from the converged motion, at what time."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import common
import numpy as np
from finger import fingers

import pdcorrect as pc

EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES = {
    "lifting_gripper": 12, "crawler": 12, "pressure_finger": 6, "dropped_jelly": 14,
    "twisted_bar": 10, "bracket": 15,
}  # fmt: skip
"""Few, for converged motions with contact take minutes."""
MODELS = {"learned": pc.learned_coarse, "best coarse": pc.best_coarse}
TABLE = "Scenes"
HEADINGS = (
    "scene", "nodes", "frames",
    *(f"{name}, {what}" for name in MODELS for what in ("%", "ms a frame")), "smallest gap, mm",
)  # fmt: skip
CAUSES = "Fingers at rest, 5 kPa"
CAUSES_HEADINGS = "finger", "nodes", "RMS displacement, mm", *(f"{name}, %" for name in MODELS)


def part(name: str) -> common.Outcome:
    """One scene by all models."""
    scene = pc.Scene.load(EXAMPLES / f"{name}.toml").with_changes(time={"frames": FRAMES[name]})
    motion, row, gaps = pc.converged(scene), [], []
    for choose in MODELS.values():
        stepper = pc.ProjectiveDynamics(pc.discretise(choose(scene))).prepare()
        started = time.process_time()
        run = pc.rollout(stepper)
        spent = 1e3 * (time.process_time() - started) / len(run)
        row += [100.0 * pc.metrics.relative_error(run, motion), spent]
        gaps += list(run.stats.get("smallest_gap", ()))
    figures = {f"{name}, {model}, %": row[2 * i] for i, model in enumerate(MODELS)}
    if gaps:
        figures[f"{name}, smallest gap, mm"] = 1e3 * min(gaps)
    rows = ((name, len(run.points), len(run), *row, 1e3 * min(gaps) if gaps else "–"),)
    return common.Outcome(figures, (common.Table(TABLE, HEADINGS, rows),))


def causes() -> common.Outcome:
    """Fingers with wide and narrow chambers, with and without threads."""
    rows = []
    for name, scene in fingers(pc.Scene.load(EXAMPLES / "pressure_finger.toml")).items():
        motion = pc.converged(scene)
        moved = np.linalg.norm(motion.positions[-1] - motion.points, axis=1)
        runs = [
            pc.rollout(pc.ProjectiveDynamics(pc.discretise(choose(scene))))
            for choose in MODELS.values()
        ]
        errors = [100.0 * pc.metrics.relative_error(run, motion) for run in runs]
        rows.append((name, len(moved), 1e3 * float(np.sqrt((moved**2).mean())), *errors))
    return common.Outcome({}, (common.Table(CAUSES, CAUSES_HEADINGS, tuple(rows)),))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """One part a scene; a quick run has the one of the fewest cells."""
    if quick:
        return {"crawler": partial(part, "crawler")}
    return {**{name: partial(part, name) for name in FRAMES}, "fingers at rest": causes}


def finding(record: common.Record) -> str:
    """How many scenes the learned element is nearer in."""
    rows = record.table(TABLE)["rows"]
    nearer = sum(row[3] < row[5] for row in rows)
    return f"The learned element is nearer to the converged motion in {nearer} of {len(rows)}."
