"""Twelve scenes of unlike bodies: how far coarse runs and hybrids are from the converged motion."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc
from pdcorrect.errors import PdcorrectWarning

GRAVITY = {"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}
FOOT = {"region": {"plane": "z", "at": "min"}}
WALL = {"region": {"plane": "x", "at": "min"}}
GENERALISED, EULER = "generalised-alpha", "backward-euler"
MODELS = ("impulse-exact", "torsion-exact", "stretch-exact")
BEST, LEARNED, HEX27 = (f"{name}, {GENERALISED}" for name in ("best coarse", "learned", "hex27"))
TWO = "2 substeps"
FINER = f"learned on 2x2x2, {TWO}"
RUNS = (
    f"plain, {EULER}", f"best coarse, {EULER}", *(f"hybrid {model}" for model in MODELS),
    f"plain, {GENERALISED}", BEST, LEARNED, HEX27, f"learned, {TWO}", f"hex27, {TWO}",
    f"best on 2x2x2, {TWO}", FINER,
)  # fmt: skip
ESTIMATED = (BEST, LEARNED, HEX27)
"""Runs whose error is also estimated, without the converged motion."""
QUICK, FEW = "cantilever", {"frames": 8}
"""Scene and frames of a quick run."""


def voxels(shape: tuple[int, int, int], *holes: tuple[slice, slice, slice]) -> list[Any]:
    """Occupancy of a box of cells with boxes taken out."""
    full = np.ones(shape, dtype=int)
    for hole in holes:
        full[hole] = 0
    return list(full.tolist())


def rotated(axis: str, centre: list[float], degrees: float, seconds: float) -> dict[str, Any]:
    """A clamp's motion: turned once and held."""
    return {"times": [0.0, seconds, 10.0], "rotation": [0.0, degrees, degrees], "axis": axis,
            "centre": centre}  # fmt: skip


def scene(
    young: float, poisson: float, step: float, frames: int, body: dict[str, Any], *loads: Any,
    clamps: tuple[Any, ...] = (WALL,), cell: float = 0.05, **more: Any,
) -> pc.Scene:  # fmt: skip
    """Of one material with a density of 1 000 kg/m3; ``cell`` in m."""
    return pc.Scene(
        body={"cell_size": cell, **body},
        material={"young": young, "poisson": poisson, "density": 1e3},
        time={"step": step, "frames": frames}, clamps=list(clamps), loads=list(loads), **more,
    )  # fmt: skip


