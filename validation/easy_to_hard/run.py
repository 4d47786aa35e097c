"""Error against run time in simulations of an evaluation split, from easy ones to hard ones."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import common

import pdcorrect as pc
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.home import home_folder

QUANTILES = (0.95, 0.75, 0.5, 0.25, 0.05)
"""Of the corrector's recorded Omega over the split: easy first."""
REFINE = 4
"""Of the reference, as in the data sets."""


@dataclass(frozen=True)
class Subject:
    """A data set and its correctors.

    Attributes
    ----------
    models : tuple of str
        Released; simulations are ranked by the first one's Omega.
    record, run : str
        Folder in `common.RESULTS` with its evaluation by the weights released, and its name there.
    """

    models: tuple[str, ...]
    record: str
    run: str


SUBJECTS = {
    "impulse": Subject(("impulse-exact",), "impulse-exact-third", "model"),
    "stretch": Subject(("stretch-exact",), "stretch-exact-second", "through-further/model"),
    "torsion": Subject(
        ("torsion-exact", "torsion-exact-compact"), "torsion-exact-seventh", "model"
    ),
}


@dataclass(frozen=True)
class Recorded:
    """A simulation of the split and what was recorded of it, per cent."""

    mesh: int
    simulation: int
    hybrid: float
    best: float


@dataclass(frozen=True)
class Row:
    """What a method reached: nodes, ms a frame, RMS error in m, Omega in per cent."""

    name: str
    nodes: int
    milliseconds: float
    error: float
    omega: float


def ranked(subject: Subject) -> list[Recorded]:
    """The split's simulations, hardest first."""
    found: dict[str, dict[tuple[int, int], float]] = {subject.run: {}, "best": {}}
    with (common.RESULTS / subject.record / "trajectories.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if line["run"] in found:
                key = int(line["mesh"]), int(line["simulation"])
                found[line["run"]][key] = float(line["omega"])
    hybrid, best = found[subject.run], found["best"]
    return sorted((Recorded(*key, hybrid[key], best[key]) for key in hybrid), key=_omega)


def _omega(recorded: Recorded) -> float:
    return recorded.hybrid


def scene_of(motion: str, recorded: Recorded) -> pc.Scene:
    """The scene of a simulation, whose load was the first one drawn for it."""
    config = DatasetConfig.load(home_folder("datasets") / f"{motion}-exact" / "config.toml")
    plans = [plan for plan in make_plan(config) if plan.split == EVALUATION]
    return draw_scene(config, plans[recorded.mesh], recorded.simulation)


def methods(scene: pc.Scene, models: Sequence[str]) -> dict[str, Callable[[], Any]]:
    """What makes each method's stepper."""
    best = pc.best_coarse(scene)
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
    return found | {name: partial(_hybrid, scene, name) for name in models}


def _hybrid(scene: pc.Scene, name: str) -> pc.HybridStepper:
    return pc.hybrid_of(scene, home_folder("models") / name)


def rows_of(scene: pc.Scene, models: Sequence[str]) -> tuple[list[Row], float]:
    """All methods over all frames, the reference last; and the largest displacement, m."""
    coarse = pc.discretise(scene)
    reference = pc.rollout(
        pc.ProjectiveDynamics(pc.discretise(pc.best_coarse(scene), refine=REFINE))
    )
    truth = pc.restrict(reference, to=coarse)
    rows: list[Row] = []
    plain = None
    for name, make in methods(scene, models).items():
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
    subject = SUBJECTS[motion]
    order = ranked(subject)
    figures: common.Figures = {}
    body: list[tuple[float | str, ...]] = []
    found = []
    for quantile in QUANTILES:
        recorded = order[round(quantile * (len(order) - 1))]
        rows, scale = rows_of(scene_of(motion, recorded), subject.models)
        by_name = {row.name: row for row in rows}
        found.append(by_name)
        label = f"{motion}, easier than {100 * quantile:g} %"
        for name, told in (("best", recorded.best), (subject.models[0], recorded.hybrid)):
            figures[f"{label}, {name}, omega less the recorded"] = by_name[name].omega - told
        for name in subject.models:
            figures |= beside(f"{label}, {name}", by_name, name)
        first = (100 * quantile, recorded.mesh, recorded.simulation, 1e3 * scale)
        body += [
            (*first, r.name, r.nodes, r.milliseconds, 1e3 * r.error, r.omega) for r in rows
        ]  # fmt: skip
    picture = common.Picture(motion, caption(motion), lambda path: draw(path, found))
    return common.Outcome(figures, (common.Table(motion, HEADS, tuple(body)),), (picture,))


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


def caption(motion: str) -> str:
    """Of a data set's picture."""
    return (
        f"{motion}, exact: RMS error and time of a frame over the plain mesh's, in five "
        "simulations of the evaluation split; the larger a mark, the harder for the corrector."
    )


def draw(path: Path, simulations: Sequence[Mapping[str, Row]]) -> None:
    """Each method's RMS errors against its times, both over the plain mesh's."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    names = [name for name in simulations[0] if name not in ("plain", "reference")]
    for k, name in enumerate(names):
        label: str | None = name
        for rank, rows in enumerate(simulations):
            axis.scatter(
                rows[name].milliseconds / rows["plain"].milliseconds,
                rows[name].error / rows["plain"].error,
                20 + 28 * rank, common.COLOURS[k], "osD^vP"[k], alpha=0.8, label=label,
            )  # fmt: skip
            label = None
    common.plain_log_axes(
        axis, ("time of a frame over the plain mesh's", "RMS error over the plain mesh's")
    )
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path, dpi=150)


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each data set; there is no quick one."""
    return {} if quick else {motion: partial(measure, motion) for motion in SUBJECTS}


if __name__ == "__main__":
    sys.exit(common.main(__file__))
