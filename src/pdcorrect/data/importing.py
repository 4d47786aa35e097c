"""Trajectories of any solver, as arrays or in files, made files of a data set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from pdcorrect.data.check_file import file_faults
from pdcorrect.data.schema import BEST, INTEGRATOR, PLAIN, REFERENCE, Array, Run, Shard, Simulation
from pdcorrect.data.simulate import unlike_arrays
from pdcorrect.errors import InputError
from pdcorrect.fem.graph import velocities
from pdcorrect.fem.hexahedron import gauss_points, jacobians, shortest_edges
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.operators import Space, lumped
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import MeshFile, Scene, check_scene, trained_coarse
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import rollout
from pdcorrect.state import State

SETTING = "imported"
_AT_REST = 1e-6  # of a cell's shortest edge: how far what rests may be from the rest shape
_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Of the largest coordinate: the same, of positions that were stored as float32."""


@dataclass(frozen=True, eq=False)
class ImportedMotion:
    """One simulation of another solver, on the nodes of the coarse mesh."""

    reference: ArrayLike  # (T+1, N, 3): what the network is to reach, m; frame 0 is the rest shape
    forces: ArrayLike | None = None  # (T, N, 3): nodal forces of each step, N; zero by default
    coarse: ArrayLike | None = None  # (T+1, N, 3): rollout of the coarse model, m
    # (T, N, 3): one step of the coarse model from each frame of the reference but the last, m
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
    """A file of a data set from the arrays of any solver, checked, for `write_shard`.

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
        and missing predictions are computed with `ProjectiveDynamics`, at this time step.
    best : bool
        Also compute the run "best": rollout and predictions of `pdcorrect.scene.trained_coarse` of
        the scene, so that models which correct it can be trained and evaluated on this file.

    Raises
    ------
    MeshError
        If the mesh has a cell that is inverted, collapsed or not connected.
    InputError
        If an array has a wrong type or shape or is not finite, a cell of the reference is
        inverted, `file_faults` finds what the check of a data set would find, the scene is
        another, or ``best`` is wanted without a scene or of one that is its own best coarse
        model.
    ConvergenceError
        If a rollout of the best coarse model fails.
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
    about = {"dataset": dataset, "split": split, "number": number}
    return shard_of(arrays, every, problems, step, about, best)


def check_integrator(name: str, found: str) -> None:
    if found != INTEGRATOR:
        raise InputError(
            f"{name} has the integrator {found!r}: expected {INTEGRATOR!r}, for the velocities "
            "of a data set are backward differences of its positions."
        )


def coarse_problem(name: str, scene: Scene, step: float) -> Problem:
    """A scene's coarse model with one step of this length (s) in a frame."""
    step = scene.time.step if math.isclose(step, scene.time.step, rel_tol=1e-6) else step
    problem = discretise(scene.with_changes(time={"step": step, "substeps": 1}))
    if len(problem.positions) > len(problem.mesh.positions):
        raise InputError(
            f"{name}: its solver.element is {scene.solver.element!r}: expected a coarse model "
            "without nodes besides the corners of the cells."
        )
    return problem


def shard_of(
    arrays: Mapping[str, Any],
    motions: Sequence[ImportedMotion],
    problems: Sequence[Problem],
    time_step: float,
    about: Mapping[str, Any],
    best: bool,
) -> Shard:
    """A checked file from arrays of mesh and material, by their names in a `Shard`.

    ``problems`` are the coarse model under each simulation's loads; none without a scene.
    """
    if not motions:
        raise InputError("no simulations: expected at least one.")
    shard = Shard(
        attributes={
            **about, "setting": SETTING, "config_hash": "", "time_step": time_step,
            "tolerance": problems[0].scene.solver.tolerance if problems else 0.0,
        },
        **arrays,
        simulations=(),
    )  # fmt: skip
    for name in unlike_arrays(problems[0], shard) if problems else ():
        if name != "mass":  # which may be another
            raise InputError(f"the scene: its {name} is not the one given: expected equal values.")
    better = _best_problem(problems) if best else None
    given = [_given(f"simulation {k}", motion, shard) for k, motion in enumerate(motions)]
    _with_simulations(shard, given)  # before steps are taken from them
    for k, problem in enumerate(problems):
        _add_coarse_runs(f"simulation {k}", given[k], problem, better)
    texts = [portable(problem.scene).to_toml() for problem in problems]
    return _with_simulations(shard, given, texts)


def _best_problem(problems: Sequence[Problem]) -> Problem:
    """The best coarse model, whose loads are the first simulation's."""
    if not problems:
        raise InputError('the run "best" without a scene: expected the scene of the coarse model.')
    scene = problems[0].scene
    better = trained_coarse(scene)
    if better.solver == scene.solver:
        raise InputError(
            f"the scene has the best coarse model's element {scene.solver.element!r} already: "
            "expected the plain coarse model's, which Omega is against."
        )
    return discretise(better)


def portable(scene: Scene) -> Scene:
    """The scene as a data set holds it: of the path of a mesh file the name alone.

    Raises
    ------
    InputError
        If it has several bodies, or a region is a group, which a data set's mesh does not have.
    """
    if scene.bodies:
        raise InputError(f"bodies: {len(scene.bodies)} of them: a data set keeps [body] alone.")
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


def _add_coarse_runs(
    where: str, given: dict[str, Array], problem: Problem, best: Problem | None
) -> None:
    """Loads and single steps of the coarse model where there are none, and the best one's run."""
    reference, h = given["reference"], problem.time_step
    if "predictions" not in given:
        given["predictions"] = _single_steps(where, reference, problem)
    if "forces" not in given:
        spans = ((t * h, (t + 1) * h, x) for t, x in enumerate(reference[:-1]))
        given["forces"] = np.stack([problem.external_forces(*span) for span in spans])
    if best is not None:
        loaded = best.with_loads(problem.scene.loads)
        given["best"] = rollout(ProjectiveDynamics(loaded), len(reference) - 1).positions
        given["best steps"] = _single_steps(where, reference, loaded)


def _single_steps(where: str, reference: Array, problem: Problem) -> Array:
    """One step from each frame of the reference but the last, (T, N, 3), m."""
    stepper, h = ProjectiveDynamics(problem), problem.time_step
    found = []
    for t, (x, v) in enumerate(zip(reference[:-1], velocities(reference, h), strict=False)):
        result = stepper(State(x, v, t * h))
        if not result.status.ok:
            raise InputError(
                f"{where}: step {t + 1}: {result.status.value} of the coarse model: expected a "
                "reference from which it can step."
            )
        found.append(result.state.positions)
    return np.stack(found)


def _with_simulations(
    shard: Shard, given: Sequence[Mapping[str, Array]], scenes: Sequence[str] = ()
) -> Shard:
    """The shard with its simulations; the check would find nothing but inverted cells in it."""
    told = {"time_step": shard.attributes["time_step"]}
    simulations = []
    for each, scene in zip(given, scenes or [""] * len(given), strict=True):
        reference = each["reference"]
        runs = {REFERENCE: Run(reference, attributes={"solver": "imported", **told})}
        if "coarse" in each or "predictions" in each:
            runs[PLAIN] = Run(each.get("coarse"), each.get("predictions"), attributes=told)
        if "best" in each:
            runs[BEST] = Run(each["best"], each["best steps"], attributes=told)
        forces = each.get("forces", np.zeros_like(reference[1:]))
        simulations.append(Simulation(forces, runs, scene))
    shard = replace(shard, simulations=tuple(simulations))
    for message in file_faults(shard, inverted=True):
        raise InputError(f"{message}.")
    return shard


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
