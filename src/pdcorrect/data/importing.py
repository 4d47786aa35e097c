"""Trajectories of any solver as arrays, made a file of a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from pdcorrect.data.schema import BEST, PLAIN, REFERENCE, Array, Run, Shard, Simulation
from pdcorrect.errors import InputError
from pdcorrect.fem.graph import velocities
from pdcorrect.fem.hexahedron import gauss_points, jacobians, shortest_edges
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.operators import Space, lumped
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import MeshFile, Scene, check_scene, trained_coarse
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import rollout
from pdcorrect.state import State, Status


def portable(scene: Scene) -> Scene:
    """The scene as a data set holds it: of the path of a mesh file the name alone."""
    if not isinstance(scene.body, MeshFile):
        return scene
    return scene.with_changes(body={"path": scene.body.path.name})


def discretise_stored(scene: Scene, points: Array, cells: Array, refine: int = 1) -> Problem:
    """A stored scene's problem.

    Parameters
    ----------
    scene : Scene
    points : (N, 3)
        Of the file that holds the scene, m.
    cells : (C, 8)
        Of the same file, VTK order.
    refine : int

    Raises
    ------
    SceneError, MeshError
        As `discretise`.
    """
    if not isinstance(scene.body, MeshFile):
        return discretise(scene, refine)
    return discretise(scene, refine, mesh=HexMesh.create(points, cells.astype(np.int64)))


SETTING = "imported"
INTEGRATOR = "backward-euler"
"""The one that velocities and predictions of a data set suppose."""

_AT_REST = 1e-6
"""Of a cell's shortest edge: how far what rests may be from the rest shape."""
_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Of the largest coordinate: the same, of positions that were stored as float32."""
ELEMENTS = ("hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced")
"""Of coarse models: those whose nodes are the corners of the cells, as a data set's."""


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
        Of the coarse model, by backward Euler and with one of `ELEMENTS`, whose mesh, material
        and clamps must be these.
        With it, missing forces are its loads and missing predictions are computed with
        `ProjectiveDynamics`.  Its time step is replaced by this one.
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
        If an array has a wrong type or shape or is not finite, frame 0 or a held node has
        moved, a cell of the reference is inverted, the scene is another, or ``best`` is wanted
        without a scene or of one that is its own best coarse model; names simulation, frame and
        cell or node.
    """
    motions = [motions] if isinstance(motions, ImportedMotion) else list(motions)
    if not motions:
        raise InputError("no simulations: expected at least one.")
    mesh = HexMesh.create(
        _array("points", points, (None, 3)), _array("cells", cells, (None, 8), np.int64)
    )
    count, nodes = len(mesh.cells), len(mesh.positions)
    moduli = {
        name: _array(name, values if np.ndim(values) else np.full(count, values), (count,))
        for name, values in (("young", young), ("poisson", poisson), ("density", density))
    }
    time_step = float(_array("time_step", time_step, ()))
    if (moduli["poisson"] < 0).any() or (moduli["poisson"] >= 0.5).any():
        raise InputError("poisson: expected 0 or more and less than 0.5 in every cell.")
    movable = _array("free", free, (nodes, 3), np.bool_)
    model, better = None, None
    if scene is not None:
        scene, time_step = _in_step(scene, time_step)
        model = _stepper(scene, mesh, {"free": movable, **moduli})
    if best:
        better = _best_stepper(scene)
    if mass is not None:
        masses = _array("mass", mass, (nodes,))
    else:
        masses = (
            lumped(Space(mesh).mass(moduli["density"])) if model is None else model.problem.mass
        )
    for name, values in {**moduli, "mass": masses, "time_step": np.array(time_step)}.items():
        if name != "poisson" and (values <= 0).any():
            raise InputError(f"{name}: {values.min():g}: expected more than 0.")
    body = _Body(mesh, movable, model, better, time_step)
    simulations = tuple(
        _simulation(f"simulation {k}", motion, body) for k, motion in enumerate(motions)
    )
    if scene is not None:
        text = portable(scene).to_toml()
        simulations = tuple(replace(one, scene_toml=text) for one in simulations)
    return Shard(
        attributes={
            "dataset": dataset, "split": split, "number": number, "setting": SETTING,
            "config_hash": "", "time_step": time_step,
            "tolerance": 0.0 if scene is None else scene.solver.tolerance,
        },
        points=mesh.positions, cells=mesh.cells, free=movable, mass=masses,
        young=moduli["young"], poisson=moduli["poisson"], density=moduli["density"],
        simulations=simulations,
    )  # fmt: skip


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


@dataclass(frozen=True, eq=False)
class _Body:
    """What the simulations of a file share; the steppers are of coarse models, if any."""

    mesh: HexMesh
    free: Array
    plain: ProjectiveDynamics | None
    best: ProjectiveDynamics | None
    time_step: float

    @property
    def tolerance(self) -> float:
        """How far from the rest shape what rests may be, m."""
        shortest = shortest_edges(self.mesh.positions, self.mesh.cells).min()
        return float(_AT_REST * shortest + _ROUNDING * np.abs(self.mesh.positions).max())

    def from_rest(self, where: str, positions: Array) -> Array:
        """Positions (T+1, N, 3) with exactly the rest shape in frame 0; refuse another there."""
        away = np.linalg.norm(positions[0] - self.mesh.positions, axis=1)
        node = int(np.argmax(away))
        if away[node] > self.tolerance:
            raise InputError(
                f"{where}: in frame 0 node {node} is {away[node]:.3g} m away from its rest "
                "position: expected the rest shape."
            )
        return np.concatenate([self.mesh.positions[None], positions[1:]])

    def held(self, where: str, positions: Array) -> Array:
        """Positions (T, N, 3) with held components exactly at rest; refuse those that move."""
        away = np.where(self.free, 0.0, np.abs(positions - self.mesh.positions))
        frame, node, axis = (int(i) for i in np.unravel_index(np.argmax(away), away.shape))
        if away[frame, node, axis] > self.tolerance:
            raise InputError(
                f"{where}[{frame}]: node {node} is held in {'xyz'[axis]} and "
                f"{away[frame, node, axis]:.3g} m away from its rest position: expected held "
                "components to stay there; clamps that move are not supported."
            )
        return np.where(self.free, positions, self.mesh.positions)

    def check_volumes(self, where: str, positions: Array) -> None:
        """Refuse cells with det F <= 0 at a point of the 2 x 2 x 2 Gauss rule."""
        points = gauss_points(2)
        rest = jacobians(self.mesh.positions, self.mesh.cells, points)
        for frame, now in enumerate(positions):
            ratios = jacobians(now, self.mesh.cells, points) / rest
            if ratios.min() <= 0:
                cell = int(np.argmin(ratios.min(axis=1)))
                raise InputError(
                    f"{where}: in frame {frame} cell {cell} is inverted (det F = "
                    f"{ratios[cell].min():.3g}): expected det F > 0."
                )


def _simulation(where: str, motion: ImportedMotion, body: _Body) -> Simulation:
    nodes, step = len(body.mesh.positions), {"time_step": body.time_step}
    reference = _array(f"{where}, reference", motion.reference, (None, nodes, 3))
    frames = len(reference)
    if frames < 2:
        raise InputError(f"{where}, reference: {frames} frames: expected 2 or more.")
    reference = body.from_rest(f"{where}, reference", reference)
    body.check_volumes(f"{where}, reference", reference)
    reference = body.held(f"{where}, reference", reference)
    coarse, predictions = None, None
    if motion.coarse is not None:
        coarse = _array(f"{where}, coarse", motion.coarse, (frames, nodes, 3))
        coarse = body.held(f"{where}, coarse", body.from_rest(f"{where}, coarse", coarse))
    if motion.predictions is not None:
        shape = (frames - 1, nodes, 3)
        predictions = _array(f"{where}, predictions", motion.predictions, shape)
    elif body.plain is not None:
        predictions = _predict(body.plain, reference, body.time_step)
    if predictions is not None:
        predictions = body.held(f"{where}, predictions", predictions)
    if motion.forces is not None:
        forces = _array(f"{where}, forces", motion.forces, (frames - 1, nodes, 3))
    elif body.plain is not None:
        forces = _loads(body.plain.problem, reference, body.time_step)
    else:
        forces = np.zeros((frames - 1, nodes, 3))
    runs = {REFERENCE: Run(reference, attributes={"solver": "imported", **step})}
    if coarse is not None or predictions is not None:
        runs[PLAIN] = Run(coarse, predictions, attributes=step)
    if body.best is not None:
        single = body.held(f"{where}, best", _predict(body.best, reference, body.time_step))
        runs[BEST] = Run(_roll_out(body.best, where, frames - 1), single, attributes=step)
    return Simulation(forces, runs)


def _in_step(scene: Scene, time_step: float) -> tuple[Scene, float]:
    """A scene and a time step (s) that agree: where they nearly do, by the scene's."""
    check_scene(scene)
    if math.isclose(time_step, scene.time.step, rel_tol=1e-6):
        time_step = scene.time.step
    return scene.with_changes(time={"step": time_step, "substeps": 1}), time_step


