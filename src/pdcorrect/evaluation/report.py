"""A `Comparison` as Markdown, CSV, JSON and figures."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import pdcorrect.figures as figures
from pdcorrect._environment import environment
from pdcorrect._files import make_folder, write_text
from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.converged import MESH_ERROR, TIME_ERROR
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series
from pdcorrect.metrics import energy_balance, largest_displacement, rms_error
from pdcorrect.state import Status
from pdcorrect.trajectory import Trajectory

VTU = "vtu"
"""Folder, inside a report's, of what `write_series` writes."""

_NOT_UNIQUE = 100.0
"""Tolerances by which PD and Newton differ where they have taken different branches."""

_HEADINGS = (
    "solver", "nodes", "RMS mm", "worst mm", "corrected", "ms/frame", "speed-up", "iter."
)  # fmt: skip
_CONVERGED_FIRST = (
    "solver", "error", "ms/frame", "speed-up", "corrected", "RMS mm", "worst mm", "nodes", "iter."
)  # fmt: skip


def headings(comparison: Comparison) -> tuple[str, ...]:
    """Of `table`; where there is a converged motion, first the error to it."""
    return _HEADINGS if comparison.converged is None else _CONVERGED_FIRST


def table(comparison: Comparison) -> list[tuple[str, ...]]:
    """The comparison as rows of text under `headings`."""
    order = headings(comparison)
    seconds = {row.label: row.seconds_a_frame for row in comparison.rows}[comparison.reference]
    shown = shown_labels(comparison)
    found = [
        {"solver": shown[row.label], **_cells(row, seconds, row.label == comparison.reference)}
        for row in comparison.rows
    ]
    failed = "error" if "error" in order else "RMS mm"
    found += [{"solver": label, failed: "failed"} for label in comparison.failures]
    return [tuple(cells.get(name, "") for name in order) for cells in found]


def _cells(row: Row, reference_seconds: float, is_reference: bool) -> dict[str, str]:
    distances = {
        "RMS mm": f"{1e3 * row.rms_error:.3g}",
        "worst mm": f"{1e3 * row.largest_error:.3g}",
        "corrected": _percent(row.omega),
    }
    return {
        "error": "" if row.relative_error is None else _relative(row.relative_error),
        "nodes": str(row.nodes),
        **(dict.fromkeys(distances, "ref.") if is_reference else distances),
        "ms/frame": three_digits(1e3 * row.seconds_a_frame),
        "speed-up": f"{three_digits(reference_seconds / row.seconds_a_frame)}x",
        "iter.": f"{row.iterations_a_frame:.1f}",
    }


def _relative(share: float) -> str:
    return f"{three_digits(100.0 * share)} %"


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{round(share, 1) + 0.0:.1f} %"  # no minus zero


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
        f"{_of_the_converged(comparison)}RMS and worst are distances "
        f"of the coarse nodes from {comparison.reference}, which moves by up to "
        f"{1e3 * largest_displacement(truth):.3g} mm; 'corrected' is the share of the coarse PD "
        "run's squared error that is gone."
    )


def _of_the_converged(comparison: Comparison) -> str:
    """What relative errors are of, and how exact that is itself if it is known."""
    run = comparison.converged
    if run is None:
        return ""
    size = rms_error(np.broadcast_to(run.points, run.positions.shape), run)
    known = [
        f"{name} {_relative(float(run.attributes[key]))}"
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
            refused = refused_corrections(run.stats["gate"], run.attributes["trained_step"])
            text = f"{text} {refused}".strip()
        told.append((label, text))
    return " ".join(grouped(told))


def grouped(told: Iterable[tuple[str, str]]) -> list[str]:
    """Sentences with the names that they are told of, each sentence once."""
    names: dict[str, list[str]] = {}
    for name, text in told:
        names.setdefault(text, []).append(name)
    return [f"{', '.join(every)}: {text}" for text, every in names.items()]


def refused_corrections(reasons: Iterable[float], trained_step: str = "", runs: int = 1) -> str:
    """One sentence: how many corrections were refused, and why; empty if none was.

    Parameters
    ----------
    reasons : iterable of numbers of `pdcorrect.corrector.gate.Reason`
        Of each step, 0 where it was corrected.
    trained_step : str
        See `HybridStepper.trained_step`; told where it is the reason.
    runs : int
        Of which the steps are.
    """
    from pdcorrect.corrector.gate import Reason, refusals

    every = list(reasons)
    found = refusals(every)
    if not found:
        return ""
    total = sum(one.steps for one in found)
    counts = ", ".join(f"{one.steps} because {one.reason.meaning}" for one in found)
    if trained_step and any(one.reason is Reason.TIME_STEP for one in found):
        counts += f", {trained_step} for cells of this size"
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


def three_digits(value: float) -> str:
    """A number with three significant digits and without powers of ten where it is large."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


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
        error = f"error {_relative(row.relative_error)}"
    elif row.label == comparison.reference:
        error = "reference"
    time = three_digits(1e3 * row.seconds_a_frame)
    refused = refused_share(comparison, row)
    return f"{row.label}, {row.nodes} nodes\n{error}, {time} ms a frame" + (
        f"\n{refused}" if refused else ""
    )
