"""A `Comparison` as Markdown, CSV, JSON, figures and files for ParaView."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np

from pdcorrect._environment import environment
from pdcorrect._files import make_folder, write_text
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.report_figures import draw_figures
from pdcorrect.evaluation.report_notes import notes
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series
from pdcorrect.trajectory import Trajectory

VTU = "vtu"
"""Folder, inside a report's, of what `write_series` writes."""

# --- the table ---------------------------------------------------------------------------


def table(comparison: Comparison) -> list[dict[str, str]]:
    """The comparison as rows of text by heading; the first error is that which is asked for.

    "error" is relative and to the converged motion, "estimated" the same to a finer run; others
    are from the reference.  "corrected" is the share of the scene's own coarse PD run's squared
    error that is gone.
    """
    by_label = {row.label: row for row in comparison.rows}
    reference = by_label[comparison.reference]
    found = []
    for row in comparison.rows:
        distances = {
            "RMS mm": f"{1e3 * row.rms_error:.3g}",
            "worst mm": f"{1e3 * row.largest_error:.3g}",
            "corrected": "" if np.isnan(row.omega) else f"{round(row.omega, 1) + 0.0:.1f} %",
        }
        cells = {"solver": shown_label(comparison, row)}
        if comparison.finer is not None:
            cells["estimated"] = _percent(row.estimated_error)
        if comparison.converged is not None:
            cells["error"] = _percent(row.relative_error)
        found.append({
            **cells,
            **(dict.fromkeys(distances, "ref.") if row is reference else distances),
            "ms/frame": three_digits(1e3 * row.seconds_a_frame),
            "speed-up": f"{three_digits(reference.seconds_a_frame / row.seconds_a_frame)}x",
            "iter.": f"{row.iterations_a_frame:.1f}",
            "nodes": str(row.nodes),
        })  # fmt: skip
    none = dict.fromkeys(found[0], "")
    failed = "RMS mm" if comparison.converged is None else "error"
    return [*found, *({**none, "solver": x, failed: "failed"} for x in comparison.failures)]


def _percent(share: float | None) -> str:
    return "" if share is None else f"{three_digits(100.0 * share)} %"


def three_digits(value: float) -> str:
    """A number with three significant digits and without powers of ten where it is large."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def shown_label(comparison: Comparison, row: Row) -> str:
    """A label for readers: of a hybrid also how many of its corrections were refused."""
    if not row.refused_frames:
        return row.label
    frames = len(comparison.runs[row.label])
    share = "all" if row.refused_frames == frames else f"{row.refused_frames} of {frames}"
    return f"{row.label} ({share} refused)"


# --- files -------------------------------------------------------------------------------


def to_markdown(comparison: Comparison, pictures: list[str]) -> str:
    """The whole report as Markdown."""
    rows = table(comparison)
    lines = [f"# {comparison.scene.name}", ""]
    lines += [f"![{name}]({name})" for name in pictures[:1]] + [""]
    lines += ["| " + " | ".join(rows[0]) + " |", "|---|" + "---:|" * (len(rows[0]) - 1)]
    lines += ["| " + " | ".join(row.values()) + " |" for row in rows]
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
    runs: dict[str, Trajectory] = {}
    for row in comparison.rows:
        name = re.sub(r"[^a-z0-9.]+", "-", row.label.lower()).strip("-.") or "run"
        while name in runs:  # labels that differ in other signs only
            name += "-again"
        runs[name] = comparison.runs[row.label]
    for stale in {path.stem for path in target.glob("*.pvd")} - set(runs):
        delete_vtu_series(target, stale)
    return [
        write_vtu_series(run, target, name=name, stress_of=run.problem)
        for name, run in runs.items()
    ]
