"""Solver, time, discretisation and model error of one motion, each with the others held."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc
from pdcorrect.scene import trained_coarse

Array = np.ndarray

CELL = 0.05
STEP = 0.01
FRAMES = 40
TIGHT = 1e-10
"""Tolerance of what solver error is measured against, of the coarse cell size."""
ACCURATE = 1e-9
"""Of small steps: what is left of a step enters the velocity divided by the step."""

RAMP = {"window": [0.0, 10.0], "ramp": 0.1}
SCENE = pc.Scene(
    name="four errors",
    body={"shape": "beam", "cells": [12, 2, 2], "cell_size": CELL},
    material={"young": 3e5, "poisson": 0.4, "density": 1e3},
    clamps=[{"region": {"plane": "x", "at": "min"}}],
    loads=[
        {"kind": "gravity", "acceleration": [0, 0, -9.81], **RAMP},
        {"kind": "torsion", "strength": 4e4, **RAMP},
    ],
    time={"step": STEP, "frames": FRAMES, "integrator": "backward-euler"},
    solver={"tolerance": 1e-6},
)
"""What every run changes in one respect: hex8, lumped mass, backward Euler, corotated energy."""

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6)
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
SPLITS = (1, 2, 4, 8, 16)
"""Steps a frame."""
FINEST = 128
"""Steps a frame of the references of time error."""
EARLY, EARLY_FINEST = 10, 32
"""Frames, and steps a frame of the reference, of the orders that quick runs measure."""

BEST = trained_coarse(SCENE).solver.element
MESHES = {
    "hex8": {"element": "hex8", "mass": "lumped"},
    BEST: {"element": BEST, "mass": "averaged"},
    "hex27": {"element": "hex27", "mass": "averaged"},
}
REFINES = (1, 2)
FINE = 3
"""Refinement of the hex27 mesh that discretisation error is measured against."""

MODELS: dict[str, dict[str, Any]] = {
    "volume weight published": {"volume_weight": "published"},
    "neo-hookean": {"energy": "neo-hookean"},
    "st-venant-kirchhoff": {"energy": "st-venant-kirchhoff"},
    "arap": {"energy": "arap"},
}


def run(scene: pc.Scene, refine: int = 1, newton: bool = False) -> pc.Trajectory:
    """All steps.

    Raises
    ------
    RuntimeError
        If a step needs a fallback: one in sub-steps would have another time error.
    """
    problem = pc.discretise(scene, refine=refine)
    made = pc.rollout(pc.Newton(problem) if newton else pc.ProjectiveDynamics(problem))
    if (made.stats["status"] != pc.Status.CONVERGED.name).any():
        raise RuntimeError(f"{problem!r}: a step needed a fallback")
    return made


def stepped(integrator: str, split: int, frames: int = FRAMES) -> Array:
    """Positions (T+1, N, 3) at the frames, with ``split`` steps a frame."""
    time = {"step": STEP / split, "frames": frames * split, "integrator": integrator}
    changed = SCENE.with_changes(time=time, solver={"tolerance": ACCURATE})
    return run(changed).positions[::split]


def tight() -> Array:
    """Positions (T+1, N, 3) of the scene itself without solver error."""
    return run(SCENE.with_changes(solver={"tolerance": TIGHT})).positions


def solver_error() -> common.Figures:
    """PD at several tolerances, and Newton at the tightest, against PD at the tightest."""
    truth, figures = tight(), {}
    for tolerance in TOLERANCES:
        changed = SCENE.with_changes(solver={"tolerance": tolerance})
        label = f"solver, {tolerance:g}"
        figures |= _error(label, run(changed).positions, truth)
        figures[f"{label}, of the tolerance"] = figures[f"{label}, mm"] / (1e3 * CELL * tolerance)
    newton = run(SCENE.with_changes(solver={"tolerance": TIGHT}), newton=True)
    return figures | _error("solver, Newton", newton.positions, truth)


def time_error() -> common.Figures:
    """Integrators against midpoint with `FINEST` steps a frame, and the order of each."""
    truth = stepped("midpoint", FINEST)
    figures = _error("time, reference", stepped("generalised-alpha", FINEST), truth)
    for integrator in INTEGRATORS:
        for split in SPLITS:
            label = f"time, {integrator}, {_step(split)}"
            figures |= _error(label, stepped(integrator, split), truth)
        for split, finer in itertools.pairwise(SPLITS):
            steps = _step(split), _step(finer)
            before, after = (figures[f"time, {integrator}, {step}, mm"] for step in steps)
            figures[f"order, {integrator}, {' to '.join(steps)}"] = float(np.log2(before / after))
    return figures


def early_orders() -> common.Figures:
    """Orders of two integrators while the loads rise, against midpoint."""
    truth, figures = stepped("midpoint", EARLY_FINEST, EARLY), {}
    for integrator in ("backward-euler", "midpoint"):
        found = (stepped(integrator, split, EARLY) for split in (2, 4))
        before, after = (pc.metrics.rms_error(positions, truth) for positions in found)
        label = f"order over {EARLY} frames, {integrator}, {_step(2)} to {_step(4)}"
        figures[label] = float(np.log2(before / after))
    return figures


def discretisation_error() -> common.Figures:
    """Elements and refinements on the coarse nodes, against a fine mesh of hex27."""

    def on_coarse(name: str, refine: int) -> Array:
        made = run(SCENE.with_changes(solver=MESHES[name]), refine)
        return pc.restrict(made, to=coarse).positions

    coarse = pc.discretise(SCENE)
    truth, figures = on_coarse("hex27", FINE), {}
    for name in MESHES:
        for refine in REFINES:
            figures |= _error(f"mesh, {name} {refine}x", on_coarse(name, refine), truth)
    return figures


def model_error(mesh: str = "hex8") -> common.Figures:
    """Other energies against the default one on the same coarse mesh."""
    scene, figures = SCENE.with_changes(solver=MESHES[mesh]), {}
    truth = run(scene).positions
    place = "" if mesh == "hex8" else f", on {mesh}"
    for name, material in MODELS.items():
        found = run(scene.with_changes(material=material)).positions
        figures |= _error(f"model, {name}{place}", found, truth)
    return figures


def _step(split: int) -> str:
    return "h" if split == 1 else f"h/{split}"


def _size(positions: Array) -> float:
    """RMS displacement over nodes and frames, m."""
    return pc.metrics.rms_error(positions, np.broadcast_to(positions[0], positions.shape))


def _error(label: str, found: Array, truth: Array) -> common.Figures:
    """RMS distance over nodes and frames in mm, and in per cent of the RMS displacement."""
    error = pc.metrics.rms_error(found, truth)
    return {f"{label}, mm": 1e3 * error, f"{label}, per cent": 100.0 * error / _size(truth)}


RATIOS = (
    ("time, backward-euler, h", "mesh, hex8 1x"),
    ("time, midpoint, h", "time, backward-euler, h"),
    ("time, midpoint, h", f"mesh, {BEST} 1x"),
    (f"mesh, {BEST} 1x", "mesh, hex8 1x"),
    ("mesh, hex27 1x", "mesh, hex8 2x"),
    ("model, volume weight published", f"mesh, {BEST} 1x"),
    ("model, neo-hookean", "model, st-venant-kirchhoff"),
    ("solver, 1e-05", "model, neo-hookean"),
)
"""Errors whose order of size is a statement of the case."""


def compute() -> common.Figures:
    """All figures."""
    figures = {"displacement, mm": 1e3 * _size(tight())}
    figures |= solver_error() | time_error() | early_orders()
    figures |= discretisation_error() | model_error() | model_error("hex27")
    for above, below in RATIOS:
        figures[f"ratio, {above} over {below}"] = figures[f"{above}, mm"] / figures[f"{below}, mm"]
    return figures


KINDS = {
    "solver": "solver error: 10 ms, tolerance in cells, against 1e-10",
    "time": "time error: 10 ms, against 10/128 ms",
    "mesh": "discretisation error: against hex27 3x",
    "model": "model error: against the corotated energy",
}


def draw(record: common.Record, path: Path) -> None:
    """Bars on a logarithmic axis, grouped by the kind of error."""
    figures = record.figures
    figure, axis = common.panels(9, 6.2)
    names = [n.removesuffix(", mm") for n in figures if n.endswith(", mm")]
    names = [n for n in names if n.startswith("time") == n.endswith(", h") and ", on " not in n]
    place, labels = 0.0, {}
    for k, (kind, label) in enumerate(KINDS.items()):
        place += 0.7
        for name in (n for n in names if n.startswith(f"{kind}, ") and n != "solver, Newton"):
            value = figures[f"{name}, mm"]
            axis.barh(place, value, 0.78, color=common.COLOURS[k], label=label)
            axis.annotate(
                f"{value:.3g}", (value, place), (5, 0), textcoords="offset points", va="center"
            )
            labels[place] = name.removeprefix(f"{kind}, ").removesuffix(", h")
            label, place = "", place + 1.0
    axis.set_yticks(list(labels), list(labels.values()))
    axis.invert_yaxis()
    moved = f"RMS displacement {figures['displacement, mm']:.0f} mm"
    label = f"RMS distance of a node over nodes and frames, mm ({moved})"
    axis.set(xscale="log", xlim=(5e-6, 100.0), xlabel=label)
    common.plain(axis, "x")
    common.save(figure, path, axis, 2)


def finding(record: common.Record) -> str:
    """The four kinds by size."""
    names = ("time, backward-euler, h", "time, midpoint, h", f"mesh, {BEST} 1x", "solver, 1e-05")
    euler, midpoint, mesh, solver = (record.figures[f"{name}, mm"] for name in names)
    return (
        f"At 10 ms backward Euler's time error is {euler:.0f} mm (midpoint {midpoint:.1f}), the "
        f"best coarse mesh's {mesh:.1f}, the default tolerance's {solver:.0e}."
    )


def case(quick: bool) -> common.Outcome:
    """The case's outcome; quick runs have no mesh error, and orders over few frames."""
    return common.Outcome(solver_error() | early_orders() | model_error() if quick else compute())
