"""Error against run time of every model and solver, for a scene of each data set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import common
import numpy as np
from scipy.optimize import minimize_scalar

import pdcorrect as pc
from pdcorrect._environment import home_folder
from pdcorrect.data.configuration import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.scene import trained_coarse

MOTIONS, SETTINGS = ("impulse", "stretch", "torsion"), ("as-published", "exact")
FRAMES = 30
FINEST = {"as-published": 4, "exact": 8}
"""Cut of the reference's cells: that of the thesis, and one finer than the data set's."""
TOLERANCES = (1e-2, 1e-3, 1e-6)
"""Of the coarse cell size, beside the scene's own."""
MODELS = {(motion, setting): f"{motion}-{setting}" for motion in MOTIONS for setting in SETTINGS}
"""The released corrector that was trained on such scenes."""
FITTED = "fitted stiffness"
"""Fitted to the very scene: shown, but no one's rival."""
NEARER = 0.99
"""Of the error of what is quicker: more is no gain."""
FAMILIES = ("coarse mesh, 8-node elements", "coarse mesh, other elements", "finer mesh",
            "other tolerance", "Newton", "hybrid")  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What a method reached: nodes, ms a frame, RMS error in m on the coarse nodes."""

    name: str
    family: str
    nodes: int
    milliseconds: float
    error: float


def quickest(rows: Sequence[Row], error: float) -> Row:
    """With at most so much error."""
    return min((r for r in rows if r.error <= error), key=lambda r: r.milliseconds)


def nearest(rows: Sequence[Row], milliseconds: float) -> Row:
    """In at most so much time."""
    return min((r for r in rows if r.milliseconds <= milliseconds), key=lambda r: r.error)


def front(rows: Sequence[Row]) -> list[Row]:
    """Those that nothing quicker is as near as, to `NEARER`, quickest first."""
    out: list[Row] = []
    for row in sorted(rivals(rows), key=lambda r: (r.milliseconds, r.error)):
        if not out or row.error < NEARER * out[-1].error:
            out.append(row)
    return out


def rivals(rows: Sequence[Row]) -> list[Row]:
    """All but what was fitted to the scene."""
    return [row for row in rows if row.name != FITTED]


@dataclass(frozen=True)
class Method:
    """A way to compute the scene.

    Attributes
    ----------
    family : str
        One of `FAMILIES`.
    stepper : callable
        Makes what steps.
    every : float
        Frames from one step to the next: 2 where the step is twice as long.
    """

    family: str
    stepper: Callable[[], Any]
    every: float = 1.0


class Comparison:
    """The methods for one scene, and their errors.

    Parameters
    ----------
    motion, setting : str
    quick : bool
        Fewer frames, and the data set's reference.
    """

    def __init__(self, motion: str, setting: str, quick: bool) -> None:
        self.motion, self.setting, self.quick = motion, setting, quick
        self.frames = 5 if quick else FRAMES
        self.finest = 4 if quick else FINEST[setting]
        self.scene = smallest_scene(motion, setting)
        self.points = pc.discretise(self.scene)

    @cached_property
    def truth(self) -> pc.Trajectory:
        """The reference on the coarse nodes."""
        scene = self.best if self.setting == "exact" else self.scene
        run = self.run(pc.ProjectiveDynamics(pc.discretise(scene, refine=self.finest)))
        self.reference = run
        return pc.restrict(run, to=self.points)

    @cached_property
    def best(self) -> pc.Scene:
        """The scene with the better element."""
        return trained_coarse(self.scene)

    def run(self, stepper: Any, every: float = 1.0) -> pc.Trajectory:
        """All frames."""
        return pc.rollout(stepper, round(self.frames / every))

    def row(self, name: str, method: Method) -> Row:
        """Run a method, once more if it is quick, and measure it."""
        run = self.run(method.stepper(), method.every)
        seconds = median_step(run)
        if seconds < 0.1:
            seconds = min(seconds, median_step(self.run(method.stepper(), method.every)))
        error = self.error(run, method.every)
        nodes = len(run.problem.positions)
        return Row(name, method.family, nodes, 1e3 * seconds / method.every, error)

    def error(self, run: pc.Trajectory, every: float = 1.0) -> float:
        """RMS distance from the reference, m, at the frames that both have."""
        found = pc.restrict(run, to=self.points).positions
        truth = self.truth.positions
        if every < 1.0:
            found = found[:: round(1.0 / every)]
        return pc.metrics.rms_error(found, truth[:: max(1, round(every))])

    def methods(self) -> Iterator[tuple[str, Method]]:
        """All of them, by name."""
        coarse, other, finer, tolerance, newton, _ = FAMILIES
        plain = partial(pc.discretise, self.scene)
        yield "plain", Method(coarse, lambda: pc.ProjectiveDynamics(plain()))
        yield "right mass", Method(coarse, self._right_mass)
        yield FITTED, Method(coarse, self._fitted)
        elements = ("hex8-mean", "hex8-bubble", "hex27")
        for element in elements[:1] if self.quick else elements:
            yield element, Method(other, self._pd(plain, element=element))
        best = partial(pc.discretise, self.best)
        yield "best", Method(other, self._pd(best))
        yield "plain 2×2×2", Method(finer, self._pd(plain, refine=2))
        if self.quick:
            return
        yield "best 2×2×2", Method(finer, self._pd(best, refine=2))
        if self.setting == "exact":  # the other's reference
            yield "plain 4×4×4", Method(finer, self._pd(plain, refine=4))
            yield "best 4×4×4", Method(finer, self._pd(best, refine=4))
        for name, make in (("plain", plain), ("best", best)):
            for size in TOLERANCES:
                label = f"{name}, {size:.0e}"
                yield label, Method(tolerance, lambda m=make, s=size: pc.ProjectiveDynamics(m(), s))
            yield f"{name}, Newton", Method(newton, lambda m=make: pc.Newton(m()))
        for every in (2.0, 0.5):
            step = every * self.points.time_step
            make = partial(self._newton, best, step)
            yield f"best, Newton, {every:g} h", Method(newton, make, every)
        name = MODELS[self.motion, self.setting]
        yield f"hybrid, {name}", Method("hybrid", partial(self._hybrid, name))

    def _pd(self, make: Callable[..., pc.Problem], **options: Any) -> Callable[[], Any]:
        return lambda: pc.ProjectiveDynamics(make(**options))

    def _newton(self, make: Callable[..., pc.Problem], step: float) -> pc.Newton:
        return pc.Newton(make(), time_step=step)

    def _hybrid(self, name: str) -> Any:
        return pc.hybrid_of(self.scene, home_folder("models") / name)

    def _right_mass(self) -> pc.ProjectiveDynamics:
        mass = self.reference.problem.mass.sum()
        return pc.ProjectiveDynamics(self.points.with_total_mass(mass))

    def _fitted(self) -> pc.ProjectiveDynamics:
        """With the modulus that suits this very scene best: more than one can have elsewhere."""
        known = self.points.materials

        def stepper(logarithm: float) -> pc.ProjectiveDynamics:
            problem = self.points.with_material(np.exp(logarithm) * known.young, known.poisson)
            return pc.ProjectiveDynamics(problem)

        def error(logarithm: float) -> float:
            return self.error(self.run(stepper(logarithm)))

        found = minimize_scalar(
            error, bounds=(-2.0, 1.0), method="bounded", options={"xatol": 0.02, "maxiter": 12}
        )
        return stepper(float(found.x))


def median_step(run: pc.Trajectory) -> float:
    """Wall-clock seconds of a step."""
    return float(np.median(run.stats["seconds"]))


def smallest_scene(motion: str, setting: str) -> pc.Scene:
    """The first simulation on the smallest mesh of a data set's evaluation split."""
    config = DatasetConfig.load(home_folder("datasets") / f"{motion}-{setting}" / "config.toml")
    plans = [plan for plan in make_plan(config) if plan.split == EVALUATION]
    return draw_scene(config, min(plans, key=lambda plan: plan.design.nodes), 0)


