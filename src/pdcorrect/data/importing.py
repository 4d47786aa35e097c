"""Trajectories of any solver as arrays, made a file of a data set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from pdcorrect.data.check_file import file_faults
from pdcorrect.data.engines import OneByOne, Steps
from pdcorrect.data.schema import BEST, INTEGRATOR, PLAIN, REFERENCE, Array, Run, Shard, Simulation
from pdcorrect.data.simulate import unlike_arrays
from pdcorrect.errors import InputError
from pdcorrect.fem.graph import velocities
from pdcorrect.fem.hexahedron import gauss_points, jacobians, shortest_edges
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.operators import Space, lumped
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import MeshFile, Scene, check_scene, trained_coarse
from pdcorrect.state import State

SETTING = "imported"
_AT_REST = 1e-6
"""Of a cell's shortest edge: how far what rests may be from the rest shape."""
_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Of the largest coordinate: the same, of positions that were stored as float32."""


@dataclass(frozen=True, eq=False)
class ImportedMotion:
    """One simulation of another solver, on the nodes of the coarse mesh.

    Attributes
    ----------
    reference : (T+1, N, 3)
        What the network is to reach, m; frame 0 is the rest shape.
    forces : (T, N, 3), optional
        Nodal forces of each step, N; zero by default.
    coarse : (T+1, N, 3), optional
        Rollout of the coarse model, m.
    predictions : (T, N, 3), optional
        One step of the coarse model from each frame of the reference but the last, m.
    """

    reference: ArrayLike
    forces: ArrayLike | None = None
    coarse: ArrayLike | None = None
    predictions: ArrayLike | None = None


def shard_from_arrays(
    points: ArrayLike,
    cells: ArrayLike,
    motions: ImportedMotion | Sequence[ImportedMotion],
    *,
    free: ArrayLike,
    young: ArrayLike,
    poisson: ArrayLike,
    density: ArrayLike,
    time_step: float,
    dataset: str = "imported",
    split: str = "training",
    number: int = 0,
    mass: ArrayLike | None = None,
    scene: Scene | None = None,
    best: bool = False,
) -> Shard:
    """A file of a data set from the arrays of any solver, checked.

    Parameters
    ----------
    points : (N, 3)
        Rest positions of the coarse mesh, m.
    cells : (C, 8)
        Node numbers, VTK order.
    motions : ImportedMotion or sequence of ImportedMotion
        At least one.
    free : (N, 3) bool
        Components that may move, or 1 for them and 0 for the others, which stay at rest.
    young, poisson, density : float or (C,)
        Pa, dimensionless, kg/m3.
    time_step : float
        Between frames, s.
    dataset, split, number
        Name of the data set, split, number of the mesh in it.
    mass : (N,), optional
        kg; by default the scene's, or the density integrated with the shape functions.
    scene : Scene, optional
        Of the coarse model, by backward Euler and with nodes at the corners of cells only,
        whose mesh, material and clamps must be these.  With it, missing forces are its loads
        and missing predictions are computed with `ProjectiveDynamics`.  Its time step is
        replaced by this one.
    best : bool
        Also compute the run "best": rollout and predictions of `pdcorrect.scene.trained_coarse` of
        the scene, so that models which correct it can be trained and evaluated on this file.

    Returns
    -------
    Shard
        For `write_shard`.

    Raises
    ------
    MeshError
        If the mesh has a cell that is inverted, collapsed or not connected.
    InputError
        If an array has a wrong type or shape or is not finite, a cell of the reference is
        inverted, `file_faults` finds what the check of a data set would find, the scene is
        another, or ``best`` is wanted without a scene or of one that is its own best coarse
        model.
    """
    mesh = HexMesh.create(
        _array("points", points, (None, 3)), _array("cells", cells, (None, 8), np.int64)
    )
    count, nodes = len(mesh.cells), len(mesh.positions)
    moduli = {
        name: _array(name, values if np.ndim(values) else np.full(count, values), (count,))
        for name, values in (("young", young), ("poisson", poisson), ("density", density))
    }
    step = float(_array("time_step", time_step, ()))
    arrays = {
        "points": mesh.positions, "cells": mesh.cells,
        "free": _array("free", free, (nodes, 3), np.bool_), **moduli,
    }  # fmt: skip
    problem = None
    if scene is not None:
        check_scene(scene)
        check_integrator("the scene", scene.time.integrator)
        problem = coarse_problem("the scene", scene, step)
        step = problem.time_step
    if mass is not None:
        arrays["mass"] = _array("mass", mass, (nodes,))
    elif problem is not None:
        arrays["mass"] = problem.mass
    else:
        arrays["mass"] = lumped(Space(mesh).mass(moduli["density"]))
    every = [motions] if isinstance(motions, ImportedMotion) else list(motions)
    problems = [] if problem is None else [problem] * len(every)
    return shard_of(arrays, every, problems, step, dataset, split, number, best)


def check_integrator(name: str, found: str) -> None:
    """Refuse others than backward Euler."""
    if found != INTEGRATOR:
        raise InputError(
            f"{name} has the integrator {found!r}: expected {INTEGRATOR!r}, for the velocities "
            "of a data set are backward differences of its positions."
        )


def coarse_problem(name: str, scene: Scene, step: float) -> Problem:
    """A scene's coarse model with one step of this length (s) in a frame.

    Raises
    ------
    InputError
        If it has nodes besides the corners of the cells.
    """
    step = scene.time.step if math.isclose(step, scene.time.step, rel_tol=1e-6) else step
    problem = discretise(scene.with_changes(time={"step": step, "substeps": 1}))
    if len(problem.positions) > len(problem.mesh.positions):
        raise InputError(
            f"{name}: its solver.element is {scene.solver.element!r}: expected a coarse model "
            "without nodes besides the corners of the cells."
        )
    return problem


def portable(scene: Scene) -> Scene:
    """The scene as a data set holds it: of the path of a mesh file the name alone.

    Raises
    ------
    InputError
        If a region is a group, which a data set's mesh does not have.
    """
    if not isinstance(scene.body, MeshFile):
        return scene
    for name in ("clamps", "loads", "materials"):
        for number, part in enumerate(getattr(scene, name)):
            region = getattr(part, "region", None)
            if region is not None and region.group is not None:
                raise InputError(
                    f"{name}[{number}].region.group = {region.group!r}: a data set keeps no "
                    "groups of the mesh file: expected another region, such as nodes."
                )
    return scene.with_changes(body={"path": scene.body.path.name})


def shard_of(
    arrays: Mapping[str, Any],
    motions: Sequence[ImportedMotion],
    problems: Sequence[Problem],
    time_step: float,
    dataset: str,
    split: str,
    number: int,
    best: bool,
) -> Shard:
    """A checked file of simulations on one mesh, see `shard_from_arrays`.

    Parameters
    ----------
    arrays : mapping of str to array
        Of mesh and material, by their names in a `Shard`.
    motions : sequence of ImportedMotion
    problems : sequence of Problem
        The coarse model under each simulation's loads; none where there is no scene.
    """
    if not motions:
        raise InputError("no simulations: expected at least one.")
    shard = Shard(
        attributes={
            "dataset": dataset, "split": split, "number": number, "setting": SETTING,
            "config_hash": "", "time_step": time_step,
            "tolerance": problems[0].scene.solver.tolerance if problems else 0.0,
        },
        **arrays,
        simulations=(),
    )  # fmt: skip
    for name in unlike_arrays(problems[0], shard) if problems else ():
        if name != "mass":  # which may be another
            raise InputError(f"the scene: its {name} is not the one given: expected equal values.")
    given = [_given(f"simulation {k}", motion, shard) for k, motion in enumerate(motions)]
    _refuse_faults(shard, given)  # before steps are taken from them
    if problems:
        _add_steps_and_loads(given, problems)
    if best:
        _add_best(given, problems)
    shard = _refuse_faults(shard, given)
    texts = [portable(problem.scene).to_toml() for problem in problems] or [""] * len(given)
    told = zip(shard.simulations, texts, strict=True)
    return replace(shard, simulations=tuple(replace(s, scene_toml=text) for s, text in told))


def _refuse_faults(shard: Shard, given: Sequence[Mapping[str, Array]]) -> Shard:
    """The shard with its simulations, in which the check of a data set would find nothing.

    Besides inverted cells of coarse models.
    """
    step = float(shard.attributes["time_step"])
    shard = replace(shard, simulations=tuple(_simulation(each, step) for each in given))
    for message in file_faults(shard, inverted=True):
        raise InputError(f"{message}.")
    return shard


def _given(where: str, motion: ImportedMotion, shard: Shard) -> dict[str, Array]:
    """The arrays of a motion, with the rest shape where they are off it by rounding only."""
    nodes = len(shard.points)
    reference = _array(f"{where}, reference", motion.reference, (None, nodes, 3))
    steps = len(reference) - 1
    if steps < 1:
        raise InputError(f"{where}, reference: {steps + 1} frames: expected 2 or more.")
    found = {"reference": reference}
    for name, rows in (("coarse", steps + 1), ("predictions", steps), ("forces", steps)):
        values = getattr(motion, name)
        if values is not None:
            found[name] = _array(f"{where}, {name}", values, (rows, nodes, 3))
    for frame, x in enumerate(reference):
        volumes = jacobians(x, shard.cells, gauss_points(2)).min(axis=1)
        if volumes.min() <= 0:
            raise InputError(
                f"{where}, reference: cell {volumes.argmin()} is inverted in row {frame} of its "
                "positions: expected det F > 0."
            )
    shortest = shortest_edges(shard.points, shard.cells).min()
    near = _AT_REST * shortest + _ROUNDING * np.abs(shard.points).max()
    for name in found.keys() - {"forces"}:
        fixed = np.broadcast_to(~shard.free, found[name].shape).copy()
        fixed[0] |= name != "predictions"
        rounded = fixed & (np.abs(found[name] - shard.points) <= near)
        found[name] = np.where(rounded, shard.points, found[name])
    return found


def _add_steps_and_loads(given: Sequence[dict[str, Array]], problems: Sequence[Problem]) -> None:
    """Those of the coarse model where they are not given."""
    bare = [k for k, each in enumerate(given) if "predictions" not in each]
    for k, steps in zip(bare, _single_steps(given, problems, bare), strict=True):
        given[k]["predictions"] = steps
    for each, problem in zip(given, problems, strict=True):
        if "forces" not in each:
            h, frames = problem.time_step, enumerate(each["reference"][:-1])
            loads = [problem.external_forces(t * h, (t + 1) * h, x) for t, x in frames]
            each["forces"] = np.stack(loads)


def _add_best(given: Sequence[dict[str, Array]], problems: Sequence[Problem]) -> None:
    """Rollouts and single steps of the best coarse model."""
    if not problems:
        raise InputError('the run "best" without a scene: expected the scene of the coarse model.')
    scene = problems[0].scene
    better = trained_coarse(scene)
    if better.solver == scene.solver:
        raise InputError(
            f"the scene has the best coarse model's element {scene.solver.element!r} already: "
            "expected the plain coarse model's, which Omega is against."
        )
    problem = discretise(better)
    loaded = [problem.with_loads(p.scene.loads) for p in problems]
    numbers = range(len(given))
    for k, steps in zip(numbers, _single_steps(given, loaded, numbers), strict=True):
        run = _engine(problem).rollouts([loaded[k]], len(given[k]["reference"]) - 1)
        frames = [problem.positions[None], *_moved(run, [k])]
        given[k] |= {"best": np.concatenate(frames), "best steps": steps}


def _engine(problem: Problem) -> OneByOne:
    return OneByOne("pd", problem.scene.solver.tolerance, recover=True)


def _single_steps(
    given: Sequence[Mapping[str, Array]], problems: Sequence[Problem], numbers: Sequence[int]
) -> list[Array]:
    """Of chosen simulations one step from each frame of the reference but the last."""
    h, starts = problems[0].time_step, []
    for reference in (given[k]["reference"] for k in numbers):
        frames = enumerate(zip(reference, velocities(reference, h), strict=True))
        starts.append([State(x, v, t * h) for t, (x, v) in frames][:-1])
    found = _engine(problems[0]).predictions([problems[k] for k in numbers], starts)
    return _moved(found, numbers)


def _moved(found: Sequence[Steps], numbers: Sequence[int]) -> list[Array]:
    """The positions of steps that all succeeded."""
    for k, steps in zip(numbers, found, strict=True):
        if steps.failure:
            raise InputError(f"simulation {k}: {steps.failure} of the coarse model.")
    return [steps.positions for steps in found]


def _simulation(given: Mapping[str, Array], step: float) -> Simulation:
    reference, told = given["reference"], {"time_step": step}
    runs = {REFERENCE: Run(reference, attributes={"solver": "imported", **told})}
    if "coarse" in given or "predictions" in given:
        runs[PLAIN] = Run(given.get("coarse"), given.get("predictions"), attributes=told)
    if "best" in given:
        runs[BEST] = Run(given["best"], given["best steps"], attributes=told)
    return Simulation(given.get("forces", np.zeros_like(reference[1:])), runs)


def _array(
    name: str, values: ArrayLike, shape: tuple[int | None, ...], dtype: DTypeLike = np.float64
) -> Array:
    """Values as a finite array of a shape, in which None is any length, and of a type."""
    try:
        given = np.asarray(values)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an array of shape {shape}.") from None
    fits = given.ndim == len(shape) and all(
        n in (None, m) for n, m in zip(shape, given.shape, strict=True)
    )
    if given.dtype.kind not in "biuf" or not fits:
        raise InputError(
            f"{name}: {given.dtype} of shape {given.shape}: expected numbers of shape {shape}."
        )
    with np.errstate(invalid="ignore"):
        found = np.asarray(given, dtype=dtype, order="C")
    wrong = ~np.isfinite(given) | (found != given)
    if wrong.any():
        place = tuple(np.argwhere(wrong)[0].tolist())
        raise InputError(
            f"{name}: {given[place]} at {list(place)}: expected finite {np.dtype(dtype)}."
        )
    return found
