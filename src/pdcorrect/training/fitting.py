"""Fits a corrector's normalisation to the training split."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from pdcorrect.corrector import features
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, FeatureView
from pdcorrect.corrector.normaliser import TIME_STEP, RunningMoments
from pdcorrect.errors import InputError
from pdcorrect.training.windows import Numbers, StepBatch, StepWindows

_AT_ONCE = 32  # windows


@torch.no_grad()
def fit_normaliser(corrector: Corrector, windows: StepWindows, most: int, seed: int = 0) -> None:
    """Set means, deviations, ranges and the output's scale from windows of one step.

    Inputs are what the network sees in a step from the reference, targets what it should
    give there, on free components.  Ranges hold the first steps of simulations besides: of a
    kick, that is the only one with its load.  If there are more than ``most`` windows, or first
    steps, so many are drawn without replacement by ``seed``.
    """
    chosen = _chosen(np.arange(len(windows.dataset)), most, seed)
    found, target = _moments(corrector, windows, chosen)
    corrector.normaliser.fit(found, target)
    averages = _averages(corrector, windows, chosen)
    corrector.envelope.fit({**found, "average": averages, **_at_rest(windows)})
    _widen(corrector, windows, _chosen(windows.beginnings(), most, seed), last=False)


@torch.no_grad()
def widen_ranges(corrector: Corrector, windows: StepWindows, most: int, seed: int = 0) -> None:
    """Widen the ranges of a fitted normalisation to what these windows hold, too.

    Means, deviations and the output's scale stay, for the weights belong to them; a gate then
    takes these data for known as well as those before.
    """
    corrector.envelope.widen(_at_rest(windows))
    _widen(corrector, windows, _chosen(np.arange(len(windows.dataset)), most, seed))
    _widen(corrector, windows, _chosen(windows.beginnings(), most, seed), last=False)


def check_time_steps(corrector: Corrector, windows: StepWindows) -> None:
    """Refuse data whose time step a default gate refuses by a corrector's ranges, which stay."""
    found = _at_rest(windows)["time_step"]
    steps = torch.cat([found.low, found.high])
    if not (corrector.envelope.time_step_excess(steps) > TIME_STEP).any():
        return
    here, there = (
        " to ".join(dict.fromkeys(f"{x:.4g}" for x in each))
        for each in (steps.exp().tolist(), corrector.envelope.time_steps)
    )
    raise InputError(
        f"fitting.widen = false: the data's time step over the cell size is {here} s/m, that of "
        f"the ranges that stay {there} s/m, so a gate would refuse every step: expected data of "
        "that time step, or widen = true."
    )


def _widen(corrector: Corrector, windows: StepWindows, chosen: Numbers, last: bool = True) -> None:
    found, _ = _moments(corrector, windows, chosen, last)
    averages = _averages(corrector, windows, chosen, last)
    corrector.envelope.widen({**found, "average": averages})


def _chosen(numbers: Numbers, most: int, seed: int) -> Numbers:
    """At most so many of some windows."""
    if len(numbers) > most:
        numbers = np.random.default_rng((seed, 1)).choice(numbers, most, replace=False)
    return np.sort(numbers)


def _moments(
    corrector: Corrector, windows: StepWindows, chosen: Numbers, last: bool = True
) -> tuple[dict[str, RunningMoments], RunningMoments]:
    """Of features by name, and of targets (m, 1)."""
    config = corrector.config
    moments = {name: RunningMoments() for name in (*config.node_features, *config.edge_features)}
    target = RunningMoments()
    for batch in _batches(windows, chosen, last):
        view = FeatureView(batch.bodies, batch.snapshot)
        found = features.values(NODE_FEATURES, config.node_features, view)
        found |= features.values(EDGE_FEATURES, config.edge_features, view)
        for name, values in found.items():
            moments[name].add(values)
        wanted = corrector.target(view, batch.target)
        target.add(wanted[batch.bodies.free.all(dim=1)].reshape(-1, 1))
    return moments, target


def _averages(
    corrector: Corrector, windows: StepWindows, chosen: Numbers, last: bool = True
) -> RunningMoments:
    """Of bodies' mean inputs (m, a), for which the normalisation has to be there."""
    averages = RunningMoments()
    for batch in _batches(windows, chosen, last):
        view = FeatureView(batch.bodies, batch.snapshot)
        averages.add(batch.bodies.body_means(corrector.inputs(view)[0]))
    return averages


def _at_rest(windows: StepWindows) -> dict[str, RunningMoments]:
    """Of all bodies' measures (m, 10), and of logarithms of time steps over cell sizes (m, 1)."""
    shapes, steps = RunningMoments(), RunningMoments()
    for batch in _batches(windows, windows.of_each_file(), last=False):
        shapes.add(batch.bodies.shapes)
        steps.add(batch.bodies.time_steps[:, None])
    return {"shape": shapes, "time_step": steps}


def _batches(windows: StepWindows, chosen: Numbers, last: bool) -> Iterator[StepBatch]:
    for first in range(0, len(chosen), _AT_ONCE):
        yield windows.batch(chosen[first : first + _AT_ONCE], last=last)
