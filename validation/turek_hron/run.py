"""Turek and Hron's elastic strip under its weight: at rest (CSM1) and swinging (CSM3)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc

LENGTH, HEIGHT, RADIUS, GRAVITY = 0.35, 0.02, 0.05, 2.0
"""m; of the cylinder that holds the strip, m; m/s2."""
STATIC = {
    "hex27, 16x1": ("hex27", 16, 1),
    "hex27, 32x2": ("hex27", 32, 2),
    "hex27, 64x4": ("hex27", 64, 4),
    "hex8-enhanced, 32x2": ("hex8-enhanced", 32, 2),
    "hex8-enhanced, 64x4": ("hex8-enhanced", 64, 4),
    "hex8-bubble-mean, 32x2": ("hex8-bubble-mean", 32, 2),
    "hex8, 32x2": ("hex8", 32, 2),
    "hex8, 64x4": ("hex8", 64, 4),
}
"""Element and cells."""
QUICK = ("hex27, 32x2", "hex8-enhanced, 32x2")
RAMP = 4
"""Load steps."""
SECONDS = 10.0
SWINGS = {
    "generalised-alpha, 5 ms": ("hex8-enhanced", "generalised-alpha", 0.005),
    "generalised-alpha, 10 ms": ("hex8-enhanced", "generalised-alpha", 0.01),
    "midpoint, 5 ms": ("hex8-enhanced", "midpoint", 0.005),
    "backward-euler, 5 ms": ("hex8-enhanced", "backward-euler", 0.005),
}
"""Element on 32×2 cells, integrator and step, s."""
PUBLISHED = {"x": (-14.305, 14.305, 1.0995), "y": (-63.607, 65.160, 1.0995)}
"""Mean and amplitude, mm, and frequency, Hz, of CSM3."""


def place(unit: np.ndarray, depth: float) -> np.ndarray:
    """The strip of the unit cube, held at the cylinder's arc; LENGTH from its middle on."""
    y = HEIGHT * (unit[:, 1] - 0.5)
    arc = np.sqrt(RADIUS**2 - y**2) - RADIUS
    return np.column_stack([arc + unit[:, 0] * (LENGTH - arc), y, depth * unit[:, 2]])


def strip(element: str, nx: int, ny: int, time: dict[str, Any], **load: Any) -> pc.Problem:
    """In plane strain: z is held everywhere."""
    arc = [[-HEIGHT, -HEIGHT, -1.0], [1e-9, HEIGHT, 1.0]]
    return common.mapped_block(
        (nx, ny, 1), partial(place, depth=LENGTH / nx), element,
        material={"energy": "st-venant-kirchhoff", "young": 1.4e6, "poisson": 0.4, "density": 1e3},
        clamps=[{"region": {"box": arc}},
                {"region": {"everywhere": True}, "components": ["z"]}],
        loads=[{"kind": "gravity", "acceleration": [0.0, -GRAVITY, 0.0], **load}],
        time=time, solver={"mass": "consistent", "tolerance": 1e-6},
    )  # fmt: skip


def at_rest(quick: bool) -> common.Outcome:
    """CSM1: displacement of the tip, mm."""
    figures: common.Figures = {}
    rows = []
    for name in QUICK if quick else STATIC:
        problem = strip(*STATIC[name], common.STATIC, table=[[0.0, 0.0], [RAMP, 1.0]])
        tip = common.nearest(problem, (LENGTH, 0.0, 0.0))
        x, y, _ = 1e3 * (common.equilibrium(problem, RAMP) - problem.positions)[tip]
        figures |= {f"CSM1, {name}, u_x, mm": float(x), f"CSM1, {name}, u_y, mm": float(y)}
        rows.append((name, float(x), float(y)))
    rows.append(("published", -7.187, -66.10))
    return common.Outcome(
        figures, (common.Table("CSM1", ("mesh", "u_x, mm", "u_y, mm"), tuple(rows)),)
    )


