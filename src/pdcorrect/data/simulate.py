"""The runs of a data set's simulations: reference, coarse models, intermediate mesh."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pdcorrect.data.configuration import (
    CONVERGED_DIVISOR,
    EVALUATION,
    TRAINING,
    VALIDATION,
    DatasetConfig,
)
from pdcorrect.data.engines import Engine, Steps
from pdcorrect.data.plan import MeshPlan, draw_scene
from pdcorrect.data.schema import (
    BEST,
    CONVERGED,
    PLAIN,
    REFERENCE,
    STATISTICS,
    TOTAL_MASS,
    Run,
    Shard,
    Simulation,
)
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.problem import BASES, Problem, discretise
from pdcorrect.scene import MeshFile, Scene, best_coarse, trained_coarse
from pdcorrect.state import State


@dataclass(frozen=True)
class Model:
    """How a simulation is discretised and stepped."""

    refine: int
    best: bool = False  # with the setting's better element and mass, see `_better`
    predict: bool = False  # whether to take single steps from the reference, too
    divisor: int = 1  # parts of each time step
    heavy: bool = False  # density scaled so that the mass is the reference's
    truth: bool = False  # stepped by the reference's solver
    sample: bool = False  # for the first simulation of the mesh only


def models(config: DatasetConfig, mesh: MeshPlan) -> dict[str, Model]:
    """The runs of a mesh by name, the reference first."""
    best, converged = config.setting != "as-published", config.setting == "converged"
    divisor = CONVERGED_DIVISOR if converged else 1
    truth = partial(Model, best=best, truth=True)
    found = {REFERENCE: truth(mesh.refine, divisor=divisor), PLAIN: Model(1, predict=not converged)}
    if best:
        found[BEST] = Model(1, best=True, predict=not converged)
    else:
        found[TOTAL_MASS] = Model(1, heavy=True, predict=True)
    if mesh.split in (TRAINING, VALIDATION):
        return found
    if mesh.refine > 2:
        found["intermediate"] = Model(2)
    if mesh.split == EVALUATION:
        if config.converged_steps:
            found[CONVERGED] = truth(mesh.refine, divisor=config.converged_steps)
        if mesh.number < config.finest_meshes:
            found["finest"] = truth(2 * mesh.refine, divisor=divisor, sample=True)
    return found


def _better(scene: Scene, setting: str) -> Scene:
    """A setting's best coarse model of a scene; "exact" keeps that of the released models."""
    return best_coarse(scene) if setting == "converged" else trained_coarse(scene)


def lacking(
    config: DatasetConfig,
    mesh: MeshPlan,
    number: int,
    runs: Collection[str],
    predictions: Collection[str],
) -> list[str]:
    """What a simulation of a mesh lacks that has these runs, and single steps of those."""
    found = []
    for name, model in sorted(models(config, mesh).items()):
        if model.sample and number:
            continue
        if name not in runs:
            found.append(f"run {name!r}")
        elif model.predict and name not in predictions:
            found.append(f"single steps of run {name!r}")
    return found


def work_per_node(config: DatasetConfig, mesh: MeshPlan) -> float:
    """About how much a simulation takes for each coarse node: steps of refined nodes."""
    runs = (m for m in models(config, mesh).values() if not m.sample)
    return float(mesh.frames * sum((1 + m.predict) * m.refine**3 * m.divisor for m in runs))


MOST_ATTEMPTS = 20
"""Draws of a simulation's load before the data set is given up."""


class Engines(NamedTuple):
    """What steps the models, and the reference."""

    models: Engine
    truth: Engine

    def of(self, model: Model) -> Engine:
        """The engine for a run."""
        return self.truth if model.truth else self.models


@dataclass(eq=False)
class _Draft:
    """A simulation in the making, at one attempt."""

    plan: MeshPlan
    models: dict[str, Model]
    problems: dict[str, Problem]  # of the mesh by run, without this simulation's loads
    number: int  # on its mesh
    scene: Scene
    attempt: int = 0
    rejected: tuple[str, ...] = ()
    steps: dict[str, Steps] = field(default_factory=dict)  # rollouts by run
    predictions: dict[str, Steps] = field(default_factory=dict)

    @property
    def alive(self) -> bool:
        """Whether nothing of this attempt has failed."""
        return len(self.rejected) == self.attempt

    def wants(self, name: str) -> bool:
        """Whether a run belongs to this simulation."""
        model = self.models.get(name)
        return model is not None and not (model.sample and self.number)

    def loaded(self, name: str) -> Problem:
        """A run's problem under this simulation's load."""
        return self.problems[name].with_loads(self.scene.loads)

    def keep(self, kept: dict[str, Steps], name: str, steps: Steps) -> None:
        """Note a run, or why it is of no use."""
        kept[name] = steps
        if steps.failure and self.alive:
            self.rejected = (*self.rejected, f"{name}, {steps.failure}")

    def again(self, config: DatasetConfig) -> _Draft:
        """The next attempt; `ConvergenceError` if there were too many."""
        attempt = self.attempt + 1
        if attempt == MOST_ATTEMPTS:
            raise ConvergenceError(
                f"{self.plan.name}, simulation {self.number}: {attempt} loads were drawn and all "
                f"rejected, the last one by {self.rejected[-1]}. Ask for weaker loads or stiffer "
                "materials."
            )
        scene = draw_scene(config, self.plan, self.number, attempt)
        return replace(self, scene=scene, attempt=attempt, steps={}, predictions={})


