"""Repeat a stepper, go on with a run from its file, restrict runs to the nodes of another mesh."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pdcorrect._config import parse_toml
from pdcorrect.errors import ConvergenceError, InputError, MeshError, PdcorrectWarning
from pdcorrect.fem.clamps import rigid_freedom
from pdcorrect.fem.hexahedron import gauss_points, jacobians
from pdcorrect.fem.mesh import coincident_nodes
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Scene
from pdcorrect.solvers.implicit import whole
from pdcorrect.state import State, Status, StepResult, joined_stats
from pdcorrect.trajectory import Stepper, Trajectory

Array = NDArray[np.float64]
OnStep = Callable[[StepResult, float], None]
DENSITY_CHANGED = "the scene's but for its density"
"""Attribute "material" of runs of `Problem.with_total_mass`."""
OWN_MATERIAL = "the scene's"
"""The same of most runs."""

_GAINED = 0.1
"""Of a run's largest energy: more than steps of second order gain where they are short enough."""
_SAME_VOLUME = 1e-6

OnFailure = Literal["raise", "stop", "continue"]


def march(
    stepper: Stepper,
    frames: int | None = None,
    *,
    state: State | None = None,
    forces: Callable[[State], Array] | None = None,
    on_failure: OnFailure = "raise",
) -> Iterator[tuple[StepResult, float]]:
    """Apply a stepper again and again, keeping nothing: yields each frame and its seconds.

    Parameters are those of `rollout`.  A frame of several substeps has the state after them, the
    sums of their iterations, works and losses, and the largest of their errors.

    Raises
    ------
    ConvergenceError
        At the first step that failed, unless told otherwise.
    """
    if on_failure not in ("raise", "stop", "continue"):
        raise InputError(f"on_failure = {on_failure!r}: expected 'raise', 'stop' or 'continue'.")
    problem = stepper.problem
    frames = whole("frames", problem.scene.time.frames if frames is None else frames, 1)
    current = problem.initial_state() if state is None else state
    for frame in range(1, frames + 1):
        started, results = time.perf_counter(), []
        for _ in range(problem.scene.time.substeps):
            result = stepper(current, forces(current) if forces else None)
            if not result.status.ok and on_failure != "continue":
                if on_failure == "stop":
                    return
                raise ConvergenceError(
                    f"frame {frame} (t = {result.state.time:g} s) {result.status.value} after "
                    f"{result.iterations} iterations (largest out-of-balance force "
                    f"{result.residual:.3g} N, estimated distance from the solution "
                    f"{result.error_estimate:.3g} m). Use a smaller time step, weaker loads or a "
                    f"finer mesh{_of_contact(problem)}.",
                    result=result,
                )
            current = result.state
            results.append(result)
        yield _of_frame(results), time.perf_counter() - started


def _of_contact(problem: Problem) -> str:
    """What to look for where there are obstacles, which are expected to hold static bodies."""
    if problem.contact is None:
        return ""
    static = problem.scene.time.integrator == "quasi-static"
    loose = static and rigid_freedom(problem.positions, problem.cells, problem.clamps)
    if loose:
        return f", and look whether obstacles hold the body at all times: {loose}"
    return ", and look whether an obstacle meets nodes that are held, or another obstacle"


def _of_frame(results: list[StepResult]) -> StepResult:
    """One result of all substeps."""
    last = results[-1]
    if len(results) == 1:
        return last
    unusual = [r.status for r in results if r.status is not Status.CONVERGED]
    unusual.sort(key=lambda status: status.ok)  # what failed counts most
    return replace(
        last,
        status=unusual[0] if unusual else Status.CONVERGED,
        iterations=sum(r.iterations for r in results),
        residual=max(r.residual for r in results),
        error_estimate=max(r.error_estimate for r in results),
        stats=joined_stats([r.stats for r in results]),
    )


