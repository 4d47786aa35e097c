"""Results of an evaluation, summed up over trajectories, as tables, CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pdcorrect._files import make_folder, write_text
from pdcorrect.data.schema import REFERENCE
from pdcorrect.evaluation.evaluation import EvaluatedRun, Evaluation
from pdcorrect.evaluation.measures import TrajectoryMeasures

VERSION = 1
"""Of ``summary.json``."""
SUMMARY, TRAJECTORIES, ERRORS, TABLE = "summary.json", "trajectories.csv", "errors.csv", "table.md"
FILES = (SUMMARY, TRAJECTORIES, ERRORS, TABLE)
"""Of an evaluation."""

MEASURES = tuple(
    f.name for f in fields(TrajectoryMeasures) if f.name not in ("mesh", "simulation", "failed")
)
Rows = list[list[str]]
Array = NDArray[np.float64]
RESAMPLES, LEVEL = 2000, 0.95


@dataclass(frozen=True)
class Summary:
    """How a measure is distributed over trajectories."""

    # trajectories that have the measure, and meshes that these are on
    count: int
    meshes: int
    mean: float
    median: float
    q05: float
    q95: float
    smallest: float
    largest: float
    interval: tuple[float, float] | None  # of the mean, see `mean_interval`


def summarise(values: Sequence[float], meshes: Sequence[int], seed: int = 0) -> Summary:
    """Summary of one value or more; ``meshes`` says on which mesh each one is."""
    found = np.asarray(values, dtype=np.float64)
    q05, median, q95 = np.quantile(found, (0.05, 0.5, 0.95)).tolist()
    return Summary(
        len(found), len(set(meshes)), float(found.mean()), median, q05, q95, float(found.min()),
        float(found.max()), mean_interval(found, meshes, seed),
    )  # fmt: skip


def mean_interval(
    values: Sequence[float] | Array,
    clusters: Sequence[int],
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> tuple[float, float] | None:
    """Expanded percentile bootstrap interval of the mean (Hesterberg 2015, section 5.2).

    Clusters are drawn with replacement, not values: trajectories on one mesh share its shape and
    material, so they tell less than as many on different meshes.  With n clusters the percentiles
    are those at which a normal variable with the deviation of a resample, too small by sqrt((n - 1)
    / n), is Student's t with n - 1 degrees of freedom: 0.9 and 99.1 instead of 2.5 and 97.5 for ten
    clusters. None if there is one cluster only, which tells nothing of others.
    """
    found = np.asarray(values, dtype=np.float64)
    names, owner = np.unique(np.asarray(clusters), return_inverse=True)
    if len(names) < 2:
        return None
    sums, counts = np.bincount(owner, found), np.bincount(owner)
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(names), size=(resamples, len(names)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    t = stats.t.ppf((1.0 + level) / 2.0, len(names) - 1)
    tail = float(stats.norm.cdf(-t * np.sqrt(len(names) / (len(names) - 1.0))))
    low, high = np.quantile(means, (tail, 1.0 - tail)).tolist()
    return low, high


def summaries(run: EvaluatedRun, seed: int = 0) -> dict[str, Summary]:
    """By measure, of those that some trajectory has."""
    found = {name: run.values(name) for name in MEASURES}
    return {name: summarise(x, meshes, seed) for name, (x, meshes) in found.items() if x}


def to_json(evaluation: Evaluation, record: Mapping[str, Any] | None = None, seed: int = 0) -> str:
    """All summaries, and ``record``: how they came about (environment, command, models)."""
    count = len(evaluation.runs[REFERENCE].trajectories)
    content = {
        "version": VERSION,
        **(record or {}),
        "bootstrap_seed": seed,
        "data": {
            "name": evaluation.dataset,
            "split": evaluation.split,
            "setting": evaluation.setting,
            "config_hash": evaluation.config_hash,
            "time_step": evaluation.time_step,
            "trajectories": count,
            "shards": dict(evaluation.shards),
            "missing": [path.name for path in evaluation.missing],
        },
        "runs": {
            name: {
                "base": run.base,
                "trajectories": len(run.trajectories),
                "failed": [
                    {"mesh": m.mesh, "simulation": m.simulation, "step": m.failed}
                    for m in run.failures()
                ],
                "measures": {name: asdict(x) for name, x in summaries(run, seed).items()},
            }
            for name, run in evaluation.runs.items()
        },
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def trajectories_csv(evaluation: Evaluation) -> str:
    """One line a run and trajectory; empty where a measure is not defined."""
    names = [f.name for f in fields(TrajectoryMeasures)]
    rows = (
        [run.name, *("" if x is None else repr(x) for x in asdict(t.measures).values())]
        for run in evaluation.runs.values()
        for t in run.trajectories
    )
    return _csv(["run", *names], rows)


def errors_csv(evaluation: Evaluation) -> str:
    """RMS distance from the reference of each run, trajectory and frame, m."""
    rows = (
        [
            run.name, t.measures.mesh, t.measures.simulation, frame,
            repr(frame * evaluation.time_step), repr(error),
        ]
        for run in evaluation.runs.values()
        if run.name != REFERENCE
        for t in run.trajectories
        for frame, error in enumerate(t.errors.tolist())
    )  # fmt: skip
    return _csv(["run", "mesh", "simulation", "frame", "time", "rms_error"], rows)


def mean_errors(evaluation: Evaluation) -> dict[str, Array]:
    """Mean over trajectories of the RMS distance over time by run, (T+1,), m.

    Runs and frames that not every trajectory has are left out, so all means are of the same
    trajectories.
    """
    count = len(evaluation.runs[REFERENCE].trajectories)
    every = {
        name: [t.errors for t in run.trajectories if len(t.errors)]
        for name, run in evaluation.runs.items()
        if name != REFERENCE
    }
    every = {name: errors for name, errors in every.items() if len(errors) == count}
    shortest = min((len(x) for errors in every.values() for x in errors), default=0)
    return {name: np.mean([x[:shortest] for x in each], axis=0) for name, each in every.items()}


# --- tables ------------------------------------------------------------------------------


def headline(evaluation: Evaluation, seed: int = 0) -> tuple[list[str], Rows]:
    """Headings and rows of the main table: shares of squared error removed, per cent.

    Where the data have a time-converged reference, first the relative error to it, per cent.
    """
    means = ("omega_base", "step_omega", "gate_rate")
    every = {run.name: summaries(run, seed) for run in _shown(evaluation)}
    first = ["relative_error"] if any("relative_error" in found for found in every.values()) else []
    headings = [
        "run", *("error" for _ in first), "Omega", "95 % interval", "median", "5 %", "worst",
        "of own base", "one step", "refused", "failed",
    ]  # fmt: skip
    rows = []
    for run in _shown(evaluation):
        found = every[run.name]
        shares = [""] * 5
        if "omega" in found:
            x = found["omega"]
            interval = " to ".join(map(_number, x.interval or ()))
            shares = [_number(x.mean), interval, *map(_number, (x.median, x.q05, x.smallest))]
        rows.append([
            _marked(run), *(_mean(found, measure) for measure in first), *shares,
            *(_mean(found, measure) for measure in means),
            f"{len(run.failures())}/{len(run.trajectories)}",
        ])  # fmt: skip
    return headings, rows


def details(evaluation: Evaluation, seed: int = 0) -> tuple[list[str], Rows]:
    """Headings and rows of the second table: means over trajectories in their units."""
    columns: dict[str, tuple[str, float]] = {
        "RMS, mm": ("rms_error", 1e3), "worst node, mm": ("worst_node", 1e3),
        "one step, mm": ("step_rms_error", 1e3),
        "stress, %": ("stress_error", 100.0), "energy, %": ("energy_error", 100.0),
        "lost, %": ("energy_loss", 100.0), "momentum, %": ("linear_momentum_error", 100.0),
        "spin, %": ("angular_momentum_error", 100.0),
        "RMS to converged, mm": ("converged_rms_error", 1e3),
    }  # fmt: skip
    found = {name: summaries(run, seed) for name, run in evaluation.runs.items()}
    used = {
        heading: column
        for heading, column in columns.items()
        if any(column[0] in each for name, each in found.items() if name != REFERENCE)
    }
    rows = [
        [_marked(run), *(_mean(found[run.name], *column) for column in used.values())]
        for run in [*_shown(evaluation), evaluation.runs[REFERENCE]]
    ]
    return ["run", *used], rows


def tables(evaluation: Evaluation, seed: int = 0) -> list[tuple[str, list[str], Rows]]:
    """Titles, headings and rows of all tables."""
    about = f"{evaluation.dataset}, {evaluation.split}"
    removed = f"{about}: share of the plain coarse run's squared error removed, %"
    return [
        (removed, *headline(evaluation, seed)),
        (f"{about}: means over trajectories", *details(evaluation, seed)),
    ]


def markdown(evaluation: Evaluation, notes: Sequence[str] = (), seed: int = 0) -> str:
    """All tables and some notes as Markdown."""
    parts = []
    for title, headings, rows in tables(evaluation, seed):
        lines = [headings, ["---", *["---:"] * (len(headings) - 1)], *rows]
        parts += [f"**{title}**", "\n".join(f"| {' | '.join(line)} |" for line in lines)]
    parts += ["\n".join(f"- {note}" for note in notes)] if notes else []
    return "\n\n".join(parts) + "\n"


def write_evaluation(
    evaluation: Evaluation,
    folder: str | Path,
    record: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    seed: int = 0,
) -> list[Path]:
    """Write all files of an evaluation into a folder."""
    folder = make_folder(folder)
    contents = {
        TRAJECTORIES: trajectories_csv(evaluation),
        ERRORS: errors_csv(evaluation),
        TABLE: markdown(evaluation, notes, seed),
        SUMMARY: to_json(evaluation, record, seed),
    }
    for name, text in contents.items():
        write_text(folder / name, text)
    return [folder / name for name in contents]


# --- parts -------------------------------------------------------------------------------


def _shown(evaluation: Evaluation) -> list[EvaluatedRun]:
    return [run for name, run in evaluation.runs.items() if name != REFERENCE]


def _marked(run: EvaluatedRun) -> str:
    """Its name, and whether it is no corrected run."""
    return f"{run.name} (all refused)" if run.reasons and all(run.reasons) else run.name


def _csv(headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(rows)
    return text.getvalue()


def _number(value: float) -> str:
    return f"{round(value, 2) + 0.0:.2f}"


def _mean(found: Mapping[str, Summary], measure: str, factor: float = 1.0) -> str:
    if measure not in found:
        return ""
    return f"{factor * found[measure].mean:.3g}" if factor != 1.0 else _number(found[measure].mean)
