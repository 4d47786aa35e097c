"""Widen the ranges of what a model's gate takes for known by first steps of its training scenes.

python models/add_first_steps.py MODEL DATASET/config.toml [--device cuda] [--batch 60]

For models that were trained before `pdcorrect.training.fitting` did this itself: they have seen
all kicks, but their ranges are those of a sample of steps, with few of them.  The loads of the
training split are drawn as `pdcorrect dataset generate` does it first, and each begins with one
coarse step from rest: among them loads that were rejected then, which the model has not seen.  No
network takes part, nor a reference.  The model is replaced by itself with these ranges.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from first_steps import first_views, scenes_of

import pdcorrect as pc
from pdcorrect.corrector import features
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES
from pdcorrect.corrector.model_io import LoadedModel, model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig


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
    steps = add_first_steps(model, config, options.device, options.batch)
    model.record.training["first_steps"] = {"dataset": config.name, "steps": steps}
    print(pc.save_model(model.corrector, folder, record=model.record))


@torch.no_grad()
def add_first_steps(model: LoadedModel, config: DatasetConfig, device: str, batch: int) -> int:
    """Widen a model's ranges; by how many steps."""
    corrector, count = model.corrector, 0
    inputs, averages = {name: Moments() for name in corrector.normaliser.names}, Moments()
    scenes = scenes_of(config, TRAINING)
    for view, good in first_views(model, scenes, device, batch):
        at_nodes = view.bodies.by_node(good)
        for table, names, rows in (
            (NODE_FEATURES, corrector.config.node_features, at_nodes),
            (EDGE_FEATURES, corrector.config.edge_features, at_nodes[view.receiver]),
        ):
            for name, values in features.values(table, names, view).items():
                inputs[name].add(values[rows])
        averages.add(view.bodies.body_means(corrector.inputs(view)[0])[good])
        count += int(good.sum())
        print(f"{count} of {len(scenes)}", flush=True)
    corrector.normaliser.widen(inputs)
    corrector.normaliser.widen_averages(averages)
    return count


if __name__ == "__main__":
    main()
