"""The pictures of a `Comparison`: bodies side by side and over each other, and plots."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pdcorrect.figures as figures
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.report_table import (
    refused_share,
    relative_text,
    shown_labels,
    three_digits,
)


def draw_figures(comparison: Comparison, folder: Path) -> list[str]:
    """Bodies side by side and over each other, and plots; returns their file names.

    No plot of errors where there is none but the reference's.
    """
    runs = [comparison.runs[row.label] for row in comparison.rows]
    shown = shown_labels(comparison)
    labels = [*shown.values()]
    truth = comparison.on_coarse[comparison.reference]
    distance = np.linalg.norm(truth.positions - truth.points, axis=2)
    frame, node = np.unravel_index(int(distance.argmax()), distance.shape)
    figures.render(
        runs,
        folder / "comparison.png",
        labels=[_panel_label(comparison, row) for row in comparison.rows],
        colour="displacement",
        frame=int(frame),
    )
    overlaid = overlaid_labels(comparison)
    if len(overlaid) > 1:
        last = comparison.on_coarse[overlaid[-1]]
        figures.render_overlay(
            [comparison.on_coarse[label] for label in overlaid],
            folder / "overlay.png",
            labels=[shown[label] for label in overlaid],
            frame=int(np.linalg.norm(last.positions - truth.positions, axis=(1, 2)).argmax()),
        )
    figures.plot_node_trajectories(
        runs, folder / "node.png", node_point=truth.points[node], labels=labels
    )
    figures.plot_energy(runs, folder / "energy.png", labels=labels)
    names = ["comparison.png", *(["overlay.png"] if len(overlaid) > 1 else [])]
    marks = {
        shown[row.label]: (row.seconds_a_frame, error)
        for row in comparison.rows
        if (error := _error(row)) > 0
    }
    if marks:
        names += ["error_against_time.png", "error_over_time.png"]
        relative = comparison.converged is not None
        figures.plot_error_over_time(
            {shown[label]: errors for label, errors in comparison.errors_over_time().items()},
            truth.times,
            folder / "error_over_time.png",
            "converged motion" if relative else "reference",
        )
        figures.plot_error_against_time(marks, folder / "error_against_time.png", relative)
    return [*names, "node.png", "energy.png"]


def _error(row: Row) -> float:
    """That which comes first: to the converged motion, or else from the reference, m."""
    return row.rms_error if row.relative_error is None else row.relative_error


def overlaid_labels(comparison: Comparison) -> list[str]:
    """Which runs are drawn over each other: the reference, what is near it, and the coarse mesh.

    What is near it is the nearest corrector or better coarse model; without any, the nearest with
    more nodes.  Runs that the comparison does not have are left out.
    """
    errors = {row.label: row.rms_error for row in comparison.rows}
    cases = [case for case in comparison.cases if case.label in errors]
    plain = [c.label for c in cases if c.plain and c.solver == "pd"]
    others = [c for c in cases if c.label != comparison.reference]
    finer = [c.label for c in others if c.refine > 1 or c.element is not None]
    better = [c.label for c in cases if c.refine == 1 and (c.model or c.base != "plain")] or finer
    nearest = sorted(better, key=lambda label: errors[label])[:1]
    return list(dict.fromkeys([comparison.reference, *nearest, *plain[:1]]))


def _panel_label(comparison: Comparison, row: Row) -> str:
    """Lines above a body; a line more is narrower than a longer name."""
    error = f"RMS error {1e3 * row.rms_error:.2g} mm"
    if row.relative_error is not None:
        error = f"error {relative_text(row.relative_error)}"
    elif row.label == comparison.reference:
        error = "reference"
    time = three_digits(1e3 * row.seconds_a_frame)
    refused = refused_share(comparison, row)
    return f"{row.label}, {row.nodes} nodes\n{error}, {time} ms a frame" + (
        f"\n{refused}" if refused else ""
    )
