"""Forty scenes of five families: how far runs are from the converged motion, at what time."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import common
import numpy as np
from families import EACH, FAMILIES, scenes

import pdcorrect as pc
from pdcorrect.errors import ConvergenceError, PdcorrectWarning

HEX27 = {"element": "hex27", "mass": "consistent"}
SUBSTEPS = (1, 2, 4)
RUNS = {
    **{f"best coarse, {n}": (pc.best_coarse, n, 1) for n in SUBSTEPS},
    **{f"learned, {n}": (pc.learned_coarse, n, 1) for n in SUBSTEPS},
    **{f"hex27, {n}": (lambda scene: scene.with_changes(solver=HEX27), n, 1) for n in SUBSTEPS},
    "best on 2x2x2, 2": (pc.best_coarse, 2, 2),
    "learned on 2x2x2, 2": (pc.learned_coarse, 2, 2),
}
"""What discretises, substeps, and cells along each axis of a coarse one."""
QUICK, FEW = "arch 0", {"frames": 8}
"""Scene and frames of a quick run."""
TABLE, TIMES = "Errors, % of the RMS displacement", "Time a frame, ms"
DRAWN = (
    *(f"{name}, {n}" for name in ("best coarse", "hex27", "learned") for n in (1, 2)),
    "learned on 2x2x2, 2",
)
OTHERS = "best coarse", "hex27"
"""Beside which the learned element is judged, with as many substeps."""
FARTHER = 1.1
DRAWABLE = "hand"
"""Family of which most bodies are unions of boxes that the training could have drawn."""
MODES = 10
MODELS = {
    "best coarse": pc.best_coarse,
    "learned": pc.learned_coarse,
    "hex27": lambda scene: scene.with_changes(solver=HEX27),
}
"""Whose frequencies are compared with those of the best element on 4x4x4 cells."""
_FINE_FRAMES = 5
"""Of the fine mesh, for its time."""
_LOST = 100.0
"""Error, %, of runs that fail."""


def of_run(scene: pc.Scene, motion: pc.Trajectory, which: str) -> tuple[float, float]:
    """Error, %, and time a frame, ms."""
    choose, substeps, refine = RUNS[which]
    problem = pc.discretise(choose(scene.with_changes(time={"substeps": substeps})), refine)
    stepper = pc.ProjectiveDynamics(problem).prepare()
    started = time.perf_counter()
    try:
        run = pc.rollout(stepper)
    except ConvergenceError:
        return _LOST, float("nan")
    spent = 1e3 * (time.perf_counter() - started) / len(run)
    return 100.0 * pc.metrics.relative_error(run, motion), spent


def of_frequencies(scene: pc.Scene) -> list[float]:
    """Mean error of each model's lowest frequencies, %."""
    fine = pc.modes(pc.discretise(pc.best_coarse(scene), 4), MODES).frequencies
    found = [pc.modes(pc.discretise(f(scene)), MODES).frequencies for f in MODELS.values()]
    return [100.0 * float(np.abs(x / fine - 1.0).mean()) for x in found]


def fine_time(scene: pc.Scene) -> float:
    """Of the best element on 4x4x4 cells, ms a frame."""
    stepper = pc.ProjectiveDynamics(pc.discretise(pc.best_coarse(scene), 4)).prepare()
    started = time.perf_counter()
    pc.rollout(stepper, _FINE_FRAMES)
    return 1e3 * (time.perf_counter() - started) / _FINE_FRAMES


