"""Trajectories of any solver as arrays, made a file of a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdcorrect.data.import_checks import (
    bool_array,
    check_moduli,
    check_volumes,
    finite_array,
    from_rest,
    integer_array,
    optional_array,
    per_cell,
    real_array,
    with_held_nodes,
)
from pdcorrect.data.schema import BEST, PLAIN, REFERENCE, Array, Run, Shard, Simulation
from pdcorrect.errors import InputError
from pdcorrect.fem.graph import velocities
from pdcorrect.fem.hexahedron import (
    VTK_CORNERS,
    gauss_points,
    jacobians,
)
from pdcorrect.fem.mesh import HexMesh
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
    mesh = HexMesh.create(real_array("points", points), integer_array("cells", cells))
    count, nodes = len(mesh.cells), len(mesh.positions)
    moduli = {
        name: per_cell(name, values, count)
        for name, values in (("young", young), ("poisson", poisson), ("density", density))
    }
    time_step = float(finite_array("time_step", time_step, ()))
    check_moduli(moduli, time_step)
    if not motions:
        raise InputError("no simulations: expected at least one.")
    movable = bool_array("free", free, (nodes, 3))
    stepper = None
    if scene is not None:
        scene, time_step = _in_step(scene, time_step)
        stepper = _stepper(scene, mesh, {"free": movable, **moduli})
    better = _best_stepper(scene) if best else None
    if mass is not None:
        masses = finite_array("mass", mass, (nodes,))
    else:
        masses = _lumped(mesh, moduli["density"]) if stepper is None else stepper.problem.mass
    if (masses <= 0).any():
        raise InputError("mass: expected more than 0 kg at every node.")
    simulations = tuple(
        _simulation(f"simulation {k}", motion, mesh, movable, stepper, time_step, better)
        for k, motion in enumerate(motions)
    )
    _check_alike(simulations)
    if scene is not None:
        text = portable(scene).to_toml()
        simulations = tuple(replace(one, scene_toml=text) for one in simulations)
    return Shard(
        attributes={
            "dataset": dataset, "split": split, "number": number, "setting": SETTING,
            "config_hash": "", "time_step": time_step, "tolerance": _tolerance(scene),
        },
        points=mesh.positions, cells=mesh.cells, free=movable, mass=masses,
        young=moduli["young"], poisson=moduli["poisson"], density=moduli["density"],
        simulations=simulations,
    )  # fmt: skip


def _simulation(
    where: str,
    motion: ImportedMotion,
    mesh: HexMesh,
    free: Array,
    stepper: ProjectiveDynamics | None,
    time_step: float,
    better: ProjectiveDynamics | None,
) -> Simulation:
    if not isinstance(motion, ImportedMotion):
        raise InputError(f"{where}: {type(motion).__name__}: expected ImportedMotion.")
    nodes = len(mesh.positions)
    frames = _frames(f"{where}, reference", motion.reference)
    every, steps = (frames, nodes, 3), (frames - 1, nodes, 3)
    reference = finite_array(f"{where}, reference", motion.reference, every)
    reference = from_rest(f"{where}, reference", reference, mesh)
    check_volumes(f"{where}, reference", reference, mesh)
    reference = with_held_nodes(f"{where}, reference", reference, mesh, free)
    coarse = optional_array(f"{where}, coarse", motion.coarse, every)
    if coarse is not None:
        coarse = from_rest(f"{where}, coarse", coarse, mesh)
        coarse = with_held_nodes(f"{where}, coarse", coarse, mesh, free)
    forces = optional_array(f"{where}, forces", motion.forces, steps)
    predictions = optional_array(f"{where}, predictions", motion.predictions, steps)
    if stepper is not None:
        if predictions is None:
            predictions = _predict(stepper, reference, time_step)
        if forces is None:
            forces = _loads(stepper.problem, reference, time_step)
    if predictions is not None:
        predictions = with_held_nodes(f"{where}, predictions", predictions, mesh, free)
    runs = {REFERENCE: Run(reference, attributes={"solver": "imported", "time_step": time_step})}
    if coarse is not None or predictions is not None:
        runs[PLAIN] = Run(coarse, predictions, attributes={"time_step": time_step})
    if better is not None:
        rolled = _roll_out(better, where, frames - 1)
        single = with_held_nodes(
            f"{where}, best", _predict(better, reference, time_step), mesh, free
        )
        runs[BEST] = Run(rolled, single, attributes={"time_step": time_step})
    return Simulation(np.zeros(steps) if forces is None else forces, runs)


def _check_alike(simulations: Sequence[Simulation]) -> None:
    """Refuse simulations of which one has a rollout or predictions and another has not."""
    for name in ("positions", "predictions"):
        given = [getattr(one.runs.get(PLAIN), name, None) is not None for one in simulations]
        if any(given) and not all(given):
            word = "coarse" if name == "positions" else name
            raise InputError(
                f"simulation {given.index(False)} has no {word}, unlike simulation "
                f"{given.index(True)}: expected {word} of all simulations of a mesh, or of none."
            )


def _frames(name: str, positions: ArrayLike) -> int:
    """T + 1, of positions (T+1, N, 3)."""
    shape = real_array(name, positions).shape
    if len(shape) != 3:
        raise InputError(f"{name}: shape {shape}: expected (T + 1, N, 3).")
    if shape[0] < 2:
        raise InputError(f"{name}: {shape[0]} frames: expected 2 or more.")
    return shape[0]


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


def _tolerance(scene: Scene | None) -> float:
    """Of the coarse model's steps, of the cell size; 0 where it is not known."""
    return 0.0 if scene is None else float(scene.solver.tolerance)


def _lumped(mesh: HexMesh, density: Array) -> NDArray[np.float64]:
    """Density times the integral of each node's shape functions, (N,), kg."""
    points = gauss_points(2)
    factors = np.where(VTK_CORNERS == 1, points[:, None], 1 - points[:, None])
    shapes = factors.prod(axis=-1)  # (8 points, 8 corners)
    volumes = jacobians(mesh.positions, mesh.cells, points) / len(points)
    shares = density[:, None] * (volumes @ shapes)
    masses = np.bincount(mesh.cells.ravel(), shares.ravel(), minlength=len(mesh.positions))
    return np.asarray(masses, dtype=np.float64)
