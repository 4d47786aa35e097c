"""Trajectory files and ``.npz`` files, made files of a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.import_checks import finite_array
from pdcorrect.data.importing import Motion, shard_from_arrays
from pdcorrect.data.schema import SUFFIX, Shard, write_shard
from pdcorrect.errors import FileFormatError, InputError
from pdcorrect.fem.problem import discretise
from pdcorrect.io.trajectory import load_trajectory
from pdcorrect.scene import Scene
from pdcorrect.solvers.rollout import restrict
from pdcorrect.state import Trajectory

Array = NDArray[Any]


def shard_from_trajectories(
    reference: Trajectory | Sequence[Trajectory],
    coarse: Trajectory | Sequence[Trajectory] | None = None,
    *,
    dataset: str = "imported",
    split: str = "training",
    number: int = 0,
) -> Shard:
    """A file of a data set from runs of ``pdcorrect simulate`` on one mesh, checked.

    The scenes in the runs give mesh, material, clamps and loads.  References are restricted
    to the coarse nodes; predictions are computed with `ProjectiveDynamics` on the coarse mesh.

    Parameters
    ----------
    reference : Trajectory or sequence of Trajectory
        Of refined meshes, with their scenes.
    coarse : Trajectory or sequence of Trajectory, optional
        Rollouts of the coarse model, as many.
    dataset, split, number
        See `shard_from_arrays`.

    Raises
    ------
    InputError
        If a run has no scene, the scenes differ in mesh, material, clamps or time step, or
        a check of `shard_from_arrays` fails.
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
        _shard_of_run(run, rollouts[k] if rollouts else None, dataset, split, number)
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
    starts_at_rest: bool = True,
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
    split, number, starts_at_rest
        See `shard_from_arrays`.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    FileFormatError, InputError, OutputError
        If a file cannot be read, fails a check, or the file exists already or cannot be written.
    """
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
        shard = _shard_of_npz(files[0], name, split, number, starts_at_rest)
    else:
        runs, others = ([load_trajectory(f) for f in each] for each in (files, coarse))
        shard = shard_from_trajectories(runs, others, dataset=name, split=split, number=number)
    write_shard(path, replace(shard, provenance={"sources": ", ".join(map(str, files))}))
    return path


_SCALARS = ("young", "poisson", "density")
_MOTION = ("reference", "forces", "coarse", "predictions")


def _shard_of_npz(path: Path, dataset: str, split: str, number: int, starts_at_rest: bool) -> Shard:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, EOFError) as error:
        raise FileFormatError(f"{path}: cannot be read as .npz ({error}).") from None
    needed = ("points", "cells", "free", *_SCALARS, "time_step")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise InputError(f"{path}: no array {missing[0]!r}: expected {', '.join(needed)}.")
    try:
        return shard_from_arrays(
            arrays["points"], arrays["cells"], _motions(path, arrays), free=arrays["free"],
            **{name: arrays[name] for name in _SCALARS},
            time_step=float(finite_array("time_step", arrays["time_step"], ())),
            mass=arrays.get("mass"), dataset=dataset, split=split, number=number,
            starts_at_rest=starts_at_rest,
        )  # fmt: skip
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def _motions(path: Path, arrays: dict[str, Array]) -> list[Motion]:
    if "reference" in arrays:
        return [Motion(**{name: arrays[name] for name in _MOTION if name in arrays})]
    motions: list[Motion] = []
    while f"reference_{len(motions)}" in arrays:
        names = {name: f"{name}_{len(motions)}" for name in _MOTION}
        motions.append(Motion(**{k: arrays[name] for k, name in names.items() if name in arrays}))
    if not motions:
        raise InputError(f"{path}: no array 'reference' or 'reference_0'.")
    return motions


def _shard_of_run(
    run: Trajectory, coarse: Trajectory | None, dataset: str, split: str, number: int
) -> Shard:
    if not run.scene_toml:
        raise InputError(
            "the reference has no scene: expected a run of pdcorrect simulate; for others use "
            "shard_from_arrays."
        )
    scene = Scene.from_toml(run.scene_toml)
    problem = discretise(scene)
    step = _uniform_step(run)
    rollout = None if coarse is None else restrict(coarse, problem).positions
    motion = Motion(restrict(run, problem).positions, coarse=rollout)
    materials = problem.materials
    return shard_from_arrays(
        problem.mesh.positions, problem.mesh.cells, [motion],
        free=problem.free[: len(problem.mesh.positions)], young=materials.young,
        poisson=materials.poisson, density=materials.density, time_step=step,
        dataset=dataset, split=split, number=number, scene=scene,
    )  # fmt: skip


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
    steps = [float(each.attributes["time_step"]) for each in (first, shard)]
    if not math.isclose(*steps, rel_tol=1e-6):
        raise InputError(
            f"simulations 0 and {k} have steps of {steps[0]:g} and {steps[1]:g} s: expected equal "
            "ones in a file."
        )
