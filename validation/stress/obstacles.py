"""Bodies that fall onto, slide on and are squeezed by obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np
from scenarios import CALM, CELL, Scenario, beam

import pdcorrect as pc

FLOOR = {"shape": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
FOOT = {"region": {"plane": "z", "at": "min"}}
SOLVERS = ("PD", "PD enhanced", "PD learned", "Newton")
SIDE = 3 * CELL


def moved(obstacle: dict[str, Any], way: tuple[float, float, float], end: float) -> dict[str, Any]:
    """The obstacle, moved by ``way`` until ``end`` (s), where it stays."""
    return {**obstacle, "motion": {"times": [0.0, end], "displacement": [[0.0, 0.0, 0.0], way]}}


def ball(z: float) -> dict[str, Any]:
    """Above or below the middle of a plate."""
    return {"shape": "sphere", "centre": [3 * CELL, 3 * CELL, z], "radius": 0.1}


def falling(**sections: Any) -> pc.Scene:
    """A free cube above the floor."""
    body = {"shape": "beam", "cells": [3, 3, 3], "cell_size": CELL, "origin": [0.0, 0.0, 0.1]}
    return beam(frames=15, body=body, clamps=[], obstacles=[FLOOR], **sections)


def fast(problem: pc.Problem) -> np.ndarray:
    """Downwards at 8 m/s."""
    return np.broadcast_to([0.0, 0.0, -8.0], problem.positions.shape)


# a floor, seen from which gravity is inclined by 30 degrees: tan = 0.58
INCLINED = {"kind": "gravity", "acceleration": [4.905, 0.0, -8.496]}
LID = moved(
    {"shape": "plane", "point": [0.0, 0.0, SIDE], "normal": [0.0, 0.0, -1.0]},
    (0.0, 0.0, -SIDE / 2), 0.2,
)  # fmt: skip
CORNER = moved(
    {"shape": "box", "box": [3 * [SIDE + 0.005], 3 * [SIDE + 0.2]]}, (-0.045, -0.045, -0.045), 0.15
)
BALLS = [
    moved(ball(-0.105), (0.0, 0.0, 0.02), 0.15), moved(ball(CELL + 0.105), (0.0, 0.0, -0.02), 0.15)
]  # fmt: skip

OBSTACLES = tuple(
    Scenario(name, about, scene, "motion", velocity=velocity, solvers=SOLVERS)
    for name, about, scene, velocity in (
        ("drop", "a cube that hits a floor at 8 m/s", falling(), fast),
        ("drop nu 0.49", "the same", falling(material={"poisson": 0.49}), fast),
        ("drop E 1e8", "the same", falling(material={"young": 1e8}), fast),
        (
            "balls", "a plate that two balls squeeze to a fifth of its thickness",
            beam((6, 6, 1), 15, clamps=[], obstacles=BALLS, damping=CALM), None,
        ),
        (
            "incline", "a cube that slides down 30 degrees with friction 0.3",
            beam((3, 3, 3), 20, clamps=[], obstacles=[{**FLOOR, "friction": 0.3}],
                 loads=[INCLINED]), None,
        ),
        (
            "corner", "the corner of a box pokes that of a cube",
            beam((3, 3, 3), 20, clamps=[FOOT], obstacles=[CORNER]), None,
        ),
        (
            "press", "a cube squeezed to half its height",
            beam((3, 3, 3), 25, clamps=[], obstacles=[FLOOR, LID], damping=CALM), None,
        ),
    )
)  # fmt: skip
