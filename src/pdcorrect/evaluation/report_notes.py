"""What a reader of a `Comparison`, or of a run, has to know besides its numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pdcorrect.evaluation.compare import Comparison
from pdcorrect.evaluation.converged import MESH_ERROR, TIME_ERROR
from pdcorrect.metrics import largest_displacement
from pdcorrect.state import Status

_NOT_UNIQUE = 100.0
"""Tolerances by which PD and Newton differ where they have taken different branches."""


def notes(comparison: Comparison) -> list[str]:
    """What errors are measured from, and what is unusual: one sentence each."""
    truth, time = comparison.on_coarse[comparison.reference], comparison.scene.time
    found = [
        f"{len(truth)} frames of {time.step:g} s by {time.integrator}; RMS and worst are distances "
        f"from {comparison.reference}, which moves by up to {1e3 * largest_displacement(truth):.3g}"
        " mm.",
        _own_error(comparison),
        _branches(comparison),
    ]
    if comparison.without_best:
        found.append(f"There is no best coarse model: {comparison.without_best}.")
    found += [f"{label} failed: {why.rstrip('.')}." for label, why in comparison.failures.items()]
    for row in comparison.rows:
        stats = comparison.runs[row.label].stats
        told = [
            f"{row.unusual_frames} frames needed a fallback." if row.unusual_frames else "",
            inverted_frames(stats, time.step),
            refused_corrections(stats["gate"]) if row.refused_frames else "",
        ]
        found += [f"{row.label}: {text}" for text in told if text]
    return [note for note in found if note]


def _own_error(comparison: Comparison) -> str:
    """Of the converged motion, where it is known."""
    known = {} if comparison.converged is None else comparison.converged.attributes
    return ", ".join(
        f"own {name} error of the converged motion {float(known[key]):.2%}"
        for name, key in (("time", TIME_ERROR), ("mesh", MESH_ERROR))
        if key in known
    )


def _branches(comparison: Comparison) -> str:
    """Whether PD and Newton have come to other motions."""
    problem, apart = comparison.runs[comparison.reference].problem, comparison.solver_error
    if problem is None or apart is None:
        return ""
    if apart <= _NOT_UNIQUE * comparison.scene.solver.tolerance * problem.cell_size:
        return ""
    return (
        f"PD and Newton differ by {1e3 * apart:.2g} mm on the coarse mesh: the motion seems not to "
        "be unique, and distances from one reference mean little."
    )


def refused_corrections(reasons: Iterable[float]) -> str:
    """One sentence: how many corrections were refused, and why; empty if none was.

    Parameters
    ----------
    reasons : iterable of numbers of `pdcorrect.corrector.gate.Reason`
        Of each step, 0 where it was corrected.
    """
    from pdcorrect.corrector.gate import refusals

    every = list(reasons)
    found = refusals(every)
    if not found:
        return ""
    counts = ", ".join(f"{one.steps} because {one.reason.meaning}" for one in found)
    return f"{sum(one.steps for one in found)} of {len(every)} corrections were refused ({counts})."


_GAINED = 0.1
"""Of a run's largest energy: more than steps of second order gain where they are short enough."""


def gained_energy(stats: Mapping[str, Any]) -> str:
    """Whether a run has more energy than was put in since its first step; empty if not."""
    stored = np.asarray(stats["elastic_energy"]) + np.asarray(stats["kinetic_energy"])
    put_in = np.cumsum(
        np.asarray(stats["external_work"]) + stats["clamp_work"] - stats["damping_loss"]
    )
    gained = float(((stored - stored[0]) - (put_in - put_in[0])).max())
    if not gained > _GAINED * stored.max():
        return ""
    return (
        f"the run gained {gained:.3g} J that nothing put in: take smaller steps or a smaller "
        "spectral_radius"
    )


def inverted_frames(stats: Mapping[str, Any], step: float) -> str:
    """How many frames of a run ended with inverted cells, and which was the first; empty if none.

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
        return ""
    first = 1 + int(inverted.argmax())
    return (
        f"{inverted.sum()} of {len(inverted)} frames ended with inverted or folded cells, the "
        f"first at t = {first * step:g} s"
    )
