"""Trajectory files and ``.npz`` files, made files of a data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.importing import INTEGRATOR, ImportedMotion, check_element, shard_from_arrays
from pdcorrect.data.schema import CONFIG, SUFFIX, Shard, write_shard
from pdcorrect.errors import FileFormatError, InputError
from pdcorrect.fem.problem import discretise
from pdcorrect.io.trajectory import load_trajectory
from pdcorrect.scene import Scene
from pdcorrect.solvers.rollout import restrict
from pdcorrect.trajectory import Trajectory

Array = NDArray[Any]


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

    The scenes in the runs give mesh, material, clamps and loads, and the coarse runs' where
    there are any, else the references', element and masses of the coarse model.  References
    are restricted to the coarse nodes; predictions are computed with `ProjectiveDynamics` on
    the coarse mesh.

    Parameters
    ----------
    reference : Trajectory or sequence of Trajectory
        Of refined meshes, with their scenes.
    coarse : Trajectory or sequence of Trajectory, optional
        Rollouts of the coarse model, as many.
    dataset, split, number, best
        See `shard_from_arrays`.

    Raises
    ------
    InputError
        If a run has no scene, another material than it, another integrator than backward
        Euler or does not start at rest, the coarse model has an element with nodes besides the
        corners of the cells, the runs differ in mesh, material, clamps or time step,
        a coarse run also in loads from its reference, or a check of `shard_from_arrays` fails.
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
        _shard_of_run(run, rollouts[k] if rollouts else None, dataset, split, number, best)
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
    best: bool = False,
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
    split, number, best
        See `shard_from_arrays`; ``best`` of trajectories only.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    FileFormatError, InputError, OutputError
        If a file cannot be read or fails a check, the folder is that of a generated data set,
        or the file exists already or cannot be written.
    """
    if (Path(folder) / CONFIG).exists():
        raise InputError(
            f"{folder} holds {CONFIG}, as a generated data set: expected a folder of its own for "
            "imported files."
        )
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
        shard = _shard_of_npz(files[0], name, split, number, best)
    else:
        runs, others = ([load_trajectory(f) for f in each] for each in (files, coarse))
        shard = shard_from_trajectories(
            runs, others, dataset=name, split=split, number=number, best=best
        )
    write_shard(path, replace(shard, provenance={"sources": ", ".join(map(str, files))}))
    return path


_NEEDED = ("points", "cells", "free", "young", "poisson", "density", "time_step")
_MOTION = ("reference", "forces", "coarse", "predictions")
_BODY = ("body", "material", "materials", "clamps", "loads", "damping")
"""Sections of a scene in which a reference and its coarse run must agree."""


def _shard_of_npz(path: Path, dataset: str, split: str, number: int, best: bool) -> Shard:
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
        return shard_from_arrays(
            motions=motions, mass=mass, dataset=dataset, split=split, number=number, best=best,
            **arrays,
        )  # fmt: skip
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def _names_of(number: int, arrays: Mapping[str, Array]) -> dict[str, str]:
    """Arrays of a simulation by what they are; none where it has no reference."""
    for end in (f"_{number}", "") if number == 0 else (f"_{number}",):
        if f"reference{end}" in arrays:
            return {name: f"{name}{end}" for name in _MOTION if f"{name}{end}" in arrays}
    return {}


def _shard_of_run(
    run: Trajectory,
    coarse: Trajectory | None,
    dataset: str,
    split: str,
    number: int,
    best: bool,
) -> Shard:
    scene = _scene("the reference", run)
    if coarse is not None:
        scene = _scene_of_coarse(coarse, run, scene)
    check_element("the reference" if coarse is None else "the coarse run", scene)
    problem = discretise(scene)
    step = _uniform_step(run)
    if coarse is not None and len(coarse.points) != len(problem.positions):
        raise InputError(
            f"the coarse run has {len(coarse.points)} nodes, the coarse mesh of its scene "
            f"{len(problem.positions)}: expected a run with --refine 1."
        )
    rollout = None if coarse is None else restrict(coarse, problem).positions
    motion = ImportedMotion(restrict(run, problem).positions, coarse=rollout)
    materials = problem.materials
    return shard_from_arrays(
        problem.mesh.positions, problem.mesh.cells, [motion],
        free=problem.free[: len(problem.mesh.positions)], young=materials.young,
        poisson=materials.poisson, density=materials.density, time_step=step,
        dataset=dataset, split=split, number=number, scene=scene, best=best,
    )  # fmt: skip


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
    for found in (scene.time.integrator, run.attributes.get("integrator", INTEGRATOR)):
        if found != INTEGRATOR:
            raise InputError(
                f"{name} has the integrator {found!r}: expected {INTEGRATOR!r}, for the velocities "
                "of a data set are backward differences of its positions."
            )
    if run.times[0] != 0 or run.velocities[0].any():
        raise InputError(
            f"{name} starts at {run.times[0]:g} s with velocities up to "
            f"{np.abs(run.velocities[0]).max():.3g} m/s: expected a start at 0 s, at rest."
        )
    return scene


def _scene_of_coarse(coarse: Trajectory, run: Trajectory, reference: Scene) -> Scene:
    """The scene of a coarse run, if it simulates the same as the reference."""
    scene = _scene("the coarse run", coarse)
    for section in _BODY:
        if getattr(scene, section) != getattr(reference, section):
            raise InputError(
                f"the scenes of the reference and the coarse run differ in {section}: expected "
                f"equal {', '.join(_BODY)}."
            )
    if coarse.times.shape != run.times.shape or not np.allclose(
        coarse.times, run.times, rtol=1e-6, atol=0
    ):
        raise InputError(
            f"the coarse run has {len(coarse)} steps up to {coarse.times[-1]:g} s, the reference "
            f"{len(run)} up to {run.times[-1]:g} s: expected equal times."
        )
    return scene


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
    if not np.isclose(shard.attributes["time_step"], first.attributes["time_step"], rtol=1e-6):
        raise InputError(f"simulations 0 and {k} have unlike time steps: expected equal ones.")
