"""What a run's statistics say, as numbers and sentences for readers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pdcorrect.state import Status

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
    from pdcorrect.corrector.gate import refusals

    counts = {reason: n for reason, n in refusals(stats["gate"]).items() if n}
    if not counts:
        return []
    reasons = ", ".join(f"{n} by {reason}" for reason, n in counts.items())
    meaning = "; ".join(f"'{reason}': {_MEANINGS[reason]}" for reason in counts)
    refused, frames = sum(counts.values()), len(stats["gate"])
    return [
        f"{refused} of {frames} corrections were refused by the gate ({reasons}).",
        f"Of its refusals, {meaning}.",
    ]


def refused_step(stats: Mapping[str, Any], step: float, trained: str) -> str | None:
    """How a time step that a hybrid's gate refused differs from its training's; None if it was not.

    Parameters
    ----------
    stats : mapping of str to (T,) arrays
        With ``gate``.
    step : float
        s.
    trained : str
        That of the training for the body's cell size, with its unit, see
        `HybridStepper.trained_step`.
    """
    from pdcorrect.corrector.gate import Reason

    if not (np.asarray(stats["gate"]) == Reason.TIME_STEP).any():
        return None
    return f"The time step is {step:g} s, that of the training {trained} for cells of this size."


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
