"""Models that a training goes on with, or learns from in place of the reference."""

from __future__ import annotations

from typing import Literal

import torch

from pdcorrect._config import as_toml
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import LoadedModel, load_model
from pdcorrect.errors import InputError
from pdcorrect.training.recipe import TrainingConfig


def load_start(config: TrainingConfig, device: torch.device) -> LoadedModel | None:
    """The model that a training goes on with, if there is one.

    Raises
    ------
    InputError
        If there is no such model, or its architecture, base model (unless the normalisation is
        fitted anew) or velocity is another one than the training's.
    FileFormatError
        If a file is damaged.
    """
    if config.start_from is None:
        return None
    what, model = f"start_from = {config.start_from!r}", load_model(config.start_from, device)
    own, wanted = (c.model_dump() for c in (model.corrector.config, config.architecture()))
    unlike = [name for name in own if own[name] != wanted[name]]
    if unlike:
        told = ", ".join(f"{name} = {as_toml(own[name])}" for name in unlike)
        raise InputError(
            f"{what}: that model has {told}, unlike corrector: expected the same there, in "
            "corrector.changes."
        )
    _check_alike("velocity", what, model, config)  # in any case, so that the way on is one
    if not config.fitting.anew:
        instead = "" if config.fitting.widen else " in place of fitting.widen = false"
        way_on = f", or fitting.anew = true{instead}, which takes over that model's weights alone"
        _check_alike("base", what, model, config, way_on)
    return model


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
        what, model = f"teacher = {name!r}", load_model(name, device)
        _check_alike("base", what, model, config)
        _check_alike("velocity", what, model, config)
        placement = model.corrector.config.placement
        if placement != "state":
            raise InputError(f"{what}: its placement is {placement!r}: expected 'state'.")
        found[name] = model.corrector.requires_grad_(False)
    return found


def _check_alike(
    key: Literal["base", "velocity"],
    what: str,
    model: LoadedModel,
    config: TrainingConfig,
    way_on: str = "",
) -> None:
    """Refuse a model whose corrections are of another kind than those of a training."""
    there, here = getattr(model, key), getattr(config, key)
    if there != here:
        raise InputError(f"{what}: its {key} is {there!r}: expected {here!r}, as here{way_on}.")
