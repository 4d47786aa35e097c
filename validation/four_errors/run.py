"""Solver, time, discretisation and model error of one motion, each with the others held."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc

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
    time={"step": STEP, "frames": FRAMES},
    solver={"tolerance": 1e-6},
)
"""What every run changes in one respect: hex8, lumped mass, backward Euler, corotated energy."""

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6)
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
SPLITS = (1, 2, 4, 8, 16)
"""Steps a frame."""
FINEST = 128
"""Steps a frame of the references of time error."""

BEST = pc.best_coarse(SCENE).solver.element
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


def stepped(integrator: str, split: int, tolerance: float = ACCURATE) -> Array:
    """Positions (T+1, N, 3) at the frames, with ``split`` steps a frame."""
    time = {"step": STEP / split, "frames": FRAMES * split, "integrator": integrator}
    changed = SCENE.with_changes(time=time, solver={"tolerance": tolerance})
    return run(changed).positions[::split]


def tight() -> Array:
    """Positions (T+1, N, 3) of the scene itself without solver error."""
    return run(SCENE.with_changes(solver={"tolerance": TIGHT})).positions


def solver_error(tolerances: Sequence[float] = TOLERANCES) -> common.Figures:
    """PD at several tolerances, and Newton at the tightest, against PD at the tightest."""
    truth, figures = tight(), {}
    for tolerance in tolerances:
        changed = SCENE.with_changes(solver={"tolerance": tolerance})
        label = f"solver, {tolerance:g}"
        figures |= _error(label, run(changed).positions, truth)
        figures[f"{label}, of the tolerance"] = figures[f"{label}, mm"] / (1e3 * CELL * tolerance)
    newton = run(SCENE.with_changes(solver={"tolerance": TIGHT}), newton=True)
    return figures | _error("solver, Newton", newton.positions, truth)


def time_error(
    integrators: Sequence[str] = INTEGRATORS,
    splits: Sequence[int] = SPLITS,
    finest: int = FINEST,
) -> common.Figures:
    """Integrators against midpoint with ``finest`` steps a frame, and the order of each."""
    truth, figures = stepped("midpoint", finest), {}
    for integrator in integrators:
        errors = []
        for split in splits:
            label = f"time, {integrator}, {_step(split)}"
            figures |= _error(label, stepped(integrator, split), truth)
            errors.append(figures[f"{label}, mm"])
        for k in range(1, len(splits)):
            order = np.log(errors[k - 1] / errors[k]) / np.log(splits[k] / splits[k - 1])
            steps = f"{_step(splits[k - 1])} to {_step(splits[k])}"
            figures[f"order, {integrator}, {steps}"] = float(order)
    return figures


def time_reference() -> common.Figures:
    """Two references of time error against each other."""
    other = stepped("generalised-alpha", FINEST)
    return _error("time, reference", other, stepped("midpoint", FINEST))


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
    figures |= solver_error() | time_error() | time_reference()
    figures |= discretisation_error() | model_error() | model_error("hex27")
    for above, below in RATIOS:
        figures[f"ratio, {above} over {below}"] = figures[f"{above}, mm"] / figures[f"{below}, mm"]
    return figures


# --- figure ----------------------------------------------------------------------------------

_KINDS = {
    "solver": ("#009e73", "solver error: h = 0.01 s, against 10⁻¹⁰ cells"),
    "time": ("#0072b2", "time error: h = 0.01 s, against 0.01/128 s"),
    "mesh": ("#e69f00", "discretisation error: against hex27 3x"),
    "model": ("#d55e00", "model error: against the corotated energy"),
}


def _rows() -> list[tuple[str, str, str]]:
    """Kind, name shown and figure of each bar, from the top."""
    powers = "⁰¹²³⁴⁵⁶⁷⁸⁹"
    rows = []
    for tolerance in TOLERANCES:
        shown = f"to 10⁻{powers[round(-np.log10(tolerance))]} cells"
        rows.append(("solver", shown, f"solver, {tolerance:g}"))
    rows += [("time", name, f"time, {name}, h") for name in INTEGRATORS]
    names = {"hex8 1x": "hex8 (plain coarse)", f"{BEST} 1x": f"{BEST} (best coarse)"}
    for name in MESHES:
        rows += [
            ("mesh", names.get(mesh, mesh.removesuffix(" 1x")), f"mesh, {mesh}")
            for mesh in (f"{name} {refine}x" for refine in REFINES)
        ]
    return rows + [("model", name, f"model, {name}") for name in MODELS]


def draw(record: common.Record, path: Path) -> None:
    """Bars on a logarithmic axis, grouped by the kind of error."""
    figures = record.figures
    figure, axis = common.panels(9, 6.2)
    place, last, places, legend = 0.0, "", [], {}
    for kind, _, name in _rows():
        place += 1.0 if kind == last else 1.7
        colour, label = _KINDS[kind]
        value = figures[f"{name}, mm"]
        legend[label] = axis.barh(place, value, 0.78, color=colour)
        axis.annotate(
            f"{value:.3g}", (value, place), (5, 0), textcoords="offset points", va="center"
        )
        places.append(place)
        last = kind
    axis.set_yticks(places, [shown for _, shown, _ in _rows()])
    axis.invert_yaxis()
    moved = f"RMS displacement {figures['displacement, mm']:.0f} mm"
    label = f"RMS distance of a node over nodes and frames, mm ({moved})"
    axis.set(xscale="log", xlim=(5e-6, 100.0), xlabel=label)
    common.plain(axis, "x")
    figure.legend(
        legend.values(), legend.keys(), loc="outside upper center", ncols=2, frameon=False
    )
    common.save(figure, path)


def finding(record: common.Record) -> str:
    """The four kinds by size."""
    names = ("time, backward-euler, h", "time, midpoint, h", f"mesh, {BEST} 1x", "solver, 1e-05")
    euler, midpoint, mesh, solver = (record.figures[f"{name}, mm"] for name in names)
    return (
        f"At 10 ms backward Euler's time error is {euler:.0f} mm (midpoint {midpoint:.1f}), the "
        f"best coarse mesh's {mesh:.1f}, the default tolerance's {solver:.0e}."
    )


def case(quick: bool) -> common.Outcome:
    """The case's outcome; quick runs leave time steps and meshes out."""
    return common.Outcome(solver_error() | model_error() if quick else compute())
