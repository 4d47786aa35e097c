"""Volumetric and shear locking of the elements, and what distorted cells do to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import common
import numpy as np

POISSONS = (0.3, 0.4, 0.45, 0.49, 0.499, 0.4999)
SLENDERNESSES = (2, 5, 10, 20, 50)
SHAPES = {"bricks": 0.0, "trapezoids": 0.1, "parallelograms": -0.1}
CELLS = 10
"""Along the slender beams, whatever their length: the cells stretch with it."""

HELD = {"region": {"plane": "x", "at": "min"}}


def cantilever(
    size: tuple[float, float, float],
    cells: tuple[int, int, int],
    element: str,
    material: dict[str, float],
    skew: float = 0.0,
    direction: int = 2,
) -> float:
    """Tip deflection (m) under a unit force on the end, as small strain gives it.

    ``skew`` (m) moves the inner cross-sections' top forwards and bottom backwards, in turn
    (trapezoids); all alike if ``skew`` is negative (parallelograms).
    """
    length, width, height = size

    def place(unit: np.ndarray) -> np.ndarray:
        points = unit * np.array(size)
        station = np.round(unit[:, 0] * cells[0])
        inner = (station > 0) & (station < cells[0])
        turn = np.where(station % 2 == 1, 1.0, -1.0) if skew > 0 else -1.0
        points[:, 0] += inner * turn * skew * (2 * unit[:, 2] - 1)
        return points

    slender = length / (height if direction == 2 else width)
    stiffness = material["young"] * width * height / slender**2 / length
    force = common.SMALL * length * stiffness / 4  # deflects by about SMALL
    traction = [0.0, 0.0, 0.0]
    traction[direction] = force / (width * height)
    load = {"kind": "traction", "traction": traction, "region": {"plane": "x", "at": "max"}}
    problem = common.mapped_block(
        cells, place, element, clamps=[HELD], loads=[load], time=common.STATIC,
        material={"density": 1.0, **material},
    )  # fmt: skip
    end = common.on(problem, "x", length)
    moved = common.equilibrium(problem)[end] - problem.positions[end]
    return float(moved[:, direction].mean()) / force


def volumetric(elements: Sequence[str], poissons: Sequence[float] = POISSONS) -> common.Figures:
    """A 4 x 1 x 1 cantilever of 8 x 2 x 2 cells, over hex8-enhanced with 32 x 8 x 8."""
    figures: common.Figures = {}
    for nu in poissons:
        material = {"young": 1e6, "poisson": nu}
        size = (4.0, 1.0, 1.0)
        truth = cantilever(size, (32, 8, 8), "hex8-enhanced", material)
        for element in elements:
            name = f"volumetric, nu {nu:g}, {element}"
            figures[name] = cantilever(size, (8, 2, 2), element, material) / truth
    return figures


def shear(elements: Sequence[str], slendernesses: Sequence[int] = SLENDERNESSES) -> common.Figures:
    """Beams with one cell through the thickness, over hex27 with 40 x 2 x 2."""
    figures: common.Figures = {}
    material = {"young": 1e6, "poisson": 0.3}
    for slenderness in slendernesses:
        size = (float(slenderness), 1.0, 1.0)
        truth = cantilever(size, (4 * CELLS, 2, 2), "hex27", material)
        for element in elements:
            name = f"shear, L/h {slenderness}, {element}"
            figures[name] = cantilever(size, (CELLS, 1, 1), element, material) / truth
    return figures


def distortion(elements: Sequence[str]) -> common.Figures:
    """MacNeal and Harder's slender beam (6 x 0.1 x 0.2) of six cells, over beam theory."""
    figures: common.Figures = {}
    material = {"young": 1e7, "poisson": 0.3}
    for name, skew in SHAPES.items():
        for element in elements:
            for direction, theory in ((2, 0.1081), (1, 0.4321)):
                plane = "in plane" if direction == 2 else "out of plane"
                found = cantilever((6.0, 0.1, 0.2), (6, 1, 1), element, material, skew, direction)
                figures[f"distortion, {name}, {plane}, {element}"] = found / theory
    return figures


def compute(elements: Sequence[str] = common.ELEMENTS) -> common.Figures:
    """All figures: deflection over the reference."""
    return volumetric(elements) | shear(elements) | distortion(elements)


def draw(record: common.Record, path: Path) -> None:
    """Ratios against Poisson's ratio, slenderness and the cells' shape."""
    figures = record.figures
    figure, (left, middle, right) = common.panels(11, 3.9, 3, sharey=True)
    for k, (element, (colour, mark)) in enumerate(common.ELEMENT_STYLES.items()):
        style = {"color": colour, "marker": mark, "markersize": 6, "label": element}
        values = [figures[f"volumetric, nu {nu:g}, {element}"] for nu in POISSONS]
        left.semilogx([1 - 2 * nu for nu in POISSONS], values, **style)
        values = [figures[f"shear, L/h {s}, {element}"] for s in SLENDERNESSES]
        middle.semilogx(SLENDERNESSES, values, **style)
        values = [figures[f"distortion, {s}, in plane, {element}"] for s in SHAPES]
        right.bar(np.arange(3) + 0.12 * (k - 3), values, 0.11, color=colour)
    left.invert_xaxis()
    left.set_xticks([1 - 2 * nu for nu in POISSONS], [f"{nu:g}" for nu in POISSONS])
    middle.set_xticks(SLENDERNESSES, [str(s) for s in SLENDERNESSES])
    right.set_xticks(range(3), list(SHAPES))
    left.set(title="4×1×1 cantilever, 8×2×2 cells", xlabel="Poisson's ratio")
    middle.set(title="10×1×1 cells, Poisson's ratio 0.3", xlabel="length over thickness")
    right.set(title="MacNeal-Harder beam, 6×1×1 cells", xlabel="shape of the cells")
    for axis in (left, middle, right):
        axis.minorticks_off()
        axis.axhline(1.0, color="black", linewidth=0.8)
        common.plain(axis)
    left.set(ylim=(0.0, 1.5), ylabel="tip deflection / reference")
    common.save(figure, path, left)


def finding(record: common.Record) -> str:
    """Of thin, nearly incompressible and distorted cells."""
    thin, near, distorted = (
        record.figures[f"{what}, hex8-enhanced"]
        for what in ("shear, L/h 50", "volumetric, nu 0.4999", "distortion, trapezoids, in plane")
    )
    return (
        f"hex8-enhanced over the reference: {thin:.2f} in thin cells, {near:.2f} near ν = 0.5, "
        f"but {distorted:.2f} on trapezoids, where only hex27 holds."
    )


def case(quick: bool) -> common.Outcome:
    """The case's outcome."""
    if not quick:
        return common.Outcome(compute())
    figures = shear(("hex8", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced"), (50,))
    return common.Outcome(figures | distortion(("hex8-bubble", "hex27")))
