"""Repeat simulations of an evaluation split with and without a gate, and tell what it refused.

python models/with_and_without_gate.py MODEL DATASET/config.toml MESH/LOAD ... -o RECORD.json

On the CPU: the reference, the plain coarse mesh, and the corrected coarse model with the default
gate and without one.  Loads are those that are drawn first; where `pdcorrect dataset generate`
has rejected one, this is another simulation than the data set's.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import pdcorrect as pc
from pdcorrect.corrector.gate import Reason
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import MeshPlan, draw_scene, make_plan
from pdcorrect.environment import environment
from pdcorrect.replacement import write_text


def main() -> None:
    """Repeat each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of a data set")
    parser.add_argument("cases", nargs="+", metavar="MESH/LOAD")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=None, help="all of the data set by default")
    options = parser.parse_args()
    config, model = DatasetConfig.load(options.config), pc.load_model(options.model)
    plans = {plan.number: plan for plan in make_plan(config) if plan.split == EVALUATION}
    rows = []
    for case in options.cases:
        mesh, load = map(int, case.split("/"))
        rows.append(repeated(model, config, plans[mesh], load, options.frames))
        print(rows[-1], flush=True)
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "command": " ".join(["python", "models/with_and_without_gate.py", *sys.argv[1:]]),
        "environment": environment(),
        "dataset": config.name,
        "weights_sha256": weights_digest(model_folder(options.model)),
        "simulations": rows,
    }
    write_text(options.output, json.dumps(record, indent=2) + "\n")


def repeated(
    model: LoadedModel, config: DatasetConfig, plan: MeshPlan, load: int, frames: int | None
) -> dict[str, Any]:
    """Omega with and without a gate, per cent, and the steps that it refused."""
    scene, frames = draw_scene(config, plan, load), frames or plan.frames
    better = pc.best_coarse(scene)
    plain = pc.discretise(scene)
    fine = pc.discretise(better if config.setting == "exact" else scene, refine=plan.refine)
    coarse = pc.discretise(better) if model.base == "best" else plain
    truth = pc.restrict(pc.rollout(pc.ProjectiveDynamics(fine), frames), to=plain)
    zero = pc.rollout(pc.ProjectiveDynamics(plain), frames)
    found: dict[str, Any] = {"mesh": plan.number, "load": load}
    for label, gate in (("with gate", pc.Gate()), ("without", None)):
        steps = pc.ProjectiveDynamics(coarse)
        hybrid = pc.HybridStepper(steps, model.corrector, velocity=model.velocity, gate=gate)
        run = pc.rollout(hybrid, frames)
        found[label] = pc.metrics.error_corrected(run, zero, truth)
        if gate:
            reasons = np.asarray(run.stats["gate"])
            found["refused"] = {
                str(step + 1): Reason(int(reasons[step])).name.lower()
                for step in np.flatnonzero(reasons)
            }
    return found


if __name__ == "__main__":
    main()
