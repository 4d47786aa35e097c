"""What is wrong within one file of a data set: its numbers, its runs, and against its plan."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from pdcorrect.data.check_motion import model_faults, volume_faults
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.plan import MeshPlan, draw_scene
from pdcorrect.data.schema import REFERENCE, Array, Run, Shard, Simulation
from pdcorrect.data.simulate import lacking, unlike_arrays, unlike_loads
from pdcorrect.errors import SceneError
from pdcorrect.fem.hexahedron import gauss_points, jacobians
from pdcorrect.fem.problem import discretise
from pdcorrect.scene import Scene

_SLACK = 1e-6
"""Relative, for tolerances of numbers that are stored as float32."""
_LOADS_COMPARED = 8
"""Steps of each simulation, the first and the last among them."""
_LAST_DIGITS = 1e-14
"""Relative: by so much exponentials differ between processors, and with them what is drawn."""


def file_faults(shard: Shard) -> Iterator[str]:
    """What is wrong within one file whose mesh can be used."""
    for name in ("young", "density", "mass"):
        if getattr(shard, name).min() <= 0:
            yield f"{name} is {getattr(shard, name).min():g} somewhere: expected more than 0"
    cell = cell_size(shard)
    for k, simulation in enumerate(shard.simulations):
        for message in _simulation_faults(shard, simulation, cell):
            yield f"simulation {k:04d}: {message}"
    yield from _unlike_runs(shard)


def cell_size(shard: Shard) -> float:
    """Cube root of the mean cell volume, m."""
    volumes = jacobians(shard.points, shard.cells.astype(np.int64), gauss_points(2)).mean(axis=1)
    return float(np.cbrt(volumes.mean()))


def _simulation_faults(shard: Shard, simulation: Simulation, cell: float) -> Iterator[str]:
    reference = simulation.runs.get(REFERENCE)
    if reference is None or reference.positions is None:
        yield f"there is no rollout {REFERENCE!r}"
    yield from volume_faults(shard, simulation)
    if len(simulation.rejected) != simulation.attempt:
        yield (
            f"attempt is {simulation.attempt}, with {len(simulation.rejected)} reasons of "
            "rejected draws: expected as many"
        )
    for name, run in simulation.runs.items():
        for message in _run_faults(shard, run, cell):
            yield f"{name}: {message}"


def _run_faults(shard: Shard, run: Run, cell: float) -> Iterator[str]:
    errors = run.statistics.get("error_estimates")
    limit = float(shard.attributes["tolerance"]) * cell
    if errors is not None and errors.max() > limit * (1 + _SLACK):
        yield (
            f"the solver's error estimate is {errors.max():.3g} m after step "
            f"{errors.argmax() + 1}: expected at most {limit:.3g} m"
        )
    if run.positions is not None:
        away = _distance(run.positions[:1], shard.points)
        if away > _rounding(run.positions, shard.points, cell):
            yield f"frame 0 is {away:.3g} m off the rest shape"
    if run.velocities is not None:
        yield from _speed_faults(run.velocities, shard.free)
    for name in ("positions", "predictions"):
        values = getattr(run, name)
        if values is None or shard.free.all():
            continue
        away = _distance(values, shard.points, ~shard.free)
        if away > _rounding(values, shard.points, cell):
            yield f"held nodes are up to {away:.3g} m off their place in its {name}"


def _speed_faults(velocities: Array, free: Array) -> Iterator[str]:
    """Velocities (m/s) at the start, and of what is held."""
    if velocities[0].any():
        yield f"its velocities are up to {np.abs(velocities[0]).max():.3g} m/s in frame 0"
    held = np.abs(velocities[:, ~free])
    if held.any():
        yield f"held nodes have velocities of up to {held.max():.3g} m/s"


def _distance(values: Array, points: Array, where: Array | None = None) -> float:
    """Largest difference of a component from its rest position, m."""
    moved = np.abs(values - points)
    return float(moved.max() if where is None else moved[:, where].max())


def _rounding(values: Array, points: Array, cell: float) -> float:
    """How far stored positions may be off for being rounded, m."""
    return float(4 * np.finfo(values.dtype).eps * np.abs(points).max() + 1e-9 * cell)


def _unlike_runs(shard: Shard) -> Iterator[str]:
    """Simulations that lack runs; the first one of a mesh may have some more."""
    first = set(shard.simulations[0].runs)
    names = [set(simulation.runs) for simulation in shard.simulations]
    common = set.union(*names[1:]) if len(names) > 1 else first
    for k, own in enumerate(names):
        missing = sorted(common - own)
        if missing:
            yield f"simulation {k:04d} has no run {missing[0]!r}, unlike others"


def plan_faults(config: DatasetConfig, plan: MeshPlan, shard: Shard) -> Iterator[str]:
    """Where a file is not the mesh, the material, the loads and the runs that it should be."""
    if len(shard.simulations) != plan.simulations:
        yield f"{len(shard.simulations)} simulations: expected {plan.simulations}"
    problem = discretise(draw_scene(config, plan, 0))
    unlike = unlike_arrays(problem, shard)
    for name in unlike:
        yield f"its {name} is not what config.toml draws"
    for k, simulation in enumerate(shard.simulations):
        if simulation.steps != plan.frames:
            yield f"simulation {k:04d} has {simulation.steps} frames: expected {plan.frames}"
        scene = draw_scene(config, plan, k, simulation.attempt)
        if not same_scene(simulation.scene_toml, scene):
            yield f"simulation {k:04d}: its scene is not the one that config.toml draws"
        if not unlike and simulation.steps == plan.frames:
            step = unlike_loads(problem.with_loads(scene.loads), simulation, _LOADS_COMPARED)
            if step is not None:
                yield (
                    f"simulation {k:04d}: its forces in step {step + 1} are not what config.toml "
                    "draws"
                )
        single = {n for n, run in simulation.runs.items() if run.predictions is not None}
        for what in lacking(config, plan, k, simulation.runs, single)[:1]:
            yield f"simulation {k:04d} has no {what}"
        reference = simulation.runs.get(REFERENCE)
        if config.setting == "converged" and reference and reference.velocities is None:
            yield f"simulation {k:04d} has no velocities of run {REFERENCE!r}"
    yield from model_faults(config, plan, shard)


def same_scene(found: str, wanted: Scene) -> bool:
    """Whether a scene in TOML is another one but for the last digits of its numbers.

    Keys that it lacks, as those of earlier versions may, have their defaults.
    """
    try:
        return _same(Scene.from_toml(found).model_dump(), wanted.model_dump())
    except SceneError:
        return False


def _same(found: Any, wanted: Any) -> bool:
    if type(found) is not type(wanted):
        return False
    if isinstance(wanted, dict):
        return found.keys() == wanted.keys() and all(_same(found[k], wanted[k]) for k in wanted)
    if isinstance(wanted, (list, tuple)):
        return len(found) == len(wanted) and all(map(_same, found, wanted))
    if isinstance(wanted, float):
        return math.isclose(found, wanted, rel_tol=_LAST_DIGITS)
    return bool(found == wanted)
