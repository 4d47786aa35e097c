"""Trajectories of other solvers, and of ``pdcorrect simulate``, as files of a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdcorrect.data.graph import velocities
from pdcorrect.data.schema import PLAIN, REFERENCE, SUFFIX, Run, Shard, Simulation, write_shard
from pdcorrect.errors import FileFormatError, InputError
from pdcorrect.fem.hexahedron import (
    VTK_CORNERS,
    gauss_points,
    jacobians,
    shortest_edges,
)
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.io.trajectory import load_trajectory
from pdcorrect.scene import Scene
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import restrict
from pdcorrect.state import State, Trajectory

Array = NDArray[Any]

SETTING = "imported"
_AT_REST = 1e-6
"""Of a cell's shortest edge: how far frame 0 may be from the rest shape."""


@dataclass(frozen=True, eq=False)
class Motion:
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
    motions: Sequence[Motion],
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
    starts_at_rest: bool = True,
) -> Shard:
    """A file of a data set from the arrays of any solver, checked.

    Parameters
    ----------
    points : (N, 3)
        Rest positions of the coarse mesh, m.
    cells : (C, 8)
        Node numbers, VTK order.
    motions : sequence of Motion
        At least one.
    free : (N, 3) bool
        Components that may move.
    young, poisson, density : float or (C,)
        Pa, dimensionless, kg/m3.
    time_step : float
        Between frames, s.
    dataset, split, number
        Name of the data set, split, number of the mesh in it.
    mass : (N,), optional
        kg; by default the scene's, or the density integrated with the shape functions.
    scene : Scene, optional
        Of the coarse model, whose mesh must be this one.  With it, missing forces are its
        loads and missing predictions are computed with `ProjectiveDynamics`.
    starts_at_rest : bool
        Whether frame 0 of each motion must be the rest shape.

    Returns
    -------
    Shard
        For `write_shard`.

    Raises
    ------
    MeshError
        If the mesh has a cell that is inverted, collapsed or not connected.
    InputError
        If an array has a wrong shape or is not finite, frame 0 has moved, or a cell of the
        reference is inverted; names simulation, frame and cell or node.
    """
    mesh = HexMesh.create(np.asarray(points), np.asarray(cells))
    count, nodes = len(mesh.cells), len(mesh.positions)
    moduli = {
        name: _per_cell(name, values, count)
        for name, values in (("young", young), ("poisson", poisson), ("density", density))
    }
    _check_moduli(moduli, time_step)
    if not motions:
        raise InputError("no simulations: expected at least one.")
    fixed = np.asarray(free)
    if fixed.dtype != np.bool_ or fixed.shape != (nodes, 3):
        raise InputError(
            f"free: {fixed.dtype} of shape {fixed.shape}: expected bool of shape ({nodes}, 3)."
        )
    stepper = _stepper(scene, mesh, time_step) if scene is not None else None
    if mass is not None:
        masses = _array("mass", mass, (nodes,))
    else:
        masses = _lumped(mesh, moduli["density"]) if stepper is None else stepper.problem.mass
    if (masses <= 0).any():
        raise InputError("mass: expected more than 0 kg at every node.")
    simulations = tuple(
        _simulation(f"simulation {k}", motion, mesh, stepper, time_step, starts_at_rest)
        for k, motion in enumerate(motions)
    )
    if scene is not None:
        simulations = tuple(replace(one, scene_toml=scene.to_toml()) for one in simulations)
    return Shard(
        attributes={
            "dataset": dataset, "split": split, "number": number, "setting": SETTING,
            "config_hash": "", "time_step": float(time_step), "tolerance": _tolerance(scene),
        },
        points=mesh.positions, cells=mesh.cells, free=fixed, mass=masses,
        young=moduli["young"], poisson=moduli["poisson"], density=moduli["density"],
        simulations=simulations,
    )  # fmt: skip


