"""Energy of long runs, and steps much longer than all periods, by integrator and radius."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc

CELL, STEP, YOUNG, DENSITY = 0.05, 0.01, 1e5, 1e3
"""m, s, Pa, kg/m3."""
STIFFNESS = 1e4
"""E h^2 / (density CELL^2) of the stiff body: waves cross 100 cells in a step."""
LONG, SETTLED = 5000, 100
"""Steps, and those after which the energy has to be below that of the start."""
RINGING = 60
STIFF_TWIST, TWIST = 30.0, 90.0
"""Degrees at the free end."""
FINE = 16
"""Steps of the reference in one of the others."""
SCHEMES: dict[str, dict[str, Any]] = {
    "backward-euler": {"integrator": "backward-euler"},
    "bdf2": {"integrator": "bdf2"},
    "midpoint": {"integrator": "midpoint"},
    **{
        f"generalised-alpha, radius {r:g}": {
            "integrator": "generalised-alpha",
            "spectral_radius": r,
        }
        for r in (0.0, 0.5, 0.8, 0.9)
    },
}
"""Settings of the time section; radius 1 gives the positions of midpoint at rest and linear."""
DEFAULT = "generalised-alpha, radius 0.8"
WEIGHT = {"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}
CURVES = "Deflection over static - 1 by step"
IMPULSE = {"kind": "gravity", "acceleration": [0.0, 60.0, -90.0], "window": [0.0, 0.01]}


def beam(
    scheme: str, young: float, frames: int, split: int = 1, loads: tuple[Any, ...] = ()
) -> pc.Problem:
    """A cantilever of 6×2×2 cells on the best coarse mesh."""
    scene = pc.Scene(
        body={"shape": "beam", "cells": [6, 2, 2], "cell_size": CELL},
        material={"young": young, "poisson": 0.4, "density": DENSITY},
        time={"step": STEP / split, "frames": frames * split, **SCHEMES[scheme]},
        clamps=[{"region": {"plane": "x", "at": "min"}}], loads=list(loads),
        solver={"tolerance": 1e-6},
    )  # fmt: skip
    return pc.discretise(pc.best_coarse(scene))


def twisted(problem: pc.Problem, degrees: float) -> pc.State:
    """At rest, turned about the axis in proportion to the distance from the held end."""
    x = problem.positions
    angle = np.radians(degrees) * x[:, 0] / x[:, 0].max()
    arm = x[:, 1:] - 0.5 * x[:, 1:].max(axis=0)
    y = np.cos(angle) * arm[:, 0] - np.sin(angle) * arm[:, 1]
    z = np.sin(angle) * arm[:, 0] + np.cos(angle) * arm[:, 1]
    turned = np.column_stack([arm[:, 0] - y, arm[:, 1] - z])
    positions = x.copy()
    positions[:, 1:] -= turned
    return pc.State(positions, np.zeros_like(x))


def energies(scheme: str, young: float, degrees: float, steps: int) -> np.ndarray:
    """Of all frames over that of the twisted start; up to a step that failed."""
    problem = beam(scheme, young, steps)
    run = pc.rollout(
        pc.ProjectiveDynamics(problem), state=twisted(problem, degrees), on_failure="stop"
    )
    total = pc.metrics.energy_balance(run).total
    return np.asarray(total / total[0])


def long(quick: bool) -> common.Outcome:
    """Energy over thousands of steps without damping."""
    figures: common.Figures = {}
    steps = LONG // 10 if quick else LONG
    rows = []
    for scheme in (DEFAULT,) if quick else SCHEMES:
        found = energies(scheme, YOUNG, TWIST, steps)
        figures[f"long, {scheme}, largest"] = float(found.max())
        figures[f"long, {scheme}, largest after {SETTLED} steps"] = float(found[SETTLED:].max())
        if not quick:
            shown = [float(found[n]) if n < len(found) else np.nan for n in (100, 1000, steps)]
            rows.append((scheme, float(len(found) - 1), float(found.max()), *shown))
    heads = ("integrator", "steps", "largest", *(f"step {n}" for n in (100, 1000, steps)))
    return common.Outcome(
        figures, (common.Table("Energy over that of the start", heads, tuple(rows)),)
    )


def stiff(quick: bool) -> common.Outcome:
    """A stiff body let go twisted, and one that its weight is put on."""
    young = STIFFNESS * DENSITY * CELL**2 / STEP**2
    still = beam("midpoint", young, 1, loads=(WEIGHT,))
    static = common.equilibrium(still)[-1, 2] - still.positions[-1, 2]
    figures: common.Figures = {}
    at = (1, 2, 5, 10, 20, 40, RINGING)
    twist, weight, curves = [], [], []
    for scheme in ("backward-euler", "bdf2", DEFAULT) if quick else SCHEMES:
        energy = energies(scheme, young, STIFF_TWIST, RINGING)
        figures[f"stiff twist, {scheme}, largest"] = float(energy.max())
        figures[f"stiff twist, {scheme}, step {RINGING}"] = float(energy[-1])
        twist.append((scheme, *(float(energy[n]) if n < len(energy) else np.nan for n in at)))
        problem = beam(scheme, young, RINGING, loads=(WEIGHT,))
        run = pc.rollout(pc.Newton(problem, tolerance=1e-9))
        off = (run.positions[:, -1, 2] - problem.positions[-1, 2]) / static - 1.0
        figures[f"stiff weight, {scheme}, step {RINGING}"] = float(abs(off[-5:]).max())
        weight.append((scheme, *(float(off[n]) for n in at)))
        curves += [(scheme, float(n), float(x)) for n, x in enumerate(off)]
    heads = ("integrator", *(f"step {n}" for n in at))
    tables = (
        common.Table("Stiff body let go twisted: energy over the start's", heads, tuple(twist)),
        common.Table("Stiff body under its weight: deflection over static - 1", heads,
                     tuple(weight)),
        common.Table(CURVES, ("integrator", "step", "deflection"), tuple(curves)),
    )  # fmt: skip
    return common.Outcome(figures, tables)


MOTIONS: dict[str, tuple[tuple[Any, ...], float]] = {
    "twisted by 90°, let go": ((), TWIST),
    "weight from time 0": ((WEIGHT,), 0.0),
    "impulse of 10 ms": ((IMPULSE,), 0.0),
}
"""Loads, and the twist of the start in degrees."""


def accuracy(quick: bool) -> common.Outcome:
    """Errors in 60 steps of 10 ms of the soft body, per cent of the RMS displacement."""
    figures: common.Figures = {}
    rows = []
    names = (DEFAULT,) if quick else tuple(SCHEMES)
    for motion, (loads, degrees) in list(MOTIONS.items())[: 0 if quick else None]:

        def path(
            scheme: str, split: int, loads: Any = loads, degrees: float = degrees
        ) -> np.ndarray:
            problem = beam(scheme, YOUNG, 60, split, loads)
            start = twisted(problem, degrees)
            run = pc.rollout(pc.ProjectiveDynamics(problem), state=start)
            return run.positions[::split] - problem.positions

        exact = path(DEFAULT, FINE)
        size = float(np.sqrt((exact**2).sum(axis=-1).mean()))
        found = [
            100.0 * float(np.sqrt(((path(name, 1) - exact) ** 2).sum(axis=-1).mean())) / size
            for name in names
        ]
        figures |= {f"{motion}, {n}, %": x for n, x in zip(names, found, strict=True)}
        rows.append((motion, 1e3 * size, *found))
    heads = ("motion", "RMS displacement, mm", *names)
    return common.Outcome(
        figures, (common.Table("Errors, % of the RMS displacement", heads, tuple(rows)),)
    )


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """Long runs, stiff bodies, accuracy."""
    out = {"stiff": partial(stiff, quick), "long": partial(long, quick)}
    return out if quick else out | {"accuracy": partial(accuracy, quick)}


def finding(record: common.Record) -> str:
    """What the default does."""
    f = record.figures
    return (
        f"Over {LONG} steps generalised-α keeps the energy of an undamped twisted beam below "
        f"{f[f'long, {DEFAULT}, largest']:.2f} times that of the start, and below "
        f"{f[f'long, {DEFAULT}, largest after {SETTLED} steps']:.2f} after the first {SETTLED}; a "
        f"stiff body under its weight still swings by "
        f"{f[f'stiff weight, {DEFAULT}, step {RINGING}']:.0%} of its deflection after {RINGING} "
        "steps, by radius 0 not at all."
    )


def draw(record: common.Record, path: Path) -> None:
    """Energies by step of long runs are in the table; drawn is the stiff body under its weight."""
    figure, panels = common.panels(12, 3.8, 2)
    rows = record.table(CURVES)["rows"]
    for k, scheme in enumerate(SCHEMES):
        steps = [row[1] for row in rows if row[0] == scheme]
        off = [row[2] for row in rows if row[0] == scheme]
        style = {"color": common.COLOURS[k], "label": scheme, "linewidth": 1.2}
        panels[0].plot(steps, np.array(off) + 1.0, **style)
    panels[0].set(title="stiff beam under its weight", xlabel="step", ylabel="deflection / static")
    at = (1, 2, 5, 10, 20, 40, RINGING)
    for k, row in enumerate(record.tables[0]["rows"]):
        panels[1].plot((0, *at), (1.0, *row[1:]), common.MARKS[k] + "-", color=common.COLOURS[k])
    panels[1].set(title="stiff beam let go twisted", xlabel="step", ylabel="energy / start",
                  yscale="log", ylim=(1e-12, 1e5))  # fmt: skip
    for axis in panels:
        common.plain(axis)
    common.save(figure, path, panels[0], 4)
