"""What the numbers of a `Comparison` mean on its scene, in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pdcorrect.comparison_cases import without_best
from pdcorrect.evaluate import Comparison, Row
from pdcorrect.metrics import energy_balance, largest_displacement
from pdcorrect.scene import Scene
from pdcorrect.state import Status, Trajectory

_MEANINGS = {
    "not finite": "the network's answer is not a number",
    "features": "the network's inputs are unlike those of its training",
    "inversion": "cells of the corrected state are crushed or turned inside out",
    "energy": "the corrected state has more energy than the loads account for",
    "solver": "the coarse step itself failed",
    "body": "the body at rest is unlike those of its training",
}
"""Of the reasons that `pdcorrect.corrector.gate.refusals` names."""


def notes(comparison: Comparison) -> list[str]:
    """What the table's numbers mean on this scene, some sentences each."""
    return [
        *_of_the_errors(comparison),
        *_of_the_scene(comparison),
        *(
            f"{label} failed and has no errors or times: {why}"
            for label, why in comparison.failures.items()
        ),
        *_of_the_reference(comparison),
        *_of_the_best(comparison),
        *_of_the_solvers(comparison),
        *_of_the_models(comparison),
        *_of_the_cells(comparison),
    ]


def shown_labels(comparison: Comparison) -> dict[str, str]:
    """Labels for readers: of a hybrid also how many of its corrections were refused."""
    shares = {row.label: refused_share(comparison, row) for row in comparison.rows}
    return {label: f"{label} ({share})" if share else label for label, share in shares.items()}


def refused_share(comparison: Comparison, row: Row) -> str:
    """As "3 of 40 refused" or "all refused"; empty where no correction was refused."""
    if not row.refused_frames:
        return ""
    frames = len(comparison.runs[row.label])
    every = row.refused_frames == frames
    return "all refused" if every else f"{row.refused_frames} of {frames} refused"


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


# --- one group of notes each --------------------------------------------------------------


def _of_the_errors(comparison: Comparison) -> list[str]:
    step = comparison.scene.time.step
    moved = largest_displacement(comparison.on_coarse[comparison.reference])
    return [
        f"{_frames(comparison)} frames of {step:g} s; the reference moves by up to "
        f"{1e3 * moved:.3g} mm. Errors (RMS, worst) are distances of the coarse nodes from the "
        f"reference, {comparison.reference}, with the same time step, over all frames. Times and "
        "iterations are for one frame."
    ]


def _frames(comparison: Comparison) -> int:
    return len(comparison.runs[comparison.reference])


def _of_the_scene(comparison: Comparison) -> list[str]:
    scene = comparison.scene
    effective = scene.material.effective
    accuracy = (
        f"Solver tolerance: {scene.solver.tolerance:g} of the coarse cell size for PD, 1e-10 for "
        "Newton."
    )
    if any(np.isfinite(row.omega) for row in comparison.rows):
        accuracy += (
            " 'Corrected' is the share of the coarse PD run's squared error that is gone (eq. 7-2)."
        )
    return [
        f"Material: E = {scene.material.young:.6g} Pa and Poisson's ratio "
        f"{scene.material.poisson:g} asked for; the energy's small-strain moduli are "
        f"E = {effective.young:.6g} Pa and {effective.poisson:.4g} "
        f"(volume weight '{scene.material.volume_weight}'){_elsewhere(scene)}.",
        f"Of the scene itself: element {scene.solver.element}, mass {scene.solver.mass}, time "
        f"integrator {scene.time.integrator}. They are those of all rows whose names do not tell "
        "another.",
        accuracy,
    ]


def _elsewhere(scene: Scene) -> str:
    """What a scene's regions change of its material."""
    count = len(scene.materials)
    return f"; {count} region{'s' if count > 1 else ''} with other values" if count else ""


