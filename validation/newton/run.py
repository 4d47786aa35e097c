"""PD against full Newton FEM, other energies, and whether the references have converged."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import common
import numpy as np

import pdcorrect as pc

Array = np.ndarray
CELL, STEP, FRAMES = 0.05, 0.01, 20
END = {"plane": "x", "at": "max"}
MOTIONS: dict[str, dict[str, Any]] = {
    "bend": {"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]},
    "twist": {"kind": "torsion", "strength": 4e4},
    "stretch": {"kind": "traction", "traction": [3e4, 0.0, 0.0], "region": END},
}
STRENGTH = {"bend": "acceleration", "twist": "strength", "stretch": "traction"}
SHARES = (0.01, 0.1, 1.0)
"""Of the load, in the comparison of energies."""
TIGHT = 1e-8


def scene(motion: str, share: float = 1.0, split: int = 1, **sections: Any) -> pc.Scene:
    """A beam of 6 x 2 x 2 cells under a share of the motion's load; ``split`` steps a frame."""
    key = STRENGTH[motion]
    load = {**MOTIONS[motion], key: (share * np.array(MOTIONS[motion][key])).tolist()}
    settings = {
        "body": {"shape": "beam", "cells": [6, 2, 2], "cell_size": CELL},
        "material": {"young": 3e5, "poisson": 0.4, "density": 1e3},
        "clamps": [{"region": {"plane": "x", "at": "min"}}], "loads": [load],
        "time": {"step": STEP / split, "frames": FRAMES * split, "integrator": "backward-euler"},
    }  # fmt: skip
    for name, change in sections.items():
        settings[name] = {**settings.get(name, {}), **change}
    return pc.Scene(**settings)


def positions(told: pc.Scene, refine: int = 1, split: int = 1, newton: bool = False) -> Array:
    """Positions at the frames, (T+1, N, 3), on the coarse nodes."""
    problem = pc.discretise(told, refine=refine)
    stepper = pc.Newton(problem) if newton else pc.ProjectiveDynamics(problem, TIGHT)
    run = pc.restrict(pc.rollout(stepper), to=pc.discretise(told))
    return run.positions[::split]


def far(a: Array, b: Array) -> float:
    """RMS distance of a node, m."""
    return pc.metrics.rms_error(a, b)


def solver_error(motion: str, element: str) -> common.Figures:
    """Largest distance of PD from Newton on the same energy, in cells."""
    told = scene(motion, solver={"element": element})
    by_pd, by_newton = positions(told), positions(told, newton=True)
    name = f"solver, {motion}, {element}"
    return {
        f"{name}, cells": pc.metrics.largest_error(by_pd, by_newton) / CELL,
        f"{name}, displacement, cells": pc.metrics.largest_displacement(by_newton) / CELL,
    }


def model_error(motion: str) -> common.Figures:
    """Newton FEM with stable neo-Hookean energy against the corotated one, by load."""
    errors = []
    for share in SHARES:
        truth = positions(scene(motion, share), newton=True)
        other = scene(motion, share, material={"energy": "neo-hookean"})
        size = far(truth, np.broadcast_to(truth[0], truth.shape))
        errors.append(100.0 * far(positions(other, newton=True), truth) / size)
    figures = {
        f"model, {motion}, {share:g} of the load, per cent": error
        for share, error in zip(SHARES, errors, strict=True)
    }
    order = float(np.log10(errors[1] / errors[0]))
    return figures | {f"model, {motion}, order in the load": order}


def converging(name: str, runs: list[Array]) -> common.Figures:
    """Distances between neighbours in a sequence of finer runs, and their order."""
    steps = [far(a, b) for a, b in itertools.pairwise(runs)]
    figures = {f"{name}, change {k + 1}, mm": 1e3 * d for k, d in enumerate(steps)}
    for k, (a, b) in enumerate(itertools.pairwise(steps)):
        figures[f"{name}, order {k + 1}"] = float(np.log2(a / b))
    return figures


def mesh(motion: str, refines: tuple[int, ...]) -> common.Figures:
    """Best element on ever finer meshes; what is left on the 4x4x4 mesh, of the coarse error."""
    told = scene(motion, solver={"element": "hex8-bubble", "mass": "averaged"})
    runs = [positions(told, refine) for refine in refines]
    figures = converging(f"mesh, {motion}", runs)
    if 8 in refines:
        truth = runs[-1]
        left = far(runs[-2], truth) / far(runs[0], truth)
        figures[f"mesh, {motion}, 4x error over coarse error"] = left
    return figures


def time(motion: str, splits: tuple[int, ...]) -> common.Figures:
    """Backward Euler at ever smaller steps."""
    runs = [positions(scene(motion, split=s), split=s) for s in splits]
    return converging(f"time, {motion}", runs)


def outcome(motion: str, quick: bool) -> common.Outcome:
    """All figures of a motion."""
    figures: common.Figures = {}
    for element in ("hex8", "hex8-bubble-mean") if quick else common.ELEMENTS:
        figures |= solver_error(motion, element)
    refines = (1, 2, 4) if quick else (1, 2, 4, 8)
    splits = (1, 2, 4, 8) if quick else (1, 2, 4, 8, 16, 32)
    return common.Outcome(
        figures | model_error(motion) | mesh(motion, refines) | time(motion, splits)
    )


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """One part a motion; quick runs have one."""
    return {m: partial(outcome, m, quick) for m in (("bend",) if quick else MOTIONS)}


def finding(record: common.Record) -> str:
    """PD beside Newton, and the error of the reference."""
    solver = [x for name, x in record.figures.items() if name.startswith("solver,")]
    apart = max(solver[::2])  # every other one is the displacement
    left = max(record.figures[f"mesh, {m}, 4x error over coarse error"] for m in MOTIONS)
    other = record.figures["model, stretch, 1 of the load, per cent"]
    return (
        f"PD and Newton agree to {apart:.0e} cells. Neo-Hookean differs by at most {other:.1f} %. "
        f"The reference's own error is up to {left:.0%} of the best coarse element's."
    )
