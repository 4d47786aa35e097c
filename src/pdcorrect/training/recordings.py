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

from pdcorrect.data.folder import shard_paths
from pdcorrect.data.schema import PLAIN, REFERENCE, Shard
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.data.simulate import rebuilt_problems
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Base, Problem
from pdcorrect.training.losses import LEAST_ERROR, BaseErrors

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulation."""

    path: Path  # the file, which has one mesh
    dataset: str
    config_hash: str
    content_hash: str
    split: str
    number: int  # on its mesh
    # (T+1, N, 3): the reference, and the rollout of the plain coarse model, m
    reference: Array
    plain: Array
    # mean squared errors of the base model, m2, see `pdcorrect.training.losses`
    one_step: float
    rollout: float

    @property
    def steps(self) -> int:
        """T."""
        return len(self.reference) - 1

    @property
    def name(self) -> str:
        """For messages and tables."""
        return f"{self.dataset}, {self.split}/{self.path.stem}/{self.number}"


def load_recordings(
    folder: str | Path,
    split: str,
    base: Base,
    *,
    scenes: bool = True,
    without: Collection[str] = (),
) -> list[Recording]:
    """The simulations of a split, mesh by mesh, without those of files in ``without``.

    ``scenes`` says whether the base model is to step again, for which it takes the scenes.
    """
    found = []
    for path in shard_paths(folder, split, without):
        runs = dict.fromkeys(_runs(base), ("positions", "predictions"))
        shard = read_shard(path, runs=runs)
        _check_complete(path, shard, base, scenes)
        found += [
            _recording(path, shard, number, split, base) for number in range(len(shard.simulations))
        ]
    return found


def base_errors(recordings: Sequence[Recording], device: str | torch.device = "cpu") -> BaseErrors:
    """Of some simulations, in their order."""
    values = [[r.one_step for r in recordings], [r.rollout for r in recordings]]
    return BaseErrors(*torch.tensor(values, dtype=torch.float64, device=device))


def make_problems(recordings: Sequence[Recording], base: Base) -> list[Problem]:
    """The base model's problems; those of one mesh share its discretisation."""
    known: dict[Path, list[Problem]] = {}
    for path in dict.fromkeys(recording.path for recording in recordings):
        known[path] = rebuilt_problems(read_shard(path, runs=(base,)), path, base)
    return [known[recording.path][recording.number] for recording in recordings]


def data_hash(recordings: Sequence[Recording]) -> str:
    """SHA-256 of the content hashes of the files of some simulations, in their order."""
    digest = hashlib.sha256()
    for path, one in {recording.path: recording for recording in recordings}.items():
        digest.update(f"{one.split}/{path.name} {one.content_hash}\n".encode())
    return digest.hexdigest()


def _check_complete(path: Path, shard: Shard, base: Base, scenes: bool) -> None:
    """Refuse a file of which a simulation lacks what a training of ``base`` needs."""
    for number, simulation in enumerate(shard.simulations):
        runs = simulation.runs
        single = runs[base].predictions if base in runs else None
        lacks = ["scene"] if scenes and not simulation.scene_toml else []
        lacks += [
            f"rollout of run {name!r}"
            for name in _runs(base)
            if name not in runs or runs[name].positions is None
        ]
        lacks += [f"single steps of run {base!r}"] if single is None else []
        if lacks:
            raise InputError(
                f"{path}: simulation {number} has no {', no '.join(lacks)}: expected what a "
                f"training with base = {base!r} needs."
            )


def _runs(base: Base) -> tuple[str, ...]:
    """Whose rollouts are needed."""
    return tuple(dict.fromkeys((REFERENCE, PLAIN, base)))


def _recording(path: Path, shard: Shard, number: int, split: str, base: Base) -> Recording:
    """A simulation that lacks nothing, see `_check_complete`."""
    runs = shard.simulations[number].runs
    reference, plain, rollout = (np.asarray(runs[n].positions) for n in (REFERENCE, PLAIN, base))
    return Recording(
        path=path,
        dataset=str(shard.attributes["dataset"]),
        config_hash=str(shard.attributes["config_hash"]),
        content_hash=shard.content_hash,
        split=split,
        number=number,
        reference=reference,
        plain=plain,
        one_step=_mean_square(np.asarray(runs[base].predictions), reference[1:]),
        rollout=_mean_square(rollout[1:], reference[1:]),
    )


def _mean_square(x: Array, y: Array) -> float:
    """Mean over frames and nodes of the squared distance, m2; at least what rounding makes."""
    distance = x.astype(np.float64) - y
    return max(float((distance**2).sum(axis=2).mean()), rounding(y), LEAST_ERROR)


def rounding(positions: Array) -> float:
    """Squared distance that storing positions in their type may make, m2."""
    size = float(np.abs(positions).max(initial=0.0))
    return (size * float(np.finfo(positions.dtype).eps)) ** 2
