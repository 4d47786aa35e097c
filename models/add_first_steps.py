"""Widen the ranges of what a model's gate takes for known by first steps of its training scenes.

python models/add_first_steps.py MODEL DATASET/config.toml [--steps 1] [--device cuda] [--batch 60]

Trainings fit ranges to the first steps of all simulations and to a sample of the others, in which
what follows a kick is rare (`pdcorrect.training.fitting`), early ones to the sample only.  This
adds first steps, or more of them, without data.  The loads of the training split are drawn as
`pdcorrect dataset generate` does it first, and the corrected coarse model takes so many steps from
rest: among them loads that were rejected then, which the model has not seen.  That takes no
reference; scenes in which a step fails, or a correction that the gate refuses by its answer, are
left out.  The model is replaced by itself with these ranges.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from first_steps import scenes_of, seen_in_rollouts
from program import run_script

import pdcorrect as pc
from pdcorrect.corrector import features
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, View
from pdcorrect.corrector.model_io import LoadedModel, model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig

ANSWERS_ONLY = pc.Gate(body=None, time_step=None, margin=None, average=None)
"""Refuses no inputs, for it is these that are to be known."""


def main() -> None:
    """Widen the ranges of one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of the data set that it was trained on")
    parser.add_argument("--steps", type=int, default=1, help="from rest, of each simulation")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=60, help="scenes at once")
    options = parser.parse_args()
    if options.steps < 1:
        parser.error("--steps: expected one step or more.")
    folder = model_folder(options.model)
    model = pc.load_model(folder)
    model.corrector.to(options.device)
    config = DatasetConfig.load(options.config)
    count = add_first_steps(model, config, options.steps, options.device, options.batch)
    if count == 0:
        raise SystemExit(f"{folder}: no scene without a failure, nothing was changed.")
    model.record.training["first_steps"] = {
        "dataset": config.name, "simulations": count, "steps": options.steps,
    }  # fmt: skip
    print(pc.save_model(model.corrector, folder, record=model.record))


def add_first_steps(
    model: LoadedModel, config: DatasetConfig, steps: int, device: str, batch: int
) -> int:
    """Widen a model's ranges by ``steps`` steps of each training scene; by how many scenes."""
    corrector, architecture = model.corrector, model.corrector.config
    inputs, averages = {name: Moments() for name in corrector.normaliser.names}, Moments()
    scenes = scenes_of(config, TRAINING)
    count = 0

    def look(view: View) -> tuple[Any, ...]:
        of_nodes = features.values(NODE_FEATURES, architecture.node_features, view)
        of_edges = features.values(EDGE_FEATURES, architecture.edge_features, view)
        return view, of_nodes, of_edges, view.bodies.body_means(corrector.inputs(view)[0])

    for first in range(0, len(scenes), batch):
        some = scenes[first : first + batch]
        problems = [pc.coarse_model(scene, model.base, refine) for scene, refine in some]
        seen, whole = seen_in_rollouts(model, problems, steps, device, look, ANSWERS_ONLY)
        for view, of_nodes, of_edges, means in seen:
            at_nodes = view.bodies.by_node(whole)
            for values, rows in ((of_nodes, at_nodes), (of_edges, at_nodes[view.receiver])):
                for name, value in values.items():
                    inputs[name].add(value[rows])
            averages.add(means[whole])
        count += int(whole.sum())
        print(f"{count} of {first + len(some)}, {len(scenes)} in all", flush=True)
    if count:
        corrector.normaliser.widen(inputs)
        corrector.normaliser.widen_averages(averages)
    return count


if __name__ == "__main__":
    run_script(main)