def simulate(config: DatasetConfig, plans: Sequence[MeshPlan], engines: Engines) -> list[Shard]:
    """All simulations of some meshes of one split, computed together.

    A drawn load under which a run fails or inverts a cell is rejected and drawn again, and
    `ConvergenceError` is raised after `MOST_ATTEMPTS` draws.
    """
    waiting: list[_Draft] = []
    for plan in plans:
        wanted = models(config, plan)
        problems = _problems(config, plan, wanted)
        for k in range(plan.simulations):
            waiting.append(_Draft(plan, wanted, problems, k, draw_scene(config, plan, k)))
    finished: dict[tuple[str, int], _Draft] = {}
    while waiting:
        _attempt(waiting, engines)
        finished |= {(draft.plan.name, draft.number): draft for draft in waiting if draft.alive}
        waiting = [draft.again(config) for draft in waiting if not draft.alive]
    return [
        _shard(config, [finished[plan.name, k] for k in range(plan.simulations)], engines)
        for plan in plans
    ]


def _problems(
    config: DatasetConfig, plan: MeshPlan, wanted: Mapping[str, Model]
) -> dict[str, Problem]:
    """A mesh's discretisations by run; of models that differ in their steps only one is made."""
    scene = draw_scene(config, plan, 0)
    made: dict[tuple[int, bool], Problem] = {}
    found: dict[str, Problem] = {}
    for name, model in wanted.items():
        key = (model.refine, model.best)
        if key not in made:
            chosen = _better(scene, config.setting) if model.best else scene
            made[key] = discretise(chosen, model.refine)
        found[name] = made[key]
        if model.heavy:
            found[name] = made[key].with_total_mass(float(found[REFERENCE].mass.sum()))
    return found


def _attempt(drafts: Sequence[_Draft], engines: Engines) -> None:
    """Compute all runs, the cheapest first; a draft that fails takes no further part."""
    names = {name: model for draft in drafts for name, model in draft.models.items()}

    def wanted(name: str) -> list[_Draft]:
        return [d for d in drafts if d.alive and d.wants(name)]

    for name in sorted(names, key=lambda n: (names[n].refine, names[n].divisor)):
        if chosen := wanted(name):
            model, problems = names[name], [draft.loaded(name) for draft in chosen]
            frames = chosen[0].plan.frames
            found = engines.of(model).rollouts(problems, frames, model.divisor)
            for draft, steps in zip(chosen, found, strict=True):
                draft.keep(draft.steps, name, steps)
    for name in (n for n, model in names.items() if model.predict):
        if chosen := wanted(name):
            problems, states = [d.loaded(name) for d in chosen], [_states(d) for d in chosen]
            found = engines.models.predictions(problems, states)
            for draft, steps in zip(chosen, found, strict=True):
                draft.keep(draft.predictions, name, steps)


def _states(draft: _Draft) -> list[State]:
    """The reference's frames but the last, on the coarse nodes (Algorithms 1 and 2)."""
    reference, step = draft.steps[REFERENCE], draft.plan.step
    later = zip(reference.positions[:-1], reference.velocities[:-1], strict=True)
    first = draft.problems[PLAIN].initial_state()
    return [first, *(State(p, v, (t + 1) * step) for t, (p, v) in enumerate(later))]


def _shard(config: DatasetConfig, drafts: Sequence[_Draft], engines: Engines) -> Shard:
    plan, plain = drafts[0].plan, drafts[0].problems[PLAIN]
    return Shard(
        attributes={
            "dataset": config.name, "split": plan.split, "number": plan.number,
            "setting": config.setting, "config_hash": config.hash(), "time_step": plan.step,
            "tolerance": config.tolerance,
        },
        **arrays_of(plain),
        simulations=tuple(_simulation(draft, engines, config.setting) for draft in drafts),
    )  # fmt: skip


def _simulation(draft: _Draft, engines: Engines, setting: str) -> Simulation:
    plain, plan = draft.loaded(PLAIN), draft.plan
    times = plan.step * np.arange(plan.frames + 1)
    every = [*draft.steps.items(), *((f"{n} steps", s) for n, s in draft.predictions.items())]
    return Simulation(
        forces=np.stack([plain.external_forces(*span) for span in pairwise(times)]),
        runs={name: _run(draft, name, engines, setting) for name in draft.steps},
        scene_toml=draft.scene.to_toml(),
        attempt=draft.attempt,
        rejected=draft.rejected,
        seconds={name: steps.seconds for name, steps in every},
    )


