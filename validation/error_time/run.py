"""Error against run time of every model and solver, on unlike bodies and the thesis's motions."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path

import common
import numpy as np
from bodies import SCENES, scenes
from methods import (
    ERRORS,
    FAMILIES,
    METHODS,
    RIVALS,
    TIMES,
    Point,
    error_at,
    front,
    points_of,
    time_at,
)  # fmt: skip

import pdcorrect as pc
from pdcorrect.errors import ConvergenceError, PdcorrectWarning

QUICK, FEW = "cantilever", {"frames": 8}
"""Scene and frames of a quick run, which has the methods of `ESTIMATED` only."""
SHARES = "Estimated over true error"
BESIDE = "Beside the front of what needs no training"
ESTIMATED = ("best coarse, 1", "learned, 1", "hex27, 1")
"""Runs whose error is also estimated, without the converged motion."""
COMPARED = ("learned, 1", "learned, 2", "learned, 4", "learned on 2x2x2, 2")
TIGHT, NEWTON = "best coarse, 1, tolerance / 10", "best coarse, 1, Newton"
QUICKER, NEARER = "speed-up at equal error", "error of the front at equal time over its own"
LOST = 100.0
"""Error, %, of runs that fail."""


def measure(name: str, scene: pc.Scene, motion: pc.Trajectory) -> tuple[Point, float]:
    """A method's time and error in a scene, and the estimated over the true error, if asked for.

    The set-up and a first frame are not timed.
    """
    stepper = METHODS[name].stepper(scene)
    try:
        pc.rollout(stepper, 1)
        started = time.perf_counter()
        run = pc.rollout(stepper)
    except ConvergenceError:
        return Point(name, math.nan, LOST), math.nan
    spent = 1e3 * (time.perf_counter() - started) / len(run)
    error = pc.metrics.relative_error(run, motion)
    share = math.nan
    if name in ESTIMATED:
        estimate = float(np.sqrt((pc.error_estimate(run)[1:] ** 2).mean()))
        share = estimate / error / size(motion)
    return Point(name, spent, 100.0 * error), share


def size(motion: pc.Trajectory) -> float:
    """RMS displacement, m."""
    return float(np.sqrt(((motion.positions - motion.points) ** 2).sum(axis=-1).mean()))


def of_scene(label: str, scene: pc.Scene, methods: Collection[str] = METHODS) -> common.Outcome:
    """By all methods; converged motions are kept on disk."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PdcorrectWarning)
        motion = pc.converged(scene)
        found = [measure(name, scene, motion) for name in methods]
    points = [point for point, _ in found]
    shares = [share for point, share in found if point.name in ESTIMATED]
    figures = {f"{label}, {point.name}, %": point.error for point in points}
    head = ("scene", "nodes", "RMS displacement, mm")
    about = (label, float(len(motion.points)), 1e3 * size(motion))
    tables = (
        common.Table(ERRORS, (*head, *methods), ((*about, *(p.error for p in points)),)),
        common.Table(TIMES, ("scene", *methods), ((label, *(p.time for p in points)),)),
        common.Table(SHARES, ("scene", *ESTIMATED), ((label, *shares),)),
    )
    return common.Outcome(figures, tables)


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each scene."""
    if quick:
        scene = SCENES[QUICK].with_changes(time=FEW)
        return {QUICK: partial(of_scene, QUICK, scene, ESTIMATED)}
    return {name: partial(of_scene, name, scene) for name, scene in scenes().items()}


def summary(record: common.Record) -> common.Outcome:
    """Means over the unlike bodies, and over all scenes the two numbers beside classical runs."""
    rows = [row for row in record.table(ERRORS)["rows"] if row[0] in SCENES]
    figures: common.Figures = {}
    for name, errors in zip(METHODS, zip(*(row[3:] for row in rows), strict=True), strict=True):
        figures[f"mean, {name}, %"] = float(np.mean(errors))
        figures[f"median, {name}, %"] = float(np.median(errors))
        figures[f"worst, {name}, %"] = float(np.max(errors))
    shares = [x for row in record.table(SHARES)["rows"] for x in row[1:] if x is not None]
    within = [0.5 <= share <= 2.0 for share in shares]
    figures["estimates within a factor of 2, %"] = 100.0 * float(np.mean(within))
    table, ratios = [], []
    for label, points in points_of(record).items():
        rivals = [point for point in points if point.name in RIVALS]
        mine = {point.name: point for point in points}
        ratios.append(mine[TIGHT].error / mine[NEWTON].error)
        for name in COMPARED:
            point = mine[name]
            quicker = time_at(point.error, rivals) / point.time
            nearer = error_at(point.time, rivals) / point.error
            table.append((label, name, quicker, nearer))
    figures["PD's error over Newton's, least"] = min(ratios)
    figures["PD's error over Newton's, largest"] = max(ratios)
    for name in COMPARED:
        for k, what in enumerate((QUICKER, NEARER), start=2):
            found = np.array([row[k] for row in table if row[1] == name])
            figures[f"{name}, {what}, median"] = float(np.nanmedian(found))
            figures[f"{name}, {what}, worst"] = float(np.nanmin(found))
            figures[f"{name}, {what}, scenes without"] = float(np.isnan(found).sum())
    heads = ("scene", "run", QUICKER, NEARER)
    return common.Outcome(figures, (common.Table(BESIDE, heads, tuple(table)),))


def finding(record: common.Record) -> str:
    """Means of unlike bodies with median times, and both numbers of the learned element."""
    figures = record.figures
    table = record.table("Time a frame, ms")
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
