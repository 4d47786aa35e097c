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
    _check_own(run, discretise(scene, refine))
    finer = restrict(finer_run(scene, len(run), refine, on_step=on_step), run)
    return np.asarray(np.linalg.norm(run.positions - finer.positions, axis=2))


def finer_run(
    scene: Scene, frames: int, refine: int = 1, *, on_step: OnStep | None = None
) -> Trajectory:
    """The run from which `error_estimate` measures those with ``refine`` cells for each coarse one.

    Raises
    ------
    ConvergenceError
    """
    # weights tuned to a body do not know finer cells
    scene = scene.with_changes(solver={"weights": None})
    if scene.time.integrator != "quasi-static":
        scene = scene.with_changes(time={"substeps": FINER * scene.time.substeps, **INTEGRATOR})
    problem = discretise(learned_coarse(scene), FINER * refine)
    try:
        return rollout(ProjectiveDynamics(problem).prepare(), frames, on_step=on_step)
    except ConvergenceError as error:
        raise ConvergenceError(
            f"the finer run of the estimate: {error}", result=error.result
        ) from None


def _check_own(run: Trajectory, problem: Problem) -> None:
    """Refuse a run of other steps, material or initial state than those of its scene's problem."""
    time = problem.scene.time
    kind = run.attributes.get("integrator", time.integrator)
    still = [name == "quasi-static" for name in (kind, time.integrator)]
    if still[0] != still[1] or not np.allclose(run.times, time.step * np.arange(len(run) + 1)):
        raise InputError(
            f"the run's frames, by {kind}, are not at the times of its scene (steps of "
            f"{time.step:g} s, {time.integrator}): expected a run of the scene itself."
        )
    material = run.attributes.get("material", OWN_MATERIAL)
    if material != OWN_MATERIAL:
        raise InputError(f"the run's material is {material}: expected that of its scene.")
    begin, far = problem.initial_state(), _SAME * problem.cell_size
    x, v = begin.positions[None], begin.velocities[None]
    own = restrict(Trajectory(x, v, np.zeros(1), {}, problem.positions, problem.cells), run)
    if (
        np.abs(run.positions[0] - own.positions[0]).max() > far
        or np.abs(run.velocities[0] - own.velocities[0]).max() * problem.time_step > far
    ):
        raise InputError(
            "the run begins with another state than its scene: expected the scene's initial one."
        )
