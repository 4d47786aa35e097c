"""NAFEMS FV32: free vibration of a cantilevered tapered membrane in plane stress."""

from __future__ import annotations

import common
import numpy as np

import pdcorrect as pc

LENGTH, WIDTH, TIP, THICKNESS = 10.0, 5.0, 1.0, 0.05
"""m."""
PUBLISHED = (44.623, 130.03, 162.70, 246.05, 379.90, 391.44)
"""Hz."""
MESHES = (("hex27", 8), ("hex27", 16), ("hex8-enhanced", 16), ("hex8-enhanced", 32),
          ("hex8", 16), ("hex8", 32))  # fmt: skip
"""Elements and cells along the length; half as many across."""
QUICK = (("hex27", 16), ("hex8-enhanced", 32))


def place(unit: np.ndarray) -> np.ndarray:
    """The trapezium of the unit cube."""
    width = WIDTH + (TIP - WIDTH) * unit[:, 0]
    middle = unit[:, 1] - 0.5
    return np.column_stack([LENGTH * unit[:, 0], middle * width, THICKNESS * unit[:, 2]])


def frequencies(element: str, cells: int) -> np.ndarray:
    """Of the first six modes in the plane, Hz.

    One face is held in its plane, so that nothing bends and the thickness may change.
    """
    clamps = [
        {"region": {"plane": "x", "at": 0.0}},
        {"region": {"plane": "z", "at": 0.0}, "components": ["z"]},
    ]
    problem = common.mapped_block(
        (cells, cells // 2, 1), place, element,
        material={"young": 2e11, "poisson": 0.3, "density": 8e3}, clamps=clamps,
        time={"step": 1e-3, "frames": 1}, solver={"mass": "consistent"},
    )  # fmt: skip
    return np.asarray(pc.modes(problem, len(PUBLISHED)).frequencies)


def case(quick: bool) -> common.Outcome:
    """Frequencies over those published."""
    figures: common.Figures = {}
    rows = []
    for element, cells in QUICK if quick else MESHES:
        found = frequencies(element, cells)
        name = f"{element}, {cells}x{cells // 2}"
        for n, (value, wanted) in enumerate(zip(found, PUBLISHED, strict=True), start=1):
            figures[f"{name}, mode {n}, frequency over the published"] = float(value / wanted)
        rows.append((name, *map(float, found)))
    rows.append(("published", *PUBLISHED))
    heads = ("mesh", *(f"mode {n}, Hz" for n in range(1, 7)))
    return common.Outcome(figures, (common.Table("Frequencies", heads, tuple(rows)),))


def finding(record: common.Record) -> str:
    """Largest deviations."""

    def worst(mesh: str) -> float:
        return max(abs(x - 1.0) for name, x in record.figures.items() if name.startswith(mesh))

    return (
        f"The six frequencies are within {worst('hex27, 16x8'):.2%} of the published ones by "
        f"hex27 on 16×8 cells, {worst('hex8-enhanced, 32x16'):.1%} by the best coarse element "
        f"on 32×16 and {worst('hex8, 32x16'):.1%} by hex8 there."
    )