def _of_the_reference(comparison: Comparison) -> list[str]:
    """What is left of the reference's own error, in space and in time."""
    scene, run = comparison.scene, comparison.runs[comparison.reference]
    case = next(c for c in comparison.cases if c.label == comparison.reference)
    cut = f"with each cell cut {case.refine}×{case.refine}×{case.refine}" if case.refine > 1 else (
        "on the coarse mesh itself"
    )  # fmt: skip
    found = [
        f"The reference, {case.label}, is not the truth: it is the scene {cut} "
        f"({_discretisation(run)}). Its own mesh error is in none of these numbers, and rows that "
        "are nearer to it than that cannot be told apart; nor is the error of the time step, which "
        "all rows share. A finer mesh and a smaller step show how large both are."
    ]
    lost = _lost_share(run)
    if lost is not None:
        found.append(
            f"The time integrator ({scene.time.integrator}, {scene.time.step:g} s) dissipates "
            f"{100 * lost:.0f} % of the work that the loads do on the reference (time error, which "
            "all rows share)."
        )
    return found


def _discretisation(run: Trajectory) -> str:
    return f"element {run.attributes['element']}, mass {run.attributes['mass']}"


def _lost_share(run: Trajectory) -> float | None:
    """Share of the work of loads and clamps that the integrator lost; None if unclear."""
    if run.problem is None or run.problem.scene.time.integrator == "quasi-static":
        return None
    balance = energy_balance(run)
    work = float(balance.external_work[-1] + balance.clamp_work[-1])
    lost = float(balance.dissipation[-1])
    return lost / work if work > lost > 0 else None


def _of_the_best(comparison: Comparison) -> list[str]:
    """Elements of the rows whose names tell another than the scene's."""
    shown = {row.label for row in comparison.rows}
    cases = {case.label: case for case in comparison.cases if case.label in shown}
    better = cases[comparison.reference].base == "best"
    found = []
    for label, case in cases.items():
        if label == comparison.reference or case.model is not None:
            continue
        run = comparison.runs[label]
        if case.element is not None:
            found.append(
                f"{label}: {_discretisation(run)}, on the scene's cells; it has {len(run.points)} "
                "nodes, and its errors are those of the coarse ones among them."
            )
        elif case.base == "best" and better:
            found.append(
                f"{label}: {_discretisation(run)}, as the reference; speed-ups are over that, "
                "which takes longer than a fine mesh of the scene's own element."
            )
        elif case.base == "best":
            found.append(
                f"{label}: {_discretisation(run)}, unlike the reference's. Its errors are "
                "distances from a run of that element and mass, whose own errors are in them: from "
                "a fine mesh of its own element it may be nearer."
            )
    why = without_best(comparison.scene)
    if why and not any(case.base == "best" for case in comparison.cases):
        found.append(f"There is no row of the best coarse model: {why}.")
    return found


def _of_the_solvers(comparison: Comparison) -> list[str]:
    found = []
    if comparison.solver_error is not None:
        best = {c.label for c in comparison.cases if c.base == "best"}
        of_element = " and the element's" if comparison.reference in best else ""
        found.append(
            f"PD and Newton on the coarse mesh differ by at most "
            f"{1e3 * comparison.solver_error:.2g} mm (solver error); the rest of their error is "
            f"the mesh's{of_element}."
        )
    return found + [
        f"{row.label}: {row.unusual_frames} of {_frames(comparison)} frames converged only by a "
        "fallback (Newton-CG or smaller steps), which changes their time error."
        for row in comparison.rows
        if row.unusual_frames
    ]


def _of_the_models(comparison: Comparison) -> list[str]:
    gated = {case.label: case.gate for case in comparison.cases}
    found = [
        f"{label}: trained on scenes of the data set {about['dataset']!r} and with references of "
        "its setting; on others it may be of no use, and "
        + ("its gate need not notice." if gated[label] else "it has no gate.")
        for label, about in comparison.models.items()
    ]
    for row in comparison.rows:
        if not row.refused_frames:
            continue
        counted, meaning = refused_corrections(comparison.runs[row.label].stats)
        found.append(f"{row.label}: {counted}")
        if row.refused_frames == len(comparison.runs[row.label]):
            base = comparison.models[row.label]["base"]
            found.append(
                f"{row.label} is no corrected run: with all corrections refused its steps are "
                f"those of the coarse model that it would correct ({base!r}), to the last bit, "
                "and take longer."
            )
        found.append(f"{row.label}: {meaning[0].lower()}{meaning[1:]}")
    return found


def _of_the_cells(comparison: Comparison) -> list[str]:
    told = {
        row.label: inverted_frames(comparison.runs[row.label].stats, comparison.scene.time.step)
        for row in comparison.rows
    }
    return [f"{label}: {inverted}." for label, inverted in told.items() if inverted]
