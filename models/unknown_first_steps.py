"""Count the first steps of a split's scenes that a model's default gate does not know.

python models/unknown_first_steps.py MODEL DATASET/config.toml [--split evaluation] [--loads 1]

Each scene begins with one coarse step from rest; no network takes part, nor a reference.  Prints
how many inputs are refused, by nodes (`Gate.margin`) and by means over bodies (`Gate.average`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

import pdcorrect as pc
from pdcorrect.corrector.batch_step import BatchCoarseStep, BatchParts
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan

BATCH = 20


@torch.no_grad()
def main() -> None:
    """Count them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of a data set")
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--loads", type=int, default=1, help="of each mesh")
    options = parser.parse_args()
    model, gate = pc.load_model(options.model), pc.Gate()
    config = DatasetConfig.load(options.config)
    scenes = [
        draw_scene(config, plan, number)
        for plan in make_plan(config)
        if plan.split == options.split
        for number in range(min(options.loads, plan.simulations))
    ]
    by_nodes = by_body = either = 0
    for first in range(0, len(scenes), BATCH):
        some = scenes[first : first + BATCH]
        best = model.base == "best"
        problems = [pc.discretise(pc.best_coarse(scene) if best else scene) for scene in some]
        stepper = pc.BatchStepper(problems)
        parts = BatchParts(stepper, model.corrector, model.velocity)
        step = BatchCoarseStep(parts, stepper.rest_state(), None)
        view = step.view(step.solved())
        nodes = gate.model_copy(update={"average": None}).unknown(model.corrector, view)
        body = gate.model_copy(update={"margin": None}).unknown(model.corrector, view)
        by_nodes, by_body = by_nodes + int(nodes.sum()), by_body + int(body.sum())
        either += int((nodes | body).sum())
    print(f"{len(scenes)} first steps: {either} unknown, {by_nodes} by nodes, {by_body} by bodies")


if __name__ == "__main__":
    main()
