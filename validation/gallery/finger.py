"""What the error of a pressure finger on few cells is made of, at rest under little pressure."""

from __future__ import annotations

from typing import Any

import numpy as np

import pdcorrect as pc

PRESSURE = 5e3
AT_REST = {"integrator": "quasi-static", "frames": 1, "substeps": 1}


def pressed(scene: pc.Scene, loads: list[dict[str, Any]], **changes: Any) -> pc.Scene:
    """The scene at rest under loads, without threads."""
    still = {"damping": {"viscosity": 0.0}, "time": AT_REST, "actuators": []}
    return scene.with_changes(**{**still, **changes}, loads=loads)


def inside(cell: float, cells: list[int]) -> dict[str, Any]:
    """Pressure in the chamber of a finger with walls of one cell."""
    box = [3 * [cell], [(n - 1) * cell for n in cells]]
    return {"kind": "pressure", "pressure": PRESSURE, "region": {"box": box}, "follower": True}


def narrow(scene: pc.Scene) -> pc.Scene:
    """A finger whose chamber is one cell wide."""
    cells, cell = [7, 3, 3], 0.01
    full = np.ones(cells, dtype=int)
    full[1:-1, 1:-1, 1:-1] = 0
    layer = {"region": {"box": [3 * [0.0], [0.07, 0.03, 0.01]]}, "young": 5e5}
    return pressed(
        scene, [inside(cell, cells)], body={"cell_size": cell, "occupancy": full.tolist()},
        materials=[layer], probes=[],
    )  # fmt: skip


def fingers(scene: pc.Scene) -> dict[str, pc.Scene]:
    """By name, from the one of the gallery."""
    pressure = [inside(0.005, [14, 4, 4])]
    end = {
        "kind": "traction",
        "traction": [0.0, 0.0, -300.0],
        "region": {"plane": "x", "at": "max"},
    }
    threads = {"actuators": [one.model_dump(exclude_none=True) for one in scene.actuators]}
    return {
        "chamber one cell wide": narrow(scene),
        "the same, Poisson's ratio 0": narrow(scene).with_changes(material={"poisson": 0.0}),
        "chamber two cells wide": pressed(scene, pressure),
        "the same with threads": pressed(scene, pressure, **threads),
        "without threads, force at the end": pressed(scene, [end]),
    }
