"""What a run's statistics say, as numbers and sentences for readers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pdcorrect.state import Status


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
