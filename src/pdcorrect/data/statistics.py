"""Means, deviations and ranges of what a network sees, over the training split."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial, reduce
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import ctrl_c_ignored, write_text
from pdcorrect.data.configuration import TRAINING
from pdcorrect.data.folder import Damage, shard_paths, whole_files
from pdcorrect.data.schema import NORMALISATION
from pdcorrect.data.shard_arrays import (
    MeshArrays,
    MotionArrays,
    ShardHeader,
    read_arrays,
    read_header,
)
from pdcorrect.errors import FileFormatError, InputError

VERSION = 1
_FILES_A_PROCESS = 16
"""At least; a process takes some seconds to start, a file some hundredths of a second."""
_MOST_PROCESSES = 60
"""Windows waits for no more."""

Array = NDArray[np.float64]
_Parts = list[dict[str, "ComponentMoments"]]
_Work = Callable[[Path], _Parts]
Spread = Callable[[_Work, list[Path]], Iterable[_Parts]]
"""Results of a function of each path, in order."""


@dataclass(frozen=True, eq=False)
class ComponentMoments:
    """Of values with d components.

    Attributes
    ----------
    count : (d,) float64
        Values of each component.
    mean, deviation, minimum, maximum : (d,) float64
        ``deviation`` is the root of the mean squared distance from the mean.
    """

    count: Array
    mean: Array
    deviation: Array
    minimum: Array
    maximum: Array

    @classmethod
    def of(cls, values: NDArray[Any], chosen: NDArray[np.bool_] | None = None) -> ComponentMoments:
        """Of values (n, d), those ``chosen`` (n, d) where given."""
        if chosen is None:
            chosen = np.ones(values.shape, dtype=bool)
        values = np.asarray(values, dtype=np.float64)
        count = chosen.sum(axis=0).astype(np.float64)
        sums = values.sum(axis=0, where=chosen)
        mean = np.divide(sums, count, out=np.zeros_like(sums), where=count > 0)
        squares = ((values - mean) ** 2).sum(axis=0, where=chosen)
        return cls(
            count, mean, np.sqrt(squares / np.maximum(count, 1)),
            values.min(axis=0, where=chosen, initial=np.inf),
            values.max(axis=0, where=chosen, initial=-np.inf),
        )  # fmt: skip

    def repeated(self, times: int) -> ComponentMoments:
        """As if every value came so many times."""
        return ComponentMoments(
            times * self.count, self.mean, self.deviation, self.minimum, self.maximum
        )

    def merged(self, other: ComponentMoments) -> ComponentMoments:
        """Of both sets of values together (Chan, Golub and LeVeque 1979)."""
        count = self.count + other.count
        share = np.divide(other.count, count, out=np.zeros_like(count), where=count > 0)
        away = other.mean - self.mean
        variance = (1 - share) * self.deviation**2 + share * other.deviation**2
        variance += share * (1 - share) * away**2
        return ComponentMoments(
            count, self.mean + share * away, np.sqrt(variance),
            np.minimum(self.minimum, other.minimum), np.maximum(self.maximum, other.maximum),
        )  # fmt: skip

    def to_json(self) -> dict[str, list[float]]:
        """Lists of numbers."""
        return {name: getattr(self, name).tolist() for name in _MOMENTS}


_MOMENTS = ("count", "mean", "deviation", "minimum", "maximum")


@dataclass(frozen=True, eq=False)
class Statistics:
    """Of the training split, each window of one step counted once.

    Attributes
    ----------
    quantities : mapping of str to ComponentMoments
        By node: ``velocity`` (m/s), ``force`` (N), ``displacement`` (distance from rest, m),
        ``log_young`` (log Pa), ``poisson``, ``density`` (kg/m3).  By directed edge:
        ``rest_edge``, ``edge`` (vector from the first to the second node, at rest and in the
        window's first frame, m), ``rest_edge_length``, ``edge_length`` (m).  By free component:
        ``correction/NAME``, the reference minus the prediction of that run, m.
    config_hash : str
        Of the data set.
    shards : mapping of str to str
        Content hash of each file of the split, by its name.
    damaged : mapping of Path to str
        Files that were left out, and what is wrong with them; not saved.
    """

    quantities: Mapping[str, ComponentMoments]
    config_hash: str
    shards: Mapping[str, str]
    damaged: Mapping[Path, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> ComponentMoments:
        if name not in self.quantities:
            raise InputError(
                f"no statistics of {name!r}: expected one of {', '.join(self.quantities)}."
            )
        return self.quantities[name]

    def save(self, folder: str | Path) -> Path:
        """Write ``statistics.json`` into the data set's folder.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        path = Path(folder) / NORMALISATION
        content = {
            "version": VERSION,
            "config_hash": self.config_hash,
            "shards": dict(self.shards),
            "quantities": {name: m.to_json() for name, m in self.quantities.items()},
        }
        write_text(path, json.dumps(content, indent=1) + "\n")
        return path


def compute_statistics(
    folder: str | Path,
    *,
    skip_damaged: bool = False,
    processes: int = 1,
    spread: Spread | None = None,
) -> Statistics:
    """Statistics of a data set's training split.

    Corrections are those of every run that has predictions in all its simulations.

    Parameters
    ----------
    folder : path
    skip_damaged : bool
        Leave out files that are damaged; all files are read twice then.
    processes : int
        At most so many share the files where there are many; the result has the same bits.
    spread : callable, optional
        Has others do the work in place of such processes: takes a function and a list, and
        returns the function's results in order, as ``map`` does.

    Raises
    ------
    InputError
        If there is no training split, or its files come from different configurations.
    FileFormatError
        If a file is damaged; with ``skip_damaged`` if all are.
    """
    damaged: Damage = {}
    paths = whole_files(shard_paths(folder, TRAINING), damaged if skip_damaged else None)
    headers = [read_header(path) for path in paths]
    config_hash, shards = _identity(headers)
    bases = frozenset.intersection(*(names for h in headers for _, names in h.runs))
    work = partial(_parts, bases=sorted(bases))
    found = _all_merged(spread(work, paths)) if spread else _moments(work, paths, processes)
    return Statistics(found, config_hash, shards, damaged)


def _moments(work: _Work, paths: list[Path], processes: int) -> dict[str, ComponentMoments]:
    """Of all files, in their order."""
    count = min(processes, len(paths) // _FILES_A_PROCESS, _MOST_PROCESSES)
    if count > 1:
        # A process may be killed, for want of memory say; this one then does its work.
        with contextlib.suppress(BrokenProcessPool):
            return _moments_by_several(work, paths, count)
    return _all_merged(map(work, paths))


def _moments_by_several(work: _Work, paths: list[Path], count: int) -> dict[str, ComponentMoments]:
    pool = ProcessPoolExecutor(count, get_context("spawn"))
    try:
        with ctrl_c_ignored():
            found = pool.map(work, paths, chunksize=_FILES_A_PROCESS // 4)
        return _all_merged(found)
    finally:
        pool.shutdown(cancel_futures=True)


def _all_merged(files: Iterable[_Parts]) -> dict[str, ComponentMoments]:
    return reduce(_merged, chain.from_iterable(files))


def load_statistics(folder: str | Path) -> Statistics:
    """The statistics that lie in a data set's folder.

    Raises
    ------
    FileFormatError
        If the file is missing or damaged.
    InputError
        If it was computed from other files than are there now.
    """
    path = Path(folder) / NORMALISATION
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = Statistics(
            {
                name: ComponentMoments(**{part: np.array(values[part]) for part in _MOMENTS})
                for name, values in content["quantities"].items()
            },
            content["config_hash"],
            content["shards"],
        )
    except FileNotFoundError:
        raise FileFormatError(
            f"{path}: there is no such file: expected compute_statistics(folder).save(folder)."
        ) from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{path}: damaged or something else ({error}).") from None
    config_hash, shards = _identity([read_header(p) for p in shard_paths(folder, TRAINING)])
    if (config_hash, shards) == (found.config_hash, dict(found.shards)):
        return found
    names = sorted(n for n in shards.keys() | found.shards if shards.get(n) != found.shards.get(n))
    more = f" (and {len(names) - 1} more)" if len(names) > 1 else ""
    changed = f"{names[0]}{more}" if names else "the configuration"
    raise InputError(
        f"{path}: stale: {changed} has changed since: expected "
        "compute_statistics(folder).save(folder)."
    )


def _identity(headers: list[ShardHeader]) -> tuple[str, dict[str, str]]:
    """The configuration's hash and the content hashes of all files."""
    configs = {header.config_hash for header in headers}
    if len(configs) > 1:
        raise InputError(
            f"{headers[0].path.parent}: files of {len(configs)} configurations: expected one."
        )
    return configs.pop(), {header.path.name: header.content_hash for header in headers}


def _parts(path: Path, bases: list[str]) -> _Parts:
    """ComponentMoments of a file's mesh, then of each of its simulations."""
    mesh, motions = read_arrays(path, bases)
    steps = sum(len(motion.forces) for motion in motions)
    whole = {name: moments.repeated(steps) for name, moments in _of_mesh(mesh).items()}
    return [whole, *(_of_motion(mesh, motion) for motion in motions)]


def _of_mesh(mesh: MeshArrays) -> dict[str, ComponentMoments]:
    first, second = mesh.edge_index
    edges = mesh.rest[second] - mesh.rest[first]
    return {
        "log_young": ComponentMoments.of(np.log(mesh.young)[:, None]),
        "poisson": ComponentMoments.of(mesh.poisson[:, None]),
        "density": ComponentMoments.of(mesh.density[:, None]),
        "rest_edge": ComponentMoments.of(edges),
        "rest_edge_length": ComponentMoments.of(_lengths(edges)),
    }


def _of_motion(mesh: MeshArrays, motion: MotionArrays) -> dict[str, ComponentMoments]:
    first, second = mesh.edge_index
    starts = motion.positions[:-1].astype(np.float64)
    edges = (starts[:, second] - starts[:, first]).reshape(-1, 3)
    free = np.broadcast_to(mesh.free, starts.shape).reshape(-1, 3)
    targets = motion.positions[1:].astype(np.float64)
    return {
        "velocity": ComponentMoments.of(motion.velocities.reshape(-1, 3)),
        "force": ComponentMoments.of(motion.forces.reshape(-1, 3)),
        "displacement": ComponentMoments.of(_lengths((starts - mesh.rest).reshape(-1, 3))),
        "edge": ComponentMoments.of(edges),
        "edge_length": ComponentMoments.of(_lengths(edges)),
        **{
            f"correction/{name}": ComponentMoments.of((targets - predicted).reshape(-1, 3), free)
            for name, predicted in motion.predictions.items()
        },
    }


def _lengths(vectors: Array) -> Array:
    """(n, 1)."""
    return np.linalg.norm(vectors, axis=1, keepdims=True)


def _merged(
    one: dict[str, ComponentMoments], other: dict[str, ComponentMoments]
) -> dict[str, ComponentMoments]:
    both: Iterable[str] = one.keys() & other.keys()
    return {**one, **other, **{name: one[name].merged(other[name]) for name in both}}