def shard_from_trajectories(
    reference: Trajectory | Sequence[Trajectory],
    coarse: Trajectory | Sequence[Trajectory] | None = None,
    *,
    dataset: str = "imported",
    split: str = "training",
    number: int = 0,
) -> Shard:
    """A file of a data set from runs of ``pdcorrect simulate`` on one mesh, checked.

    The scenes in the runs give mesh, material, clamps and loads.  References are restricted
    to the coarse nodes; predictions are computed with `ProjectiveDynamics` on the coarse mesh.

    Parameters
    ----------
    reference : Trajectory or sequence of Trajectory
        Of refined meshes, with their scenes.
    coarse : Trajectory or sequence of Trajectory, optional
        Rollouts of the coarse model, as many.
    dataset, split, number
        See `shard_from_arrays`.

    Raises
    ------
    InputError
        If a run has no scene, the scenes differ in mesh, material, clamps or time step, or
        a check of `shard_from_arrays` fails.
    """
    references = [reference] if isinstance(reference, Trajectory) else list(reference)
    rollouts = [coarse] if isinstance(coarse, Trajectory) else list(coarse or ())
    if not references:
        raise InputError("no simulations: expected at least one reference.")
    if rollouts and len(rollouts) != len(references):
        raise InputError(
            f"{len(references)} references and {len(rollouts)} coarse runs: expected as many."
        )
    shards = [
        _shard_of_run(run, rollouts[k] if rollouts else None, dataset, split, number)
        for k, run in enumerate(references)
    ]
    for k, shard in enumerate(shards[1:], start=1):
        _check_same_body(k, shard, shards[0])
    return replace(shards[0], simulations=tuple(s for one in shards for s in one.simulations))


def import_trajectories(
    sources: Sequence[str | Path],
    folder: str | Path,
    *,
    coarse: Sequence[str | Path] = (),
    dataset: str | None = None,
    split: str = "training",
    number: int = 0,
    starts_at_rest: bool = True,
) -> Path:
    """Write a file of a data set from trajectory files or from an ``.npz`` file.

    Parameters
    ----------
    sources : sequence of path
        Trajectories (HDF5) of `shard_from_trajectories`, or one ``.npz`` file with the arrays
        of `shard_from_arrays` by their names and one simulation ``reference``, or several as
        ``reference_0``, ``reference_1``, …; likewise ``forces``, ``coarse``, ``predictions``.
    folder : path
        Of the data set; created if missing.
    coarse : sequence of path
        Trajectories of the coarse model, as many as sources.
    dataset : str, optional
        Its name; the folder's by default.
    split, number, starts_at_rest
        See `shard_from_arrays`.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    FileFormatError, InputError, OutputError
        If a file cannot be read, fails a check, or the file exists already or cannot be written.
    """
    path = Path(folder) / split / f"mesh-{number:04d}{SUFFIX}"
    if path.exists():
        raise InputError(f"{path} exists already: choose another number, or delete it first.")
    name = dataset or Path(folder).resolve().name
    files = [Path(source) for source in sources]
    if any(file.suffix == ".npz" for file in files):
        if len(files) != 1 or coarse:
            raise InputError(
                f"{len(files)} sources and {len(coarse)} coarse runs: expected one .npz alone."
            )
        shard = _shard_of_npz(files[0], name, split, number, starts_at_rest)
    else:
        runs, others = ([load_trajectory(f) for f in each] for each in (files, coarse))
        shard = shard_from_trajectories(runs, others, dataset=name, split=split, number=number)
    write_shard(path, replace(shard, provenance={"sources": ", ".join(map(str, files))}))
    return path


_SCALARS = ("young", "poisson", "density")
_MOTION = ("reference", "forces", "coarse", "predictions")


def _shard_of_npz(path: Path, dataset: str, split: str, number: int, starts_at_rest: bool) -> Shard:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, EOFError) as error:
        raise FileFormatError(f"{path}: cannot be read as .npz ({error}).") from None
    needed = ("points", "cells", "free", *_SCALARS, "time_step")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise InputError(f"{path}: no array {missing[0]!r}: expected {', '.join(needed)}.")
    try:
        return shard_from_arrays(
            arrays["points"], arrays["cells"], _motions(path, arrays), free=arrays["free"],
            **{name: arrays[name] for name in _SCALARS},
            time_step=float(_array("time_step", arrays["time_step"], ())),
            mass=arrays.get("mass"), dataset=dataset, split=split, number=number,
            starts_at_rest=starts_at_rest,
        )  # fmt: skip
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def _motions(path: Path, arrays: dict[str, Array]) -> list[Motion]:
    if "reference" in arrays:
        return [Motion(**{name: arrays[name] for name in _MOTION if name in arrays})]
    motions: list[Motion] = []
    while f"reference_{len(motions)}" in arrays:
        names = {name: f"{name}_{len(motions)}" for name in _MOTION}
        motions.append(Motion(**{k: arrays[name] for k, name in names.items() if name in arrays}))
    if not motions:
        raise InputError(f"{path}: no array 'reference' or 'reference_0'.")
    return motions


