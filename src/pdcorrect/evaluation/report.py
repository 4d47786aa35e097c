"""A `Comparison` as Markdown, CSV, JSON, figures and files for ParaView."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

from pdcorrect._environment import environment
from pdcorrect._files import make_folder, write_text
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.report_figures import draw_figures, overlaid_labels
from pdcorrect.evaluation.report_notes import (
    gained_energy,
    grouped,
    inverted_frames,
    notes,
    refused_corrections,
)
from pdcorrect.evaluation.report_table import headings, table, three_digits
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series
from pdcorrect.trajectory import Trajectory

__all__ = [
    "VTU", "draw_figures", "gained_energy", "grouped", "headings", "inverted_frames", "notes",
    "overlaid_labels",
    "refused_corrections", "table", "three_digits", "to_csv", "to_json", "to_markdown",
    "write_report", "write_series",
]  # fmt: skip

VTU = "vtu"
"""Folder, inside a report's, of what `write_series` writes."""


def to_markdown(comparison: Comparison, pictures: list[str]) -> str:
    """The whole report as Markdown."""
    lines = [f"# {comparison.scene.name}", ""]
    lines += [f"![{name}]({name})" for name in pictures[:1]] + [""]
    names = headings(comparison)
    lines += ["| " + " | ".join(names) + " |", "|---|" + "---:|" * (len(names) - 1)]
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
        "converged": None if (run := comparison.converged) is None else dict(run.attributes),
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
