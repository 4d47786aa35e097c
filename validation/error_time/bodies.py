"""Scenes of bodies, materials and motions that nothing was trained on, and the thesis's motions."""

from __future__ import annotations

from typing import Any

import numpy as np

import pdcorrect as pc
from pdcorrect._environment import home_folder
from pdcorrect.data.configuration import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan

GRAVITY = {"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}
FOOT = {"region": {"plane": "z", "at": "min"}}
WALL = {"region": {"plane": "x", "at": "min"}}
MOTIONS = ("impulse", "stretch", "torsion")
FRAMES = 30
"""Of the thesis's motions."""


def voxels(shape: tuple[int, int, int], *holes: tuple[slice, slice, slice]) -> list[Any]:
    """Occupancy of a box of cells with boxes taken out."""
    full = np.ones(shape, dtype=int)
    for hole in holes:
        full[hole] = 0
    return list(full.tolist())


def rotated(axis: str, centre: list[float], degrees: float, seconds: float) -> dict[str, Any]:
    """A clamp's motion: turned once and held."""
    return {"times": [0.0, seconds, 10.0], "rotation": [0.0, degrees, degrees], "axis": axis,
            "centre": centre}  # fmt: skip


def scene(
    young: float, poisson: float, step: float, frames: int, body: dict[str, Any], *loads: Any,
    clamps: tuple[Any, ...] = (WALL,), cell: float = 0.05, **more: Any,
) -> pc.Scene:  # fmt: skip
    """Of one material with a density of 1 000 kg/m3; ``cell`` in m."""
    return pc.Scene(
        body={"cell_size": cell, **body},
        material={"young": young, "poisson": poisson, "density": 1e3},
        time={"step": step, "frames": frames}, clamps=list(clamps), loads=list(loads), **more,
    )  # fmt: skip


ALL = slice(None)
SCENES = {
    "cantilever": scene(
        2e5, 0.3, 0.01, 40, {"shape": "beam", "cells": [10, 2, 2]}, GRAVITY),
    "plate": scene(
        2e6, 0.45, 0.01, 40, {"shape": "beam", "cells": [8, 6, 1]}, GRAVITY),
    "angle": scene(
        3e5, 0.4, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels((6, 2, 6), (slice(2, None), ALL, slice(2, None)))},
        {"kind": "gravity", "acceleration": [0.0, 40.0, -20.0], "window": [0.0, 0.05]},
        clamps=({"region": {"plane": "z", "at": "max"}},)),
    "portal": scene(
        5e5, 0.35, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels((8, 2, 7), (slice(2, 6), ALL, slice(0, 5)))},
        {"kind": "gravity", "acceleration": [8.0, 4.0, 0.0],
         "table": [[0.0, 0.0], [0.1, 1.0], [0.2, -1.0], [0.3, 1.0], [0.4, 0.0]]},
        clamps=(FOOT,)),
    "ring": scene(
        1.2e5, 0.2, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels((8, 2, 8), (slice(2, 6), ALL, slice(2, 6)))},
        GRAVITY, clamps=(FOOT,)),
    "cross under torsion": scene(
        3e5, 0.4, 0.01, 40,
        {"shape": "cross", "cells": [9, 2, 2], "arm_start": 5, "arm_length": 2},
        {"kind": "torsion", "strength": 2.5e4, "window": [0.0, 0.1], "ramp": 0.02}),
    "sheared block": scene(
        1e6, 0.48, 0.0025, 60, {"shape": "beam", "cells": [4, 4, 4]},
        clamps=(FOOT, {"region": {"plane": "z", "at": "max"}, "motion": {
            "times": [0.0, 0.05, 10.0],
            "displacement": [[0.0, 0.0, 0.0], [0.08, 0.0, 0.0], [0.08, 0.0, 0.0]]}})),
    "twisted bar": scene(
        8e5, 0.45, 0.0025, 60, {"shape": "beam", "cells": [9, 3, 3]},
        clamps=(WALL, {"region": {"plane": "x", "at": "max"},
                       "motion": rotated("x", [0.0, 0.075, 0.075], 70.0, 0.1)})),
    "tower with a window": scene(
        8e6, 0.05, 0.0025, 60,
        {"shape": "voxels", "occupancy": voxels((3, 3, 9), (slice(1, 2), ALL, slice(3, 6)))},
        {"kind": "gravity", "acceleration": [300.0, 150.0, 0.0], "window": [0.0, 0.02]},
        clamps=(FOOT,)),
    "stairs under pressure": scene(
        2.5e5, 0.4, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels(
            (6, 3, 6), (slice(2, None), ALL, slice(4, None)), (slice(4, None), ALL, slice(2, 4)))},
        {"kind": "pressure", "pressure": 6e3, "region": {"plane": "x", "at": "min"},
         "follower": True, "window": [0.0, 0.2], "ramp": 0.05},
        clamps=(FOOT,)),
    "hard and soft": scene(
        2e5, 0.45, 0.01, 40, {"shape": "beam", "cells": [10, 2, 3]}, GRAVITY,
        materials=[{"region": {"box": [[0.0, 0.0, 0.0], [0.5, 0.1, 0.05]]}, "young": 4e6,
                    "poisson": 0.3, "density": 1.2e3}]),
    "struck hook": scene(
        4e5, 0.4, 0.01, 40,
        {"shape": "voxels", "occupancy": voxels(
            (7, 2, 6), (slice(2, 5), ALL, slice(2, None)), (slice(5, None), ALL, slice(4, None)))},
        clamps=({"region": {"plane": "z", "at": "max"}},),
        initial={"velocity": [1.5, 1.0, 0.0]}),
}  # fmt: skip


def of_motion(motion: str) -> pc.Scene:
    """The first simulation on the smallest mesh of an exact data set's evaluation split."""
    config = DatasetConfig.load(home_folder("datasets") / f"{motion}-exact" / "config.toml")
    plans = [plan for plan in make_plan(config) if plan.split == EVALUATION]
    scene = draw_scene(config, min(plans, key=lambda plan: plan.design.nodes), 0)
    return scene.with_changes(time={"frames": FRAMES})


def scenes() -> dict[str, pc.Scene]:
    """All of them, by name."""
    return SCENES | {motion: of_motion(motion) for motion in MOTIONS}
