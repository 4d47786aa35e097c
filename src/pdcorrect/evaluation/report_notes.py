"""What the numbers of a `Comparison` mean on its scene, in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pdcorrect.evaluation.compare import Comparison
from pdcorrect.evaluation.converged import MESH_ERROR, TIME_ERROR
from pdcorrect.evaluation.report_table import relative_text
from pdcorrect.metrics import energy_balance, largest_displacement, rms_error
from pdcorrect.state import Status
from pdcorrect.trajectory import Trajectory

_NOT_UNIQUE = 100.0
"""Tolerances by which PD and Newton differ where they have taken different branches."""


def notes(comparison: Comparison) -> list[str]:
    """What the table's numbers mean on this scene: at most six sentences or short paragraphs."""
    found = [
        _of_the_errors(comparison),
        _of_the_reference(comparison),
        _of_the_solver(comparison),
        _of_the_rows(comparison),
        _of_the_models(comparison),
        _of_the_faults(comparison),
    ]
    return [note for note in found if note]


def _of_the_errors(comparison: Comparison) -> str:
    truth, time = comparison.on_coarse[comparison.reference], comparison.scene.time
    return (
        f"{len(truth)} frames of {time.step:g} s by {time.integrator}. "
        f"{_of_the_converged(comparison)}"
        f"{_of_the_estimate(comparison)}RMS and worst are distances "
        f"of the coarse nodes from {comparison.reference}, which moves by up to "
        f"{1e3 * largest_displacement(truth):.3g} mm; 'corrected' is the share of the scene's "
        "own coarse PD run's squared error that is gone."
    )


def _of_the_estimate(comparison: Comparison) -> str:
    if comparison.finer is None:
        return ""
    still = comparison.scene.time.integrator == "quasi-static"
    return (
        "'estimated' is the relative RMS distance from a run with the learned element on 2×2×2 "
        f"cells for each coarse one{'' if still else ', by generalised-alpha with half the step'}. "
    )


def _of_the_converged(comparison: Comparison) -> str:
    """What relative errors are of, and how exact that is itself if it is known."""
    run = comparison.converged
    if run is None:
        return ""
    size = rms_error(np.broadcast_to(run.points, run.positions.shape), run)
    known = [
        f"{name} {relative_text(float(run.attributes[key]))}"
        for name, key in (("time", TIME_ERROR), ("mesh", MESH_ERROR))
        if key in run.attributes
    ]
    own = f" (its own error: {', '.join(known)})" if known else ""
    return (
        f"'error' is the RMS distance from the converged motion{own} over that motion's RMS "
        f"displacement, {1e3 * size:.3g} mm. "
    )


def _of_the_reference(comparison: Comparison) -> str:
    """What is left of the reference's own error, in space and in time."""
    if comparison.converged is not None:
        return ""
    run = comparison.runs[comparison.reference]
    if comparison.scene.time.integrator == "quasi-static":
        return f"The reference ({_discretisation(run)}) has a mesh error of its own."
    lost = _lost_share(run)
    share = "" if lost is None else f" (it dissipates {100 * lost:.0f} % of the loads' work)"
    return (
        f"The reference ({_discretisation(run)}) is not the truth: its mesh error, and the error "
        f"of the time step{share}, which all rows share, are in none of these numbers. Option "
        "--converged measures from the converged motion instead."
    )


def _lost_share(run: Trajectory) -> float | None:
    """Share of the work of loads and clamps that the integrator lost; None if unclear."""
    if run.problem is None or run.problem.scene.time.integrator == "quasi-static":
        return None
    balance = energy_balance(run)
    work = float(balance.external_work[-1] + balance.clamp_work[-1])
    lost = float(balance.dissipation[-1])
    return lost / work if work > lost > 0 else None


