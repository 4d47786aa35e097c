"""A `Comparison` as Markdown, CSV, JSON and figures."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import pdcorrect.figures as figures
from pdcorrect.environment import environment
from pdcorrect.evaluate import Comparison, Row
from pdcorrect.metrics import energy_balance, largest_displacement
from pdcorrect.replacement import make_folder, write_text
from pdcorrect.scene import Scene
from pdcorrect.state import Status, Trajectory

HEADINGS = (
    "solver", "nodes", "RMS mm", "worst mm", "corrected", "ms/frame", "speed-up", "iter."
)  # fmt: skip


def table(comparison: Comparison) -> list[tuple[str, ...]]:
    """The comparison as rows of text under `HEADINGS`."""
    reference_seconds = next(
        r for r in comparison.rows if r.label == comparison.reference
    ).seconds_a_frame
    lines: list[tuple[str, ...]] = []
    for row in comparison.rows:
        is_reference = row.label == comparison.reference
        lines.append(
            (
                row.label,
                str(row.nodes),
                "ref." if is_reference else f"{1e3 * row.rms_error:.3g}",
                "ref." if is_reference else f"{1e3 * row.largest_error:.3g}",
                "ref." if is_reference else _percent(row.omega),
                f"{1e3 * row.seconds_a_frame:.3g}",
                f"{reference_seconds / row.seconds_a_frame:.3g}x",
                f"{row.iterations_a_frame:.1f}",
            )
        )
    rest = ("",) * (len(HEADINGS) - 3)
    lines += [(label, "", "failed", *rest) for label in comparison.failures]
    return lines


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{round(share, 1) + 0.0:.1f} %"  # no minus zero


def _elsewhere(scene: Scene) -> str:
    """What a scene's regions change of its material."""
    count = len(scene.materials)
    return f"; {count} region{'s' if count > 1 else ''} with other values" if count else ""


def notes(comparison: Comparison) -> list[str]:
    """What the table's numbers mean on this scene, one sentence each."""
    scene = comparison.scene
    effective = scene.material.effective
    moved = largest_displacement(comparison.on_coarse[comparison.reference])
    frames = len(comparison.runs[comparison.reference])
    out = [
        f"{frames} frames of {scene.time.step:g} s; the reference moves by up to "
        f"{1e3 * moved:.3g} mm. Errors (RMS, worst) are distances of the coarse nodes from the "
        f"reference, {comparison.reference}, with the same time step, over all frames. Times and "
        "iterations are for one frame.",
        f"Material: E = {scene.material.young:.6g} Pa and Poisson's ratio "
        f"{scene.material.poisson:g} asked for; the energy's small-strain moduli are "
        f"E = {effective.young:.6g} Pa and {effective.poisson:.4g} "
        f"(volume weight '{scene.material.volume_weight}'){_elsewhere(scene)}.",
        f"Of the scene itself: element {scene.solver.element}, mass {scene.solver.mass}, time "
        f"integrator {scene.time.integrator}. They are those of all rows whose names do not tell "
        "another.",
        f"Solver tolerance: {scene.solver.tolerance:g} of the coarse cell size for PD, 1e-10 for "
        "Newton.",
    ]
    if any(np.isfinite(row.omega) for row in comparison.rows):
        out[-1] += (
            " 'Corrected' is the share of the coarse PD run's squared error that is gone (eq. 7-2)."
        )
    out += [
        f"{label} failed and has no errors or times: {why}"
        for label, why in comparison.failures.items()
    ]
    lost = _lost_share(comparison.runs[comparison.reference])
    if lost is not None:
        out.append(
            f"The time integrator ({scene.time.integrator}, {scene.time.step:g} s) dissipates "
            f"{100 * lost:.0f} % of the work that the loads do on the reference (time error, which "
            "all rows share)."
        )
    if comparison.solver_error is not None:
        best = {c.label for c in comparison.cases if c.base == "best"}
        of_element = " and the element's" if comparison.reference in best else ""
        out.append(
            f"PD and Newton on the coarse mesh differ by at most "
            f"{1e3 * comparison.solver_error:.2g} mm (solver error); the rest of their error is "
            f"the mesh's{of_element}."
        )
    out += [
        f"{row.label}: {row.unusual_frames} of {frames} frames converged only by a fallback "
        "(Newton-CG or smaller steps), which changes their time error."
        for row in comparison.rows
        if row.unusual_frames
    ]
    gated = {case.label: case.gate for case in comparison.cases}
    out += [
        f"{label}: trained on scenes of the data set {about['dataset']!r} and with references of "
        "its setting; on others it may be of no use, and "
        + ("its gate need not notice." if gated[label] else "it has no gate.")
        for label, about in comparison.models.items()
    ]
    out += [
        f"{row.label}: {row.refused_frames} of {frames} corrections were refused by the gate "
        f"({_reasons(comparison.runs[row.label].stats)})."
        for row in comparison.rows
        if row.refused_frames
    ]
    for row in comparison.rows:
        inverted = inverted_frames(comparison.runs[row.label].stats, scene.time.step)
        if inverted:
            out.append(f"{row.label}: {inverted}.")
    return out


