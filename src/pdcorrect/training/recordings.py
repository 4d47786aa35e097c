"""`Recording`: a simulation of a data set with what the hybrid is trained on and judged by."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pdcorrect.data.folder import Folders, folders_of, shard_paths
from pdcorrect.data.schema import PLAIN, REFERENCE, TOTAL_MASS, Shard, Simulation
from pdcorrect.data.shard_arrays import ShardHeader, read_header
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.data.simulate import rebuilt_problems
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Base, Problem
from pdcorrect.training.losses import LEAST_ERROR, BaseErrors

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulation.

    Attributes
    ----------
    path : Path
        The file, which has one mesh.
    dataset, config_hash, setting, split : str
    mesh, number : int
        Of the mesh in its split, and on the mesh.
    time_step : float
        s.
    reference, plain : (T+1, N, 3)
        The reference, and the rollout of the plain coarse model, m.
    one_step, rollout : float
        Mean squared errors of the base model, m2, see `pdcorrect.training.losses`.
    total_mass : float or None
        To which the base model's density is scaled, kg; None where it is not.
    """

    path: Path
    dataset: str
    config_hash: str
    setting: str
    split: str
    mesh: int
    number: int
    time_step: float
    reference: Array
    plain: Array
    one_step: float
    rollout: float
    total_mass: float | None = None

    @property
    def steps(self) -> int:
        """T."""
        return len(self.reference) - 1

    @property
    def name(self) -> str:
        """For messages and tables."""
        return f"{self.dataset}, {self.split}/mesh-{self.mesh:04d}/{self.number}"


def load_recordings(
    folder: Folders, split: str, base: Base, *, scenes: bool = True, without: Collection[str] = ()
) -> list[Recording]:
    """The simulations of a split, mesh by mesh.

    Parameters
    ----------
    folder : path, or sequence of paths
        Of the data set; of several, one after the other.
    split : str
    base : {"plain", "best", "total-mass"}
    scenes : bool
        Whether the base model is to step again, for which it takes the scenes.
    without : collection of str
        Files of each data set that are left out, see `pdcorrect.data.folder.shard_paths`.

    Raises
    ------
    InputError
        If there is no such split, or a simulation lacks a run or a scene that is needed; names
        the file and all that it lacks.
    FileFormatError
        If a file is damaged.
    """
    found = []
    for path in _paths(folder, split, without):
        _check_complete(read_header(path), base, scenes)
        shard = read_shard(path, verify=False, runs=_runs(base))
        for number, simulation in enumerate(shard.simulations):
            found.append(_recording(path, shard, simulation, number, split, base))
    return found


def base_errors(recordings: Sequence[Recording], device: str | torch.device = "cpu") -> BaseErrors:
    """Of some simulations, in their order."""
    values = [[r.one_step for r in recordings], [r.rollout for r in recordings]]
    return BaseErrors(*torch.tensor(values, dtype=torch.float64, device=device))


def make_problems(recordings: Sequence[Recording], base: Base) -> list[Problem]:
    """The base model's problems; those of one mesh share its discretisation.

    Raises
    ------
    InputError
        If a scene is not that of the recorded mesh.
    """
    known: dict[Path, list[Problem]] = {}
    for path in dict.fromkeys(recording.path for recording in recordings):
        known[path] = rebuilt_problems(read_shard(path, verify=False, runs=(base,)), path, base)
    return [known[recording.path][recording.number] for recording in recordings]


def data_hash(folder: Folders, splits: Sequence[str], without: Collection[str] = ()) -> str:
    """SHA-256 of the content hashes of the files of some splits, those left out left out."""
    digest, folders = hashlib.sha256(), folders_of(folder)
    for split in splits:
        for path in _paths(folders, split, without):
            digest.update(f"{split}/{path.name} {read_header(path).content_hash}\n".encode())
    return digest.hexdigest()


def _paths(folder: Folders, split: str, without: Collection[str]) -> list[Path]:
    """Files of a split of all data sets."""
    return [path for each in folders_of(folder) for path in shard_paths(each, split, without)]


def _check_complete(header: ShardHeader, base: Base, scenes: bool) -> None:
    """Refuse a file of which a simulation lacks what a training of ``base`` needs."""
    for number, (positions, predictions) in enumerate(header.runs):
        lacks = ["scene"] if scenes and not header.scenes[number] else []
        lacks += [f"rollout of run {n!r}" for n in _runs(base) if n not in positions]
        lacks += [f"single steps of run {base!r}"] if base not in predictions else []
        if lacks:
            raise InputError(
                f"{header.path}: simulation {number} has no {', no '.join(lacks)}: expected what a "
                f"training with base = {base!r} needs."
            )


def _runs(base: Base) -> tuple[str, ...]:
    """Whose rollouts are needed."""
    return tuple(dict.fromkeys((REFERENCE, PLAIN, base)))


def _recording(
    path: Path, shard: Shard, simulation: Simulation, number: int, split: str, base: Base
) -> Recording:
    """A simulation that lacks nothing, see `_check_complete`."""
    runs = simulation.runs
    reference, plain, rollout = (np.asarray(runs[n].positions) for n in (REFERENCE, PLAIN, base))
    mass = float(runs[base].attributes["total_mass"]) if base == TOTAL_MASS else None
    return Recording(
        path=path,
        dataset=str(shard.attributes["dataset"]),
        config_hash=str(shard.attributes["config_hash"]),
        setting=str(shard.attributes["setting"]),
        split=split,
        mesh=int(shard.attributes["number"]),
        number=number,
        time_step=float(shard.attributes["time_step"]),
        reference=reference,
        plain=plain,
        one_step=_mean_square(np.asarray(runs[base].predictions), reference[1:]),
        rollout=_mean_square(rollout[1:], reference[1:]),
        total_mass=mass,
    )


def _mean_square(x: Array, y: Array) -> float:
    """Mean over frames and nodes of the squared distance, m2.

    At least that of positions which differ by the rounding of their storage, which is
    nothing that can be learned.
    """
    distance = x.astype(np.float64) - y
    return max(float((distance**2).sum(axis=2).mean()), rounding(y), LEAST_ERROR)


def rounding(positions: Array) -> float:
    """Squared distance that storing positions in their type may make, m2."""
    size = float(np.abs(positions).max(initial=0.0))
    return (size * float(np.finfo(positions.dtype).eps)) ** 2