def case(quick: bool) -> common.Outcome:
    """All scenes; converged motions are kept on disk, so that a stopped run goes on from there."""
    drawn = scenes()
    if quick:
        drawn = {QUICK: drawn[QUICK].with_changes(time=FEW)}
    names = list(drawn)
    errors, times, tones, fine = [], [], [], []
    for name in names:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PdcorrectWarning)
            motion = pc.converged(drawn[name])
            found = [of_run(drawn[name], motion, which) for which in RUNS]
            errors.append([error for error, _ in found])
            times.append([spent for _, spent in found])
            if not quick:
                tones.append(of_frequencies(drawn[name]))
                fine.append(fine_time(drawn[name]))
    figures = {
        f"{name}, {which}, %": error
        for name, row in zip(names, errors, strict=True)
        for which, error in zip(RUNS, row, strict=True)
    }
    if quick:
        return common.Outcome(figures)
    table, spent, off = np.array(errors), np.array(times), np.array(tones)
    rows = [(name, *row) for name, row in zip(names, errors, strict=True)]
    for kind, row in (
        ("mean", table.mean(axis=0)), ("median", np.median(table, axis=0)),
        ("worst", table.max(axis=0)),
    ):  # fmt: skip
        rows.append((kind, *row))
        figures |= {f"{kind}, {which}, %": x for which, x in zip(RUNS, row, strict=True)}
    others = table[[not name.startswith(DRAWABLE) for name in names]].mean(axis=0)
    rows.append((f"mean without {DRAWABLE}s", *others))
    errors_of = dict(zip(RUNS, table.T, strict=True))
    times_of = dict(zip(RUNS, spent.T, strict=True))
    for n in SUBSTEPS:
        mine = errors_of[f"learned, {n}"]
        for other in OTHERS:
            share = 100.0 * float(np.mean(mine < errors_of[f"{other}, {n}"]))
            figures[f"learned nearer than {other}, {n} substeps, % of scenes"] = share
            ratio = np.nanmedian(times_of[f"{other}, {n}"] / times_of[f"learned, {n}"])
            figures[f"time of {other} over learned, {n} substeps"] = float(ratio)
        farther = mine > FARTHER * errors_of[f"best coarse, {n}"]
        figures[f"learned over {FARTHER} times best coarse, {n} substeps, scenes"] = int(
            farther.sum()
        )
    ratio = np.nanmedian(np.array(fine) / times_of["learned, 1"])
    figures["time of best on 4x4x4 over learned, 1 substep"] = float(ratio)
    figures |= {f"frequencies, {m}, %": x for m, x in zip(MODELS, off.mean(axis=0), strict=True)}
    return common.Outcome(
        figures,
        (
            common.Table(TABLE, ("scene", *RUNS), tuple(rows)),
            common.Table(TIMES, ("", *RUNS), (("median", *np.nanmedian(spent, axis=0)),)),
            common.Table(
                f"Error of the lowest {MODES} frequencies, %", ("", *MODELS),
                (("mean", *off.mean(axis=0)), ("worst", *off.max(axis=0))),
            ),
        ),
    )  # fmt: skip


def finding(record: common.Record) -> str:
    """Mean and median errors with two substeps, and how often the learned element is nearer."""
    figures = record.figures

    def pair(which: str) -> str:
        mean, median = (figures[f"{kind}, {which}, 2, %"] for kind in ("mean", "median"))
        return f"{which} {mean:.1f} ({median:.1f})"

    nearer = (
        f"{figures[f'learned nearer than {which}, 2 substeps, % of scenes']:.0f} % of scenes"
        for which in ("best coarse", "hex27")
    )
    return (
        f"Mean (median) errors with two substeps, %: "
        f"{', '.join(pair(which) for which in ('best coarse', 'learned', 'hex27'))}. Learned is "
        f"nearer than best coarse in {', than hex27 in '.join(nearer)}."
    )


def draw(record: common.Record, path: Path) -> None:
    """Errors of each family's scenes, sorted, by run."""
    figure, axes = common.panels(12, 3.4, len(FAMILIES), sharey=True)
    rows = {row[0]: row[1:] for row in record.table(TABLE)["rows"]}
    for axis, family in zip(axes, FAMILIES, strict=True):
        for which, mark, colour in zip(DRAWN, common.MARKS, common.COLOURS, strict=False):
            column = list(RUNS).index(which)
            errors = sorted(rows[f"{family} {n}"][column] for n in range(EACH))
            axis.plot(errors, mark + "-", color=colour, label=which)
        axis.set(title=family, yscale="log", xticks=[], xlabel="scenes, sorted for each run")
        common.log_axis(axis.yaxis)
        common.plain(axis, "y")
    axes[0].set(ylabel="error, % of the RMS displacement")
    common.save(figure, path, legend_of=axes[0], columns=5)
