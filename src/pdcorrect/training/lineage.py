"""`Lineage`: the data sets that a training's model comes from, for its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pdcorrect.corrector.model_io import JOINT, LoadedModel
from pdcorrect.training.recipe import TrainingConfig
from pdcorrect.training.recordings import Recording


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


def lineage_of(
    config: TrainingConfig, start: LoadedModel | None, recordings: Sequence[Recording]
) -> Lineage:
    """Of a training's model.

    Parameters
    ----------
    config : TrainingConfig
    start : LoadedModel, optional
        The model that the training goes on with.
    recordings : sequence of Recording
        Of the training's own data sets.
    """
    own = [(one.dataset, one.config_hash) for one in recordings]
    names = [name for name, _ in own]
    if start is None:
        return _without_doubles(own, names)
    if config.fitting.anew:
        fitted_to = names
    elif config.fitting.widen:
        fitted_to = [*start.fitted_to, *names]
    else:
        fitted_to = start.fitted_to
    return _without_doubles([*start.data_sets, *own], fitted_to)


def _without_doubles(
    data_sets: Sequence[tuple[str, str | None]], fitted_to: Sequence[str]
) -> Lineage:
    return Lineage(tuple(dict.fromkeys(data_sets)), tuple(dict.fromkeys(fitted_to)))
