"""Fit the ranges of bodies' measures at rest (see `Gate.body`) to a data set's training meshes.

python models/fit_shapes.py MODEL DATASET/config.toml

For models of format version 2, from before there were such ranges; trainings fit them to their
data.  Those of later models are fitted anew.  The bodies of the training split are drawn as
`pdcorrect dataset generate` does it; nothing is simulated.  The model is replaced by itself with
these ranges, and with that of time steps where it has none (see `fit_steps.py`); told is how far
one of the bodies lies at most outside the ranges of all others.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from first_steps import scenes_of
from fit_steps import fit_steps, of_any_version

import pdcorrect as pc
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.model_io import model_folder
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig


def main() -> None:
    """Fit one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of the data set that it was trained on")
    options = parser.parse_args()
    folder = model_folder(options.model)
    model, config = of_any_version(folder), DatasetConfig.load(options.config)
    each, shapes = shapes_of(config), Moments()
    shapes.add(each)
    model.corrector.normaliser.fit_shapes(shapes)
    model.record.training["shapes"] = {
        "dataset": config.name, "meshes": len(each), "left_out": left_out(each),
    }  # fmt: skip
    if model.corrector.normaliser.step_low.isnan().any():
        fit_steps(model, [config])
    print(pc.save_model(model.corrector, folder, record=model.record), left_out(each))


def shapes_of(config: DatasetConfig) -> torch.Tensor:
    """Measures of each training mesh, (m, 10)."""
    problems = [pc.discretise(scene) for scene, _ in scenes_of(config, TRAINING, loads=1)]
    return BodyGraph.of(problems, dtype=torch.float64).shapes


def left_out(shapes: torch.Tensor) -> float:
    """How far a body lies at most outside the ranges of all others."""
    values = shapes.sort(dim=0).values
    return float(torch.maximum(values[1] - values[0], values[-1] - values[-2]).max())


if __name__ == "__main__":
    main()
