"""Fit the range of time steps (see `Gate.step`) of the data sets that a model was trained on.

python models/fit_steps.py MODEL DATASET/config.toml ...

For models of format version 3, from before there was such a range; trainings fit it to their data.
That of models of version 4 is fitted anew; version 2 is for `fit_shapes.py`.  The model is
replaced by itself with this range.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file

import pdcorrect as pc
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
from pdcorrect.data.config import DatasetConfig

LACKS = {
    2: ("normaliser.shape_", "normaliser.step_"),
    3: ("normaliser.step_",),
}
"""How the names of those tensors begin that models of an older version do not have."""


def main() -> None:
    """Fit one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    parser.add_argument(
        "config", type=Path, nargs="+", help="of the data sets that it was trained on"
    )
    options = parser.parse_args()
    folder = model_folder(options.model)
    model = of_any_version(folder)
    if model.corrector.normaliser.shape_low.isnan().any():
        raise SystemExit(f"{folder}: of format version 2: fit_shapes.py fits this range, too.")
    fit_steps(model, [DatasetConfig.load(path) for path in options.config])
    print(pc.save_model(model.corrector, folder, record=model.record))


def of_any_version(folder: Path) -> LoadedModel:
    """A model of this version or an older one, whose missing ranges are not numbers."""
    found = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    lacks = LACKS.get(found["version"])
    if lacks is None:
        return pc.load_model(folder)
    if weights_digest(folder) != found["weights_sha256"]:
        raise SystemExit(f"{folder}: its weights are not those that {DESCRIPTION} names: damaged.")
    corrector = Corrector(CorrectorConfig.model_validate(found["architecture"]))
    gaps = corrector.load_state_dict(load_file(folder / WEIGHTS), strict=False)
    if gaps.unexpected_keys or not all(name.startswith(lacks) for name in gaps.missing_keys):
        raise SystemExit(f"{folder}: its weights are not those of its architecture.")
    return LoadedModel(corrector.eval(), ModelRecord.model_validate(found["record"]))


def fit_steps(model: LoadedModel, configs: Sequence[DatasetConfig]) -> None:
    """Fit a model's range to the time steps of some training splits."""
    steps = [config.step for config in configs]
    moments = Moments()
    moments.add(torch.tensor(steps, dtype=torch.float64).log()[:, None])
    model.corrector.normaliser.fit_steps(moments)
    model.record.training["time_steps"] = {config.name: config.step for config in configs}


if __name__ == "__main__":
    main()
