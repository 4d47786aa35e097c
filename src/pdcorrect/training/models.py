"""Models that a training goes on with or learns from, and the data sets that its own comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pdcorrect._config import as_toml
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import JOINT, LoadedModel, load_model
from pdcorrect.errors import InputError
from pdcorrect.training.recipe import TrainingConfig
from pdcorrect.training.recordings import Recording


def load_start(config: TrainingConfig, device: torch.device) -> LoadedModel | None:
    """The model that a training goes on with, if there is one.

    Raises
    ------
    InputError
        If there is no such model, or its architecture, base model or velocity is another one
        than the training's.
    FileFormatError
        If a file is damaged.
    """
    if config.start_from is None:
        return None
    model = load_model(config.start_from, device)
    own, wanted = (c.model_dump() for c in (model.corrector.config, config.architecture()))
    _check_alike(f"start_from = {config.start_from!r}", model, config, own, wanted)
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
        model = load_model(name, device)
        placement = {"placement": model.corrector.config.placement}
        _check_alike(f"teacher = {name!r}", model, config, placement, {"placement": "state"})
        found[name] = model.corrector.requires_grad_(False)
    return found


def _check_alike(
    what: str,
    model: LoadedModel,
    config: TrainingConfig,
    own: dict[str, Any],
    wanted: dict[str, Any],
) -> None:
    """Refuse a model of other settings, or whose corrections are of another kind."""
    own = {"base": model.base, "velocity": model.velocity, **own}
    wanted = {"base": config.base, "velocity": "recomputed", **wanted}
    unlike = [name for name in own if own[name] != wanted[name]]
    if unlike:
        found, expected = (
            ", ".join(f"{name} = {as_toml(each[name])}" for name in unlike)
            for each in (own, wanted)
        )
        raise InputError(f"{what}: that model has {found}: expected {expected}, as here.")


@dataclass(frozen=True)
class Lineage:
    """Data sets that a model comes from.

    Attributes
    ----------
    data_sets : tuple of (str, str or None)
        Names, and hashes of configurations, of all that its weights were trained on.
    fitted_to : tuple of str
        Names of those that the normaliser's ranges were fitted or widened to.
    """

    data_sets: tuple[tuple[str, str | None], ...]
    fitted_to: tuple[str, ...]

    @classmethod
    def of(
        cls, config: TrainingConfig, start: LoadedModel | None, recordings: Sequence[Recording]
    ) -> Lineage:
        """Of a training's model: of the one it goes on with, and of its own data sets."""
        data_sets = [] if start is None else start.data_sets
        data_sets = [*data_sets, *((r.dataset, r.config_hash) for r in recordings)]
        fitted_to = [] if start is None else start.fitted_to
        if start is None or config.fitting.widen:
            fitted_to = [*fitted_to, *(r.dataset for r in recordings)]
        return cls(tuple(dict.fromkeys(data_sets)), tuple(dict.fromkeys(fitted_to)))

    @property
    def name(self) -> str:
        """All names with plus signs between them."""
        return JOINT.join(dict.fromkeys(name for name, _ in self.data_sets))

    def record(self) -> dict[str, Any]:
        """As JSON, for `ModelRecord.training`."""
        return {
            "data_sets": [{"name": name, "config_hash": x} for name, x in self.data_sets],
            "fitted_to": list(self.fitted_to),
        }
