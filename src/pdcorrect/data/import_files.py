"""Trajectory files and ``.npz`` files, made files of a data set."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect.data.configuration import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.importing import (
    ImportedMotion,
    check_integrator,
    coarse_problem,
    shard_from_arrays,
    shard_of,
)
from pdcorrect.data.schema import CONFIG, INTEGRATOR, SUFFIX, Array, Shard, write_shard
from pdcorrect.data.simulate import arrays_of
from pdcorrect.errors import FileFormatError, InputError, PdcorrectWarning
from pdcorrect.fem.problem import Problem
from pdcorrect.io.trajectory import load_trajectory
from pdcorrect.scene import Scene
from pdcorrect.solvers.rollout import restrict
from pdcorrect.trajectory import Trajectory

_KNOWN = (TRAINING, VALIDATION, EVALUATION)
_NEEDED = ("points", "cells", "free", "young", "poisson", "density", "time_step")
_MOTION = ("reference", "forces", "coarse", "predictions")
_BODY = ("body", "material", "materials", "clamps", "damping")
"""Sections of a scene in which all simulations of a file agree."""


def import_trajectories(
    sources: Sequence[str | Path],
    folder: str | Path,
    *,
    coarse: Sequence[str | Path] = (),
    split: str = "training",
    number: int = 0,
    best: bool = False,
) -> Path:
    """Write a file of a data set from trajectory files or from an ``.npz`` file; its path.

    Parameters
    ----------
    sources : sequence of path
        Trajectories (HDF5) of `shard_from_trajectories`, or one ``.npz`` file with the arrays
        of `shard_from_arrays` by their names and one simulation ``reference``, or several as
        ``reference_0``, ``reference_1``, …; likewise ``forces``, ``coarse``, ``predictions``.
    folder : path
        Of the data set, which has its name; created if missing.
    coarse : sequence of path
        Trajectories of the coarse model, as many as sources.
    split, number, best
        See `shard_from_arrays`.

    Raises
    ------
    FileFormatError, InputError, OutputError
        If a file cannot be read or fails a check, the folder is that of a generated data set,
        or the file exists already or cannot be written.
    """
    if "/" in split or split in ("", ".", ".."):
        raise InputError(f"split {split!r}: expected a name.")
    if split not in _KNOWN:
        warnings.warn(
            f"split {split!r} is one of your own; training reads {TRAINING!r} and {VALIDATION!r}, "
            f"evaluation {EVALUATION!r} unless told otherwise.",
            PdcorrectWarning,
            stacklevel=2,
        )
    if (Path(folder) / CONFIG).exists():
        raise InputError(
            f"{folder} holds {CONFIG}, as a generated data set: expected a folder of its own for "
            "imported files."
        )
    path = Path(folder) / split / f"mesh-{number:04d}{SUFFIX}"
    if path.exists():
        raise InputError(f"{path} exists already: choose another number, or delete it first.")
    about: dict[str, Any] = {
        "dataset": Path(folder).resolve().name, "split": split, "number": number,
        "best": best,
    }  # fmt: skip
    files = [Path(source) for source in sources]
    if any(file.suffix == ".npz" for file in files):
        if len(files) != 1 or coarse:
            raise InputError(
                f"{len(files)} sources and {len(coarse)} coarse runs: expected one .npz alone."
            )
        shard = _shard_of_npz(files[0], about)
    else:
        runs, others = ([load_trajectory(f) for f in each] for each in (files, coarse))
        shard = shard_from_trajectories(runs, others, **about)
    write_shard(path, replace(shard, provenance={"sources": ", ".join(map(str, files))}))
    return path


def _shard_of_npz(path: Path, about: Mapping[str, Any]) -> Shard:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except Exception as error:  # zip, zlib and NumPy raise nearly every type on damaged bytes
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise FileFormatError(
            f"{path}: cannot be read as .npz ({reason or type(error).__name__})."
        ) from None
    motions: list[ImportedMotion] = []
    while names := _names_of(len(motions), arrays):
        motions.append(ImportedMotion(**{k: arrays.pop(n) for k, n in names.items()}))
    mass = arrays.pop("mass", None)
    if arrays.keys() != set(_NEEDED):
        raise InputError(
            f"{path}: has arrays {', '.join(map(repr, arrays))} besides those of {len(motions)} "
            f"simulations: expected {', '.join(_NEEDED)}; for one simulation {', '.join(_MOTION)}, "
            "for several 'reference_0', 'forces_0' and so on."
        )
    try:
        return shard_from_arrays(motions=motions, mass=mass, **about, **arrays)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def _names_of(number: int, arrays: Mapping[str, Array]) -> dict[str, str]:
    """Arrays of a simulation by what they are; none where it has no reference."""
    for end in (f"_{number}", "") if number == 0 else (f"_{number}",):
        if f"reference{end}" in arrays:
            return {name: f"{name}{end}" for name in _MOTION if f"{name}{end}" in arrays}
    return {}


def shard_from_trajectories(
    reference: Trajectory | Sequence[Trajectory],
    coarse: Trajectory | Sequence[Trajectory] | None = None,
    *,
    dataset: str = "imported",
    split: str = "training",
    number: int = 0,
    best: bool = False,
) -> Shard:
    """A file of a data set from runs of ``pdcorrect simulate`` on one mesh, checked.

    The scenes in the runs give mesh, material, clamps and loads, and the coarse runs' where there
    are any, as many as references, else the references', element and masses of the coarse model.
    References, of refined meshes, are restricted to the coarse nodes; predictions are computed with
    `ProjectiveDynamics` on the coarse mesh.  For the other arguments see `shard_from_arrays`.

    Raises
    ------
    InputError
        If a run has no scene, another material than it, another integrator than backward Euler or
        does not start at rest, the runs' scenes differ in a section but the loads of different
        simulations, or in times, or as of `shard_from_arrays`.
    """
    references = [reference] if isinstance(reference, Trajectory) else list(reference)
    rollouts = [coarse] if isinstance(coarse, Trajectory) else list(coarse or ())
    if not references or len(rollouts) not in (0, len(references)):
        raise InputError(
            f"{len(references)} references and {len(rollouts)} coarse runs: expected one reference "
            "or more, and as many coarse runs or none."
        )
    name = "the coarse run" if rollouts else "the reference"
    scenes = [_scene("the reference", run) for run in references]
    for k, run in enumerate(rollouts):
        own = _scene(name, run)
        _check_same("the reference and the coarse run", scenes[k], own, (*_BODY, "loads"))
        _check_times(run, references[k])
        scenes[k] = own
    problem = coarse_problem(name, scenes[0], _step(references[0]))
    problems, motions = [], []
    for k, (run, scene) in enumerate(zip(references, scenes, strict=True)):
        _check_same(f"simulations 0 and {k}", scenes[0], scene, (*_BODY, "solver"))
        if not np.isclose(_step(run), problem.time_step, rtol=1e-6):
            raise InputError(f"simulations 0 and {k} have unlike time steps: expected equal ones.")
        loaded = problem.with_loads(scene.loads)
        told = loaded.scene.with_changes(name=scene.name, time={"frames": scene.time.frames})
        problems.append(replace(loaded, scene=told))
        other = _restricted(rollouts[k], problem) if rollouts else None
        motions.append(ImportedMotion(restrict(run, problem).positions, coarse=other))
    about = {"dataset": dataset, "split": split, "number": number}
    return shard_of(arrays_of(problem), motions, problems, problem.time_step, about, best)


def _scene(name: str, run: Trajectory) -> Scene:
    """The scene of a run that a file of a data set can be made of."""
    if not run.scene_toml:
        raise InputError(
            f"{name} has no scene: expected a run of pdcorrect simulate; for others use "
            "shard_from_arrays."
        )
    if run.attributes.get("material") == "changed after the scene":
        raise InputError(
            f"{name} has another material than its scene, changed after it was read: expected "
            "the scene's; for others use shard_from_arrays."
        )
    scene = Scene.from_toml(run.scene_toml)
    for found in (scene.time.integrator, str(run.attributes.get("integrator", INTEGRATOR))):
        check_integrator(name, found)
    if run.times[0] != 0 or run.velocities[0].any():
        raise InputError(
            f"{name} starts at {run.times[0]:g} s with velocities up to "
            f"{np.abs(run.velocities[0]).max():.3g} m/s: expected a start at 0 s, at rest."
        )
    return scene


def _check_same(names: str, one: Scene, other: Scene, sections: Sequence[str]) -> None:
    for section in sections:
        if getattr(one, section) != getattr(other, section):
            raise InputError(f"the scenes of {names} differ in {section}: expected equal ones.")


def _restricted(coarse: Trajectory, problem: Problem) -> Array:
    if len(coarse.points) != len(problem.positions):
        raise InputError(
            f"the coarse run has {len(coarse.points)} nodes, the coarse mesh of its scene "
            f"{len(problem.positions)}: expected a run with --refine 1."
        )
    return restrict(coarse, problem).positions


def _check_times(coarse: Trajectory, run: Trajectory) -> None:
    if coarse.times.shape != run.times.shape or not np.allclose(
        coarse.times, run.times, rtol=1e-6, atol=0
    ):
        raise InputError(
            f"the coarse run has {len(coarse)} steps up to {coarse.times[-1]:g} s, the reference "
            f"{len(run)} up to {run.times[-1]:g} s: expected equal times."
        )


def _step(run: Trajectory) -> float:
    steps = np.diff(run.times)
    if not len(steps) or not np.allclose(steps, steps[0], rtol=1e-6, atol=0):
        raise InputError("the reference: expected one step or more, equally far apart in time.")
    return float((run.times[-1] - run.times[0]) / len(run))
