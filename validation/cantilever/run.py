"""Bending, vibration and torsion of a square beam against beam theory."""

from __future__ import annotations

from typing import Any

import common
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.optimize import brentq
from thickness import bending, farthest

import pdcorrect as pc

SIDE, LENGTH, YOUNG, POISSON, DENSITY = 0.05, 1.0, 1e6, 0.3, 1e3
AREA, INERTIA = SIDE**2, SIDE**4 / 12
SHEAR = YOUNG / (2 * (1 + POISSON))
COEFFICIENT = 10 * (1 + POISSON) / (12 + 11 * POISSON)
"""Cowper's shear coefficient of a rectangle."""

TORSION = 0.1405770
"""Saint-Venant's torsion constant of a square, over the side to the fourth."""

HELD = {"region": {"plane": "x", "at": "min"}}
# The end may contract: x is held on it, z on its middle line, y at its centre.
SLIDING = [
    {"region": {"plane": "x", "at": "min"}, "components": ["x"]},
    {"region": {"box": [[0, -SIDE, 0], [0, SIDE, 0]]}, "components": ["z"]},
    {"region": {"box": [[0, 0, -SIDE], [0, 0, SIDE]]}, "components": ["y"]},
]


MASS = {"hex8-learned": "averaged"}


def beam(element: str, across: int, length: float = LENGTH, **settings: Any) -> pc.Problem:
    """Cubic cells, ``across`` of them through the thickness; the axis is y = z = 0."""
    size = SIDE / across
    body = {
        "shape": "beam",
        "cells": [round(length / size), across, across],
        "cell_size": size,
        "origin": [0.0, -SIDE / 2, -SIDE / 2],
    }
    material = {"young": YOUNG, "poisson": POISSON, "density": DENSITY}
    solver = {"element": element, "mass": MASS.get(element, "consistent")}
    scene = pc.Scene(body=body, material=material, time=common.STATIC, solver=solver, **settings)
    return pc.discretise(scene)


def end_shear(element: str, across: int, clamps: list[dict[str, Any]]) -> float:
    """Tip deflection under traction on the end face, over Timoshenko's."""
    unit = LENGTH**3 / (3 * YOUNG * INERTIA) + LENGTH / (COEFFICIENT * SHEAR * AREA)
    force = common.SMALL * LENGTH / unit
    traction = {
        "kind": "traction",
        "traction": [0.0, 0.0, -force / AREA],
        "region": {"plane": "x", "at": "max"},
    }
    return _tip(beam(element, across, clamps=clamps, loads=[traction])) / (force * unit)


def gravity(element: str, across: int, clamps: list[dict[str, Any]]) -> float:
    """Tip deflection under the beam's own weight, over Timoshenko's."""
    weight = DENSITY * AREA
    unit = weight * (
        LENGTH**4 / (8 * YOUNG * INERTIA) + LENGTH**2 / (2 * COEFFICIENT * SHEAR * AREA)
    )
    acceleration = common.SMALL * LENGTH / unit
    load = {"kind": "gravity", "acceleration": [0.0, 0.0, -acceleration]}
    return _tip(beam(element, across, clamps=clamps, loads=[load])) / (acceleration * unit)


def _tip(problem: pc.Problem) -> float:
    end = common.on(problem, "x", LENGTH)
    moved = common.equilibrium(problem)[end] - problem.positions[end]
    return float(-moved[:, 2].mean())


def bending_frequencies(element: str, across: int, count: int = 3) -> list[float]:
    """The lowest bending frequencies, Hz; the square section has each of them twice."""
    problem = beam(element, across, clamps=[HELD])
    free = np.flatnonzero(problem.free.ravel())
    stiffness = problem.stiffness(problem.positions)[free][:, free].tocsc()
    mass = sp.kron(problem.mass_matrix, sp.eye_array(3), format="csr")[free][:, free].tocsc()
    start = np.cos(np.arange(len(free)))
    squares, modes = spla.eigsh(stiffness, 4 * count, mass, sigma=0.0, v0=start)
    order = np.argsort(squares)
    shift = mass @ modes[:, order]  # moves sideways in bending, not in torsion or extension
    sideways = [(shift[free % 3 == i].sum(axis=0)) ** 2 for i in (1, 2)]
    bending = squares[order][sum(sideways) > 1e-3 * DENSITY * AREA * LENGTH]
    return [float(np.sqrt(bending[2 * n : 2 * n + 2].mean()) / (2 * np.pi)) for n in range(count)]


def timoshenko_frequencies(count: int = 3) -> list[float]:
    """Of a clamped-free Timoshenko beam, Hz (Huang 1961)."""
    r2 = INERTIA / (AREA * LENGTH**2)
    s2 = YOUNG * INERTIA / (COEFFICIENT * AREA * SHEAR * LENGTH**2)

    def equation(b: float) -> float:
        root = np.sqrt((r2 - s2) ** 2 + 4 / b**2)
        a, c = np.sqrt((root - r2 - s2) / 2), np.sqrt((root + r2 + s2) / 2)
        curved = (b**2 * (r2 - s2) ** 2 + 2) * np.cosh(b * a) * np.cos(b * c)
        slope = b * (r2 + s2) / np.sqrt(1 - b**2 * r2 * s2)
        return 2 + curved - slope * np.sinh(b * a) * np.sin(b * c)

    roots = [brentq(equation, 0.8 * b**2, 1.02 * b**2) for b in EULER[:count]]
    return [root * _unit_frequency() for root in roots]


