"""The converged motion of a scene, kept on disk, and estimates of how far runs are from it."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from pdcorrect._environment import cache_folder, code_digest
from pdcorrect._files import make_folder, part_of_process, replacing
from pdcorrect._version import __version__
from pdcorrect.errors import ConvergenceError, FileFormatError, InputError
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.fem.scene_mesh import scene_mesh
from pdcorrect.metrics import relative_error
from pdcorrect.scene import Body, Scene, best_coarse, check_scene, learned_coarse
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import OWN_MATERIAL, OnStep, restrict, rollout
from pdcorrect.state import StepResult
from pdcorrect.trajectory import Trajectory

REFINE, DIVISOR = 4, 4
"""Of the coarse cells along each axis, and of the scene's step."""

TIME_ERROR, MESH_ERROR, MESH_LEVELS = "time_error", "mesh_error", "mesh_levels"
"""Attributes of runs whose own error was asked for."""

INTEGRATOR = {"integrator": "generalised-alpha", "spectral_radius": 0.8}
_MOST_CELLS = 60_000  # of a mesh that is only for the estimate of another's error
ORDERS = 0.5, 2.0
"""Least order that is extrapolated with, and that of generalised-alpha and of 8-node elements."""
FINER = 2
"""Times as many cells along each axis, and substeps, as a run whose error is estimated."""
_SAME = 1e-9  # of the cell size, for states that are the same

OnRun = Callable[[str, int, int], None]
"""Called with what is computed, its frame, and their number."""


def converged(
    scene: Scene, frames: int | None = None, *, error: bool = False, on_step: OnRun | None = None
) -> Trajectory:
    """The motion that a scene tends to as mesh and time step are refined.

    Computed with the element and mass of `best_coarse` on 4x4x4 cells for each coarse one, by
    generalised-alpha of spectral radius 0.8 at a quarter of the scene's step, or at half its
    substeps if those are shorter; quasi-static scenes at their own steps.  The run is kept in
    `cache_folder`, under a hash of the scene, its mesh file and the code that computes it.

    Parameters
    ----------
    scene : Scene
    frames : int, optional
        The scene's by default.
    error : bool
        Also estimate the run's own relative error by `own_errors`: attributes ``time_error`` and
        ``mesh_error``, and ``mesh_levels``, the cells along each axis that it is from.
    on_step : callable, optional
        For progress.

    Returns
    -------
    Trajectory
        At the corners of the coarse cells and the times of the scene's frames.  Its statistics
        are of all steps to a frame: sums of iterations and seconds, largest errors.

    Raises
    ------
    ConvergenceError
        If a step fails.
    """
    check_scene(scene)
    if frames is not None:
        scene = scene.with_changes(time={"frames": frames})
    path = cache_folder("converged") / f"{cache_key(scene)}.h5"
    run = _kept(path, scene.time.frames)
    if run is not None and not (error and MESH_LEVELS not in run.attributes):
        return run
    if run is None:
        run = _computed(scene, REFINE, DIVISOR, on_step)
    if error:
        run = replace(run, attributes={**run.attributes, **_own_error(scene, run, on_step)})
    _keep(path, run)
    return run


def level(scene: Scene, refine: int, divisor: int) -> tuple[ProjectiveDynamics, Problem]:
    """What steps a scene at so many cells and substeps, and the problem on the coarse cells."""
    problem = discretise(_refined_in_time(best_coarse(scene), divisor), refine)
    return ProjectiveDynamics(problem).prepare(), discretise(best_coarse(scene))


def _computed(scene: Scene, refine: int, divisor: int, on_step: OnRun | None) -> Trajectory:
    stepper, coarse = level(scene, refine, divisor)
    name = f"{refine}x{refine}x{refine} cells, step / {stepper.problem.scene.time.substeps}"
    count = itertools.count(1)

    def told(_: StepResult, seconds: float) -> None:
        if on_step:
            on_step(name, next(count), scene.time.frames)

    run = restrict(rollout(stepper, on_step=told), coarse)
    return replace(
        run,
        scene_toml=scene.to_toml(),
        attributes={**run.attributes, "restricted": "to the nodes of the coarse mesh"},
    )


