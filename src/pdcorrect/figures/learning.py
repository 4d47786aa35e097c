"""Plots of learned models with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pdcorrect.errors import InputError
from pdcorrect.figures.curves import _axes, _legend, _save, _style

_BINS = 24
_HALF = 50.0  # per cent


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


def plot_validations(
    histories: Mapping[str, tuple[Sequence[float], Sequence[float]]], output: str | Path
) -> Path:
    """Omega on the validation split, per cent, over the time of training, s, one line a training.

    Zero is in the plot only where a value is below 50 %: what is near 100 is told apart then.

    Parameters
    ----------
    histories : mapping of str to (seconds, omegas)
        Of each validation.
    output : path

    Raises
    ------
    InputError
        If there is no training, or one has no validation or not as many times as values.
    """
    lengths = [(len(seconds), len(omegas)) for seconds, omegas in histories.values()]
    if not lengths or not all(0 < n == m for n, m in lengths):
        raise InputError("Omega over time: expected trainings, each with times and values.")
    figure, (axis,) = _axes(1, 4.5)
    for index, (label, (seconds, omegas)) in enumerate(histories.items()):
        axis.plot(seconds, omegas, marker="o", markersize=4, label=label, **_style(index))
    if min(min(omegas) for _, omegas in histories.values()) < _HALF:
        axis.axhline(0.0, color="0.5", linewidth=0.8)
    axis.set_xlabel("time of training [s]")
    axis.set_ylabel("Omega, mean on the validation split [%]")
    _legend(figure, [axis])
    return _save(figure, output)