ALL = slice(None)
SCENES = {
    "cantilever": scene(
        2e5, 0.3, 0.01, 40, {"shape": "beam", "cells": [10, 2, 2]}, GRAVITY),
    "plate": scene(
        2e6, 0.45, 0.01, 40, {"shape": "beam", "cells": [8, 6, 1]}, GRAVITY),
    "angle": scene(
        3e5, 0.4, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels((6, 2, 6), (slice(2, None), ALL, slice(2, None)))},
        {"kind": "gravity", "acceleration": [0.0, 40.0, -20.0], "window": [0.0, 0.05]},
        clamps=({"region": {"plane": "z", "at": "max"}},)),
    "portal": scene(
        5e5, 0.35, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels((8, 2, 7), (slice(2, 6), ALL, slice(0, 5)))},
        {"kind": "gravity", "acceleration": [8.0, 4.0, 0.0],
         "table": [[0.0, 0.0], [0.1, 1.0], [0.2, -1.0], [0.3, 1.0], [0.4, 0.0]]},
        clamps=(FOOT,)),
    "ring": scene(
        1.2e5, 0.2, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels((8, 2, 8), (slice(2, 6), ALL, slice(2, 6)))},
        GRAVITY, clamps=(FOOT,)),
    "cross under torsion": scene(
        3e5, 0.4, 0.01, 40,
        {"shape": "cross", "cells": [9, 2, 2], "arm_start": 5, "arm_length": 2},
        {"kind": "torsion", "strength": 2.5e4, "window": [0.0, 0.1], "ramp": 0.02}),
    "sheared block": scene(
        1e6, 0.48, 0.0025, 60, {"shape": "beam", "cells": [4, 4, 4]},
        clamps=(FOOT, {"region": {"plane": "z", "at": "max"}, "motion": {
            "times": [0.0, 0.05, 10.0],
            "displacement": [[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.08, 0.0, 0.0]]}})),
    "twisted bar": scene(
        8e5, 0.45, 0.0025, 60, {"shape": "beam", "cells": [9, 3, 3]},
        clamps=(WALL, {"region": {"plane": "x", "at": "max"},
                       "motion": rotated("x", [0.0, 0.075, 0.075], 70.0, 0.1)})),
    "tower with a window": scene(
        8e6, 0.05, 0.0025, 60,
        {"shape": "voxels", "occupancy": voxels((3, 3, 9), (slice(1, 2), ALL, slice(3, 6)))},
        {"kind": "gravity", "acceleration": [300.0, 150.0, 0.0], "window": [0.0, 0.02]},
        clamps=(FOOT,)),
    "stairs under pressure": scene(
        2.5e5, 0.4, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels(
            (6, 3, 6), (slice(2, None), ALL, slice(4, None)), (slice(4, None), ALL, slice(2, 4)))},
        {"kind": "pressure", "pressure": 6e3, "region": {"plane": "x", "at": "min"},
         "follower": True, "window": [0.0, 0.2], "ramp": 0.05},
        clamps=(FOOT,)),
    "hard and soft": scene(
        2e5, 0.45, 0.01, 40, {"shape": "beam", "cells": [10, 2, 3]}, GRAVITY,
        materials=[{"region": {"box": [[0.0, 0.0, 0.0], [0.5, 0.1, 0.05]]}, "young": 4e6,
                    "poisson": 0.3, "density": 1.2e3}]),
    "struck hook": scene(
        4e5, 0.4, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels(
            (7, 2, 6), (slice(2, 5), ALL, slice(2, None)), (slice(5, None), ALL, slice(4, None)))},
        clamps=({"region": {"plane": "z", "at": "max"}},),
        initial={"velocity": [1.5, 1.0, 0.0]}),
}  # fmt: skip
"""Bodies, materials and motions that no corrector was trained on."""
TABLE = "Errors, % of the RMS displacement"
HEADS = ("scene", "nodes", "RMS displacement, mm", *RUNS)
SHARES = "Estimated over true error"


def steppers(scene: pc.Scene) -> dict[str, Callable[[], Any]]:
    """What makes the stepper of each run, by name."""

    def plain(scene: pc.Scene, refine: int = 1) -> Any:
        return pc.ProjectiveDynamics(pc.discretise(scene, refine))

    euler = scene.with_changes(time={"integrator": EULER})
    two = scene.with_changes(time={"substeps": 2})
    hex27 = {"element": "hex27", "mass": "consistent"}
    made: list[Callable[[], Any]] = [
        partial(plain, euler), partial(plain, pc.best_coarse(euler)),
        *(partial(pc.hybrid_of, euler, model) for model in MODELS),
        partial(plain, scene), partial(plain, pc.best_coarse(scene)),
        partial(plain, pc.learned_coarse(scene)), partial(plain, scene.with_changes(solver=hex27)),
        partial(plain, pc.learned_coarse(two)), partial(plain, two.with_changes(solver=hex27)),
        partial(plain, pc.best_coarse(two), 2), partial(plain, pc.learned_coarse(two), 2),
    ]  # fmt: skip
    return dict(zip(RUNS, made, strict=True))