def _refined_in_time(scene: Scene, divisor: int) -> Scene:
    """With ``divisor`` substeps, or two to each of the scene's if those are more.

    Errors of so many steps add up, so each is held the smaller.
    """
    if scene.time.integrator == "quasi-static":
        return scene
    substeps = max(divisor, divisor // 2 * scene.time.substeps)
    return scene.with_changes(
        time={"substeps": substeps, **INTEGRATOR},
        solver={"tolerance": scene.solver.tolerance / substeps**2},
    )


def richardson(runs: Mapping[int, Any], at: int) -> tuple[float, float]:
    """Relative error of a run, and the order by which errors fall, within `ORDERS`.

    Runs at levels n0 < n1 < n2 with errors c n^-p are c (n^-p - n2^-p) from the last; their RMS
    distances give p and c.  An order better than theory is not believed, and a low one is raised,
    as by Eça and Hoekstra, J. Comput. Phys. 262 (2014) 104.

    Parameters
    ----------
    runs : mapping of int to Trajectory or (T+1, N, 3)
        Three, on the same nodes, by cells along an axis or by substeps.
    at : int
        Which one's error.

    Raises
    ------
    InputError
        If the finest run rests, see `relative_error`.
    """
    n0, n1, n2 = sorted(runs)
    wide, narrow = (relative_error(runs[n], runs[n2]) for n in (n0, n1))

    def gap(p: float) -> float:
        return float(narrow * (n0**-p - n2**-p) - wide * (n1**-p - n2**-p))

    low, high = ORDERS
    order = high if gap(high) <= 0.0 else low if gap(low) >= 0.0 else float(brentq(gap, low, high))
    return float(narrow * at**-order / (n1**-order - n2**-order)), order


def own_errors(
    scene: Scene, cells: int, run_of: Callable[[int, int], Any]
) -> tuple[dict[str, tuple[float, float]], list[int]]:
    """What `richardson` says of the converged motion, by attribute, and the levels of its meshes.

    Of steps those are half, once and twice as many, of cells along each axis too where the most
    are at most 60 000 in all, else a quarter, half and once.

    Parameters
    ----------
    scene : Scene
    cells : int
        Coarse ones.
    run_of : callable
        Gives the run of a refinement and a divisor of the step, on the coarse nodes.
    """
    finest = 2 * REFINE if cells * (2 * REFINE) ** 3 <= _MOST_CELLS else REFINE
    meshes = [finest // 4, finest // 2, finest]
    found = {}
    if scene.time.integrator != "quasi-static":
        steps = DIVISOR // 2, DIVISOR, 2 * DIVISOR
        found[TIME_ERROR] = richardson({n: run_of(REFINE, n) for n in steps}, DIVISOR)
    found[MESH_ERROR] = richardson({n: run_of(n, DIVISOR) for n in meshes}, REFINE)
    return found, meshes


def _own_error(scene: Scene, run: Trajectory, on_step: OnRun | None) -> dict[str, str]:
    """`own_errors` as attributes."""

    def run_of(refine: int, divisor: int) -> Trajectory:
        known = (refine, divisor) == (REFINE, DIVISOR)
        return run if known else _computed(scene, refine, divisor, on_step)

    found, meshes = own_errors(scene, len(run.cells), run_of)
    shares = {name: f"{share:.3g}" for name, (share, _) in found.items()}
    return {**shares, MESH_LEVELS: ", ".join(map(str, meshes))}


# --- the cache ---------------------------------------------------------------------------


def cache_key(scene: Scene) -> str:
    """Hash of all that the run depends on."""
    content = b""
    bodies = [_nameless(body) for body in scene.all_bodies.values()]
    if bodies != [*scene.all_bodies.values()]:
        mesh = scene_mesh(scene)
        content = mesh.positions.tobytes() + mesh.cells.tobytes()
        for name, group in sorted(mesh.groups.items()):
            content += repr((name, *(own.tolist() for own in group))).encode()
        scene = scene.model_copy(update={"body": bodies[0], "bodies": tuple(bodies[1:])})
    if scene.initial is not None and scene.initial.run is not None:
        with contextlib.suppress(OSError):  # discretise says what is wrong
            content += scene.initial.run.read_bytes()
    parts = (
        scene.with_changes(name="scene").to_toml().encode(),
        content,
        f"{__version__} {code_digest('scene', 'fem', 'solvers')} {REFINE} {DIVISOR}".encode(),
    )
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def _nameless(body: Body) -> Body:
    """A body whose files have no folder and no name."""
    found = {key: Path(f"mesh{value.suffix}") for key, value in body if isinstance(value, Path)}
    return body.model_copy(update=found)


def _kept(path: Path, frames: int) -> Trajectory | None:
    """A run of the cache; None if there is none, or it is damaged."""
    from pdcorrect.io.trajectory import load_trajectory  # h5py only where it is needed

    try:
        run = load_trajectory(path)
    except (FileFormatError, OSError):
        return None
    return run if len(run) == frames else None


def _keep(path: Path, run: Trajectory) -> None:
    """Put a run into the cache, whole or not at all; without one that can be written, do not."""
    from pdcorrect.io.trajectory import save_trajectory

    with contextlib.suppress(OSError):
        make_folder(path.parent)
        with replacing(path, part_of_process(path)) as part:
            save_trajectory(part, run)


# --- estimates ---------------------------------------------------------------------------


def error_estimate(run: Trajectory, *, on_step: OnStep | None = None) -> NDArray[np.float64]:
    """Estimated distance of each node from the converged motion, in each frame, (T+1, N), m.

    It is the distance to another run, with the learned element on 2x2x2 cells for each of the
    run's, by generalised-alpha with twice as many substeps.  That run takes 10 to 20 times as
    long.  How near the estimate is: `validation/error_time`.

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
    """What `error_estimate` measures runs from, of ``refine`` cells for each coarse one."""
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