def _of_the_solver(comparison: Comparison) -> str:
    material, effective = comparison.scene.material, comparison.scene.material.effective
    told = (
        f"The energy's small-strain moduli are E = {effective.young:.6g} Pa and ν = "
        f"{effective.poisson:.4g} (asked for: {material.young:.6g} and {material.poisson:g}"
        f"{'; regions have others' if comparison.scene.materials else ''}). "
        f"PD stops at {comparison.scene.solver.tolerance:g} of a coarse cell, Newton at 1e-10"
    )
    if comparison.solver_error is not None:
        told += f"; on the coarse mesh they differ by {1e3 * comparison.solver_error:.2g} mm"
        problem = comparison.runs[comparison.reference].problem
        unit = 0.0 if problem is None else comparison.scene.solver.tolerance * problem.cell_size
        if comparison.solver_error > _NOT_UNIQUE * unit > 0.0:
            told += (
                ", far more than that: the motion seems not to be unique (does the body buckle?), "
                "and distances from one reference mean little"
            )
    return f"{told}."


def _of_the_rows(comparison: Comparison) -> str:
    """Rows whose element or mass is not the reference's."""
    truth = comparison.runs[comparison.reference]
    unlike: dict[str, list[str]] = {}
    for row in comparison.rows:
        run = comparison.runs[row.label]
        if _discretisation(run) != _discretisation(truth):
            unlike.setdefault(_discretisation(run), []).append(row.label)
    told = [f"{', '.join(labels)}: {what}" for what, labels in unlike.items()]
    if comparison.without_best:
        told.append(f"there is no best coarse model: {comparison.without_best}")
    return f"{'; '.join(told)}." if told else ""


def _discretisation(run: Trajectory) -> str:
    """Element, mass rule and total mass."""
    mass = "" if run.problem is None else f", {float(run.problem.mass.sum()):.4g} kg"
    return f"element {run.attributes['element']}, mass {run.attributes['mass']}{mass}"


def _of_the_models(comparison: Comparison) -> str:
    """What correctors were trained on, and what their gates refused."""
    told = []
    for label, about in comparison.models.items():
        trained, now = about["trained_integrator"], comparison.scene.time.integrator
        step = f" with {trained}, not {now}" if trained != now else ""
        text = f"trained on {about['dataset']}{step}, elsewhere it may be of no use."
        if label in comparison.runs:
            run = comparison.runs[label]
            refused = refused_corrections(run.stats["gate"])
            text = f"{text} {refused}".strip()
        told.append((label, text))
    return " ".join(grouped(told))


def grouped(told: Iterable[tuple[str, str]]) -> list[str]:
    """Sentences with the names that they are told of, each sentence once."""
    names: dict[str, list[str]] = {}
    for name, text in told:
        names.setdefault(text, []).append(name)
    return [f"{', '.join(every)}: {text}" for text, every in names.items()]


def refused_corrections(reasons: Iterable[float], runs: int = 1) -> str:
    """One sentence: how many corrections were refused, and why; empty if none was.

    Parameters
    ----------
    reasons : iterable of numbers of `pdcorrect.corrector.gate.Reason`
        Of each step, 0 where it was corrected.
    runs : int
        Of which the steps are.
    """
    from pdcorrect.corrector.gate import refusals

    every = list(reasons)
    found = refusals(every)
    if not found:
        return ""
    total = sum(one.steps for one in found)
    counts = ", ".join(f"{one.steps} because {one.reason.meaning}" for one in found)
    alone = "the run is" if runs == 1 else "all runs are"
    rest = f": {alone} of the coarse model alone" if total == len(every) else ""
    return f"{total} of {len(every)} corrections were refused ({counts}){rest}."


def _of_the_faults(comparison: Comparison) -> str:
    """Rows that failed, needed a fallback, or ended frames with inverted cells."""
    told = [f"{label} failed: {why.rstrip('.')}" for label, why in comparison.failures.items()]
    for row in comparison.rows:
        stats = comparison.runs[row.label].stats
        if row.unusual_frames:
            told.append(f"{row.label}: {row.unusual_frames} frames needed a fallback")
        inverted = inverted_frames(stats, comparison.scene.time.step)
        if inverted:
            told.append(f"{row.label}: {inverted}")
    return f"{'; '.join(told)}." if told else ""


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
