"""Fit the range of time steps (see `Gate.time_step`) of the data sets a model was trained on.

python models/fit_time_steps.py MODEL DATASET/config.toml ... [--other]

For models of the format versions 3 and 4, from before gates knew time steps, or knew them without
the cell size; trainings fit the range to their data.  That of models of this version is fitted
anew; version 2 is for `fit_shapes.py`.  Expected are the configurations of the data sets that the
training fitted the ranges to, each once: `fitted_to` in the model's record, or, where that is
missing, all that it was trained on.  `--other` lets sets of other names pass, and these be missing.
The model is replaced by itself with this range, which is told.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from program import run_script

import pdcorrect as pc
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import (
    VERSION,
    WEIGHTS,
    LoadedModel,
    model_folder,
    read_description,
    read_weights,
)
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.data.config import DatasetConfig
from pdcorrect.errors import FileFormatError, InputError

LACKS = {
    2: ("normaliser.shape_", "normaliser.time_step_"),
    3: ("normaliser.time_step_",),
    4: ("normaliser.time_step_",),
}
"""How the names of those tensors begin that models of an older version do not have."""
DROPPED = "normaliser.step_"
"""How those begin that version 4 had: logarithms of time steps in s."""


def main() -> None:
    """Fit one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="folder or name")
    add_configs(parser)
    options = parser.parse_args()
    folder = model_folder(options.model)
    model = of_any_version(folder)
    if model.corrector.normaliser.shape_low.isnan().any():
        raise InputError(f"{folder}: of format version 2: fit_shapes.py fits this range, too.")
    configs = configs_of(model, options)
    fit_time_steps(model, configs)
    print(pc.save_model(model.corrector, folder, record=model.record), told(model))


def add_configs(parser: argparse.ArgumentParser) -> None:
    """Arguments for the data sets of a model's ranges."""
    parser.add_argument(
        "config", type=Path, nargs="+", help="of the data sets that its ranges were fitted to"
    )
    parser.add_argument("--other", action="store_true", help="other data sets than it names")


def configs_of(model: LoadedModel, options: argparse.Namespace) -> list[DatasetConfig]:
    """The configurations that were asked for, of the data sets of the model's ranges.

    Raises
    ------
    InputError
        If one comes twice, is missing, or of another data set.
    """
    configs = [DatasetConfig.load(path) for path in options.config]
    given = [config.name for config in configs]
    for name in given:
        if given.count(name) > 1:
            raise InputError(f"data set {name!r} comes twice: expected each one once.")
    if not options.other and set(given) != set(model.fitted_to):
        raise InputError(
            f"configurations of {', '.join(given)}: expected those of {', '.join(model.fitted_to)},"
            " the data sets of the model's ranges by its record; --other takes others."
        )
    return configs


def of_any_version(folder: Path) -> LoadedModel:
    """A model of this version or an older one, whose missing ranges are not numbers.

    Raises
    ------
    FileFormatError
        If it is damaged.
    """
    found = read_description(folder, (*LACKS, VERSION))
    if found.version == VERSION:
        return pc.load_model(folder)
    state = read_weights(folder, found)
    kept = {name: x for name, x in state.items() if not name.startswith(DROPPED)}
    corrector = Corrector(found.architecture)
    own, lacks = corrector.state_dict(), LACKS[found.version]
    shapes = {name: x.shape for name, x in own.items() if not name.startswith(lacks)}
    if {name: x.shape for name, x in kept.items()} != shapes:
        raise FileFormatError(f"{folder / WEIGHTS}: not the tensors of its architecture: damaged.")
    corrector.load_state_dict({**own, **kept})
    return LoadedModel(corrector.eval(), found.record)


def fit_time_steps(model: LoadedModel, configs: Sequence[DatasetConfig]) -> None:
    """Fit a model's range to the training splits of some data sets."""
    ratios = [config.step / config.cell_size for config in configs]
    moments = Moments()
    moments.add(torch.tensor(ratios, dtype=torch.float64).log()[:, None])
    model.corrector.normaliser.fit_time_steps(moments)
    model.record.training.pop("time_steps", None)  # of version 4, in s
    names = [config.name for config in configs]
    model.record.training["time_steps_over_cell_sizes"] = dict(zip(names, ratios, strict=True))


def told(model: LoadedModel) -> str:
    """The range of time steps."""
    least, most = model.corrector.normaliser.time_steps
    return f"time step over cell size {least:.4g} to {most:.4g} s/m"


if __name__ == "__main__":
    run_script(main)
