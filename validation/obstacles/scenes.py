"""Bodies that fall onto, slide on, are poked and squeezed by obstacles, in hard cases."""

from __future__ import annotations

from typing import Any

import pdcorrect as pc

CELL = 0.05
SIDE = 3 * CELL
FLOOR = {"shape": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}


def scene(frames: int, cells: tuple[int, int, int] = (3, 3, 3), **sections: Any) -> pc.Scene:
    """A block; ``material`` changes E = 1 MPa, Poisson's ratio 0.4, 1000 kg/m3."""
    material = {"young": 1e6, "poisson": 0.4, "density": 1e3, **sections.pop("material", {})}
    body = {"shape": "beam", "cells": cells, "cell_size": CELL, **sections.pop("body", {})}
    time = {"step": 0.01, "frames": frames, "integrator": "backward-euler"}
    return pc.Scene(body=body, material=material, time=time, **sections)


def drop(**material: float) -> pc.Scene:
    """A cube that hits the floor at 8 m/s."""
    return scene(
        15, body={"origin": [0.0, 0.0, 0.1]}, material=material, obstacles=[FLOOR],
        initial={"velocity": [0.0, 0.0, -8.0]},
    )  # fmt: skip


def moved(obstacle: dict[str, Any], way: list[float], end: float) -> dict[str, Any]:
    """The obstacle, moved by ``way`` until ``end`` (s), where it stays."""
    return {**obstacle, "motion": {"times": [0.0, end], "displacement": [[0.0, 0.0, 0.0], way]}}


def ball(z: float, way: float) -> dict[str, Any]:
    """One that closes onto the middle of a plate."""
    centre = [3 * CELL, 3 * CELL, z]
    return moved({"shape": "sphere", "centre": centre, "radius": 0.1}, [0.0, 0.0, way], 0.15)


FOOT = {"region": {"plane": "z", "at": "min"}}
INCLINED = {"kind": "gravity", "acceleration": [4.905, 0.0, -8.496]}
"""Gravity, seen from a floor at 30 degrees, whose tangent is 0.58."""
LID = {"shape": "plane", "point": [0.0, 0.0, SIDE], "normal": [0.0, 0.0, -1.0]}
DIAGONAL = {"shape": "box", "box": [3 * [SIDE + 0.005], 3 * [SIDE + 0.2]]}
CORNER = {"shape": "box", "box": [[SIDE + x for x in (0.005, 0.01, 0.015)], 3 * [SIDE + 0.2]]}
"""A face of it reaches the body's corner exactly at the end of a step."""
CALM = {"mass": 20.0}

SCENES = {
    "drop": drop(),
    "drop, nu 0.49": drop(poisson=0.49),
    "drop, E 1e8": drop(young=1e8),
    "balls": scene(
        15, (6, 6, 1), obstacles=[ball(-0.105, 0.02), ball(CELL + 0.105, -0.02)], damping=CALM
    ),
    "incline": scene(20, obstacles=[{**FLOOR, "friction": 0.3}], loads=[INCLINED]),
    "corner": scene(20, clamps=[FOOT], obstacles=[moved(CORNER, 3 * [-0.045], 0.15)]),
    "corner on corner": scene(
        20, clamps=[FOOT], obstacles=[moved(DIAGONAL, 3 * [-0.045], 0.15)]
    ),
    "press": scene(
        25, obstacles=[FLOOR, moved(LID, [0.0, 0.0, -SIDE / 2], 0.2)], damping=CALM
    ),
    "press, nu 0.49": scene(
        25, obstacles=[FLOOR, moved(LID, [0.0, 0.0, -SIDE / 2], 0.2)], damping=CALM,
        material={"poisson": 0.49},
    ),
}  # fmt: skip
"""A plate squeezed to a fifth, a cube that slides, two that a box pokes, one at half its height."""
UNDECIDED = "corner on corner", "press", "press, nu 0.49"
"""Symmetric bodies that slide off or buckle to any of several sides."""
