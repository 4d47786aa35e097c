"""A `Comparison` as a page, CSV, JSON, figures and files for ParaView; notes on runs."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

import pdcorrect.figures as figures
from pdcorrect._environment import environment
from pdcorrect._files import make_folder, write_text
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.converged import MESH_ERROR, TIME_ERROR
from pdcorrect.evaluation.page import PAGE, write_page
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series
from pdcorrect.metrics import largest_displacement, probes
from pdcorrect.scene import Scene
from pdcorrect.solvers.rollout import inverted_frames
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]

TABLE, RECORD = "report.csv", "report.json"
FILES = (PAGE, TABLE, RECORD)
"""That every report has."""
VTU = "vtu"
"""Folder, inside a report's, of what `write_series` writes."""
_NOT_UNIQUE = 100.0
"""Tolerances by which PD and Newton differ where they have taken different branches."""

# --- the table ---------------------------------------------------------------------------


def table(comparison: Comparison) -> list[dict[str, str]]:
    """The comparison as rows of text by heading; the first error is that which is asked for.

    "error" is relative and to the converged motion, "estimated" the same to a finer run; others
    are from the reference.  "corrected" is `Row.omega`, the share of a squared error that is gone.
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
    """Write index.html, report.csv, report.json and, if ``draw``, figures; path of the first.

    The page holds its figures, so it needs no other file.
    """
    folder = make_folder(folder)
    write_text(folder / TABLE, to_csv(comparison))
    write_text(folder / RECORD, to_json(comparison))

    def page(pictures: Mapping[str, str]) -> Path:
        rows, sentences = table(comparison), notes(comparison)
        return write_page(folder / PAGE, comparison.scene.name, rows, sentences, pictures)

    page({})  # what drawing may not come to
    return page(draw_figures(comparison, folder)) if draw else folder / PAGE


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


def draw_figures(comparison: Comparison, folder: Path) -> dict[str, str]:
    """Bodies in motion, side by side and over each other, and plots; captions by file name.

    No plot of errors where there is none but the reference's.
    """
    labels = [row.label for row in comparison.rows]
    runs = {label: comparison.runs[label] for label in labels}
    truth = comparison.on_coarse[comparison.reference]
    distance = np.linalg.norm(truth.positions - truth.points, axis=2)
    frame = int(distance.max(axis=1).argmax())
    figures.render(
        list(runs.values()),
        folder / "comparison.png",
        labels=[_panel_label(comparison, row) for row in comparison.rows],
        colour="displacement",
        frame=frame,
    )
    found = _animate(comparison, folder)
    found["comparison.png"] = "All runs where the reference has moved farthest."
    overlaid = overlaid_labels(comparison)
    if len(overlaid) > 1:
        last = comparison.on_coarse[overlaid[-1]]
        figures.render_overlay(
            [comparison.on_coarse[label] for label in overlaid],
            folder / "overlay.png",
            labels=overlaid,
            frame=int(np.linalg.norm(last.positions - truth.positions, axis=(1, 2)).argmax()),
        )
        found["overlay.png"] = "Runs over each other where the last of them is farthest away."
    problem = next(iter(runs.values())).problem
    free = True if problem is None else problem.free[problem.mesh.coarse_nodes].all(axis=1)
    found |= draw_places(runs, comparison.scene, farthest_point(truth, free), folder)
    relative = comparison.converged is not None
    marks = {row.label: (row.seconds_a_frame, _error(row)) for row in comparison.rows}
    marks = {label: mark for label, mark in marks.items() if mark[1] > 0}
    if marks:
        figures.plot_error_against_time(marks, folder / "error_against_time.png", relative)
        found["error_against_time.png"] = "Error against run time."
        figures.plot_error_over_time(
            comparison.errors_over_time(),
            truth.times,
            folder / "error_over_time.png",
            "converged motion" if relative else "reference",
        )
        found["error_over_time.png"] = "Error over time."
    figures.plot_energy(list(runs.values()), folder / "energy.png", labels=labels)
    return {**found, "energy.png": "Energies, and work so far."}


def _animate(comparison: Comparison, folder: Path) -> dict[str, str]:
    """The motion of all runs on the coarse mesh, coloured by error where there is one."""
    truth, name = comparison.converged, "the converged motion"
    if truth is None:
        truth, name = comparison.on_coarse[comparison.reference], comparison.reference
    labels = [row.label for row in comparison.rows]
    judged = [x for x in labels if comparison.converged or x != comparison.reference]
    frames = film_frames(len(truth.times))
    figures.render(
        [comparison.on_coarse[label] for label in judged or labels],
        folder / "motion.gif",
        labels=judged or labels,
        colour="error" if judged else "displacement",
        reference=truth,
        frame=frames,
        fps=len(frames) / 3,
    )
    by = f"distance from {name}" if judged else "displacement"
    return {"motion.gif": f"The motion, coloured by {by}."}


def film_frames(count: int) -> list[int]:
    """Up to forty of so many frames, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, 40)).round().astype(int)).tolist()


def farthest_point(run: Trajectory, free: ArrayLike = True) -> Array:
    """Where the node is at rest that moves farthest, (3,), m, among ``free`` ones (N,)."""
    distance = np.linalg.norm(run.positions - run.points, axis=2).max(axis=0)
    return run.points[(distance * np.asarray(free)).argmax()]


def draw_places(
    runs: Mapping[str, Trajectory], scene: Scene, point: Array, folder: Path
) -> dict[str, str]:
    """Displacements of the scene's probes, or else of the node at a point (m); captions by file."""
    if not scene.probes:
        figures.plot_node_trajectories(
            list(runs.values()), folder / "node.png", node_point=point, labels=list(runs)
        )
        return {"node.png": "Displacement of the node that moves farthest."}
    found = {label: probes(run) for label, run in runs.items()}
    captions = {}
    for number, probe in enumerate(scene.probes):
        name = f"probe_{number}.png"
        figures.plot_displacements(
            {label: (run.times, found[label][probe.name]) for label, run in runs.items()},
            folder / name,
            title=probe.name,
        )
        captions[name] = f"Displacement of the probe {probe.name}."
    return captions


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
