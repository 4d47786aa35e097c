"""The thesis's scenes with right masses: what needs no network, and the learned element."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import common
import numpy as np

import pdcorrect as pc
from pdcorrect._environment import home_folder
from pdcorrect.data.configuration import EVALUATION, DatasetConfig
from pdcorrect.data.engines import OneByOne
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import PLAIN, REFERENCE
from pdcorrect.data.simulate import Engines, simulate

SEED = 0
"""Of the order of the meshes, of which the first ones are taken."""
EACH = {"impulse": 3, "stretch": 3, "torsion": 2}
"""Scenes of a motion, as many as time allowed."""
FEW = 1
"""Of each motion, the converged motion is computed of so many."""
FRAMES = 30
"""Of the converged motion."""
HEX27 = {"element": "hex27", "mass": "consistent"}
STORED = {"best coarse": "best", "intermediate": "intermediate"}
"""Runs that a data set has, by backward Euler."""
OWN = {
    "learned": pc.learned_coarse,
    "hex27": lambda scene: scene.with_changes(solver=HEX27),
}
BESIDE = {
    "best coarse": (pc.best_coarse, 1), "best coarse, 2": (pc.best_coarse, 2),
    "learned": (pc.learned_coarse, 1), "learned, 2": (pc.learned_coarse, 2),
    "hex27": (OWN["hex27"], 1), "hex27, 2": (OWN["hex27"], 2),
}  # fmt: skip
"""By generalised-alpha; the number is of steps a frame."""
EULER = ("best coarse", "learned", "hex27", "fine")
"""By backward Euler, beside the converged motion."""
OMEGA, RMS, ERRORS = "Omega, %", "RMS from the fine run, mm", "Errors, % of the RMS displacement"


def of_scene(motion: str, place: int) -> common.Outcome:
    """One simulation, drawn and computed as for a data set of the setting "exact"."""
    path = home_folder("datasets") / f"{motion}-as-published" / "config.toml"
    config = DatasetConfig.load(path).model_copy(update={"setting": "exact"})
    plans = [plan for plan in make_plan(config) if plan.split == EVALUATION]
    order = np.random.default_rng(SEED).permutation(len(plans))
    plan = replace(plans[order[place]], simulations=1)
    engine = OneByOne("pd", config.tolerance)
    (found,) = simulate(config, [plan], Engines(engine, engine))[0].simulations
    scene = pc.Scene.from_toml(found.scene_toml, plan.name)
    runs = {name: found.runs[stored].positions for name, stored in STORED.items()}
    runs |= {name: rolled_out(choose(scene)).positions for name, choose in OWN.items()}
    plain, fine = found.runs[PLAIN].positions, found.runs[REFERENCE].positions
    label, about = f"{motion} {place}", (f"{motion} {place}", plan.name, float(plain.shape[1]))
    omegas = [pc.metrics.error_corrected(run, plain, fine) for run in runs.values()]
    distances = [1e3 * pc.metrics.rms_error(run, fine) for run in (plain, *runs.values())]
    tables = [
        common.Table(OMEGA, ("scene", "mesh", "nodes", *runs), ((*about, *omegas),)),
        common.Table(RMS, ("scene", "plain", *runs), ((label, *distances),)),
    ]
    if place < FEW:
        short = scene.with_changes(time={"frames": FRAMES})
        truth = pc.converged(short)
        errors = {f"{name}, BE": (runs | {"fine": fine})[name][: FRAMES + 1] for name in EULER}
        for name, (choose, substeps) in BESIDE.items():
            time = {"integrator": "generalised-alpha", "substeps": substeps}
            errors[name] = rolled_out(choose(short.with_changes(time=time))).positions
        row = [100.0 * pc.metrics.relative_error(run, truth) for run in errors.values()]
        tables.append(common.Table(ERRORS, ("scene", *errors), ((label, *row),)))
    return common.Outcome({}, tuple(tables))


def rolled_out(scene: pc.Scene) -> pc.Trajectory:
    """On the scene's coarse cells, at their corners."""
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
    return pc.restrict(run, to=pc.discretise(pc.best_coarse(scene)))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each scene, a round of all motions after the other."""
    return {
        f"{motion} {place}": partial(of_scene, motion, place)
        for place in range(1 if quick else max(EACH.values()))
        for motion, count in EACH.items()
        if place < count
    }


def summary(record: common.Record) -> common.Outcome:
    """Mean and worst of each motion."""
    figures: common.Figures = {}
    for name, first in ((OMEGA, 3), (RMS, 1), (ERRORS, 1)):
        table = record.table(name)
        for motion in EACH:
            rows = [row[first:] for row in table["rows"] if row[0].startswith(motion)]
            columns = zip(table["headings"][first:], zip(*rows, strict=True), strict=True)
            for run, found in columns:
                figures[f"{motion}, {run}, {name}, mean"] = float(np.mean(found))
                worst = min(found) if name == OMEGA else max(found)
                figures[f"{motion}, {run}, {name}, worst"] = float(worst)
    return common.Outcome(figures)


def finding(record: common.Record) -> str:
    """Mean Omega and errors of the learned element and of its rivals."""
    figures = record.figures

    def told(run: str, name: str) -> str:
        return ", ".join(f"{figures[f'{m}, {run}, {name}, mean']:.3g}" for m in EACH)

    omegas = "; ".join(f"{run} {told(run, OMEGA)}" for run in ("learned", "hex27", "best coarse"))
    errors = "; ".join(f"{r} {told(r, ERRORS)}" for r in ("learned, 2", "hex27, 2", "learned, BE"))
    return f"{', '.join(EACH)}: mean Ω {omegas}. Errors from the converged motion, %: {errors}."
