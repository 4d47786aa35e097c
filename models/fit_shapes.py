"""Fit the ranges of bodies' measures at rest (see `Gate.body`) to a data set's training meshes.

python models/fit_shapes.py MODEL DATASET/config.toml

For models of format version 2, from before there were such ranges; trainings fit them to their
data.  Those of models of version 3 are fitted anew.  The bodies of the training split are drawn as
`pdcorrect dataset generate` does it; nothing is simulated.  The model is replaced by itself with
these ranges; told is how far one of the bodies lies at most outside the ranges of all others.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from first_steps import scenes_of
from safetensors.torch import load_file

import pdcorrect as pc
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.config import CorrectorConfig
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import (
    DESCRIPTION,
    WEIGHTS,
    LoadedModel,
    ModelRecord,
    model_folder,
    weights_digest,
)
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import TRAINING, DatasetConfig

_SHAPES = "normaliser.shape_"


def main() -> None:
    """Fit one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument("config", type=Path, help="of the data set that it was trained on")
    options = parser.parse_args()
    folder = model_folder(options.model)
    version = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))["version"]
    model = second_version(folder) if version == 2 else pc.load_model(folder)
    config = DatasetConfig.load(options.config)
    each, shapes = shapes_of(config), Moments()
    shapes.add(each)
    model.corrector.normaliser.fit_shapes(shapes)
    model.record.training["shapes"] = {
        "dataset": config.name, "meshes": len(each), "left_out": left_out(each),
    }  # fmt: skip
    print(pc.save_model(model.corrector, folder, record=model.record), left_out(each))


def second_version(folder: Path) -> LoadedModel:
    """A model of format version 2, which has no ranges of bodies at rest."""
    found = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    if weights_digest(folder) != found["weights_sha256"]:
        raise SystemExit(f"{folder}: its weights are not those that {DESCRIPTION} names: damaged.")
    corrector = Corrector(CorrectorConfig.model_validate(found["architecture"]))
    gaps = corrector.load_state_dict(load_file(folder / WEIGHTS), strict=False)
    if gaps.unexpected_keys or not all(name.startswith(_SHAPES) for name in gaps.missing_keys):
        raise SystemExit(f"{folder}: its weights are not those of its architecture.")
    return LoadedModel(corrector.eval(), ModelRecord.model_validate(found["record"]))


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