def _stepper(scene: Scene, mesh: HexMesh, body: dict[str, Array]) -> ProjectiveDynamics:
    """The scene's coarse model, if it is of this mesh, material and clamps."""
    if scene.time.integrator != INTEGRATOR:
        raise InputError(
            f"scene: its time.integrator is {scene.time.integrator!r}: expected {INTEGRATOR!r}, "
            "for predictions start from backward differences of the positions."
        )
    check_element("scene", scene)
    problem = discretise(scene)
    if not np.array_equal(problem.mesh.cells, mesh.cells) or not np.allclose(
        problem.mesh.positions, mesh.positions, rtol=0, atol=1e-9
    ):
        raise InputError("scene: its coarse mesh is not the one given: expected equal nodes.")
    materials = problem.materials
    found = {
        "free": problem.free[: len(mesh.positions)], "young": materials.young,
        "poisson": materials.poisson, "density": materials.density,
    }  # fmt: skip
    for name, values in found.items():
        if not np.allclose(values, body[name], rtol=1e-9, atol=0):
            raise InputError(f"scene: its {name} is not the one given: expected equal values.")
    return ProjectiveDynamics(problem)


def check_element(name: str, scene: Scene) -> None:
    """Refuse a coarse model with nodes besides the corners of the cells, as "hex27".

    Raises
    ------
    InputError
        If its element is none of `ELEMENTS`.
    """
    if scene.solver.element not in ELEMENTS:
        raise InputError(
            f"{name}: its solver.element is {scene.solver.element!r}, whose nodes are not only the "
            f"corners of the cells: expected a coarse model with one of {', '.join(ELEMENTS)}."
        )


def _best_stepper(scene: Scene | None) -> ProjectiveDynamics:
    """Of the best coarse model of a scene."""
    if scene is None:
        raise InputError('the run "best" without a scene: expected the scene of the coarse model.')
    better = trained_coarse(scene)
    if better.solver == scene.solver:
        raise InputError(
            f"the scene has the best coarse model's element {scene.solver.element!r} already: "
            "expected the plain coarse model's, which Omega is against."
        )
    return ProjectiveDynamics(discretise(better))


def _roll_out(stepper: ProjectiveDynamics, where: str, steps: int) -> Array:
    """Positions from rest, (T+1, N, 3), m."""
    run = rollout(stepper, steps)
    for step, name in enumerate(run.stats["status"], start=1):
        if not Status[name].ok:
            raise InputError(f"{where}: step {step} of the best coarse model {Status[name].value}.")
    return run.positions


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
