"""Plots of learned models with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pdcorrect.errors import InputError
from pdcorrect.figures.curves import _axes, _legend, _save, _style

_BINS = 24


def plot_omega(values: Mapping[str, Sequence[float]], output: str | Path) -> Path:
    """Histograms over trajectories of Omega, per cent, one outline a model.

    Raises
    ------
    InputError
        If a model has no value, or there is no model.
    """
    if not values or not all(len(found) for found in values.values()):
        raise InputError("Omega by model: expected one model or more, each with values.")
    every = np.concatenate([np.asarray(found, dtype=np.float64) for found in values.values()])
    low, high = float(every.min()), float(every.max())
    edges = (
        np.linspace(low - 0.5, high + 0.5, _BINS + 1)
        if high - low < 1.0
        else np.linspace(low, high, _BINS + 1)
    )
    figure, (axis,) = _axes(1, 4.0)
    for index, (label, found) in enumerate(values.items()):
        axis.hist(found, edges, histtype="step", label=label, **_style(index))
    axis.axvline(0.0, color="0.5", linewidth=0.8)
    axis.set_xlabel("share of the plain run's squared error removed [%]")
    axis.set_ylabel("trajectories")
    _legend(figure, [axis])
    return _save(figure, output)
