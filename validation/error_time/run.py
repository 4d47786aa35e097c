"""Error against run time of every model and solver, on unlike bodies and the thesis's motions."""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path

import common
import numpy as np
import reference
from bodies import SCENES, scenes
from methods import (
    ERRORS,
    FAMILIES,
    FIRST,
    LOOSE,
    METHODS,
    RIVALS,
    ROUNDS,
    TIMES,
    error_at,
    front,
    points_of,
    time_at,
)  # fmt: skip
from rounds import Timed, timed

import pdcorrect as pc
from pdcorrect._environment import cache_folder, code_digest, environment
from pdcorrect._files import make_folder
from pdcorrect.errors import PdcorrectWarning
from pdcorrect.evaluation.converged import cache_key

QUICK, FEW = "cantilever", {"frames": 8}
"""Scene and frames of a quick run, which has the methods of `ESTIMATED` only."""
SHARES = "Estimated over true error"
BESIDE = "Beside the front of what needs no training"
ESTIMATED = ("best coarse, 1", "learned, 1", "hex27, 1")
"""Runs whose error is also estimated, without the converged motion."""
COMPARED = (
    "learned, 1", f"learned, 1{LOOSE}", "learned, 2", f"learned, 2{LOOSE}", "learned, 4",
    "learned on 2x2x2, 2",
)  # fmt: skip
TIGHT, NEWTON = "best coarse, 1, tolerance / 10", "best coarse, 1, Newton"
QUICKER, NEARER = "speed-up at equal error", "error of the front at equal time over its own"
LOST = 100.0
"""Error, %, of runs that fail."""


def rounded(value: float, digits: int = 4) -> float:
    """A time to so many digits."""
    return float(f"{value:.{digits}g}")


KINDS: dict[str, Callable[[Timed], float]] = {
    "rounds": lambda found: len(found.wall),
    "first quartile, ms": lambda found: float(np.quantile(found.wall, 0.25)),
    "third quartile, ms": lambda found: float(np.quantile(found.wall, 0.75)),
    "of the process, ms": lambda found: min(found.cpu),
    FIRST: lambda found: min(found.first),
}
"""Rows of `ROUNDS`."""


def size(motion: pc.Trajectory) -> float:
    """RMS displacement, m."""
    return float(np.sqrt(((motion.positions - motion.points) ** 2).sum(axis=-1).mean()))


def of_scene(label: str, scene: pc.Scene, methods: Collection[str] = METHODS) -> common.Outcome:
    """By all methods; converged motions are kept on disk, and rounds until all are done."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PdcorrectWarning)
        motion = pc.converged(scene)
        extent = size(motion)

        def judge(name: str, run: pc.Trajectory) -> dict[str, float]:
            error = pc.metrics.relative_error(run, motion)
            if name not in ESTIMATED:
                return {"error": 100.0 * error}
            estimate = float(np.sqrt((pc.error_estimate(run)[1:] ** 2).mean()))
            return {"error": 100.0 * error, "share": estimate / error / extent}

        found = timed(scene, {name: METHODS[name] for name in methods}, judge, kept(scene, methods))
    errors = {name: x.found.get("error", LOST) for name, x in found.items()}
    rows: list[tuple[float | str, ...]] = []
    for kind, of in KINDS.items():
        told = (math.nan if x.failed else rounded(of(x), 3) for x in found.values())
        rows.append((label, float(scene.time.frames), kind, *told))
    times = (math.nan if x.failed else rounded(min(x.wall)) for x in found.values())
    shares = (found[name].found.get("share", math.nan) for name in ESTIMATED)
    head, about = ("nodes", "RMS displacement, mm"), (float(len(motion.points)), 1e3 * extent)
    tables = (
        common.Table(ERRORS, ("scene", *head, *methods), ((label, *about, *errors.values()),)),
        common.Table(TIMES, ("scene", *methods), ((label, *times),)),
        common.Table(ROUNDS, ("scene", "frames", "what", *methods), tuple(rows)),
        common.Table(SHARES, ("scene", *ESTIMATED), ((label, *shares),)),
    )
    return common.Outcome({f"{label}, {name}, %": errors[name] for name in ESTIMATED}, tables)


def kept(scene: pc.Scene, methods: Collection[str]) -> Path:
    """Where rounds of this machine and code are kept."""
    about = cache_key(scene), code_digest(), environment(), list(methods)
    name = hashlib.sha256(json.dumps(about).encode()).hexdigest()
    return make_folder(cache_folder("rounds")) / f"{name}.json"


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each scene, and for some one for the error of its converged motion."""
    if quick:
        scene = SCENES[QUICK].with_changes(time=FEW)
        return {QUICK: partial(of_scene, QUICK, scene, ESTIMATED)}
    found: dict[str, Callable[[], common.Outcome]] = {}
    for name, scene in scenes().items():
        found[name] = partial(of_scene, name, scene)
        if name in reference.SCENES:
            found[f"converged motion of {name}"] = partial(reference.of_scene, name, scene)
    return found


