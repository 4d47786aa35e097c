"""A `Comparison` as Markdown, CSV, JSON and figures."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np

import pdcorrect.figures as figures
from pdcorrect._environment import environment
from pdcorrect._files import make_folder, write_text
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.report_notes import notes, refused_share, shown_labels
from pdcorrect.evaluation.run_text import inverted_frames, three_digits
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series
from pdcorrect.trajectory import Trajectory

__all__ = [
    "HEADINGS", "draw_figures", "inverted_frames", "notes", "overlaid_labels", "table", "to_csv",
    "to_json", "to_markdown", "write_report", "write_series",
]  # fmt: skip

VTU = "vtu"
"""Folder, inside a report's, of what `write_series` writes."""

HEADINGS = (
    "solver", "nodes", "RMS mm", "worst mm", "corrected", "ms/frame", "speed-up", "iter."
)  # fmt: skip


def table(comparison: Comparison) -> list[tuple[str, ...]]:
    """The comparison as rows of text under `HEADINGS`."""
    reference_seconds = next(
        r for r in comparison.rows if r.label == comparison.reference
    ).seconds_a_frame
    lines: list[tuple[str, ...]] = []
    shown = shown_labels(comparison)
    for row in comparison.rows:
        is_reference = row.label == comparison.reference
        lines.append(
            (
                shown[row.label],
                str(row.nodes),
                "ref." if is_reference else f"{1e3 * row.rms_error:.3g}",
                "ref." if is_reference else f"{1e3 * row.largest_error:.3g}",
                "ref." if is_reference else _percent(row.omega),
                three_digits(1e3 * row.seconds_a_frame),
                f"{three_digits(reference_seconds / row.seconds_a_frame)}x",
                f"{row.iterations_a_frame:.1f}",
            )
        )
    rest = ("",) * (len(HEADINGS) - 3)
    lines += [(label, "", "failed", *rest) for label in comparison.failures]
    return lines


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{round(share, 1) + 0.0:.1f} %"  # no minus zero


def to_markdown(comparison: Comparison, pictures: list[str]) -> str:
    """The whole report as Markdown."""
    lines = [f"# {comparison.scene.name}", ""]
    lines += [f"![{name}]({name})" for name in pictures[:1]] + [""]
    lines += ["| " + " | ".join(HEADINGS) + " |", "|---|" + "---:|" * (len(HEADINGS) - 1)]
    lines += ["| " + " | ".join(cells) + " |" for cells in table(comparison)]
    lines += ["", *[f"- {note}" for note in notes(comparison)], ""]
    lines += [f"![{name}]({name})\n" for name in pictures[1:]]
    lines += ["Measured on: " + ", ".join(f"{k} {v}" for k, v in environment().items()) + ".", ""]
    return "\n".join(lines)


def to_csv(comparison: Comparison) -> str:
    """All numbers in SI units, one line a solver; of those that failed label and reason."""
    buffer = io.StringIO()
    names = [field.name for field in dataclasses.fields(Row)]
    writer = csv.DictWriter(buffer, [*names, "failure"], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(dataclasses.asdict(row) for row in comparison.rows)
    writer.writerows({"label": k, "failure": why} for k, why in comparison.failures.items())
    return buffer.getvalue()


def to_json(comparison: Comparison) -> str:
    """Numbers, scene and environment."""
    rows = [
        {k: None if v != v else v for k, v in dataclasses.asdict(row).items()}
        for row in comparison.rows
    ]
    record = {
        "scene": comparison.scene.to_toml(),
        "reference": comparison.reference,
        "solver_error": comparison.solver_error,
        "notes": notes(comparison),
        "cases": [dataclasses.asdict(case) for case in comparison.cases],
        "models": dict(comparison.models),
        "failures": dict(comparison.failures),
        "rows": rows,
        "environment": environment(),
    }
    return json.dumps(record, indent=2, allow_nan=False)


def write_report(comparison: Comparison, folder: str | Path, draw: bool = True) -> Path:
    """Write report.md, report.csv, report.json and, if ``draw``, the figures.

    Returns
    -------
    Path
        Of the Markdown file.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    folder = make_folder(folder)
    write_text(folder / "report.csv", to_csv(comparison))
    write_text(folder / "report.json", to_json(comparison))
    write_text(folder / "report.md", to_markdown(comparison, []))
    if draw:
        pictures = draw_figures(comparison, folder)
        write_text(folder / "report.md", to_markdown(comparison, pictures))
    return folder / "report.md"


def write_series(comparison: Comparison, folder: str | Path) -> list[Path]:
    """Write every run for ParaView, with stress, into ``vtu`` inside a report's folder.

    Series of an earlier report there, of rows that this one does not have, are deleted.

    Returns
    -------
    list of Path
        PVD files, in the order of the rows, with the rows' labels in small letters and dashes.

    Raises
    ------
    OutputError
        If they cannot be written.
    """
    target = make_folder(Path(folder) / VTU)
    runs = _named_runs(comparison)
    for stale in {path.stem for path in target.glob("*.pvd")} - set(runs):
        delete_vtu_series(target, stale)
    return [
        write_vtu_series(run, target, name=name, stress_of=run.problem)
        for name, run in runs.items()
    ]


def _named_runs(comparison: Comparison) -> dict[str, Trajectory]:
    """Runs of the rows by the names of their files."""
    found: dict[str, Trajectory] = {}
    for row in comparison.rows:
        name = _file_name(row.label)
        while name in found:  # labels that differ in other signs only
            name += "-again"
        found[name] = comparison.runs[row.label]
    return found


def _file_name(label: str) -> str:
    return re.sub(r"[^a-z0-9.]+", "-", label.lower()).strip("-.") or "run"


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
    if any(row.rms_error > 0 for row in comparison.rows):
        names += ["error_against_time.png", "error_over_time.png"]
        figures.plot_error_over_time(
            {shown[label]: errors for label, errors in comparison.errors_over_time().items()},
            truth.times,
            folder / "error_over_time.png",
        )
        figures.plot_error_against_time(
            {
                shown[row.label]: (row.seconds_a_frame, row.rms_error)
                for row in comparison.rows
                if row.rms_error > 0
            },
            folder / "error_against_time.png",
        )
    return [*names, "node.png", "energy.png"]


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
    error = (
        "reference"
        if row.label == comparison.reference
        else f"RMS error {1e3 * row.rms_error:.2g} mm"
    )
    time = three_digits(1e3 * row.seconds_a_frame)
    refused = refused_share(comparison, row)
    return f"{row.label}, {row.nodes} nodes\n{error}, {time} ms a frame" + (
        f"\n{refused}" if refused else ""
    )
