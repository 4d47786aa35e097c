"""Give a model's network the ranges of another one: what that one's gate takes for known.

python models/take_ranges.py MODEL FROM -o OUTPUT

For models that went on from each other, and whose trainings widened the ranges of inputs, bodies
and time steps on the way, before there was `fitting.widen`: OUTPUT has all of MODEL but its ranges
(the normaliser's `*_low` and `*_high`), which are those of FROM, as its record tells, too.  Weights
belong to the means and deviations with which they were trained; both models must have the same.
Models of older versions of the format are brought up to date first, see `fit_time_steps.py`.
OUTPUT is a new folder, or an empty one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from program import run_script

import pdcorrect as pc
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.errors import InputError

RANGES = ("_low", "_high")
"""How the names of a normaliser's ranges end."""


def main() -> None:
    """Write one model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", metavar="MODEL", help="folder or name")
    parser.add_argument("ranges", metavar="FROM", help="folder or name")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder")
    options = parser.parse_args()
    check_new(options.output)
    model, other = pc.load_model(options.model), pc.load_model(options.ranges)
    take_ranges(model, other, f"{options.model} and {options.ranges}")
    model.record.training["ranges_of"] = weights_digest(model_folder(options.ranges))
    model.record.training["fitted_to"] = [*other.fitted_to]
    print(pc.save_model(model.corrector, options.output, record=model.record))


def check_new(output: Path) -> None:
    """Refuse a place where something is already.

    Raises
    ------
    InputError
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(
            f"{output}: exists already, and nothing is overwritten: expected a new folder; choose "
            "another name, or delete it first."
        )


def take_ranges(model: LoadedModel, other: LoadedModel, names: str = "the two models") -> None:
    """Put another model's ranges in the place of a model's.

    Raises
    ------
    InputError
        If the models differ in architecture or in what else the normaliser holds.
    """
    if model.corrector.config != other.corrector.config:
        raise InputError(f"{names}: of unlike architectures: expected the same.")
    own = model.corrector.normaliser.state_dict()
    theirs = other.corrector.normaliser.state_dict()
    for name, values in own.items():
        if not name.endswith(RANGES) and not torch.equal(values, theirs[name]):
            raise InputError(
                f"{names}: their normalisation differs in {name}: expected the same means and "
                "deviations, as of models of which one went on from the other."
            )
    ranges = {name: x for name, x in theirs.items() if name.endswith(RANGES)}
    model.corrector.normaliser.load_state_dict({**own, **ranges})


if __name__ == "__main__":
    run_script(main)