def _shard_of_run(
    run: Trajectory, coarse: Trajectory | None, dataset: str, split: str, number: int
) -> Shard:
    if not run.scene_toml:
        raise InputError(
            "the reference has no scene: expected a run of pdcorrect simulate; for others use "
            "shard_from_arrays."
        )
    scene = Scene.from_toml(run.scene_toml)
    problem = discretise(scene)
    step = _uniform_step(run)
    rollout = None if coarse is None else restrict(coarse, problem).positions
    motion = Motion(restrict(run, problem).positions, coarse=rollout)
    materials = problem.materials
    return shard_from_arrays(
        problem.mesh.positions, problem.mesh.cells, [motion],
        free=problem.free[: len(problem.mesh.positions)], young=materials.young,
        poisson=materials.poisson, density=materials.density, time_step=step,
        dataset=dataset, split=split, number=number, scene=scene,
    )  # fmt: skip


def _uniform_step(run: Trajectory) -> float:
    if len(run) < 1:
        raise InputError("the reference has no steps: expected at least one.")
    steps = np.diff(run.times)
    if not np.allclose(steps, steps[0], rtol=1e-6, atol=0):
        raise InputError("the reference's frames are not equally far apart in time.")
    return float((run.times[-1] - run.times[0]) / len(run))


def _check_same_body(k: int, shard: Shard, first: Shard) -> None:
    for name in ("points", "cells", "free", "young", "poisson", "density"):
        if not np.array_equal(getattr(shard, name), getattr(first, name)):
            raise InputError(
                f"simulations 0 and {k} differ in {name}: expected one mesh, material and clamps "
                "in a file."
            )
    steps = [float(each.attributes["time_step"]) for each in (first, shard)]
    if not math.isclose(*steps, rel_tol=1e-6):
        raise InputError(
            f"simulations 0 and {k} have steps of {steps[0]:g} and {steps[1]:g} s: expected equal "
            "ones in a file."
        )


def _simulation(
    where: str,
    motion: Motion,
    mesh: HexMesh,
    stepper: ProjectiveDynamics | None,
    time_step: float,
    starts_at_rest: bool,
) -> Simulation:
    frames, nodes = len(np.asarray(motion.reference)), len(mesh.positions)
    if frames < 2:
        raise InputError(f"{where}, reference: {frames} frames: expected 2 or more.")
    every, steps = (frames, nodes, 3), (frames - 1, nodes, 3)
    reference = _array(f"{where}, reference", motion.reference, every)
    coarse = _optional(f"{where}, coarse", motion.coarse, every)
    for name, positions in (("reference", reference), ("coarse", coarse)):
        if starts_at_rest and positions is not None:
            _check_rest(f"{where}, {name}", positions[0], mesh)
    _check_volumes(f"{where}, reference", reference, mesh)
    forces = _optional(f"{where}, forces", motion.forces, steps)
    predictions = _optional(f"{where}, predictions", motion.predictions, steps)
    if stepper is not None:
        if predictions is None:
            predictions = _predict(stepper, reference, time_step)
        if forces is None:
            forces = _loads(stepper.problem, reference, time_step)
    runs = {REFERENCE: Run(reference, attributes={"solver": "imported", "time_step": time_step})}
    if coarse is not None or predictions is not None:
        runs[PLAIN] = Run(coarse, predictions, attributes={"time_step": time_step})
    return Simulation(np.zeros(steps) if forces is None else forces, runs)


def _stepper(scene: Scene, mesh: HexMesh, time_step: float) -> ProjectiveDynamics:
    problem = discretise(scene)
    if not np.array_equal(problem.mesh.cells, mesh.cells) or not np.allclose(
        problem.mesh.positions, mesh.positions, rtol=0, atol=1e-9
    ):
        raise InputError("scene: its coarse mesh is not the one given: expected equal nodes.")
    return ProjectiveDynamics(problem, time_step=time_step)


