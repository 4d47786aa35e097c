"""Models that a training goes on with, or learns from in place of the reference."""

from __future__ import annotations

import torch

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import LoadedModel, load_model
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
        check_trained_alike(f"teacher = {name!r}", model, config)
        placement = model.corrector.config.placement
        if placement != "state":
            raise InputError(
                f"teacher = {name!r}: its placement is {placement!r}: expected 'state'."
            )
        found[name] = model.corrector.requires_grad_(False)
    return found


def check_trained_alike(
    what: str, model: LoadedModel, config: TrainingConfig, any_base: bool = False
) -> None:
    """Refuse a model whose corrections are of another kind than those of a training.

    Raises
    ------
    InputError
        If it corrects another base model, unless ``any_base`` is allowed, or its corrected states
        have other velocities.
    """
    for key in ("velocity",) if any_base else ("base", "velocity"):
        there, here = getattr(model, key), getattr(config, key)
        if there != here:
            raise InputError(f"{what}: its {key} is {there!r}: expected {here!r}, as here.")