def _run(draft: _Draft, name: str, engines: Engines, setting: str) -> Run:
    model, problem, steps = draft.models[name], draft.problems[name], draft.steps[name]
    predictions = draft.predictions.get(name)
    rest = problem.positions[problem.mesh.coarse_nodes]
    velocities = None
    if setting == "converged" and name == REFERENCE:
        velocities = np.concatenate([np.zeros_like(rest)[None], steps.velocities])
    return Run(
        positions=np.concatenate([rest[None], steps.positions]),
        predictions=None if predictions is None else predictions.positions,
        statistics={key: getattr(steps, key) for key in STATISTICS},
        attributes={
            **engines.of(model).describe(),
            "refine": model.refine,
            "nodes": len(problem.positions),
            "element": problem.element,
            "mass": problem.mass_rule,
            "total_mass": float(problem.mass.sum()),
            "time_step": draft.plan.step / model.divisor,
        },
        velocities=velocities,
    )


FORCE_ERROR = 1e-5
"""Largest difference of loads from the stored ones, over their largest; those are float32."""


def discretise_stored(scene: Scene, shard: Shard, refine: int = 1) -> Problem:
    """The problem of a scene in a file, on the file's own mesh if its body is a mesh file."""
    if not isinstance(scene.body, MeshFile):
        return discretise(scene, refine)
    mesh = HexMesh.create(shard.points, shard.cells.astype(np.int64))
    return discretise(scene, refine, mesh=mesh)


def rebuilt_problems(shard: Shard, path: Path, run: str = PLAIN) -> list[Problem]:
    """The problem of each simulation of a file, discretised as one of its runs was.

    They share mesh, operators and masses.  ``path`` is the file's, for messages, and ``run`` one of
    `pdcorrect.fem.problem.BASES`, or "reference".  `InputError` if a simulation has no scene, as
    imported ones, lacks the run, or what its scene leads to is not what the file holds.
    """
    stored = shard.simulations[0].runs.get(run)
    if stored is None or run not in (*BASES, REFERENCE):
        raise InputError(
            f"{path}: run {run!r}: expected one of {', '.join((*BASES, REFERENCE))} that it has."
        )
    if not all(simulation.scene_toml for simulation in shard.simulations):
        raise InputError(
            f"{path}: a simulation has no scene, as if imported: expected one that "
            "`pdcorrect dataset generate` made, for it has to be stepped again."
        )
    scenes = [Scene.from_toml(s.scene_toml, f"{path}, a scene") for s in shard.simulations]
    plain = discretise_stored(scenes[0], shard)
    wrong = unlike_arrays(plain, shard)
    for k, scene in enumerate([] if wrong else scenes):
        step = unlike_loads(plain.with_loads(scene.loads), shard.simulations[k])
        wrong += [] if step is None else [f"the loads of simulation {k} in step {step + 1}"]
    if wrong:
        raise InputError(
            f"{path}: {wrong[0]} rebuilt from the stored scene differ from the file's: expected "
            "the same. Was the file made by another version of the code?"
        )
    problem = plain
    if run == TOTAL_MASS:
        problem = plain.with_total_mass(float(stored.attributes["total_mass"]))
    elif run != PLAIN:
        setting = str(shard.attributes["setting"])
        better = run == BEST or setting in ("exact", "converged")
        refine = int(stored.attributes.get("refine", 1))
        scene = _better(scenes[0], setting) if better else scenes[0]
        problem = discretise_stored(scene, shard, refine)
    loaded = [(problem.with_loads(scene.loads), scene.name) for scene in scenes]
    return [replace(p, scene=p.scene.with_changes(name=name)) for p, name in loaded]


def arrays_of(problem: Problem) -> dict[str, Any]:
    """The arrays of a `Shard` whose plain coarse model is this problem."""
    materials = problem.materials
    return {
        "points": problem.positions, "cells": problem.cells, "free": problem.free,
        "mass": problem.mass, "young": materials.young, "poisson": materials.poisson,
        "density": materials.density,
    }  # fmt: skip


def unlike_arrays(problem: Problem, shard: Shard) -> list[str]:
    """Arrays of a file, and its time step, that are not those of its plain coarse problem."""
    unlike = [
        name
        for name, values in arrays_of(problem).items()
        if values.shape != getattr(shard, name).shape
        or not np.allclose(values, getattr(shard, name), rtol=1e-9, atol=1e-12)
    ]
    same = np.isclose(problem.time_step, shard.attributes["time_step"], rtol=1e-9, atol=1e-12)
    return unlike if same else [*unlike, "time_step"]


def unlike_loads(problem: Problem, simulation: Simulation, count: int = 2) -> int | None:
    """The first of some steps, evenly spread, whose forces are not a problem's loads."""
    h, size = problem.time_step, np.abs(simulation.forces).max()
    for step in np.unique(np.linspace(0, simulation.steps - 1, count).astype(int)):
        loads = problem.external_forces(step * h, (step + 1) * h)
        if np.abs(loads - simulation.forces[step]).max() > FORCE_ERROR * size:
            return int(step)
    return None
