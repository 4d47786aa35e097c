"""Widen the ranges of what a model's gate takes for known by first steps of its training scenes.

python models/add_first_steps.py MODEL DATASET/config.toml [--steps 1] [--device cuda] [--batch 60]

Trainings fit ranges to the first steps of all simulations and to a sample of the others
(`pdcorrect.training.fitting`), those before 2026-11-23 to the sample only.  What follows a kick
within few steps is rare in it.  The loads of the training split are drawn as `pdcorrect dataset
generate` does it first, and the corrected coarse model takes so many steps from rest, without a
gate: among them loads that were rejected then, which the model has not seen.  That takes no
reference; scenes in which a step fails are left out.  The model is replaced by itself with these
ranges.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from first_steps import scenes_of

import pdcorrect as pc
from pdcorrect.corrector import features
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, View
from pdcorrect.corrector.model_io import LoadedModel, model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig
from pdcorrect.evaluation.rollouts import roll_out


def main() -> None:
    """Widen the ranges of one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of the data set that it was trained on")
    parser.add_argument("--steps", type=int, default=1, help="from rest, of each simulation")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=60, help="scenes at once")
    options = parser.parse_args()
    folder = model_folder(options.model)
    model = pc.load_model(folder)
    model.corrector.to(options.device)
    config = DatasetConfig.load(options.config)
    count = add_first_steps(model, config, options.steps, options.device, options.batch)
    model.record.training["first_steps"] = {"dataset": config.name, "steps": count}
    print(pc.save_model(model.corrector, folder, record=model.record))


@torch.no_grad()
def add_first_steps(
    model: LoadedModel, config: DatasetConfig, steps: int, device: str, batch: int
) -> int:
    """Widen a model's ranges by ``steps`` steps of each training scene; by how many in all."""
    corrector, config_of = model.corrector, model.corrector.config
    tables = (NODE_FEATURES, config_of.node_features), (EDGE_FEATURES, config_of.edge_features)
    inputs, averages = {name: Moments() for name in corrector.normaliser.names}, Moments()
    answer, seen = corrector.of_view, []

    def watched(view: View) -> torch.Tensor:
        found = [features.values(table, names, view) for table, names in tables]
        seen.append((view, found, view.bodies.body_means(corrector.inputs(view)[0])))
        return answer(view)

    corrector.of_view = watched  # type: ignore[method-assign]
    scenes = scenes_of(config, TRAINING)
    count = 0
    for first in range(0, len(scenes), batch):
        seen.clear()
        some = scenes[first : first + batch]
        stepper = pc.BatchStepper(
            [pc.coarse_model(scene, model.base, refine) for scene, refine in some], device=device
        )
        hybrid = pc.BatchHybrid(stepper, corrector, velocity=model.velocity)
        runs = roll_out(hybrid, stepper, [steps] * len(some))
        whole = torch.tensor([run.failed is None for run in runs], device=stepper.device)
        for view, (of_nodes, of_edges), means in seen:
            at_nodes = view.bodies.by_node(whole)
            for values, rows in ((of_nodes, at_nodes), (of_edges, at_nodes[view.receiver])):
                for name, value in values.items():
                    inputs[name].add(value[rows])
            averages.add(means[whole])
        count += steps * int(whole.sum())
        print(f"{first + len(some)} of {len(scenes)}", flush=True)
    del corrector.of_view
    corrector.normaliser.widen(inputs)
    corrector.normaliser.widen_averages(averages)
    return count


if __name__ == "__main__":
    main()
