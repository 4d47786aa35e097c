"""Error against run time in simulations of an evaluation split, from easy ones to hard ones."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np

import pdcorrect as pc
from pdcorrect._environment import home_folder
from pdcorrect.data.configuration import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.scene import trained_coarse

REFINE = 4
"""Of the reference, as in the data sets."""


EASIER = (95.0, 75.0, 50.0, 25.0, 5.0)
"""Per cent of the split's simulations that were harder for the corrector than each of CHOSEN."""
CHOSEN: dict[str, tuple[tuple[int, int], ...]] = {
    "impulse": ((22, 0), (10, 0), (20, 1), (32, 0), (35, 0)),
    "stretch": ((21, 1), (36, 1), (45, 0), (30, 0), (32, 0)),
    "torsion": ((5, 1), (9, 0), (2, 0), (19, 2), (18, 0)),
}
"""Mesh and simulation, by the Omega recorded of the corrector; for torsion by its weights before
the last training."""


@dataclass(frozen=True)
class Row:
    """What a method reached: nodes, ms a frame, RMS error in m, Omega in per cent."""

    name: str
    nodes: int
    milliseconds: float
    error: float
    omega: float


def recorded(model: str) -> dict[tuple[int, int], tuple[float, float]]:
    """Omega of the corrected run and of its base by mesh and simulation, per cent."""
    path = home_folder("models") / model / "trajectories.csv"
    with path.open(encoding="utf-8") as file:
        return {
            (int(line["mesh"]), int(line["simulation"])): (
                float(line["omega"]), float(line["omega_base"]),
            )
            for line in csv.DictReader(file)
        }  # fmt: skip


def scene_of(motion: str, mesh: int, simulation: int) -> pc.Scene:
    """The scene of a simulation, whose load was the first one drawn for it."""
    config = DatasetConfig.load(home_folder("datasets") / f"{motion}-exact" / "config.toml")
    plans = [plan for plan in make_plan(config) if plan.split == EVALUATION]
    return draw_scene(config, plans[mesh], simulation)


def methods(scene: pc.Scene, model: str) -> dict[str, Callable[[], Any]]:
    """What makes each method's stepper."""
    best = trained_coarse(scene)
    problems = {
        "plain": partial(pc.discretise, scene),
        "best": partial(pc.discretise, best),
        "hex27": partial(pc.discretise, scene, element="hex27"),
        "plain 2×2×2": partial(pc.discretise, scene, refine=2),
        "best 2×2×2": partial(pc.discretise, best, refine=2),
    }
    found: dict[str, Callable[[], Any]] = {
        name: lambda make=make: pc.ProjectiveDynamics(make()) for name, make in problems.items()
    }
    return found | {model: partial(pc.hybrid_of, scene, home_folder("models") / model)}


def rows_of(scene: pc.Scene, model: str) -> tuple[list[Row], float]:
    """All methods over all frames, the reference last; and the largest displacement, m."""
    coarse = pc.discretise(scene)
    reference = pc.rollout(
        pc.ProjectiveDynamics(pc.discretise(trained_coarse(scene), refine=REFINE))
    )
    truth = pc.restrict(reference, to=coarse)
    rows: list[Row] = []
    plain = None
    for name, make in methods(scene, model).items():
        run = pc.rollout(make())
        found = pc.restrict(run, to=coarse)
        plain = plain or found
        rows.append(
            Row(
                name, len(run.problem.positions), _median_step(run),
                pc.metrics.rms_error(found.positions, truth.positions),
                pc.metrics.error_corrected(found, plain, truth),
            )
        )  # fmt: skip
    nodes = len(reference.problem.positions)
    rows.append(Row("reference", nodes, _median_step(reference), 0.0, 100.0))
    return rows, pc.metrics.largest_displacement(truth)


def _median_step(run: pc.Trajectory) -> float:
    """Wall-clock milliseconds."""
    return 1e3 * float(np.median(run.stats["seconds"]))