def extremes(values: np.ndarray, sign: float) -> np.ndarray:
    """Places and values (n, 2) of the largest of sign times values, by parabolas, in steps."""
    x = sign * values
    inner = np.flatnonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:]) & (x[1:-1] > x.mean())) + 1
    slope, bend = 0.5 * (x[inner + 1] - x[inner - 1]), x[inner + 1] - 2 * x[inner] + x[inner - 1]
    return np.column_stack([inner - slope / bend, sign * (x[inner] - 0.5 * slope**2 / bend)])


def swing(name: str) -> common.Outcome:
    """CSM3: mean, amplitude and frequency of the last period in ten seconds."""
    element, integrator, step = SWINGS[name]
    time = {"step": step, "frames": round(SECONDS / step), "integrator": integrator}
    problem = strip(element, 32, 2, time)
    tip = common.nearest(problem, (LENGTH, 0.0, 0.0))
    run = pc.rollout(pc.Newton(problem))
    moved = 1e3 * (run.positions[:, tip] - problem.positions[tip])
    figures: common.Figures = {}
    row: list[Any] = [name]
    for axis in "xy":
        low, high = (extremes(moved[:, "xy".index(axis)], sign) for sign in (-1.0, 1.0))
        mean, swing = 0.5 * (high[-1, 1] + low[-1, 1]), 0.5 * (high[-1, 1] - low[-1, 1])
        rate = float((len(low) - 1) / (low[-1, 0] - low[0, 0]) / step)
        label = f"CSM3, {name}, u_{axis}"
        found = {"mean, mm": mean, "amplitude, mm": swing, "frequency, Hz": rate}
        figures |= {f"{label}, {what}": float(x) for what, x in found.items()}
        row += [float(mean), float(swing), rate]
    heads = (
        "run",
        "u_x, mm",
        "amplitude, mm",
        "Hz",
        "u_y, mm",
        "amplitude of u_y, mm",
        "Hz of u_y",
    )
    every = max(1, round(0.02 / step))
    curve = tuple((name, float(t), *map(float, u[:2]))
                  for t, u in zip(run.times[::every], moved[::every], strict=True))  # fmt: skip
    tables = (
        common.Table("CSM3", heads, (tuple(row),)),
        common.Table("Curves", ("run", "s", "u_x, mm", "u_y, mm"), curve),
    )
    return common.Outcome(figures, tables)


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """CSM1, and a part a run of CSM3."""
    out: dict[str, Callable[[], common.Outcome]] = {"CSM1": partial(at_rest, quick)}
    return out if quick else out | {name: partial(swing, name) for name in SWINGS}


def finding(record: common.Record) -> str:
    """Best coarse against the published values."""
    f = record.figures
    x, y = (f[f"CSM1, hex8-enhanced, 32x2, u_{axis}, mm"] for axis in "xy")
    name = "generalised-alpha, 5 ms"
    mean, size, rate = (
        f[f"CSM3, {name}, u_y, {what}"] for what in ("mean, mm", "amplitude, mm", "frequency, Hz")
    )
    return (
        f"Two best coarse cells through the thickness rest at {x:.3f}, {y:.2f} mm (published "
        f"−7.187, −66.10) and swing by {mean:.1f} ± {size:.1f} mm at {rate:.4f} Hz by "
        f"generalised-α (published −63.607 ± 65.160 mm, 1.0995 Hz)."
    )


def draw(record: common.Record, path: Path) -> None:
    """The tip's height in the first and last seconds."""
    figure, panels = common.panels(12, 3.6, 2, sharey=True)
    rows = record.table("Curves")["rows"]
    for axis, (first, last) in zip(panels, ((0.0, 2.5), (7.5, 10.0)), strict=True):
        for k, name in enumerate(SWINGS):
            points = [
                (row[1], row[3]) for row in rows if row[0] == name and first <= row[1] <= last
            ]
            axis.plot(*np.transpose(points), color=common.COLOURS[k], label=name, linewidth=1.2)
        mean, size, _ = PUBLISHED["y"]
        for level in (mean - size, mean + size):
            axis.axhline(level, color="0.6", linewidth=1.0, linestyle="--")
        axis.set(xlabel="s")
        common.plain(axis)
    panels[0].set_ylabel("height of the tip, mm")
    common.save(figure, path, panels[0], 4)