EULER = (1.8751041, 4.6940911, 7.8547574)
"""Roots of cos b cosh b = -1."""


def _unit_frequency() -> float:
    """sqrt(EI / (rho A L^4)) / (2 pi), Hz."""
    return float(np.sqrt(YOUNG * INERTIA / (DENSITY * AREA * LENGTH**4)) / (2 * np.pi))


def torsion(element: str, across: int, warping: bool, length: float = 10 * SIDE) -> float:
    """Torque over that of Saint-Venant for the twist rate in the middle 40 % of the bar.

    One end is held and the other turned by 0.1 degrees.  With ``warping`` both may
    move along the axis, so that Saint-Venant's solution holds throughout.
    """
    turn = {"times": [0.0, 1.0], "rotation": [0.0, 0.1], "axis": "x"}
    components = ["y", "z"] if warping else ["x", "y", "z"]
    clamps = [
        {"region": {"plane": "x", "at": "min"}, "components": components},
        {"region": {"plane": "x", "at": "max"}, "components": components, "motion": turn},
    ]
    if warping:  # a corner of the section does not warp
        clamps.append({"region": {"nodes": [0]}, "components": ["x"]})
    problem = beam(element, across, length, clamps=clamps)
    positions = common.equilibrium(problem)
    end = common.on(problem, "x", length)
    y, z = positions[end, 1:].T
    reaction = -problem.forces(positions)[end]
    torque = float(y @ reaction[:, 2] - z @ reaction[:, 1])
    return torque / (_twist_rate(problem, positions, length) * SHEAR * TORSION * SIDE**4)


def _twist_rate(problem: pc.Problem, positions: np.ndarray, length: float) -> float:
    """Slope of the sections' mean angle over the middle of the bar, 1/m."""
    rest, moved = problem.positions, positions - problem.positions
    places = np.unique(np.round(rest[:, 0], 9))
    places = places[np.abs(places - length / 2) <= 0.2 * length + 1e-9]
    angles = []
    for x in places:
        n = common.on(problem, "x", x)
        arms = (rest[n, 1:] ** 2).sum()
        angles.append((rest[n, 1] @ moved[n, 2] - rest[n, 2] @ moved[n, 1]) / arms)
    return float(np.polyfit(places, angles, 1)[0])


MESHES = (1, 2, 4)
"""Cells through the thickness."""


def compute(elements: tuple[str, ...] = common.ELEMENTS) -> common.Figures:
    """All figures: ratios to theory by load, element and cells through the thickness."""
    return _beam_theory(elements, MESHES) | bending(elements)


def _beam_theory(elements: tuple[str, ...], meshes: tuple[int, ...]) -> common.Figures:
    """Those of the slender beam with a Poisson's ratio of 0.3."""
    figures: common.Figures = {}
    theory = timoshenko_frequencies()
    for across in meshes:
        for element in elements:
            what = f"{element} {across}x{across}"
            figures[f"end shear, {what}"] = end_shear(element, across, [HELD])
            figures[f"gravity, {what}"] = gravity(element, across, [HELD])
            if across > 1:
                figures[f"end shear, sliding clamp, {what}"] = end_shear(element, across, SLIDING)
            found = bending_frequencies(element, across)
            for n, (mine, beam_theory) in enumerate(zip(found, theory, strict=True), start=1):
                figures[f"frequency {n}, {what}"] = mine / beam_theory
            figures[f"torsion, free to warp, {what}"] = torsion(element, across, True)
            figures[f"torsion, ends held, {what}"] = torsion(element, across, False)
    return figures


def quick_figures() -> common.Figures:
    """Those that take seconds."""
    figures = _beam_theory(("hex27",), (2,))
    for element in ("hex8", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced"):
        figures[f"end shear, {element} 1x1"] = end_shear(element, 1, [HELD])
    figures |= bending(("hex8-enhanced",), (0.3, 0.4999), (1, 2))
    return figures | {"torsion, free to warp, hex27 4x4": torsion("hex27", 4, True, SIDE)}


def finding(record: common.Record) -> str:
    """Of bending with few cells and torsion with four cells through the thickness."""
    best, soft = (farthest(record.figures, e) for e in ("hex8-enhanced", "hex8-bubble-mean"))
    twist = record.figures["torsion, free to warp, hex27 4x4"]
    return (
        f"Bending with one to three cells, ν to 0.4999, plane strain too: hex8-enhanced within "
        f"{100 * best:.1f} % of beam theory, hex8-bubble-mean within {100 * soft:.0f} %. "
        f"Torsion: hex27 {twist:.3f} with four cells."
    )


def case(quick: bool) -> common.Outcome:
    """The case's outcome."""
    return common.Outcome(quick_figures() if quick else compute())