def measure(motion: str, setting: str, quick: bool) -> common.Outcome:
    """One scene, computed in all ways."""
    comparison = Comparison(motion, setting, quick)
    scale = pc.metrics.largest_displacement(comparison.truth)
    rows = [comparison.row(name, method) for name, method in comparison.methods()]
    run = comparison.reference
    last = Row("reference", FAMILIES[2], len(run.problem.positions), 1e3 * median_step(run), 0.0)
    return outcome(f"{motion}, {setting}", rows, last, scale)


def outcome(label: str, rows: Sequence[Row], reference: Row, scale: float) -> common.Outcome:
    """What a scene's rows say; ``scale`` is the largest displacement, m."""
    by_name = {row.name: row for row in rows}
    plain, middle = by_name["plain"], by_name["plain 2×2×2"]
    figures: dict[str, float] = {
        f"{label}, largest displacement, mm": 1e3 * scale,
        f"{label}, plain, error, per cent": 100.0 * plain.error / scale,
        f"{label}, best, error over plain's": by_name["best"].error / plain.error,
        f"{label}, intermediate mesh, omega": 100.0 * (1.0 - (middle.error / plain.error) ** 2),
    }
    tables = [methods_table(label, [*rows, reference], scale)]
    hybrids = [row for row in rows if row.family == "hybrid"]
    if hybrids:  # times of a quick run's few frames say nothing
        as_near = quickest(rivals(rows), middle.error)
        as_quick = nearest(rivals(rows), 1.1 * middle.milliseconds)
        speed_up = middle.milliseconds / as_near.milliseconds
        figures[f"{label}, speed-up at the intermediate mesh's error"] = speed_up
        figures[f"{label}, error at its time, of its error"] = as_quick.error / middle.error
        untrained = [r for r in [*rivals(rows), reference] if r not in hybrids]
        tables.append(beside(label, hybrids, untrained))
    for row in hybrids:
        base = by_name["best" if label.endswith("exact") else "plain"]
        figures[f"{label}, {row.name}, error over its base's"] = row.error / base.error
    for name in ("plain", "best"):
        if f"{name}, 1e-06" in by_name:
            tight, newton = by_name[f"{name}, 1e-06"], by_name[f"{name}, Newton"]
            figures[f"{label}, {name}, PD's error over Newton's"] = tight.error / newton.error
    return common.Outcome(figures, tuple(tables))