def rollout(
    stepper: Stepper,
    frames: int | None = None,
    *,
    state: State | None = None,
    forces: Callable[[State], Array] | None = None,
    on_step: OnStep | None = None,
    on_failure: OnFailure = "raise",
) -> Trajectory:
    """Apply a stepper again and again and keep every frame.

    Parameters
    ----------
    stepper : Stepper
        Projective dynamics, Newton, or anything that maps a state to a
        `StepResult`.
    frames : int, optional
        To compute, 1 or more, each of the scene's substeps; the scene's by default.
    state : State, optional
        Where to start; `Problem.initial_state` by default.
    forces : callable, optional
        Extra nodal forces (N, 3), N, for the step from a state.
    on_step : callable, optional
        Called with each frame's `StepResult` and its wall-clock seconds: for progress.
    on_failure : {"raise", "stop", "continue"}
        What to do after a step that failed: raise `ConvergenceError` (which
        carries the frames so far), return the frames so far, or go on from the
        best iterate.

    Returns
    -------
    Trajectory
        ``frames + 1`` frames, the first one the initial state.  A `PdcorrectWarning` says if
        frames have inverted cells, or energy came from nowhere.

    Raises
    ------
    ConvergenceError
        See ``on_failure``.
    InputError
        If an argument, or what ``forces`` returns, has a wrong shape or value.
    """
    if not hasattr(stepper, "problem"):
        raise InputError(
            f"stepper is a {type(stepper).__name__}: expected pc.ProjectiveDynamics(problem)."
        )
    states = [stepper.problem.initial_state() if state is None else state]
    log = StepLog()
    steps = march(stepper, frames, state=states[0], forces=forces, on_failure=on_failure)
    try:
        for result, elapsed in steps:
            states.append(result.state)
            log.add(result, elapsed)
            if on_step:
                on_step(result, elapsed)
    except ConvergenceError as error:
        error.trajectory = _trajectory(stepper, states, log)
        raise
    run = _trajectory(stepper, states, log)
    scene = stepper.problem.scene
    told = [inverted_frames(run.stats, scene.time.step)]
    if forces is None and scene.time.integrator != "quasi-static" and "kinetic_energy" in run.stats:
        told.append(gained_energy(run.stats))
    for text in filter(None, told):
        warnings.warn(text, PdcorrectWarning, stacklevel=2)
    return run


def stored_and_put_in(stats: Mapping[str, Any]) -> tuple[Array, Array]:
    """Energy after each frame of a run, and what went in since the start less losses, (T,), J."""
    stored = np.asarray(stats["elastic_energy"]) + np.asarray(stats["kinetic_energy"])
    put_in = np.asarray(stats["external_work"]) + stats["clamp_work"] - stats["damping_loss"]
    if "contact_energy" in stats:
        stored = stored + stats["contact_energy"]
        put_in = put_in + stats["obstacle_work"] - stats["friction_loss"]
    if "actuator_work" in stats:
        put_in = put_in + stats["actuator_work"]
    return stored, np.cumsum(put_in)


def gained_energy(stats: Mapping[str, Any]) -> str:
    """Whether a run has more energy than was put in since its first step; empty if not."""
    stored, put_in = stored_and_put_in(stats)
    gained = float(((stored - stored[0]) - (put_in - put_in[0])).max())
    if not gained > _GAINED * stored.max():
        return ""
    return (
        f"the run gained {gained:.3g} J that nothing put in: take smaller steps or a smaller "
        "spectral_radius"
    )


def inverted_frames(stats: Mapping[str, Any], step: float) -> str:
    """How many frames of a run ended with inverted cells, and the first one; empty if none.

    ``step`` is the length of a frame, s.
    """
    inverted = np.asarray(stats["status"]) == Status.INVERTED.name
    if "smallest_volume_ratio" in stats:  # also after a fallback, which the status names instead
        inverted = inverted | (np.asarray(stats["smallest_volume_ratio"]) <= 0.0)
    if not inverted.any():
        return ""
    first = 1 + int(inverted.argmax())
    return (
        f"{inverted.sum()} of {len(inverted)} frames ended with inverted or folded cells, the "
        f"first at t = {first * step:g} s"
    )


def _trajectory(stepper: Stepper, states: list[State], log: StepLog) -> Trajectory:
    """With NaN for what states do not remember."""
    problem, none = stepper.problem, np.full_like(states[0].positions, np.nan)
    remembered = dict.fromkeys(name for state in states for name in state.memory)
    return Trajectory(
        positions=np.stack([s.positions for s in states]),
        velocities=np.stack([s.velocities for s in states]),
        times=np.array([s.time for s in states]),
        stats=log.arrays(),
        points=problem.positions,
        cells=problem.cells,
        scene_toml=problem.scene.to_toml(),
        attributes=run_attributes(stepper),
        problem=problem,
        memory={name: np.stack([s.memory.get(name, none) for s in states]) for name in remembered},
    )