def _predict(stepper: ProjectiveDynamics, reference: Array, time_step: float) -> Array:
    """One step from each frame but the last, (T, N, 3)."""
    moving = velocities(reference, time_step)
    found = []
    for t in range(len(reference) - 1):
        result = stepper(State(reference[t], moving[t], t * time_step))
        if not result.status.ok:
            raise InputError(f"the coarse model's step from frame {t} {result.status.value}.")
        found.append(result.state.positions)
    return np.stack(found)


def _loads(problem: Problem, reference: Array, time_step: float) -> Array:
    """Nodal forces of the scene's loads, (T, N, 3), N."""
    return np.stack([
        problem.external_forces(t * time_step, (t + 1) * time_step, reference[t])
        for t in range(len(reference) - 1)
    ])  # fmt: skip


def _tolerance(scene: Scene | None) -> float:
    """Of the coarse model's steps, of the cell size; 0 where it is not known."""
    return 0.0 if scene is None else float(scene.solver.tolerance)


def _array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Values of a shape, finite."""
    try:
        array = np.ascontiguousarray(values, dtype=np.float64).reshape(np.shape(values))
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected numbers of shape {shape}.") from None
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}: expected {shape}.")
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InputError(f"{name}: not finite at {place}: expected finite numbers.")
    return array


def _optional(
    name: str, values: ArrayLike | None, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    return None if values is None else _array(name, values, shape)


def _per_cell(name: str, values: ArrayLike, count: int) -> NDArray[np.float64]:
    if np.ndim(values) == 0:
        return np.full(count, _array(name, values, ()))
    return _array(name, values, (count,))


def _check_moduli(moduli: dict[str, Array], time_step: float) -> None:
    for name in ("young", "density"):
        if (moduli[name] <= 0).any():
            raise InputError(f"{name}: {moduli[name].min():g}: expected more than 0 in every cell.")
    ratio = moduli["poisson"]
    if (ratio < 0).any() or (ratio >= 0.5).any():
        raise InputError("poisson: expected 0 or more and less than 0.5 in every cell.")
    if not (np.isfinite(time_step) and time_step > 0):
        raise InputError(f"time_step = {time_step}: expected more than 0 s.")


def _check_rest(where: str, positions: Array, mesh: HexMesh) -> None:
    away = np.linalg.norm(positions - mesh.positions, axis=1)
    node = int(np.argmax(away))
    if away[node] > _AT_REST * shortest_edges(mesh.positions, mesh.cells).min():
        raise InputError(
            f"{where}: in frame 0 node {node} is {away[node]:.3g} m away from its rest position: "
            "expected the rest shape (starts_at_rest=False allows another)."
        )


def _check_volumes(where: str, positions: Array, mesh: HexMesh) -> None:
    """Refuse cells with det F <= 0 at a point of the 2 x 2 x 2 Gauss rule."""
    points = gauss_points(2)
    rest = jacobians(mesh.positions, mesh.cells, points)
    for frame, now in enumerate(positions):
        ratios = jacobians(now, mesh.cells, points) / rest
        if ratios.min() <= 0:
            cell = int(np.argmin(ratios.min(axis=1)))
            raise InputError(
                f"{where}: in frame {frame} cell {cell} is inverted (det F = "
                f"{ratios[cell].min():.3g}): expected det F > 0."
            )


def _lumped(mesh: HexMesh, density: Array) -> NDArray[np.float64]:
    """Density times the integral of each node's shape functions, (N,), kg."""
    points = gauss_points(2)
    factors = np.where(VTK_CORNERS == 1, points[:, None], 1 - points[:, None])
    shapes = factors.prod(axis=-1)  # (8 points, 8 corners)
    volumes = jacobians(mesh.positions, mesh.cells, points) / len(points)
    shares = density[:, None] * (volumes @ shapes)
    masses = np.bincount(mesh.cells.ravel(), shares.ravel(), minlength=len(mesh.positions))
    return np.asarray(masses, dtype=np.float64)
