"""Count the steps that a gate refuses as folded at a corner, and tell what that costs.

python models/folded_steps.py DATASET/config.toml ... [--split evaluation] [--meshes 50]
    -o RECORD.json

First loads of a split's meshes, by the released model that is called as the data set, on a CPU,
with the default gate and with ``Gate(corners=0)``.  Where they do not refuse the same steps both
runs are held against the reference.  Loads are those that are drawn first; where `pdcorrect dataset
generate` has rejected one, this is another simulation than the data set's.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from program import run_script
from run_record import write_record

import pdcorrect as pc
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import MeshPlan, draw_scene, make_plan

GATES = {"default": pc.Gate(), "corners": pc.Gate(corners=0.0)}


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
                "refused": {gate: sum(row["refused"][gate] for row in rows) for gate in GATES},
                "least_corner": min(row["least_corner"] for row in rows),
                "those_that_differ": [row for row in rows if "rms_mm" in row],
            }
        )  # fmt: skip
        print(sets[-1], flush=True)
        write_record(options.output, gate=pc.Gate().model_dump(), sets=sets)


def simulation(config: DatasetConfig, plan: MeshPlan, model: LoadedModel) -> dict[str, Any]:
    """Steps that each gate refuses, and errors of both runs if these are not the same."""
    scene = draw_scene(config, plan, 0)
    coarse = pc.coarse_model(scene, model.base, plan.refine)
    runs = {name: corrected(model, coarse, gate, plan.frames) for name, gate in GATES.items()}
    refused = {name: np.asarray(run.stats["gate"]) != 0.0 for name, run in runs.items()}
    ends = runs["default"].positions[1:]
    row = {
        "mesh": plan.number, "nodes": len(coarse.positions), "steps": plan.frames,
        "refused": {name: int(found.sum()) for name, found in refused.items()},
        "least_corner": float(min(coarse.corner_volume_ratios(x).min() for x in ends)),
    }  # fmt: skip
    if np.array_equal(*refused.values()):
        return row
    truth = pc.best_coarse(scene) if config.setting == "exact" else scene
    fine = pc.rollout(pc.ProjectiveDynamics(pc.discretise(truth, refine=plan.refine)), plan.frames)
    reference = pc.restrict(fine, to=coarse)
    runs["base"] = pc.rollout(pc.ProjectiveDynamics(coarse), plan.frames)
    errors = {name: 1e3 * pc.metrics.rms_error(run, reference) for name, run in runs.items()}
    return {**row, "rms_mm": errors}


def corrected(model: LoadedModel, coarse: pc.Problem, gate: pc.Gate, frames: int) -> pc.Trajectory:
    """A rollout of the coarse mesh with the corrector."""
    stepper = pc.ProjectiveDynamics(coarse)
    hybrid = pc.HybridStepper(stepper, model.corrector, velocity=model.velocity, gate=gate)
    return pc.rollout(hybrid, frames)


if __name__ == "__main__":
    run_script(main)
