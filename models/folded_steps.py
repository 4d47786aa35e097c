"""Count the steps in which evaluation bodies are folded at a corner, and what refusing them costs.

python models/folded_steps.py DATASET/config.toml ... [--split evaluation] [--meshes 50]
    -o RECORD.json

First loads of a split's meshes, by the released model that is called as the data set, with the
default gate, on a CPU.  Where a cell has det F <= 0 at a corner after a step, the simulation is
computed again with ``Gate(corners=0)`` and held against the reference.  Loads are
those that are drawn first; where `pdcorrect dataset generate` has rejected one, this is another
simulation than the data set's.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from run_record import write_record

import pdcorrect as pc
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import MeshPlan, draw_scene, make_plan


def main() -> None:
    """Count and compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("configs", type=Path, nargs="+")
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--meshes", type=int, default=50, help="of a split, at most")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    sets = []
    for path in options.configs:
        config = DatasetConfig.load(path)
        model, folder = pc.load_model(config.name), model_folder(config.name)
        plans = [plan for plan in make_plan(config) if plan.split == options.split]
        rows = [simulation(config, plan, model) for plan in plans[: options.meshes]]
        steps = sum(row["steps"] for row in rows)
        sets.append(
            {
                "model": config.name, "weights_sha256": weights_digest(folder),
                "split": options.split, "simulations": len(rows), "steps": steps,
                "folded": sum(row["folded"] for row in rows),
                "least_corner": min(row["least_corner"] for row in rows),
                "those_with_folds": [row for row in rows if row["folded"]],
            }
        )  # fmt: skip
        print(sets[-1], flush=True)
        write_record(options.output, gate=pc.Gate().model_dump(), sets=sets)


def simulation(config: DatasetConfig, plan: MeshPlan, model: LoadedModel) -> dict[str, Any]:
    """How often a body is folded, and errors of both gates if it ever is."""
    scene = draw_scene(config, plan, 0)
    coarse = pc.coarse_model(scene, model.base, plan.refine)
    run = corrected(model, coarse, pc.Gate(), plan.frames)
    least = np.array([coarse.corner_volume_ratios(x).min() for x in run.positions[1:]])
    row = {
        "mesh": plan.number, "nodes": len(coarse.positions), "steps": plan.frames,
        "folded": int((least <= 0.0).sum()), "least_corner": float(least.min()),
    }  # fmt: skip
    if not row["folded"]:
        return row
    truth = pc.best_coarse(scene) if config.setting == "exact" else scene
    fine = pc.rollout(pc.ProjectiveDynamics(pc.discretise(truth, refine=plan.refine)), plan.frames)
    reference = pc.restrict(fine, to=coarse)
    strict = corrected(model, coarse, pc.Gate(corners=0.0), plan.frames)
    base = pc.rollout(pc.ProjectiveDynamics(coarse), plan.frames)
    return {
        **row,
        "refused": {"default": refused(run), "corners": refused(strict)},
        "rms_mm": {
            name: 1e3 * pc.metrics.rms_error(one, reference)
            for name, one in (("base", base), ("default", run), ("corners", strict))
        },
    }


def corrected(model: LoadedModel, coarse: pc.Problem, gate: pc.Gate, frames: int) -> pc.Trajectory:
    """A rollout of the coarse mesh with the corrector."""
    stepper = pc.ProjectiveDynamics(coarse)
    hybrid = pc.HybridStepper(stepper, model.corrector, velocity=model.velocity, gate=gate)
    return pc.rollout(hybrid, frames)


def refused(run: pc.Trajectory) -> int:
    """Steps whose corrections were."""
    return int(np.count_nonzero(run.stats["gate"]))


if __name__ == "__main__":
    main()