def of_scene(name: str, scene: pc.Scene) -> tuple[common.Figures, tuple[Any, ...]]:
    """All runs of a scene, and estimates; hybrids take no correction that their gate refuses."""
    motion = pc.converged(scene)
    away = motion.positions - motion.points
    size = 1e3 * float(np.sqrt((away**2).sum(axis=-1).mean()))
    figures: common.Figures = {}
    for label, make in steppers(scene).items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PdcorrectWarning)
            stepper = make()
            pc.rollout(stepper, 1)
            started = time.perf_counter()
            run = pc.rollout(stepper)
        spent = time.perf_counter() - started
        error = 100.0 * pc.metrics.relative_error(run, motion)
        figures[f"{name}, {label}, %"] = error
        figures[f"{name}, {label}, ms a frame"] = 1e3 * spent / len(run)
        if label in ESTIMATED:
            estimate = float(np.sqrt((pc.error_estimate(run)[1:] ** 2).mean()))
            share = 1e5 * estimate / size / error
            figures[f"{name}, {label}, estimated over true"] = share
    figures[f"{name}, RMS displacement, mm"] = size
    errors = [figures[f"{name}, {label}, %"] for label in RUNS]
    return figures, (name, float(len(motion.points)), size, *errors)


def case(quick: bool) -> common.Outcome:
    """All scenes; converged motions are kept on disk, so that a stopped run goes on from there."""
    figures: common.Figures = {}
    rows: list[Any] = []
    scenes = {QUICK: SCENES[QUICK].with_changes(time=FEW)} if quick else SCENES
    for name, scene in scenes.items():
        found, row = of_scene(name, scene)
        figures |= found
        rows.append(row)
    shares = [
        (row[0], *(figures[f"{row[0]}, {label}, estimated over true"] for label in ESTIMATED))
        for row in rows
    ]
    near = [0.5 <= share <= 2.0 for _, *row in shares for share in row]
    figures["estimates within a factor of 2, %"] = 100.0 * float(np.mean(near))
    if not quick:
        means = [float(np.mean([row[3 + k] for row in rows])) for k in range(len(RUNS))]
        spent = [float(np.mean([figures[f"{name}, {label}, ms a frame"] for name in SCENES]))
                 for label in RUNS]  # fmt: skip
        figures |= {f"mean, {label}, %": x for label, x in zip(RUNS, means, strict=True)}
        rows += [("mean", "", "", *means), ("ms a frame", "", "", *spent)]
    tables = (
        common.Table(TABLE, HEADS, tuple(rows)),
        common.Table(SHARES, ("scene", *ESTIMATED), tuple(shares)),
    )
    return common.Outcome(figures, tables)


def finding(record: common.Record) -> str:
    """Means of what needs no training of its own, of the hybrids, and of the estimates."""
    means = {label: record.figures[f"mean, {label}, %"] for label in RUNS}
    hybrids = ", ".join(f"{means[f'hybrid {model}']:.1f}" for model in MODELS)
    pair = [f"{means[label]:.1f} % and {means[two]:.1f} %" for label, two in (
        (LEARNED, f"learned, {TWO}"), (HEX27, f"hex27, {TWO}"))]  # fmt: skip
    return (
        f"Mean errors, generalised-α, one step a frame and two: learned {pair[0]}, hex27 "
        f"{pair[1]}; best coarse {means[BEST]:.1f} %; on 2×2×2 cells learned {means[FINER]:.1f} "
        f"%, best {means[f'best on 2x2x2, {TWO}']:.1f} %; hybrids, by backward Euler, {hybrids} %. "
        f"{record.figures['estimates within a factor of 2, %']:.0f} of 100 estimated errors are "
        "within a factor of 2."
    )


def draw(record: common.Record, path: Path) -> None:
    """Errors of all runs, scene by scene."""
    figure, axis = common.panels(12, 4.4)
    rows = record.table(TABLE)["rows"][: len(SCENES)]
    for k, label in enumerate(RUNS):
        mark, colour = common.MARKS[k % 7], common.COLOURS[k % 7]
        errors = [row[3 + k] for row in rows]
        name = label.replace(GENERALISED, "gen.-α").replace(EULER, "BE")
        axis.plot(errors, mark, color=colour, label=name, fillstyle="none" if k > 6 else "full")
    axis.set(ylabel="error, % of the RMS displacement", yscale="log")
    axis.set_xticks(range(len(rows)), [row[0] for row in rows], rotation=30, ha="right")
    common.log_axis(axis.yaxis)
    common.plain(axis, "y")
    common.save(figure, path, legend_of=axis, columns=5)
