"""The pictures of a `Comparison`: bodies side by side and over each other, and plots."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pdcorrect.figures as figures
from pdcorrect.evaluation.compare import Comparison, Row


def draw_figures(comparison: Comparison, folder: Path) -> list[str]:
    """Bodies side by side and over each other, and plots; returns their file names.

    No plot of errors where there is none but the reference's.
    """
    labels = [row.label for row in comparison.rows]
    runs = [comparison.runs[label] for label in labels]
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
    names = ["comparison.png"]
    overlaid = overlaid_labels(comparison)
    if len(overlaid) > 1:
        last = comparison.on_coarse[overlaid[-1]]
        figures.render_overlay(
            [comparison.on_coarse[label] for label in overlaid],
            folder / "overlay.png",
            labels=overlaid,
            frame=int(np.linalg.norm(last.positions - truth.positions, axis=(1, 2)).argmax()),
        )
        names.append("overlay.png")
    point = truth.points[node]
    figures.plot_node_trajectories(runs, folder / "node.png", node_point=point, labels=labels)
    figures.plot_energy(runs, folder / "energy.png", labels=labels)
    relative = comparison.converged is not None
    marks = {row.label: (row.seconds_a_frame, _error(row)) for row in comparison.rows}
    marks = {label: mark for label, mark in marks.items() if mark[1] > 0}
    if marks:
        names += ["error_against_time.png", "error_over_time.png"]
        figures.plot_error_over_time(
            comparison.errors_over_time(),
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
    """Lines above a body."""
    error = f"RMS error {1e3 * row.rms_error:.2g} mm"
    if row.relative_error is not None:
        error = f"error {100.0 * row.relative_error:.3g} %"
    elif row.label == comparison.reference:
        error = "reference"
    lines = [
        f"{row.label}, {row.nodes} nodes",
        f"{error}, {1e3 * row.seconds_a_frame:.3g} ms a frame",
    ]
    if row.refused_frames:
        lines.append(f"{row.refused_frames} of {len(comparison.runs[row.label])} refused")
    return "\n".join(lines)
