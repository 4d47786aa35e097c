"""What is wrong within one file of a data set: its numbers, its runs, and against its plan.

What a file says of its own steps is not proof of them.  Forces are computed again from the
scenes, and some steps of the coarse models are taken again from the stored states; the reference
is held against them, too, since predictions start from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.engines import OneByOne
from pdcorrect.data.plan import MeshPlan, draw_scene
from pdcorrect.data.schema import INTEGRATOR, REFERENCE, Array, Run, Shard
from pdcorrect.data.simulate import lacking, rebuilt_problems, unlike_arrays, unlike_loads
from pdcorrect.errors import InputError, SceneError
from pdcorrect.fem.hexahedron import gauss_points, jacobians, shape_derivatives
from pdcorrect.fem.problem import BASES, Problem, discretise
from pdcorrect.scene import Scene
from pdcorrect.state import State

_CENTRE = np.full((1, 3), 0.5)
_STEP_ERROR = 10.0
"""Largest distance from a step that is taken again, in tolerances of the data set."""
_ROUNDINGS = 16.0
"""The same for rounding, in spacings of the largest coordinate: a step starts from two frames."""
_SLACK = 1e-6  # relative, for tolerances of numbers that are stored as float32
_LOADS_COMPARED = 8  # steps of each simulation, the first and the last among them
_LAST_DIGITS = 1e-14
"""Relative: by so much exponentials differ between processors, and with them what is drawn."""


def file_faults(shard: Shard, inverted: bool = False) -> Iterator[str]:
    """What is wrong within one file whose mesh can be used.

    Cells that runs turn inside out are, unless they may be ``inverted``.
    """
    for name in ("young", "density", "mass"):
        if getattr(shard, name).min() <= 0:
            yield f"{name} is {getattr(shard, name).min():g} somewhere: expected more than 0"
    low, high = shard.poisson.min(), shard.poisson.max()
    if low < 0 or high >= 0.5:
        yield f"poisson is from {low:g} to {high:g}: expected 0 or more and less than 0.5"
    if float(shard.attributes["time_step"]) <= 0:
        yield f"time_step is {shard.attributes['time_step']}: expected more than 0"
    cell, cells = cell_size(shard), shard.cells.astype(np.int64)
    limit = float(shard.attributes["tolerance"]) * cell * (1 + _SLACK)
    for k, simulation in enumerate(shard.simulations):
        reference = simulation.runs.get(REFERENCE)
        if reference is None or reference.positions is None:
            yield f"simulation {k:04d}: there is no rollout {REFERENCE!r}"
        for name, run in simulation.runs.items():
            for message in (
                *_statistics_faults(run, limit),
                *_motion_faults(shard, run, cell),
                *(() if inverted else _volume_faults(run, cells)),
            ):
                yield f"simulation {k:04d}: {name}: {message}"


def cell_size(shard: Shard) -> float:
    """Cube root of the mean cell volume, m."""
    volumes = jacobians(shard.points, shard.cells.astype(np.int64), gauss_points(2)).mean(axis=1)
    return float(np.cbrt(volumes.mean()))


def _statistics_faults(run: Run, limit: float) -> Iterator[str]:
    """What a run says of itself: error estimates above the limit (m), inverted cells."""
    errors = run.statistics.get("error_estimates")
    if errors is not None and errors.max() > limit:
        yield (
            f"the solver's error estimate is {errors.max():.3g} m after step "
            f"{errors.argmax() + 1}: expected at most {limit:.3g} m"
        )
    ratios = run.statistics.get("smallest_volume_ratios")
    if ratios is not None and ratios.min() <= 0:
        yield f"det F is {ratios.min():.3g} after step {ratios.argmin() + 1}"


def _motion_faults(shard: Shard, run: Run, cell: float) -> Iterator[str]:
    """What does not start at rest, and held components that move."""
    if run.positions is not None:
        away = float(np.abs(run.positions[0] - shard.points).max())
        if away > _rounding(run.positions, shard.points, cell):
            yield f"frame 0 is {away:.3g} m off the rest shape"
    for name in ("positions", "predictions"):
        values = getattr(run, name)
        if values is None:
            continue
        moved = np.where(shard.free, 0.0, np.abs(values - shard.points))
        row, node, axis = np.unravel_index(moved.argmax(), moved.shape)
        if moved.max() > _rounding(values, shard.points, cell):
            yield (
                f"node {node} is held in {'xyz'[axis]} and {moved.max():.3g} m off its place in "
                f"row {row} of its {name}: expected clamps that do not move"
            )
    if run.velocities is not None:
        if run.velocities[0].any():
            yield f"its velocities are up to {np.abs(run.velocities[0]).max():.3g} m/s in frame 0"
        held = np.abs(run.velocities[:, ~shard.free])
        if held.any():
            yield f"held nodes have velocities of up to {held.max():.3g} m/s"


def _rounding(values: Array, points: Array, cell: float) -> float:
    """How far stored positions may be off for being rounded, m."""
    return float(4 * np.finfo(values.dtype).eps * np.abs(points).max() + 1e-9 * cell)


def _volume_faults(run: Run, cells: Array) -> Iterator[str]:
    """Cells whose centre a run turns inside out, on the coarse nodes of what is stored."""
    slopes = shape_derivatives(_CENTRE)[:, 0]  # (3, 8)
    for name in ("positions", "predictions"):
        for row, frame in enumerate(() if (x := getattr(run, name)) is None else x):
            a, b, c = np.matmul(slopes, frame[cells]).transpose(1, 0, 2)
            volumes = np.einsum("ni,ni->n", a, np.cross(b, c))
            if volumes.min() <= 0:
                yield f"cell {volumes.argmin()} is inside out in row {row} of its {name}"
                break


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


def same_scene(found: str, wanted: Scene) -> bool:
    """Whether a scene in TOML is another one but for the last digits of its numbers.

    Keys that it lacks have their defaults.
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


