"""How far a run is from the converged motion, estimated by a finer run with the learned element."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.evaluation.converged import INTEGRATOR
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import Scene, learned_coarse
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import OWN_MATERIAL, OnStep, restrict, rollout
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]

FINER = 2
"""Times as many cells along each axis, and substeps."""
_SAME = 1e-9
"""Of the cell size, for states that are the same."""


def error_estimate(run: Trajectory, *, on_step: OnStep | None = None) -> Array:
    """Estimated distance of each node from the converged motion, in each frame, (T+1, N), m.

    It is the distance to another run, with the learned element on 2x2x2 cells for each of the
    run's, by generalised-alpha with twice as many substeps.  That run takes 10 to 20 times as
    long.  How near the estimate is: `validation/unlike_bodies`.

    Parameters
    ----------
    run : Trajectory
        Of its scene's material and initial state, without other forces than the scene's.
    on_step : callable, optional
        For progress, see `rollout`.

    Raises
    ------
    InputError
        If the run has no scene, or another material, state at the beginning, or steps.
    ConvergenceError
        If a step of the finer run fails.
    """
    if not isinstance(run, Trajectory):
        raise InputError(f"run is a {type(run).__name__}: expected a Trajectory.")
    scene = Scene.from_toml(run.scene_toml, "the run's scene")
    scene = scene.with_changes(time={"frames": max(1, len(run))})
    refine = int(run.attributes.get("refine", "1"))
    _check_steps(run, scene)
    _check_begin(run, discretise(scene, refine))
    finer = finer_run(scene, len(run), refine, on_step=on_step)
    distance = np.linalg.norm(run.positions - restrict(finer, run).positions, axis=2)
    return np.asarray(distance)


def finer_run(
    scene: Scene, frames: int, refine: int = 1, *, on_step: OnStep | None = None
) -> Trajectory:
    """The run from which `error_estimate` measures those with ``refine`` cells for each coarse one.

    Raises
    ------
    ConvergenceError
    """
    try:
        problem = _finer(scene, refine)
        return rollout(ProjectiveDynamics(problem).prepare(), frames, on_step=on_step)
    except ConvergenceError as error:
        raise ConvergenceError(
            f"the finer run of the estimate: {error}", result=error.result
        ) from None


def _finer(scene: Scene, refine: int) -> Problem:
    """The scene as the estimate computes it; weights tuned to a body do not know finer cells."""
    scene = scene.with_changes(solver={"weights": None})
    if scene.time.integrator != "quasi-static":
        scene = scene.with_changes(time={"substeps": FINER * scene.time.substeps, **INTEGRATOR})
    return discretise(learned_coarse(scene), FINER * refine)


def _check_steps(run: Trajectory, scene: Scene) -> None:
    static = scene.time.integrator == "quasi-static"
    other = run.attributes.get("integrator", scene.time.integrator)
    expected = scene.time.step * np.arange(len(run) + 1)
    if static != (other == "quasi-static") or not np.allclose(run.times, expected):
        raise InputError(
            f"the run's frames, by {other}, are not at the times of its scene (steps of "
            f"{scene.time.step:g} s, {scene.time.integrator}): expected a run of the scene itself."
        )


def _check_begin(run: Trajectory, problem: Problem) -> None:
    material = run.attributes.get("material", OWN_MATERIAL)
    if material != OWN_MATERIAL:
        raise InputError(f"the run's material is {material}: expected that of its scene.")
    begin = problem.initial_state()
    start = restrict(
        Trajectory(
            begin.positions[None], begin.velocities[None], np.zeros(1), {}, problem.positions,
            problem.cells,
        ),
        run,
    )  # fmt: skip
    far = float(np.abs(run.positions[0] - start.positions[0]).max())
    fast = float(np.abs(run.velocities[0] - start.velocities[0]).max()) * problem.time_step
    if max(far, fast) > _SAME * problem.cell_size:
        raise InputError(
            "the run begins with another state than its scene: expected the scene's initial one."
        )
