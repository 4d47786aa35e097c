"""Repeat a stepper, and bring runs of different meshes onto the same nodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.mesh import coincident_nodes
from pdcorrect.fem.problem import Problem
from pdcorrect.state import State, Stepper, StepResult, Trajectory

Array = NDArray[np.float64]
OnStep = Callable[[StepResult, float], None]


def rollout(
    stepper: Stepper,
    frames: int | None = None,
    *,
    state: State | None = None,
    forces: Callable[[State], Array] | None = None,
    on_step: OnStep | None = None,
    on_failure: Literal["raise", "stop", "continue"] = "raise",
) -> Trajectory:
    """Apply a stepper again and again.

    Parameters
    ----------
    stepper : Stepper
        Projective dynamics, Newton, or anything that maps a state to a
        `StepResult`.
    frames : int, optional
        Steps to take; the scene's by default.
    state : State, optional
        Where to start; at rest by default.
    forces : callable, optional
        Extra nodal forces (N, 3), N, for the step from a state.
    on_step : callable, optional
        Called with each `StepResult` and its wall-clock seconds, also with the
        one that failed if the rollout goes on: for progress and files.
    on_failure : {"raise", "stop", "continue"}
        What to do after a step that failed: raise `ConvergenceError` (which
        carries the frames so far), return the frames so far, or go on from the
        best iterate.

    Returns
    -------
    Trajectory
        ``frames + 1`` frames, the first one the initial state.
    """
    if on_failure not in ("raise", "stop", "continue"):
        raise InputError(f"on_failure = {on_failure!r}: expected 'raise', 'stop' or 'continue'.")
    problem = stepper.problem
    frames = problem.scene.time.frames if frames is None else frames
    if frames < 0:
        raise InputError(f"frames = {frames}: expected 0 or more.")
    current = problem.rest_state() if state is None else state
    states = [current]
    results: list[StepResult] = []
    seconds: list[float] = []
    for frame in range(1, frames + 1):
        started = time.perf_counter()
        result = stepper(current, forces(current) if forces else None)
        elapsed = time.perf_counter() - started
        if not result.status.ok and on_failure != "continue":
            if on_failure == "stop":
                break
            raise ConvergenceError(
                _failure(frame, result),
                trajectory=_trajectory(stepper, states, results, seconds),
                result=result,
            )
        current = result.state
        states.append(current)
        results.append(result)
        seconds.append(elapsed)
        if on_step:
            on_step(result, elapsed)
    return _trajectory(stepper, states, results, seconds)


def _failure(frame: int, result: StepResult) -> str:
    return (
        f"frame {frame} (t = {result.state.time:g} s) {result.status.value} after "
        f"{result.iterations} iterations (largest out-of-balance force {result.residual:.3g} N, "
        f"estimated distance from the solution {result.error_estimate:.3g} m). Use a smaller "
        "time step, weaker loads or a finer mesh."
    )


def _trajectory(
    stepper: Stepper, states: list[State], results: list[StepResult], seconds: list[float]
) -> Trajectory:
    problem = stepper.problem
    stats: dict[str, NDArray[Any]] = {
        "status": np.array([r.status.name for r in results], dtype=str),
        "iterations": np.array([r.iterations for r in results], dtype=np.int64),
        "residual": np.array([r.residual for r in results], dtype=np.float64),
        "error_estimate": np.array([r.error_estimate for r in results], dtype=np.float64),
        "seconds": np.array(seconds, dtype=np.float64),
    }
    for name in results[0].stats if results else ():
        stats[name] = np.array([r.stats[name] for r in results])
    return Trajectory(
        positions=np.stack([s.positions for s in states]),
        velocities=np.stack([s.velocities for s in states]),
        times=np.array([s.time for s in states]),
        stats=stats,
        points=problem.positions,
        cells=problem.cells,
        scene_toml=problem.scene.to_toml(),
        attributes=run_attributes(stepper),
        problem=problem,
    )


def run_attributes(stepper: Stepper) -> dict[str, str]:
    """What a run's file says about its origin."""
    problem = stepper.problem
    return {
        "refine": str(problem.refine),
        "element": problem.element,
        "mass": problem.mass_rule,
        **stepper.describe(),
    }


def restrict(run: Trajectory, to: Problem | Trajectory) -> Trajectory:
    """A run on the nodes that it shares with a coarser mesh (T_D of the thesis).

    Parameters
    ----------
    run : Trajectory
        On the finer mesh.
    to : Problem or Trajectory
        On the coarser one; each of its nodes must coincide, at rest, with one
        of the run's.

    Raises
    ------
    MeshError
        If a coarse node has no counterpart.
    """
    points, cells = (to.points if isinstance(to, Trajectory) else to.positions), to.cells
    tolerance = 1e-6 * float(np.ptp(points[cells[0]], axis=0).max())
    nodes = coincident_nodes(run.points, points, tolerance)
    return Trajectory(
        positions=run.positions[:, nodes],
        velocities=run.velocities[:, nodes],
        times=run.times,
        stats=run.stats,
        points=points,
        cells=cells,
        scene_toml=run.scene_toml,
        attributes={**run.attributes, "restricted": "to the nodes of a coarser mesh"},
        problem=None,
    )
