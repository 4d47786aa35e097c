"""Fit the ranges of bodies' mean inputs (see `Gate.average`) to a model's own rollouts.

python models/fit_body_ranges.py MODEL DATASET/config.toml [--device cuda] [--batch 20]

Trainings fit them to their data, of references; this fits them anew, without data.
One load is drawn for each mesh of the training split, as `pdcorrect dataset generate` does it,
and the corrected coarse model rolled out from rest, without a gate; what the network sees on
the way is what it knows.  That takes no reference; rollouts that fail are left out.  The model
is replaced by itself with these ranges.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from first_steps import scenes_of, seen_in_rollouts
from program import run_script

import pdcorrect as pc
from pdcorrect.corrector.features import View
from pdcorrect.corrector.model_io import LoadedModel, model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig


def main() -> None:
    """Fit one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of the data set that it was trained on")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=20, help="rollouts at once")
    options = parser.parse_args()
    folder = model_folder(options.model)
    model = pc.load_model(folder)
    model.corrector.to(options.device)
    config = DatasetConfig.load(options.config)
    averages, bodies = averages_of(model, config, options.device, options.batch)
    model.corrector.normaliser.fit_averages(averages)
    model.record.training["body_ranges"] = {
        "dataset": config.name, "rollouts": bodies, "steps": averages.count,
    }  # fmt: skip
    print(pc.save_model(model.corrector, folder, record=model.record))


def averages_of(
    model: LoadedModel, config: DatasetConfig, device: str, batch: int
) -> tuple[Moments, int]:
    """Of bodies' mean inputs over all steps of all rollouts, and how many rollouts."""
    scenes = scenes_of(config, TRAINING, loads=1)
    problems = [pc.coarse_model(scene, model.base, refine) for scene, refine in scenes]
    problems.sort(key=lambda problem: len(problem.positions))
    averages, bodies = Moments(), 0

    def means(view: View) -> torch.Tensor:
        return view.bodies.body_means(model.corrector.inputs(view)[0])

    for first in range(0, len(problems), batch):
        some = problems[first : first + batch]
        seen, whole = seen_in_rollouts(model, some, config.frames, device, means)
        for found in seen:
            averages.add(found[whole])
        bodies += int(whole.sum())
        print(f"{first + len(some)} of {len(problems)}", flush=True)
    return averages, bodies


if __name__ == "__main__":
    run_script(main)
