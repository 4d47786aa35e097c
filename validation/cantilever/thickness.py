"""Bending with one to three cells through the thickness, for any Poisson's ratio."""

from __future__ import annotations

from collections.abc import Sequence

import common
import numpy as np

import pdcorrect as pc

POISSONS = (0.0, 0.3, 0.45, 0.49, 0.4999)
ACROSS = (1, 2, 3)
"""Cells through the thickness."""
SLENDERNESS = 10
YOUNG, DENSITY = 1e6, 1e3

EVERYWHERE = {"box": [[-1e3] * 3, [1e3] * 3]}


def strip(element: str, across: int, poisson: float, plane: bool) -> tuple[pc.Problem, float]:
    """A beam of cubic cells under its weight, and beam theory's deflection of its end, m.

    ``plane``: one cell wide and held sideways (plane strain), else as wide as thick.  The
    section at the wall may contract.
    """
    thick, wide = float(across), 1 if plane else across
    length = SLENDERNESS * thick
    young, shear = YOUNG, YOUNG / (2 * (1 + poisson))
    coefficient = 10 * (1 + poisson) / (12 + 11 * poisson)
    clamps = [
        {"region": {"plane": "x", "at": "min"}, "components": ["x"]},
        {"region": {"nodes": [0]}, "components": ["y", "z"]},
    ]
    if plane:
        young, coefficient = YOUNG / (1 - poisson**2), 5 / 6
        clamps.append({"region": EVERYWHERE, "components": ["y"]})
    else:  # not to turn about the axis
        clamps.append({"region": {"box": [[0, wide, 0], [0, wide, 0]]}, "components": ["z"]})
    bending = 12 * length**4 / (8 * young * thick**2)
    unit = DENSITY * (bending + length**2 / (2 * coefficient * shear))
    weight = common.SMALL * length / unit
    problem = pc.discretise(
        pc.Scene(
            body={"shape": "beam", "cells": [SLENDERNESS * across, wide, across], "cell_size": 1.0},
            material={"young": YOUNG, "poisson": poisson, "density": DENSITY},
            time=common.STATIC, clamps=clamps,
            loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -weight]}],
        ),
        element=element,
    )  # fmt: skip
    return problem, weight * unit


def ratio(element: str, across: int, poisson: float, plane: bool) -> float:
    """Deflection over that of beam theory."""
    problem, theory = strip(element, across, poisson, plane)
    end = common.on(problem, "x", SLENDERNESS * float(across))
    moved = common.equilibrium(problem)[end] - problem.positions[end]
    return float(-moved[:, 2].mean() / theory)


def bending(
    elements: Sequence[str], poissons: Sequence[float] = POISSONS, across: Sequence[int] = ACROSS
) -> common.Figures:
    """All ratios."""
    figures: common.Figures = {}
    for plane, name in ((False, "beam"), (True, "plane strain")):
        for poisson in poissons:
            for element in elements:
                for n in across:
                    what = f"bending, {name}, nu {poisson:g}, {element} {n}"
                    figures[what] = ratio(element, n, poisson, plane)
    return figures


def farthest(figures: common.Figures, element: str) -> float:
    """Largest distance of an element's ratios from 1."""
    found = [v for k, v in figures.items() if k.startswith("bending") and f", {element} " in k]
    return float(np.abs(np.array(found) - 1.0).max())
