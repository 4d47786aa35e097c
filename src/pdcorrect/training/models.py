"""The model that a training goes on with, and the data sets that its own comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pdcorrect._config import as_toml
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
    own |= {"base": model.base, "velocity": model.velocity}
    wanted |= {"base": config.base, "velocity": "recomputed"}
    unlike = [name for name in own if own[name] != wanted[name]]
    if unlike:
        found, expected = (
            ", ".join(f"{name} = {as_toml(each[name])}" for name in unlike)
            for each in (own, wanted)
        )
        raise InputError(
            f"start_from = {config.start_from!r}: that model has {found}: expected {expected}, as "
            "here."
        )
    return model


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
