"""Orders in time of every integrator, by load and damping, and the momentum of impulses."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import common
import motions
import numpy as np
from motions import DAMPING, END, FRAMES, MOTIONS

import pdcorrect as pc

INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
COUNTS = (40, 80, 160)
"""Steps up to the end; the order is that between the last two."""
QUICK = (("ramp", "none"), ("impulse", "none"), ("follower torsion", "none"), ("ramp", "viscosity"))
HEADS = ("load", "damping", "integrator", "order", "order of velocities",
         *(f"error, {n} steps" for n in COUNTS))  # fmt: skip


def errors(problem: pc.Problem, exact: tuple[np.ndarray, np.ndarray], steps: int) -> list[float]:
    """RMS errors of positions and velocities over all frames, m and m/s."""
    free, every = problem.free.ravel(), steps // FRAMES
    run = pc.rollout(pc.Newton(problem, tolerance=1e-10, time_step=END / steps), steps)
    return [
        float(np.sqrt(np.mean((values[every::every].reshape(FRAMES, -1)[:, free] - wanted) ** 2)))
        for values, wanted in zip((run.positions, run.velocities), exact, strict=True)
    ]


def orders(pairs: tuple[tuple[str, str], ...], quick: bool) -> common.Outcome:
    """Of all integrators for some loads with some damping."""
    figures: common.Figures = {}
    rows = []
    for motion, damping in pairs:
        rest = motions.body(motion, damping)
        exact = motions.reference(rest, motion)
        size = np.sqrt(np.mean((exact[0] - rest.positions.ravel()[rest.free.ravel()]) ** 2))
        for name in INTEGRATORS:
            problem = motions.body(motion, damping, name)
            counts = COUNTS[-2:] if quick else COUNTS
            found = np.array([errors(problem, exact, n) for n in counts])
            order = np.log2(found[-2] / found[-1])
            figures[f"{motion}, {damping}, {name}, order"] = float(order[0])
            shares = [np.nan] * (len(COUNTS) - len(counts)) + list(found[:, 0] / size)
            rows.append((motion, damping, name, *map(float, (*order, *shares))))
    return common.Outcome(figures, (common.Table("Orders in time", HEADS, tuple(rows)),))


STEPS_MS, IMPULSES_MS = (2.0, 4.0, 10.0, 20.0), (3.0, 10.0, 25.0)
AFTER = 20
"""Steps; the two-step schemes need some to settle."""


def momentum(quick: bool) -> common.Outcome:
    """Of a free body over that of the impulse on it, step by step."""
    figures: common.Figures = {}
    rows = []
    push = np.array([3.0, -2.0, 5.0])
    for name in INTEGRATORS:
        for step in STEPS_MS:
            for length in IMPULSES_MS:
                scene = pc.Scene(
                    body={"shape": "beam", "cells": [2, 1, 1], "cell_size": 0.05},
                    material={"young": 1e5, "poisson": 0.3, "density": 1e3},
                    time={"step": 1e-3 * step, "frames": AFTER, "integrator": name},
                    loads=[{"kind": "gravity", "acceleration": push, "window": (0, 1e-3 * length)}],
                    solver={"tolerance": 1e-9},
                )  # fmt: skip
                problem = pc.discretise(scene)
                run = pc.rollout(pc.ProjectiveDynamics(problem))
                wanted = problem.mass.sum() * 1e-3 * length * push
                found = np.stack([problem.mass_times(v).sum(axis=0) for v in run.velocities])
                shares = found @ wanted / (wanted @ wanted)
                label = f"{name}, impulse of {length:g} ms, step {step:g} ms"
                figures[f"{label}, momentum"] = float(shares[-1])
                over = np.maximum.accumulate(shares[::-1])[::-1]  # of this frame and all later
                first = [float(shares[n]) for n in range(1, 7)]
                rows.append((name, length, step, *first, float(shares[-1]), float(over.max())))
    heads = ("integrator", "impulse, ms", "step, ms", *(f"step {n}" for n in range(1, 7)),
             f"step {AFTER}", "largest")  # fmt: skip
    return common.Outcome(figures, (common.Table("Momentum over impulse", heads, tuple(rows)),))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """Momentum, and orders a load."""
    out: dict[str, Callable[[], common.Outcome]] = {"momentum": partial(momentum, quick)}
    if quick:
        return out | {"orders": partial(orders, QUICK, quick)}
    for motion in MOTIONS:
        pairs = tuple((motion, damping) for damping in DAMPING)
        out[motion] = partial(orders, pairs, quick)
    return out


def finding(record: common.Record) -> str:
    """Range of the orders and the farthest momentum."""
    found: dict[bool, list[float]] = {True: [], False: []}
    for row in record.table("Orders in time")["rows"]:
        found[row[2] == "backward-euler"].append(row[3])
    far = max(abs(row[-2] - 1.0) for row in record.table("Momentum over impulse")["rows"])
    first, second = found[True], found[False]
    return (
        f"Backward Euler has orders {min(first):.2f} to {max(first):.2f}, the others "
        f"{min(second):.2f} to {max(second):.2f}, whatever the load and the damping. Impulses "
        f"keep their momentum to {far:.0e}, shorter and longer than a step."
    )


def draw(record: common.Record, path: Path) -> None:
    """Orders by load, a panel a damping."""
    figure, panels = common.panels(13, 3.6, len(DAMPING), sharey=True)
    rows = record.table("Orders in time")["rows"]
    for axis, damping in zip(panels, DAMPING, strict=True):
        for k, name in enumerate(INTEGRATORS):
            found = [row[3] for motion in MOTIONS for row in rows
                     if row[:3] == [motion, damping, name]]  # fmt: skip
            places = np.arange(len(MOTIONS)) + 0.16 * (k - 1.5)
            axis.plot(places, found, common.MARKS[k], color=common.COLOURS[k], label=name)
        axis.set_xticks(range(len(MOTIONS)), MOTIONS, rotation=50, ha="right")
        axis.set(title=f"damping: {damping}", ylim=(0.5, 2.5))
        common.plain(axis, "y")
    panels[0].set_ylabel("order of positions")
    common.save(figure, path, panels[0], 4)
