"""What models have in free rollouts of bodies that they were trained on, and of others.

python models/seen_and_unseen.py DATA MODEL... [--splits training validation] [--meshes 72]
    [--device cuda] [-o RECORD.json]

Omega is that by which a training chooses its weights (`pdcorrect.training.validation`): over all
frames, without a gate, at least -100 a simulation.  Meshes are spread evenly over a split that has
more of them, and all simulations on them are rolled out together.  MODEL is a name or folder, or
several with a plus sign between them: the mean of their weights, for models of which one went on
from the other.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from program import run_script
from run_record import write_record

import pdcorrect as pc
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.data.config import TRAINING, VALIDATION
from pdcorrect.errors import InputError
from pdcorrect.training.recordings import load_recordings
from pdcorrect.training.validation import Validation


def main() -> None:
    """Roll out and tell."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="+", metavar="MODEL")
    parser.add_argument("--splits", nargs="+", default=[TRAINING, VALIDATION])
    parser.add_argument("--meshes", type=int, default=72, help="of a split, at most")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    known: dict[tuple[str, str, str], Validation] = {}
    rows = []
    for name in options.models:
        model = averaged(name.split("+"), options.device)
        for split in options.splits:
            key = split, model.base, model.velocity
            if key not in known:
                known[key] = Validation(
                    load_recordings(options.data, split, model.base, meshes=options.meshes),
                    model.base, velocity=model.velocity, device=options.device,
                )  # fmt: skip
            rollouts = known[key]
            scores = rollouts(model.corrector)
            rows.append(
                {
                    "model": name, "base": model.base, "split": split,
                    "weights_sha256": [weights_digest(model_folder(x)) for x in name.split("+")],
                    "simulations": len(rollouts.recordings), **scores.metrics(),
                    "names": [recording.name for recording in rollouts.recordings],
                    "omegas": scores.omegas.tolist(),
                }
            )  # fmt: skip
            told = {part: rows[-1][part] for part in ("model", "split", *scores.metrics())}
            print(told, flush=True)
            if options.output:
                write_record(options.output, rollouts=rows)


def averaged(names: Sequence[str], device: str) -> LoadedModel:
    """The first model with the mean of the weights of all.

    Raises
    ------
    InputError
        If their architecture, base, velocity or normalisation differ.
    """
    first, *others = [pc.load_model(name, device) for name in names]
    states = [first.corrector.network.state_dict()]
    scales = _normalisation(first)
    for name, model in zip(names[1:], others, strict=True):
        alike = _kind(model) == _kind(first)
        theirs = _normalisation(model)
        if not alike or any(not torch.equal(scales[key], theirs[key]) for key in scales):
            raise InputError(
                f"{name}: another architecture, base, velocity or normalisation than {names[0]}: "
                "expected models of which one went on from the other."
            )
        states.append(model.corrector.network.state_dict())
    mean = {key: torch.stack([s[key] for s in states]).mean(dim=0) for key in states[0]}
    first.corrector.network.load_state_dict(mean)
    return first


def _kind(model: LoadedModel) -> tuple[Any, ...]:
    return model.corrector.config, model.base, model.velocity


def _normalisation(model: LoadedModel) -> dict[str, torch.Tensor]:
    """Means, deviations and the output's scale; not the ranges, which trainings widen."""
    state = model.corrector.state_dict()
    names = ("__mean", "__deviation", "output_scale")
    return {key: x for key, x in state.items() if key.endswith(names)}


if __name__ == "__main__":
    run_script(main)