HEADS = (
    "easier than, per cent", "mesh", "simulation", "largest displacement, mm", "method", "nodes",
    "ms a frame", "RMS error, mm", "omega, per cent",
)  # fmt: skip


def measure(motion: str) -> common.Outcome:
    """The simulations of a data set, all in all ways."""
    model = f"{motion}-exact"
    told = recorded(model)
    figures: common.Figures = {}
    body: list[tuple[float | str, ...]] = []
    for easier, chosen in zip(EASIER, CHOSEN[motion], strict=True):
        rows, scale = rows_of(scene_of(motion, *chosen), model)
        by_name = {row.name: row for row in rows}
        label = f"{motion}, easier than {easier:g} %"
        for name, omega in zip((model, "best"), told[chosen], strict=True):
            figures[f"{label}, {name}, omega less the recorded"] = by_name[name].omega - omega
        figures |= beside(f"{label}, {model}", by_name, model)
        first = (easier, *chosen, 1e3 * scale)
        body += [
            (*first, r.name, r.nodes, r.milliseconds, 1e3 * r.error, r.omega) for r in rows
        ]  # fmt: skip
    return common.Outcome(figures, (common.Table(motion, HEADS, tuple(body)),))


def beside(label: str, rows: Mapping[str, Row], name: str) -> common.Figures:
    """A hybrid's error and time beside those of what needs no training."""
    hybrid, hex27 = rows[name], rows["hex27"]
    return {
        f"{label}, error over best's": hybrid.error / rows["best"].error,
        f"{label}, error over hex27's": hybrid.error / hex27.error,
        f"{label}, time over hex27's": hybrid.milliseconds / hex27.milliseconds,
        f"{label}, reference's time over its own": (
            rows["reference"].milliseconds / hybrid.milliseconds
        ),
    }


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each data set; there is no quick one."""
    return {} if quick else {motion: partial(measure, motion) for motion in CHOSEN}


def draw(record: common.Record, path: Path) -> None:
    """Each method's RMS errors against its times, both over the plain mesh's."""
    figure, panels = common.panels(12, 4.4, len(CHOSEN), sharey=True)
    for axis, motion in zip(panels, CHOSEN, strict=True):
        rows = record.table(motion)["rows"]
        plain = {tuple(row[:3]): row for row in rows if row[4] == "plain"}
        methods = dict.fromkeys(row[4] for row in rows)
        for k, name in enumerate(n for n in methods if n not in ("plain", "reference")):
            found = [(row, plain[tuple(row[:3])]) for row in rows if row[4] == name]
            axis.scatter(
                [row[6] / base[6] for row, base in found],
                [row[7] / base[7] for row, base in found],
                [20 + 28 * rank for rank in range(len(found))], common.COLOURS[k], common.MARKS[k],
                alpha=0.8, label="hybrid" if name == f"{motion}-exact" else name,
            )  # fmt: skip
        axis.set(xscale="log", yscale="log", title=f"{motion}, exact")
        axis.set_xlabel("time of a frame over the plain mesh's")
        common.log_axis(axis.xaxis)
        common.log_axis(axis.yaxis)
        common.plain(axis)
    panels[0].set_ylabel("RMS error over the plain mesh's")
    common.save(figure, path, panels[0], 6)


def finding(record: common.Record) -> str:
    """How often the hybrid is nearer than 27-node elements, and at what times."""
    ends = {name.rpartition(", ")[2] for name in record.figures}
    assert "error over hex27's" in ends
    told = {end: [x for n, x in record.figures.items() if n.endswith(f", {end}")] for end in ends}
    left, times = np.median(told["error over best's"]), told["reference's time over its own"]
    nearer = sum(x < 1.0 for x in told["error over hex27's"])
    return (
        f"Beside a fine run by the same backward Euler steps, whose error it shares, the hybrid at "
        f"home leaves {left:.2f} of its coarse model's error in the median. It is nearer than "
        f"27-node elements in {nearer} of 15 simulations, not in the hard ones; the fine run takes "
        f"{min(times):.0f} to {max(times):.0f} times as long."
    )
