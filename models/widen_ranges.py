"""Widen the ranges of what a model's gate takes for known by first steps of its training scenes.

python models/widen_ranges.py MODEL DATASET/config.toml [--device cuda] [--batch 60]

For models that were trained before `pdcorrect.training.fitting` did this itself: they have seen
all kicks, but their ranges are those of a sample of steps, with few of them.  The loads of the
training split are drawn as `pdcorrect dataset generate` does it, rejected ones among them, and
each begins with one coarse step from rest.  No network takes part, nor a reference.  The model is
replaced by itself with these ranges.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

import pdcorrect as pc
from pdcorrect.corrector import features
from pdcorrect.corrector.batch_step import BatchCoarseStep, BatchParts
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES
from pdcorrect.corrector.model_io import LoadedModel, model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan


def main() -> None:
    """Widen the ranges of one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of the data set that it was trained on")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=60, help="scenes at once")
    options = parser.parse_args()
    folder = model_folder(options.model)
    model = pc.load_model(folder)
    model.corrector.to(options.device)
    config = DatasetConfig.load(options.config)
    steps = widen(model, config, options.device, options.batch)
    model.record.training["first_steps"] = {"dataset": config.name, "steps": steps}
    print(pc.save_model(model.corrector, folder, record=model.record))


@torch.no_grad()
def widen(model: LoadedModel, config: DatasetConfig, device: str, batch: int) -> int:
    """Widen a model's ranges; by how many steps."""
    corrector, count = model.corrector, 0
    names = corrector.normaliser.names
    inputs, averages = {name: Moments() for name in names}, Moments()
    scenes = [
        draw_scene(config, plan, number)
        for plan in make_plan(config)
        if plan.split == TRAINING
        for number in range(plan.simulations)
    ]
    best = model.base == "best"
    for first in range(0, len(scenes), batch):
        some = scenes[first : first + batch]
        problems = [pc.discretise(pc.best_coarse(scene) if best else scene) for scene in some]
        stepper = pc.BatchStepper(problems, device=device)
        parts = BatchParts(stepper, corrector, model.velocity)
        step = BatchCoarseStep(parts, stepper.rest_state(), None)
        guess = corrector.config.placement != "state"
        answer = None if guess else step.solved()
        view = step.view(answer)
        good = torch.ones(len(some), dtype=torch.bool, device=view.bodies.rest.device)
        good = good if answer is None else step.ok(answer)
        at_nodes = view.bodies.by_node(good)
        found = features.values(NODE_FEATURES, corrector.config.node_features, view)
        for name, values in found.items():
            inputs[name].add(values[at_nodes])
        found = features.values(EDGE_FEATURES, corrector.config.edge_features, view)
        for name, values in found.items():
            inputs[name].add(values[at_nodes[view.receiver]])
        averages.add(view.bodies.body_means(corrector.inputs(view)[0])[good])
        count += int(good.sum())
        print(f"{first + len(some)} of {len(scenes)}", flush=True)
    corrector.normaliser.widen(inputs)
    corrector.normaliser.widen_averages(averages)
    return count


if __name__ == "__main__":
    main()
