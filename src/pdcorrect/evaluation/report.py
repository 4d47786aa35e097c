"""A `Comparison` as Markdown, CSV, JSON, figures and files for ParaView; notes on runs."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pdcorrect.figures as figures
from pdcorrect._environment import environment
from pdcorrect._files import make_folder, write_text
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.converged import MESH_ERROR, TIME_ERROR
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series
from pdcorrect.metrics import largest_displacement, probes
from pdcorrect.solvers.rollout import inverted_frames
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]

VTU = "vtu"
"""Folder, inside a report's, of what `write_series` writes."""
_NOT_UNIQUE = 100.0
"""Tolerances by which PD and Newton differ where they have taken different branches."""

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
    """Write report.md, report.csv, report.json and, if ``draw``, figures; path of the first."""
    folder = make_folder(folder)
    write_text(folder / "report.csv", to_csv(comparison))
    write_text(folder / "report.json", to_json(comparison))
    write_text(folder / "report.md", to_markdown(comparison, []))
    if draw:
        pictures = draw_figures(comparison, folder)
        write_text(folder / "report.md", to_markdown(comparison, pictures))
    return folder / "report.md"


def write_series(comparison: Comparison, folder: str | Path) -> list[Path]:
    """Write every run for ParaView, with stress, into ``vtu`` inside a report's folder; PVD files.

    They are called by the rows' labels in small letters and dashes.  Series of an earlier report,
    of rows that this one does not have, are deleted.
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


# --- figures -----------------------------------------------------------------------------


def draw_figures(comparison: Comparison, folder: Path) -> list[str]:
    """Bodies side by side and over each other, and plots; returns their file names.

    No plot of errors where there is none but the reference's.
    """
    labels = [row.label for row in comparison.rows]
    runs = [comparison.runs[label] for label in labels]
    truth = comparison.on_coarse[comparison.reference]
    distance = np.linalg.norm(truth.positions - truth.points, axis=2)
    frame = int(distance.max(axis=1).argmax())
    figures.render(
        runs,
        folder / "comparison.png",
        labels=[_panel_label(comparison, row) for row in comparison.rows],
        colour="displacement",
        frame=frame,
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
    names += _draw_places(comparison, distance, folder)
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
    return [*names, "energy.png"]


def _draw_places(comparison: Comparison, distance: Array, folder: Path) -> list[str]:
    """Displacements of the scene's probes, or else of the free node that moves farthest."""
    runs = {row.label: comparison.runs[row.label] for row in comparison.rows}
    if not comparison.scene.probes:
        problem = next(iter(runs.values())).problem
        if problem is not None:
            distance = distance * problem.free[problem.mesh.coarse_nodes].all(axis=1)
        point = comparison.on_coarse[comparison.reference].points[distance.max(axis=0).argmax()]
        figures.plot_node_trajectories(
            list(runs.values()), folder / "node.png", node_point=point, labels=list(runs)
        )
        return ["node.png"]
    found = {label: probes(run) for label, run in runs.items()}
    names = []
    for number, probe in enumerate(comparison.scene.probes):
        names.append(f"probe_{number}.png")
        figures.plot_displacements(
            {label: (run.times, found[label][probe.name]) for label, run in runs.items()},
            folder / names[-1],
            title=probe.name,
        )
    return names


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


# --- notes -------------------------------------------------------------------------------


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

    ``reasons`` are numbers of `pdcorrect.corrector.gate.Reason`, 0 where a step was corrected.
    """
    from pdcorrect.corrector.gate import refusals

    every = list(reasons)
    found = refusals(every)
    if not found:
        return ""
    counts = ", ".join(f"{one.steps} because {one.reason.meaning}" for one in found)
    return f"{sum(one.steps for one in found)} of {len(every)} corrections were refused ({counts})."
