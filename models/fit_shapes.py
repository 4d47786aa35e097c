"""Fit the ranges of bodies' measures at rest (see `Gate.body`) to data sets' training meshes.

python models/fit_shapes.py MODEL DATASET/config.toml ... [--other]

For models of format version 2, from before there were such ranges; trainings fit them to their
data.  Those of later models are fitted anew.  The bodies of the training splits are drawn as
`pdcorrect dataset generate` does it; nothing is simulated.  The model is replaced by itself with
these ranges, and with that of time steps where it has none, or an older version's; told are the
latter, and how far one of the bodies lies at most outside the ranges of all others.  Which
configurations are expected is told in `fit_time_steps.py`.
"""

from __future__ import annotations

import argparse

import torch
from first_steps import scenes_of
from fit_time_steps import add_configs, configs_of, fit_time_steps, of_any_version, told
from program import run_script

import pdcorrect as pc
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.model_io import JOINT, model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig


def main() -> None:
    """Fit one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    add_configs(parser)
    options = parser.parse_args()
    folder = model_folder(options.model)
    model = of_any_version(folder)
    configs = configs_of(model, options)
    each, shapes = torch.cat([shapes_of(config) for config in configs]), Moments()
    shapes.add(each)
    model.corrector.normaliser.fit_shapes(shapes)
    model.record.training["shapes"] = {
        "dataset": JOINT.join(config.name for config in configs), "meshes": len(each),
        "left_out": left_out(each),
    }  # fmt: skip
    if model.corrector.normaliser.time_step_low.isnan().any():
        fit_time_steps(model, configs)
    saved = pc.save_model(model.corrector, folder, record=model.record)
    print(saved, told(model), f"one left out: {left_out(each):.3g}", sep="; ")


def shapes_of(config: DatasetConfig) -> torch.Tensor:
    """Measures of each training mesh, (m, 10)."""
    problems = [pc.discretise(scene) for scene, _ in scenes_of(config, TRAINING, loads=1)]
    return BodyGraph.of(problems, dtype=torch.float64).shapes


def left_out(shapes: torch.Tensor) -> float:
    """How far a body lies at most outside the ranges of all others."""
    values = shapes.sort(dim=0).values
    return float(torch.maximum(values[1] - values[0], values[-1] - values[-2]).max())


if __name__ == "__main__":
    run_script(main)