def _reasons(stats: Mapping[str, Any]) -> str:
    """Why a gate refused corrections, as "2 by features, 1 by energy"."""
    from pdcorrect.corrector.gate import refusals

    found = refusals(stats["gate"])
    return ", ".join(f"{count} by {reason}" for reason, count in found.items() if count)


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


def _lost_share(run: Trajectory) -> float | None:
    """Share of the work of loads and clamps that the integrator lost; None if unclear."""
    if run.problem is None or run.problem.scene.time.integrator == "quasi-static":
        return None
    balance = energy_balance(run)
    work = float(balance.external_work[-1] + balance.clamp_work[-1])
    lost = float(balance.dissipation[-1])
    return lost / work if work > lost > 0 else None


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


def draw_figures(comparison: Comparison, folder: Path) -> list[str]:
    """Bodies side by side and over each other, and plots; returns their file names.

    No plot of errors where there is none but the reference's.
    """
    runs = [comparison.runs[row.label] for row in comparison.rows]
    labels = [row.label for row in comparison.rows]
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
            labels=overlaid,
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
            comparison.errors_over_time(), truth.times, folder / "error_over_time.png"
        )
        figures.plot_error_against_time(
            {r.label: (r.seconds_a_frame, r.rms_error) for r in comparison.rows if r.rms_error > 0},
            folder / "error_against_time.png",
        )
    return [*names, "node.png", "energy.png"]


def overlaid_labels(comparison: Comparison) -> list[str]:
    """Which runs are drawn over each other: the reference, what is near it, and the coarse mesh.

    What is near it is the nearest corrector or better coarse model; without any, the nearest finer
    mesh.  Runs that the comparison does not have are left out.
    """
    errors = {row.label: row.rms_error for row in comparison.rows}
    cases = [case for case in comparison.cases if case.label in errors]
    plain = [c.label for c in cases if c.plain and c.solver == "pd"]
    finer = [c.label for c in cases if c.refine > 1 and c.label != comparison.reference]
    better = [c.label for c in cases if c.refine == 1 and (c.model or c.base != "plain")] or finer
    nearest = sorted(better, key=lambda label: errors[label])[:1]
    return list(dict.fromkeys([comparison.reference, *nearest, *plain[:1]]))


def _panel_label(comparison: Comparison, row: Row) -> str:
    error = (
        "reference"
        if row.label == comparison.reference
        else f"RMS error {1e3 * row.rms_error:.2g} mm"
    )
    ms = 1e3 * row.seconds_a_frame
    time = f"{ms:.3g}" if ms < 999.5 else f"{ms:.0f}"  # no powers of ten
    return f"{row.label}, {row.nodes} nodes\n{error}, {time} ms a frame"