class StepLog:
    """Statistics of a run, one row a step; ``earlier`` are those of a run that is continued."""

    def __init__(self, earlier: Mapping[str, NDArray[Any]] | None = None) -> None:
        columns = earlier or {}
        rows = zip(*columns.values(), strict=True)
        self._rows: list[dict[str, Any]] = [dict(zip(columns, row, strict=True)) for row in rows]

    def __len__(self) -> int:
        """Number of steps."""
        return len(self._rows)

    def add(self, result: StepResult, seconds: float) -> None:
        """Note a step and its wall-clock seconds."""
        self._rows.append(
            {
                "status": result.status.name,
                "iterations": result.iterations,
                "residual": result.residual,
                "error_estimate": result.error_estimate,
                "seconds": seconds,
                **result.stats,
            }
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The ``stats`` of a `Trajectory`: (T,) arrays by name."""
        names = dict.fromkeys(n for row in self._rows for n in row) if self._rows else _NO_STEPS
        return {name: np.array([row.get(name, np.nan) for row in self._rows]) for name in names}


_NO_STEPS = ("status", "iterations", "residual", "error_estimate", "seconds")


def run_attributes(stepper: Stepper) -> dict[str, str]:
    """What a run's file says about its origin."""
    problem, correction = stepper.problem, stepper.problem.correction
    material = DENSITY_CHANGED if problem.density_changed else OWN_MATERIAL
    found = {
        "refine": str(problem.refine),
        "element": problem.element,
        "mass": problem.mass_rule,
        "material": "changed after the scene" if problem.material_changed else material,
    }
    if correction is not None:
        found["element_weights"] = "" if correction.writer is None else correction.writer.digest
        learned = correction.learned
        found["learned_cells"] = f"{int(learned.sum())} of {len(learned)}"
    return found | stepper.describe()


def restrict(run: Trajectory, to: Problem | Trajectory) -> Trajectory:
    """A run on the nodes that it shares with a coarser mesh (T_D of the thesis).

    Each node of ``to`` must coincide, at rest, with one of the run's.  The memory, which is of
    the run's own mesh, is left out.

    Raises
    ------
    MeshError
        If a coarse node has no counterpart, or the bodies have other extents or volumes.
    """
    points, cells = (to.points if isinstance(to, Trajectory) else to.positions), to.cells
    tolerance = 1e-6 * float(np.ptp(points[cells[0]], axis=0).max())
    nodes = coincident_nodes(run.points, points, tolerance)
    meshes = (run.points, run.cells), (points, cells)
    own, other = (np.stack([x.min(axis=0), x.max(axis=0)]) for x, _ in meshes)
    if np.abs(own - other).max() > tolerance:
        raise MeshError(
            f"the run's body extends up to {np.abs(own - other).max():.3g} m further, or less far: "
            "expected a refinement of the same body."
        )
    volumes = [jacobians(x, c[:, :8], gauss_points(2)).mean(axis=1).sum() for x, c in meshes]
    if abs(volumes[0] - volumes[1]) > _SAME_VOLUME * volumes[1]:
        raise MeshError(
            f"the run's body has {volumes[0]:.6g} m3, the coarser mesh {volumes[1]:.6g} m3: "
            "expected a refinement of the same body."
        )
    return replace(
        run,
        positions=run.positions[:, nodes],
        velocities=run.velocities[:, nodes],
        points=points,
        cells=cells,
        attributes={**run.attributes, "restricted": "to the nodes of a coarser mesh"},
        problem=None,
        memory={},
    )


_SHOWN = 4


def continue_from(stepper: Stepper, run: Trajectory) -> State:
    """The state to go on from, after telling the stepper about the frames so far.

    If it has a method ``restore``, that is called with ``run``.

    Raises
    ------
    InputError
        If another scene, mesh or solver made the frames.
    """
    check_same_run(stepper, run)
    if hasattr(stepper, "restore"):
        stepper.restore(run)
    return run.state(-1)


def check_same_run(stepper: Stepper, run: Trajectory, name: str = "the run") -> None:
    """Raise `InputError`, saying what differs, if the stepper would have made other frames."""
    found = differences(stepper, run)
    if found:
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise InputError(
            f"{name}: cannot be continued, its frames are of another run: "
            f"{'; '.join(found[:_SHOWN])}{more}. Ask for the same, or start again under "
            "another name."
        )


def differences(stepper: Stepper, run: Trajectory) -> list[str]:
    """How a run differs from what a stepper would do, one phrase each; frames do not count."""
    problem = stepper.problem
    old, new = _settings(run.scene_toml), _settings(problem.scene.to_toml())
    old |= run.attributes
    new |= run_attributes(stepper)
    found = [
        f"{name} was {old.get(name, 'nothing')}, now {new.get(name, 'nothing')}"
        for name in dict.fromkeys((*old, *new))
        if old.get(name) != new.get(name)
    ]
    meshes = ("nodes", run.points, problem.positions), ("cells", run.cells, problem.cells)
    return found + [
        f"the mesh's {name} are different ones ({len(was)}, now {len(now)})"
        for name, was, now in meshes
        if not np.array_equal(was, now)
    ]


def _settings(scene_toml: str) -> dict[str, str]:
    """A scene's keys, dotted, and values as text, without the number of frames.

    With the defaults of keys that it was written without, if it can be read.
    """
    with contextlib.suppress(InputError):
        scene_toml = Scene.from_toml(scene_toml).to_toml()
    try:
        scene = parse_toml(scene_toml)
    except ValueError:
        return {"scene": "unreadable"}
    return {key: value for key, value in _flat("", scene) if key != "time.frames"}


def _flat(prefix: str, table: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", repr(value)
