"""What a run's statistics say, as numbers and sentences for readers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pdcorrect.state import Status

if TYPE_CHECKING:
    from pdcorrect.corrector.gate import Gate

_MEANINGS = {
    "not finite": "the network's answer is not a number",
    "features": "the network's inputs are unlike those of its training",
    "inversion": "cells of the corrected state are crushed or turned inside out",
    "energy": "the corrected state has more energy than the loads account for",
    "solver": "the coarse step itself failed",
    "body": "the body at rest is unlike those of its training",
    "pause": "it would have passed, too soon after one that did not",
    "folded": "a cell is folded at a corner",
    "time step": "the time step over the cell size is unlike that of its training",
}
"""Of the reasons that `pdcorrect.corrector.gate.refusals` names."""


def three_digits(value: float) -> str:
    """A number with three significant digits and without powers of ten where it is large."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def inverted_frames(stats: Mapping[str, Any], step: float) -> str | None:
    """How many frames of a run ended with inverted cells, and which was the first; None if none.

    Parameters
    ----------
    stats : mapping of str to (T,) arrays
        Those of a run from its first step on.
    step : float
        s.
    """
    inverted = np.asarray(stats["status"]) == Status.INVERTED.name
    if "smallest_volume_ratio" in stats:  # also after a fallback, which the status names instead
        inverted = inverted | (np.asarray(stats["smallest_volume_ratio"]) <= 0.0)
    if not inverted.any():
        return None
    first = 1 + int(inverted.argmax())
    return (
        f"{inverted.sum()} of {len(inverted)} frames ended with inverted or folded cells, the "
        f"first of them frame {first} (t = {first * step:g} s)"
    )


def refused_corrections(stats: Mapping[str, Any]) -> list[str]:
    """How many corrections of a hybrid's run were refused and why; empty if none was.

    Parameters
    ----------
    stats : mapping of str to (T,) arrays
        With ``refused`` and ``gate``.
    """
    refused, reasons, meaning = _counted(stats["gate"])
    if not refused:
        return []
    return [
        f"{refused} of {len(stats['gate'])} corrections were refused by the gate ({reasons}).",
        f"Of its refusals, {meaning}.",
    ]


def refused_rollouts(reasons: Iterable[float]) -> str | None:
    """How many rollouts a gate refused in all steps, and why; None if it did so in none.

    Parameters
    ----------
    reasons : iterable of numbers of `Reason`
        Of each rollout, see `pdcorrect.evaluation.measures.Measured.refused_by`.
    """
    every = list(reasons)
    refused, counts, meaning = _counted(every)
    if not refused:
        return None
    return (
        f"{refused} of {len(every)} rollouts were refused in all steps by the gate ({counts}), "
        f"and are those of the coarse model; {meaning}."
    )


def _counted(reasons: Iterable[float]) -> tuple[int, str, str]:
    """How many refusals there are, how many by each reason, and what these reasons mean."""
    from pdcorrect.corrector.gate import refusals

    counts = {reason: n for reason, n in refusals(reasons).items() if n}
    return (
        sum(counts.values()),
        ", ".join(f"{n} by {reason}" for reason, n in counts.items()),
        "; ".join(f"'{reason}': {_MEANINGS[reason]}" for reason in counts),
    )


def refused_step(gate: Gate | None, step: float, excess: float, trained: str) -> str | None:
    """How a time step that a gate refuses differs from its training's; None if it does not.

    Said also where the body at rest is refused, which is the reason then that steps record.

    Parameters
    ----------
    gate : Gate or None
    step : float
        s.
    excess : float
        See `HybridStepper.time_step_excess`.
    trained : str
        See `HybridStepper.trained_step`.
    """
    bound = None if gate is None else gate.time_step
    if bound is None or excess <= bound:
        return None
    return (
        f"The time step is {step:g} s, that of the training {trained} for cells of this size: "
        f"farther than the gate's bound {bound:g} of its logarithm, a factor of "
        f"{math.exp(bound):.2g}. Expected a time step as in the training; or, at your own risk, a "
        "gate without this bound, Gate(time_step=None), or none (--no-gate)."
    )


def foreign_integrator(found: str, trained: str, name: str) -> str | None:
    """A warning if a model was trained on steps of another time integrator; None if not.

    Parameters
    ----------
    found, trained : str
        Integrators of the scene and of the model's data.
    name : str
        Of the model.
    """
    if found == trained:
        return None
    return (
        f"{name} was trained on steps by {trained}, and the scene's integrator is {found}: such "
        "steps it has never seen, its corrections may be worth less, and its gate need not notice."
    )
