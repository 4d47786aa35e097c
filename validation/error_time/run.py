"""Error against run time of every model and solver, for a scene of each data set."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))
import common
from drawing import draw
from rows import FAMILIES, FITTED, Measured, Row, front, nearest, quickest, rivals

import pdcorrect as pc
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.home import home_folder

MOTIONS, SETTINGS = ("impulse", "stretch", "torsion"), ("as-published", "exact")
FRAMES = 30
FINEST = {"as-published": 4, "exact": 8}
"""Cut of the reference's cells: that of the thesis, and one finer than the data set's."""
TOLERANCES = (1e-2, 1e-3, 1e-6)
"""Of the coarse cell size, beside the scene's own."""
ALL_MOTIONS = "all-as-published-total-mass"
MODELS: Mapping[tuple[str, str], Sequence[str]] = {
    ("impulse", "as-published"): (
        "impulse-as-published",
        "impulse-as-published-total-mass",
        ALL_MOTIONS,
    ),
    ("impulse", "exact"): ("impulse-exact",),
    ("stretch", "as-published"): (
        "stretch-as-published",
        "stretch-as-published-total-mass",
        ALL_MOTIONS,
    ),
    ("stretch", "exact"): ("stretch-exact",),
    ("torsion", "as-published"): (
        "torsion-as-published",
        "torsion-as-published-total-mass",
        ALL_MOTIONS,
    ),
    ("torsion", "exact"): ("torsion-exact", "torsion-exact-compact"),
}
"""Released correctors that were trained on such scenes, by motion and setting."""
ROWS = {"plain": "plain", "best": "best", "total-mass": "right mass"}
"""Methods that correctors are added to, by the name of their base."""


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
        return pc.best_coarse(self.scene)

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
        for name in MODELS.get((self.motion, self.setting), ()):
            yield f"hybrid, {name}", Method("hybrid", partial(self._hybrid, name))

    def _pd(self, make: Callable[..., pc.Problem], **options: Any) -> Callable[[], Any]:
        return lambda: pc.ProjectiveDynamics(make(**options))

    def _newton(self, make: Callable[..., pc.Problem], step: float) -> pc.Newton:
        return pc.Newton(make(), time_step=step)

    def _hybrid(self, name: str) -> Any:
        return pc.hybrid_of(self.scene, released(name))

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


@cache
def released(name: str) -> Any:
    """A corrector of `models/`."""
    return pc.load_model(home_folder("models") / name)


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
    caption = (
        f"{motion}, {setting}: error against time for {comparison.frames} frames; distances from "
        f"{comparison.finest}×{comparison.finest}×{comparison.finest} cells a cell."
    )
    return outcome(Measured(motion, setting, rows, last, scale), quick, caption)


def outcome(measured: Measured, quick: bool, caption: str) -> common.Outcome:
    """What a scene says."""
    rows, scale = measured.rows, measured.scale
    label = f"{measured.motion}, {measured.setting}"
    by_name = {row.name: row for row in rows}
    plain, middle = by_name["plain"], by_name["plain 2×2×2"]
    as_near = quickest(rivals(rows), middle.error)
    as_quick = nearest(rivals(rows), 1.1 * middle.milliseconds)
    figures: dict[str, float] = {
        f"{label}, largest displacement, mm": 1e3 * scale,
        f"{label}, plain, error, per cent": 100.0 * plain.error / scale,
        f"{label}, best, error over plain's": by_name["best"].error / plain.error,
        f"{label}, intermediate mesh, omega": 100.0 * (1.0 - (middle.error / plain.error) ** 2),
    }
    if not quick:  # times of a few frames say nothing
        speed_up = middle.milliseconds / as_near.milliseconds
        figures[f"{label}, speed-up at the intermediate mesh's error"] = speed_up
        figures[f"{label}, error at its time, of its error"] = as_quick.error / middle.error
    models = MODELS.get((measured.motion, measured.setting), ())
    hybrids = [by_name[f"hybrid, {name}"] for name in models if f"hybrid, {name}" in by_name]
    for row in hybrids:
        base = by_name[ROWS[released(row.name.removeprefix("hybrid, ")).base]]
        figures[f"{label}, {row.name}, error over its base's"] = row.error / base.error
    for name in ("plain", "best"):
        if f"{name}, 1e-06" in by_name:
            tight, newton = by_name[f"{name}, 1e-06"], by_name[f"{name}, Newton"]
            figures[f"{label}, {name}, PD's error over Newton's"] = tight.error / newton.error
    tables = [methods_table(measured), winners(label, as_near, as_quick)]
    if hybrids:
        untrained = [r for r in [*rivals(rows), measured.reference] if r not in hybrids]
        tables.append(beside(label, hybrids, untrained))
    picture = f"{measured.motion}-{measured.setting}"
    return common.Outcome(
        figures, tuple(tables),
        (common.Picture(picture, caption, lambda path: draw(path, rows, scale)),),
    )  # fmt: skip


HEADS = ("method", "kind", "nodes", "ms a frame", "RMS error, mm", "per cent", "front")


def methods_table(measured: Measured) -> common.Table:
    """All rows, quickest first."""
    on_front = {row.name for row in front(measured.rows)}
    body = tuple(
        (r.name, r.family, float(r.nodes), r.milliseconds, 1e3 * r.error,
         100.0 * r.error / measured.scale, "yes" if r.name in on_front else "")
        for r in sorted([*measured.rows, measured.reference], key=lambda r: r.milliseconds)
    )  # fmt: skip
    return common.Table(f"{measured.motion}, {measured.setting}", HEADS, body)


def winners(label: str, as_near: Row, as_quick: Row) -> common.Table:
    """Who is as near as the intermediate mesh in the least time, and nearest in its time."""
    heads = ("scene", "as near, quickest", "ms a frame", "as quick, nearest", "RMS error, mm")
    row = (label, as_near.name, as_near.milliseconds, as_quick.name, 1e3 * as_quick.error)
    return common.Table("Beside the intermediate mesh (plain 2×2×2)", heads, (row,))


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
    return common.Table("Hybrids beside what needs no training", heads, tuple(body))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each scene; quick runs have one."""
    pairs = [("torsion", "exact")] if quick else [(m, s) for m in MOTIONS for s in SETTINGS]
    return {f"{m}, {s}": partial(measure, m, s, quick) for m, s in pairs}


if __name__ == "__main__":
    sys.exit(common.main(__file__))
