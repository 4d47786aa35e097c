"""Time ten frames of the twisted cross on THREADS threads; prints JSON."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = sys.argv[1]

import numpy as np

import pdcorrect as pc
from pdcorrect.evaluation.compare import make_stepper

SCENE = Path(__file__).parent.parent / "examples" / "twisted_cross.toml"


def main() -> None:
    """One row for each solver and mesh."""
    scene = pc.Scene.load(SCENE)
    rows = []
    for solver, refine in (("pd", 1), ("pd", 2), ("pd", 4), ("newton", 1), ("newton", 2)):
        stepper = make_stepper(pc.discretise(scene, refine=refine), solver)
        run = pc.rollout(stepper, frames=10)
        rows.append(
            {
                "threads": int(sys.argv[1]),
                "solver": solver,
                "tolerance": stepper.describe()["tolerance"],
                "nodes": len(run.points),
                "milliseconds_a_frame": 1e3 * float(np.median(run.stats["seconds"])),
                "iterations_a_frame": float(np.mean(run.stats["iterations"])),
            }
        )
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
