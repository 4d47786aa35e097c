"""Models that a training learns from, in place of the reference."""

from __future__ import annotations

import torch

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import load_model
from pdcorrect.errors import InputError
from pdcorrect.training.config import TrainingConfig


def load_teachers(config: TrainingConfig, device: torch.device) -> dict[str, Corrector]:
    """The teachers of a training's stages by what names them.

    Raises
    ------
    InputError
        If there is no such model, it does not correct states, or its base model or velocity is
        another one than the training's.
    FileFormatError
        If a file is damaged.
    """
    found: dict[str, Corrector] = {}
    for name in dict.fromkeys(s.teacher for s in config.stages if s.teacher is not None):
        model = load_model(name, device)
        own = model.record.training.get("config")
        told = own if isinstance(own, dict) else {}
        taught = {
            "base": (told.get("base", "plain"), config.base),
            "velocity": (told.get("velocity", "recomputed"), config.velocity),
            "placement": (model.corrector.config.placement, "state"),
        }
        for key, (there, here) in taught.items():
            if there != here:
                raise InputError(
                    f"teacher = {name!r}: its {key} is {there!r}: expected {here!r}, as here."
                )
        found[name] = model.corrector.requires_grad_(False)
    return found
