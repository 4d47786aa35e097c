"""Cook's membrane: convergence of the elements in plane stress, plane strain and finite strain."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc

THICKNESS = 0.5
CORNER, MIDDLE = (48.0, 60.0, 0.0), (48.0, 52.0, 0.0)
SIZES = (2, 4, 8, 16, 32)
"""Cells along each edge."""


def membrane(
    n: int, element: str, material: dict[str, Any], load: float, flat: bool, ramp: float = 0.0
) -> pc.Problem:
    """Mesh of n x n x 1 cells with the force ``load`` (N) for each metre of thickness.

    ``flat`` holds z on both faces (plane strain), otherwise on one only (plane stress).
    """
    faces = ["min", "max"] if flat else ["min"]
    clamps: list[dict[str, Any]] = [
        {"region": {"plane": "z", "at": at}, "components": ["z"]} for at in faces
    ]
    clamps.append({"region": {"plane": "x", "at": "min"}, "components": ["x", "y"]})
    traction = {
        "kind": "traction",
        "traction": [0.0, load / 16, 0.0],
        "region": {"plane": "x", "at": "max"},
        "ramp": ramp,
    }
    return common.mapped_block(
        (n, n, 1), _place, element, clamps=clamps, loads=[traction], time=common.STATIC,
        material={"density": 1.0, **material},
    )  # fmt: skip


def _place(unit: np.ndarray) -> np.ndarray:
    x, y, z = unit.T
    low, height = 44 * x, 44 - 28 * x
    return np.column_stack([48 * x, low + height * y, THICKNESS * z])


def lift(problem: pc.Problem, point: tuple[float, float, float], steps: int = 1) -> float:
    """Vertical displacement of the node at a point, m."""
    node = common.nearest(problem, point)
    moved = common.equilibrium(problem, steps)[node] - problem.positions[node]
    return float(moved[1])


def plane_stress(n: int, element: str) -> float:
    """Lift of the loaded edge's middle for E = 1, nu = 1/3, unit force and thickness."""
    load = 2e-4
    material = {"young": 1.0, "poisson": 1 / 3}
    return lift(membrane(n, element, material, load, flat=False), MIDDLE) / load


def plane_strain(n: int, element: str, poisson: float = 1 / 3) -> float:
    """Lift of the corner for E = 70 and force 100, by the slope at a small force."""
    load = 0.02
    material = {"young": 70.0, "poisson": poisson}
    return lift(membrane(n, element, material, load, flat=True), CORNER) * 100 / load


def incompressible(n: int, element: str) -> float:
    """The same for nu = 0.4999."""
    return plane_strain(n, element, 0.4999)


def finite_strain(n: int, element: str, steps: int = 5) -> float:
    """Lift of the corner for E = 240.565 at the full force; NaN without a stable equilibrium."""
    material = {"young": 240.565, "poisson": 0.4999, "energy": "neo-hookean"}
    problem = membrane(n, element, material, 100.0, flat=True, ramp=float(steps))
    try:
        return lift(problem, CORNER, steps)
    except RuntimeError:
        return float("nan")


PROBLEMS = {
    "plane stress": plane_stress,
    "plane strain": plane_strain,
    "near incompressible": incompressible,
    "neo-Hookean": finite_strain,
}


def compute(
    problems: Sequence[str] = tuple(PROBLEMS),
    elements: Sequence[str] = common.OFF_GRIDS,
    sizes: Sequence[int] = SIZES,
) -> common.Figures:
    """Lifts by problem, element and cells along an edge."""
    figures: common.Figures = {}
    for problem in problems:
        for element in elements:
            for n in sizes:
                figures[f"{problem}, {element}, {n}x{n}"] = PROBLEMS[problem](n, element)
    return figures


PUBLISHED = {
    "plane stress": (23.96, 23.96),
    "plane strain": (32.20, 32.28),
    "near incompressible": (27.35, 27.56),
    "neo-Hookean": (6.9, 6.9),
}
"""Least and largest of the values that others give, by problem; sources in the README."""


def draw(record: common.Record, path: Path) -> None:
    """Lifts against cells along an edge, a panel a problem, with the published values."""
    figure, panels = common.panels(12, 3.7, len(PROBLEMS))
    for axis, problem in zip(panels, PROBLEMS, strict=True):
        for element in common.OFF_GRIDS:
            colour, mark = common.ELEMENT_STYLES[element]
            lifts = [record.figures[f"{problem}, {element}, {n}x{n}"] for n in SIZES]
            values = [np.nan if lift is None else lift for lift in lifts]
            axis.plot(SIZES, values, color=colour, marker=mark, markersize=5, label=element)
        axis.axhspan(*PUBLISHED[problem], color="0.6", linewidth=1.2, label="published")
        common.axis_of_meshes(axis, problem, "cells along an edge", SIZES)
        axis.set_ylim(bottom=0.0)
    panels[0].set_ylabel("lift, units of length")
    common.save(figure, path, panels[0], 6)


def finding(record: common.Record) -> str:
    """Of the finest mesh near incompressibility."""
    lift, locked = (
        record.figures[f"near incompressible, {e}, 32x32"] for e in ("hex8-enhanced", "hex8")
    )
    return (
        f"Near incompressibility hex8-enhanced reaches {lift:.2f} (published 27.35 to 27.56), "
        f"hex8 {locked:.1f}: it locks."
    )


def case(quick: bool) -> common.Outcome:
    """The case's outcome."""
    if not quick:
        return common.Outcome(compute())
    figures = compute(("plane strain", "near incompressible"), ("hex8",), (4, 8))
    return common.Outcome(
        figures | compute(("plane stress",), ("hex8-bubble", "hex8-enhanced"), (32,))
    )
