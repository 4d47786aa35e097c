"""Draw the first evaluation trajectory of data sets: a node's path, and bodies over each other.

python models/draw_first.py OUTPUT [NAME ...]

As figures 7.2 to 7.7 of the thesis, for models that have the names of their data sets; all by
default.  The scene is computed anew on the CPU: the coarse mesh alone, corrected with the default
gate, and the reference.  OUTPUT gets ``NAME-node.png``, of the node that the reference moves
farthest, ``NAME-overlay.png``, the frame in which the coarse mesh alone is farthest from the
reference, and ``first.json``, the errors of these runs.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from program import run_script
from run_record import write_record

from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.evaluate import cases_with, compare
from pdcorrect.figures import plot_node_trajectories, render_overlay

ROOT = Path(__file__).parents[1]
NAMES = [
    f"{motion}-{setting}"
    for motion in ("impulse", "stretch", "torsion")
    for setting in ("as-published", "exact")
]


def main() -> None:
    """Compute and draw each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME", default=NAMES)
    parser.add_argument("--frames", type=int, default=None, help="all of the data set by default")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    found = {name: draw(name, options.output, options.frames) for name in options.names}
    write_record(options.output / "first.json", trajectories=found)


def draw(name: str, output: Path, frames: int | None) -> dict[str, Any]:
    """Both pictures of one data set; errors of what they show."""
    config = DatasetConfig.load(ROOT / "datasets" / name / "config.toml")
    plan = next(plan for plan in make_plan(config) if plan.split == EVALUATION)
    every = cases_with([name])
    cases = tuple(c for c in every if c == every[0] or c.model or (c.plain and c.refine == 1))
    cases = tuple(c for c in cases if c.solver == "pd")
    found = compare(draw_scene(config, plan, 0), frames or plan.frames, cases)
    if found.failures:
        raise SystemExit(f"{name}: " + "; ".join(map(" ".join, found.failures.items())))
    (corrected,) = found.models
    labels = [found.reference, corrected, next(c.label for c in cases if c.plain)]
    runs = {
        title: found.on_coarse[label]
        for title, label in zip(("reference", "corrected", "coarse"), labels, strict=True)
    }
    truth, plain = runs["reference"], runs["coarse"]
    moved = np.linalg.norm(truth.positions - truth.points, axis=2).max(axis=0)
    away = np.linalg.norm(plain.positions - truth.positions, axis=(1, 2))
    frame, place = int(away.argmax()), truth.points[moved.argmax()]
    render_overlay(list(runs.values()), output / f"{name}-overlay.png", labels=[*runs], frame=frame)
    titles = ["reference", "coarse", "corrected"]  # the colours of the other picture
    curves = [runs[title] for title in titles]
    plot_node_trajectories(curves, output / f"{name}-node.png", node_point=place, labels=titles)
    print(f"{name}: frame {frame} of {len(away) - 1}", flush=True)
    return {
        "mesh": plan.number, "load": 0, "frame drawn": frame, "model": found.models[corrected],
        "runs": {
            row.label: {"rms_mm": 1e3 * row.rms_error, "omega": row.omega,
                        "refused": row.refused_frames}
            for row in found.rows if row.label != found.reference
        },
    }  # fmt: skip


if __name__ == "__main__":
    run_script(main)
