"""The converged motion of a scene, from which relative errors are measured; kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pdcorrect._environment import cache_folder, code_digest
from pdcorrect._files import make_folder, part_of_process, replacing
from pdcorrect._version import __version__
from pdcorrect.errors import FileFormatError
from pdcorrect.fem.problem import discretise
from pdcorrect.metrics import relative_error
from pdcorrect.scene import MeshFile, Scene, best_coarse, check_scene
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import restrict, rollout
from pdcorrect.state import StepResult
from pdcorrect.trajectory import Trajectory

REFINE, DIVISOR = 4, 4
"""Of the coarse cells along each axis, and of the scene's step."""

TIME_ERROR, MESH_ERROR, MESH_CHECK = "time_error", "mesh_error", "mesh_error_from"
"""Attributes of runs whose own error was asked for."""

INTEGRATOR = {"integrator": "generalised-alpha", "spectral_radius": 0.8}
_MOST_CELLS = 60_000
"""Of a mesh that is only for the estimate of another's error."""

OnStep = Callable[[str, int, int], None]
"""Called with what is computed, its frame, and their number."""


def converged(
    scene: Scene, frames: int | None = None, *, error: bool = False, on_step: OnStep | None = None
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
        Also estimate the run's own relative error: attributes ``time_error``, from a run at an
        eighth of the step, and ``mesh_error``, from 8x8x8 cells where those are at most 60 000,
        else from 2x2x2.  Both take errors to fall with the first power of step and cells, which
        is on the safe side.
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
    path = cache_folder("converged") / f"{_key(scene)}.h5"
    run = _kept(path, scene.time.frames)
    if run is not None and not (error and MESH_ERROR not in run.attributes):
        return run
    if run is None:
        run = _computed(scene, REFINE, DIVISOR, on_step)
    if error:
        run = replace(run, attributes={**run.attributes, **_own_error(scene, run, on_step)})
    _keep(path, run)
    return run


def _computed(scene: Scene, refine: int, divisor: int, on_step: OnStep | None) -> Trajectory:
    problem = discretise(_refined_in_time(best_coarse(scene), divisor), refine)
    coarse = discretise(best_coarse(scene))
    stepper = ProjectiveDynamics(problem).prepare()
    name = f"{refine}x{refine}x{refine} cells, step / {problem.scene.time.substeps}"
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


def _own_error(scene: Scene, run: Trajectory, on_step: OnStep | None) -> dict[str, str]:
    """Relative errors by halving or doubling step and cells, as attributes."""
    found = {}
    if scene.time.integrator != "quasi-static":
        half = _computed(scene, REFINE, 2 * DIVISOR, on_step)
        found[TIME_ERROR] = f"{2 * relative_error(run, half):.3g}"
    finer = len(run.cells) * (2 * REFINE) ** 3 <= _MOST_CELLS
    other = _computed(scene, 2 * REFINE if finer else REFINE // 2, DIVISOR, on_step)
    share = 2 * relative_error(run, other) if finer else relative_error(other, run)
    cells = "x".join(3 * [str(2 * REFINE if finer else REFINE // 2)])
    return {**found, MESH_ERROR: f"{share:.3g}", MESH_CHECK: f"{cells} cells"}


# --- the cache ---------------------------------------------------------------------------


def _key(scene: Scene) -> str:
    """Hash of all that the run depends on."""
    content = b""
    if isinstance(scene.body, MeshFile):
        with contextlib.suppress(OSError):  # discretise says what is wrong
            content = scene.body.path.read_bytes()
        scene = scene.with_changes(body={"path": f"mesh{scene.body.path.suffix}"})
    parts = (
        scene.with_changes(name="scene").to_toml().encode(),
        content,
        f"{__version__} {code_digest('scene', 'fem', 'solvers')} {REFINE} {DIVISOR}".encode(),
    )
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


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