def step_faults(path: Path, shard: Shard, count: int, tolerance: float) -> Iterator[str]:
    """Steps of the coarse models that come out otherwise when they are taken again.

    ``count`` single steps and steps of rollouts of each simulation and model of a generated file;
    ``tolerance`` is the solver's, m.
    """
    for name in BASES:
        if all(name in simulation.runs for simulation in shard.simulations):
            try:
                problems = rebuilt_problems(shard, path, name)
            except InputError as error:
                yield reason(path, error)
                return
            for what in ("positions", "predictions"):
                yield from _repeated(shard, name, what, problems, count, tolerance)


def reason(path: Path, error: InputError) -> str:
    """What an error says of a file, without its name and the full stop."""
    return str(error).removeprefix(f"{path}: ").removesuffix(".")


def _repeated(
    shard: Shard, name: str, what: str, problems: list[Problem], count: int, tolerance: float
) -> Iterator[str]:
    """Steps of backward Euler from rows spread over each simulation; of others the first in a row.

    Those remember more than two frames tell, and their errors add up.
    """
    engine = OneByOne("pd", float(shard.attributes["tolerance"]))
    euler = problems[0].scene.time.integrator == INTEGRATOR
    for k, (simulation, problem) in enumerate(zip(shard.simulations, problems, strict=True)):
        run, reference = simulation.runs[name], simulation.runs[REFERENCE]
        starts = run.positions if what == "positions" else reference.positions
        ends = getattr(run, what)
        if starts is None or ends is None:
            continue
        after = ends[-(len(starts) - 1) :]  # of a rollout all frames but the first
        rows = list(range(min(count, len(after))))
        if euler:
            rows = [(31 * k + i * len(after) // count) % len(after) for i in rows]
            states = [_start(problem, starts, row) for row in rows]
            (found,) = engine.predictions([problem], [states])
        else:
            (found,) = engine.rollouts([problem], len(rows))
        spacing = np.finfo(starts.dtype).eps * np.abs(starts).max()
        limit = float(_STEP_ERROR * tolerance + _ROUNDINGS * spacing)
        for i, (row, positions) in enumerate(zip(rows, found.positions, strict=False)):
            away, most = np.abs(positions - after[row]).max(), limit * (1 if euler else i + 1)
            if not away <= most:
                yield (
                    f"simulation {k:04d}: {name}: step {row + 1} of its {what} is {away:.3g} m "
                    f"off when it is taken again: expected at most {most:.3g} m"
                )
                break


def _start(problem: Problem, frames: Array, row: int) -> State:
    """A frame with the velocities of backward Euler."""
    if row == 0:
        return problem.initial_state()
    h, rest = problem.time_step, problem.positions
    frame, before = (frames[k].astype(np.float64) for k in (row, row - 1))
    frame, before = (np.where(problem.free, x, rest) for x in (frame, before))
    return State(frame, (frame - before) / h, row * h)