def summary(record: common.Record) -> common.Outcome:
    """Means over the unlike bodies, and over all scenes the two numbers beside classical runs."""
    table = record.table(ERRORS)
    rows = [row[3:] for row in table["rows"] if row[0] in SCENES]
    figures: common.Figures = {}
    for name, errors in zip(table["headings"][3:], zip(*rows, strict=True), strict=True):
        figures[f"mean, {name}, %"] = float(np.mean(errors))
        figures[f"median, {name}, %"] = float(np.median(errors))
        figures[f"worst, {name}, %"] = float(np.max(errors))
    shares = [x for row in record.table(SHARES)["rows"] for x in row[1:] if x is not None]
    within = [0.5 <= share <= 2.0 for share in shares]
    figures["estimates within a factor of 2, %"] = 100.0 * float(np.mean(within))
    for k, what in ((1, "time"), (3, "mesh")):
        own = [row[k] for row in record.table(reference.OWN)["rows"]]
        figures[f"converged motions, {what}, mean, %"] = float(np.mean(own))
        figures[f"converged motions, {what}, worst, %"] = float(np.max(own))
    table = record.table(reference.FINER)
    for name, errors in zip(
        table["headings"][1:], zip(*(row[1:] for row in table["rows"]), strict=True), strict=True
    ):
        figures[f"from the finest mesh, {name}, mean, %"] = float(np.mean(errors))
    beside, ratios = [], []
    for label, points in points_of(record).items():
        rivals = [point for point in points if point.name in RIVALS]
        mine = {point.name: point for point in points}
        ratios.append(mine[TIGHT].error / mine[NEWTON].error)
        for name in COMPARED:
            point = mine[name]
            quicker = time_at(point.error, rivals) / point.time
            nearer = error_at(point.time, rivals) / point.error
            beside.append((label, name, quicker, nearer))
    figures["PD's error over Newton's, least"] = min(ratios)
    figures["PD's error over Newton's, largest"] = max(ratios)
    for name in COMPARED:
        for k, what in enumerate((QUICKER, NEARER), start=2):
            found = np.array([row[k] for row in beside if row[1] == name])
            figures[f"{name}, {what}, median"] = float(np.nanmedian(found))
            figures[f"{name}, {what}, worst"] = float(np.nanmin(found))
            figures[f"{name}, {what}, scenes without"] = float(np.isnan(found).sum())
    heads = ("scene", "run", QUICKER, NEARER)
    return common.Outcome(figures, (common.Table(BESIDE, heads, tuple(beside)),))


def finding(record: common.Record) -> str:
    """Means of unlike bodies with median times, and both numbers of the learned element."""
    figures = record.figures
    table = record.table(TIMES)
    times = dict(zip(table["headings"], zip(*table["rows"], strict=True), strict=True))

    def told(run: str) -> str:
        spent = np.median([x for x in times[run] if x is not None])
        return f"{figures[f'mean, {run}, %']:.1f} % in {spent:.0f} ms a frame"

    quicker, nearer = (
        [figures[f"learned, 2, {what}, {kind}"] for kind in ("median", "worst")]
        for what in (QUICKER, NEARER)
    )
    return (
        f"Mean errors on twelve bodies that nothing was trained on: learned {told('learned, 1')}, "
        f"best coarse {told('best coarse, 1')}, hex27 {told('hex27, 1')}, 4×4×4 cells "
        f"{told('best on 4x4x4, 1')}; with two steps learned is {quicker[0]:.1f} times as quick at "
        f"its error as the front of all untrained runs (worst {quicker[1]:.2g}), and "
        f"{nearer[0]:.1f} times as near in its time (worst {nearer[1]:.2g}), in the median of "
        f"{len(points_of(record))} scenes."
    )


def draw(record: common.Record, path: Path) -> None:
    """Error against time, a panel a scene, with the front of what needs no training."""
    found = points_of(record)
    figure, grid = common.panels(13, 9, 5, rows=3)
    for axis, (label, points) in zip(grid.ravel(), found.items(), strict=True):
        line = front([point for point in points if point.name in RIVALS])
        axis.plot([p.time for p in line], [p.error for p in line], color="0.6",
                  label="front without training")  # fmt: skip
        for k, family in enumerate(FAMILIES):
            of = [p for p in points if METHODS[p.name].family == family and p.error < LOST]
            axis.scatter([p.time for p in of], [p.error for p in of], 22, zorder=3, label=family,
                         marker=common.MARKS[k], color=common.COLOURS[k])  # fmt: skip
        axis.set(xscale="log", yscale="log")
        axis.set_title(label, fontsize=10)
        common.log_axis(axis.yaxis)
        common.plain(axis)
    figure.supxlabel("ms a frame, one thread")
    figure.supylabel("error, % of the RMS displacement")
    common.save(figure, path, grid[0, 0], 7)