HEADS = ("method", "kind", "nodes", "ms a frame", "RMS error, mm", "per cent", "front")


def methods_table(label: str, rows: Sequence[Row], scale: float) -> common.Table:
    """All rows, quickest first."""
    on_front = {row.name for row in front(rows[:-1])}
    body = tuple(
        (r.name, r.family, float(r.nodes), r.milliseconds, 1e3 * r.error,
         100.0 * r.error / scale, "yes" if r.name in on_front else "")
        for r in sorted(rows, key=lambda r: r.milliseconds)
    )  # fmt: skip
    return common.Table(label, HEADS, body)


BESIDE = "Hybrids beside what needs no training"


def beside(label: str, hybrids: Sequence[Row], untrained: Sequence[Row]) -> common.Table:
    """Each hybrid beside the quickest as near, and the nearest as quick, without training."""
    heads = (
        "scene", "hybrid", "as near without training", "takes of its time",
        "as quick without training", "its error of that one's",
    )  # fmt: skip
    body = []
    for row in hybrids:
        near, quick = quickest(untrained, row.error), nearest(untrained, row.milliseconds)
        body.append((
            label, row.name.removeprefix("hybrid, "), near.name,
            near.milliseconds / row.milliseconds, quick.name, row.error / quick.error,
        ))  # fmt: skip
    return common.Table(BESIDE, heads, tuple(body))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each scene; quick runs have one."""
    pairs = [("torsion", "exact")] if quick else list(MODELS)
    return {f"{m}, {s}": partial(measure, m, s, quick) for m, s in pairs}


def draw(record: common.Record, path: Path) -> None:
    """Error against time in the exact scenes, with the Pareto front."""
    figure, panels = common.panels(12, 4.4, len(MOTIONS))
    for axis, motion in zip(panels, MOTIONS, strict=True):
        rows = [row for row in record.table(f"{motion}, exact")["rows"] if row[0] != "reference"]
        best = [(row[3], row[5]) for row in rows if row[6]]
        axis.step(*zip(*best, strict=True), where="post", color="0.6", label="Pareto front")
        for k, family in enumerate(FAMILIES):
            points = [(r[3], r[5]) for r in rows if r[1] == family and r[0] != FITTED]
            style = {"marker": common.MARKS[k], "color": common.COLOURS[k], "label": family}
            axis.scatter(*zip(*points, strict=True), 40, zorder=3, **style)
        axis.set(xscale="log", yscale="log", title=f"{motion}, exact", xlabel="ms a frame")
        common.log_axis(axis.xaxis)
        common.log_axis(axis.yaxis)
        common.plain(axis)
    panels[0].set_ylabel("RMS error, % of the largest displacement")
    common.save(figure, path, panels[0], 4)


def finding(record: common.Record) -> str:
    """The hybrids of the exact scenes beside what is as quick or as near without training."""
    rows = [row for row in record.table(BESIDE)["rows"] if row[0].endswith("exact")]
    times, errors = [row[3] for row in rows], [1.0 / row[5] for row in rows]
    fitted = [f"{ratio:.2g} ({motion})" for motion, ratio in over_hybrids(record).items()]
    return (
        f"In three exact scenes, kind to the hybrids, they are {min(errors):.0f} to "
        f"{max(errors):.0f} times as near as anything untrained in their time, but for a modulus "
        f"fitted to the scene itself: its error is {', '.join(fitted)} times theirs. What is as "
        f"near takes {min(times):.0f} to {max(times):.0f} times as long."
    )


def over_hybrids(record: common.Record) -> dict[str, float]:
    """The fitted modulus's error over the hybrid's, by motion, in the exact scenes."""
    found = {}
    for motion in MOTIONS:
        rows = {row[0]: row for row in record.table(f"{motion}, exact")["rows"]}
        at = HEADS.index("RMS error, mm")
        found[motion] = rows[FITTED][at] / rows[f"hybrid, {MODELS[motion, 'exact']}"][at]
    return found
