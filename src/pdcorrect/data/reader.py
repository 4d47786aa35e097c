"""`TrajectoryDataset`: windows of a data set's simulations for PyTorch Geometric."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.cache import RecentlyUsed
from pdcorrect.data.damage import Damage, whole_files
from pdcorrect.data.folder import shard_paths
from pdcorrect.data.sampling import ShardShuffle
from pdcorrect.data.shard_arrays import (
    MeshArrays,
    MotionArrays,
    ShardHeader,
    read_arrays,
    read_header,
)
from pdcorrect.errors import InputError, require_extra

require_extra("torch_geometric", "learn")

import torch  # noqa: E402
from torch import Tensor  # noqa: E402
from torch.utils.data import BatchSampler, DataLoader, SequentialSampler  # noqa: E402
from torch_geometric.data import Batch, Data, Dataset  # noqa: E402

CACHE_BYTES = 4 * 2**30
"""Default bound of the decoded files that a process keeps, bytes."""

_MESH = ("rest", "free", "mass", "young", "poisson", "density")
_CELLS = ("cell_young", "cell_poisson", "cell_density")
_GRAPHS = ("mesh", "simulation", "frame", "time", "time_step")
_INDICES = ("cells", "edge_index")
_ALIGNMENT = 64
"""Bytes."""


class MeshSample(Data):
    """A window of a simulation on its mesh; batching renumbers ``cells`` like ``edge_index``."""

    def __inc__(self, key: str, value: Any, *args: Any, **kwargs: Any) -> Any:
        """By how much the next graph's values are raised."""
        return self.num_nodes if key == "cells" else super().__inc__(key, value, *args, **kwargs)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Tensors of a simulation, frame first."""

    positions: Tensor
    velocities: Tensor
    steps: dict[str, Tensor]
    rollouts: dict[str, Tensor]

    def window(self, frame: int, length: int) -> dict[str, Tensor]:
        """Node by node what happens in ``length`` steps from a frame, as views."""
        last = frame + length
        found = {
            "positions": self.positions[frame],
            "velocities": self.velocities[frame],
            "targets": self.positions[frame + 1 : last + 1].transpose(0, 1),
        }
        for name, values in self.steps.items():
            found[name] = values[frame:last].transpose(0, 1)
        for name, values in self.rollouts.items():
            found[name] = values[frame : last + 1].transpose(0, 1)
        return found


@dataclass(frozen=True, eq=False)
class _Shard:
    """Tensors of a file."""

    nodal: dict[str, Tensor]
    cellwise: dict[str, Tensor]
    cells: Tensor
    edge_index: Tensor
    motions: list[_Motion]


def _bytes(shard: _Shard) -> int:
    """What a file's tensors take."""
    found = [shard.cells, shard.edge_index, *shard.nodal.values(), *shard.cellwise.values()]
    for motion in shard.motions:
        found += [motion.positions, motion.velocities]
        found += [*motion.steps.values(), *motion.rollouts.values()]
    return sum(tensor.numel() * tensor.element_size() for tensor in found)


class _Place(NamedTuple):
    """Where a window is."""

    header: ShardHeader
    shard: _Shard
    simulation: int
    motion: _Motion
    frame: int


class TrajectoryDataset(Dataset):  # type: ignore[misc]
    """Windows of ``window`` + 1 successive reference frames of a split's simulations.

    Item i is a `MeshSample` of a mesh with n nodes, E directed edges and c cells, for a
    window of k steps from frame t on:

    ==============================  =========================================================
    ``positions``                   (n, 3), the reference in frame t, m
    ``velocities``                  (n, 3), (p_t - p_(t-1)) / h, zero in frame 0, m/s
    ``targets``                     (n, k, 3), the reference in frames t + 1 .. t + k, m
    ``predictions``                 (n, k, 3), one step of the base model from the reference
                                    in frames t .. t + k - 1, m; without ``base`` absent
    ``forces``                      (n, k, 3), loads of these steps, N
    ``run_NAME``                    (n, k + 1, 3), the run's own rollout in frames t .. t + k, m
    ``rest``, ``free``, ``mass``    (n, 3), m; (n, 3) bool; (n,), kg
    ``young``, ``poisson``,         (n,), means over the cells of a node, Pa, -, kg/m3; with
    ``density``                     ``cell_`` before the name (c,), for each cell
    ``edge_index``                  (2, E), each edge of a cell once in both directions
    ``cells``                       (c, 8), VTK order
    ``mesh``, ``simulation``,       (1,), number of the mesh in its split, of the simulation
    ``frame``                       on the mesh, and t
    ``time``, ``time_step``         (1,), of frame t, and h, s
    ==============================  =========================================================

    Files are decoded when first needed and kept in memory.  No file stays open, so the
    data set may be forked, spawned and pickled; a pickled copy starts with an empty memory.
    `batch` assembles many windows at once and is much quicker than
    ``Batch.from_data_list``; `TrajectoryLoader` uses it.

    Parameters
    ----------
    folder : path
        Of the data set.
    split : str
    window : int
        k.
    base : str, optional
        Run whose predictions are given, "plain" or "best"; None for data without.
    runs : sequence of str
        Runs whose own rollouts are given.
    cache_bytes : int
        Bound of the decoded files kept by each process that reads (each worker of a loader,
        or the main process).  While a file is read, and if a single one is larger, it is
        exceeded by that file.
    dtype : torch.dtype
        Of everything but indices and masks.
    skip_damaged : bool
        Leave out files that are damaged; all files are read once to find them.

    Attributes
    ----------
    damaged : dict of Path to str
        Files that were left out, and what is wrong with them.

    Raises
    ------
    InputError
        If there is no such split, its simulations lack a run, or all are shorter than k.
    FileFormatError
        If a file is damaged; with ``skip_damaged`` if all are.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str,
        *,
        window: int = 1,
        base: str | None = "plain",
        runs: Sequence[str] = (),
        cache_bytes: int = CACHE_BYTES,
        dtype: torch.dtype = torch.float32,
        skip_damaged: bool = False,
    ) -> None:
        super().__init__()
        if window < 1:
            raise InputError(f"window = {window}: expected 1 step or more.")
        self.folder, self.split = Path(folder), split
        self.window, self.base, self.runs, self.dtype = window, base, tuple(runs), dtype
        self.cache_bytes = cache_bytes
        self.damaged: Damage = {}
        paths = whole_files(shard_paths(folder, split), self.damaged if skip_damaged else None)
        self.headers = [read_header(path) for path in paths]
        for header in self.headers:
            _check_runs(header, base, self.runs)
        counts = [max(0, steps - window + 1) for h in self.headers for steps in h.steps]
        # Row by row: file, simulation, number of its first window; in the order of windows.
        self._owners = np.array(
            [(i, s) for i, h in enumerate(self.headers) for s in range(len(h.steps))]
        )
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        if not self._starts[-1]:
            longest = max((steps for h in self.headers for steps in h.steps), default=0)
            raise InputError(
                f"{self.folder}, {split}: no simulation has {window} steps, the longest "
                f"{longest}: expected a smaller window."
            )
        self._shards = RecentlyUsed(self._load, _bytes, cache_bytes)

    def len(self) -> int:
        """Number of windows."""
        return int(self._starts[-1])

    def get(self, idx: int) -> MeshSample:
        """Window ``idx``; its tensors are copies."""
        place = self._place(idx)
        shard = place.shard
        fields = {
            **place.motion.window(place.frame, self.window), **_numbers([place], self.dtype),
            **shard.nodal, **shard.cellwise, "cells": shard.cells, "edge_index": shard.edge_index,
        }  # fmt: skip
        copies = {name: values.clone().contiguous() for name, values in fields.items()}
        return MeshSample(num_nodes=len(shard.nodal["rest"]), **copies)

    def batch(self, indices: Sequence[int] | NDArray[np.int64]) -> Batch:
        """The windows at ``indices`` as one graph, equal to ``Batch.from_data_list``."""
        parts, sizes = self._collect(indices)
        values = {name: torch.cat(found, _joined_along(name)) for name, found in parts.items()}
        return _batch(values, sizes)

    def packed(self, indices: Sequence[int]) -> _Packed:
        """The same for another process."""
        return _Packed.join(*self._collect(indices))

    def _collect(
        self, indices: Sequence[int] | NDArray[np.int64]
    ) -> tuple[dict[str, list[Tensor]], _Sizes]:
        chosen = self.indices()
        places = [self._place(chosen[int(i)]) for i in indices]
        sizes = _sizes(places)
        return _parts(places, sizes, self.window, self.dtype), sizes

    def places(
        self, indices: Sequence[int] | NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Of the windows at ``indices``: file of the split, simulation of the file, frame, (B,).

        Raises
        ------
        IndexError
            If there is no such window.
        """
        numbers, chosen = np.asarray(indices, dtype=np.int64), self.indices()
        if not isinstance(chosen, range):
            numbers = np.asarray(chosen, dtype=np.int64)[numbers]
        for idx in numbers[(numbers < 0) | (numbers >= self.len())]:
            raise self._no_window(int(idx))
        rows = np.searchsorted(self._starts, numbers, side="right") - 1
        files, simulations = self._owners[rows].T
        return files, simulations, numbers - self._starts[rows]

    def decoded(self, file: int) -> _Shard:
        """A file's tensors, which are kept as far as memory allows."""
        return self._shards[file]

    def forget(self) -> None:
        """Drop all decoded files from memory."""
        self._shards = RecentlyUsed(self._load, _bytes, self.cache_bytes)

    def shard_numbers(self) -> NDArray[np.int64]:
        """For each window the number of its file in the split, (len(self),)."""
        every = np.repeat(self._owners[:, 0], np.diff(self._starts))
        return every[np.asarray(self.indices(), dtype=np.int64)]

    def shard_bytes(self) -> NDArray[np.int64]:
        """What each file takes in memory, about, bytes."""
        width = torch.empty((), dtype=self.dtype).element_size()
        arrays = 3 + (self.base is not None) + len(self.runs)
        return np.array([
            sum(h.steps) * h.nodes * 3 * width * arrays + h.nodes * 150 + h.cells * 100
            for h in self.headers
        ])  # fmt: skip

    def _place(self, idx: int) -> _Place:
        if not 0 <= idx < self.len():
            raise self._no_window(idx)
        row = int(np.searchsorted(self._starts, idx, side="right")) - 1
        number, simulation = self._owners[row].tolist()
        shard = self._shards[number]
        return _Place(
            self.headers[number], shard, simulation, shard.motions[simulation],
            idx - int(self._starts[row]),
        )  # fmt: skip

    def _no_window(self, idx: int) -> IndexError:
        return IndexError(f"window {idx}: expected 0 to {self.len() - 1}")

    def _load(self, number: int) -> _Shard:
        path = self.headers[number].path
        mesh, motions = read_arrays(path, (self.base,) if self.base else (), self.runs)
        return _tensors(mesh, motions, self.base, self.dtype)


class TrajectoryLoader(DataLoader[Any]):
    """Batches of a `TrajectoryDataset`, and where an epoch is.

    Parameters
    ----------
    dataset : TrajectoryDataset
    batch_size : int
    sampler : ShardShuffle, optional
        Windows in order without.
    drop_last : bool
        Leave out a last batch that is smaller.
    assemble : callable, optional
        Makes a batch, which knows its ``num_graphs``, of the numbers of its windows;
        `TrajectoryDataset.batch` by default.  Without worker processes.
    **options
        Of ``torch.utils.data.DataLoader``, such as ``num_workers``, ``persistent_workers``,
        ``multiprocessing_context`` and ``pin_memory``.
    """

    def __init__(
        self,
        dataset: TrajectoryDataset,
        batch_size: int,
        sampler: ShardShuffle | None = None,
        *,
        drop_last: bool = False,
        assemble: Callable[[Sequence[int]], Any] | None = None,
        **options: Any,
    ) -> None:
        self.shuffle, self.windows = sampler, batch_size
        order = SequentialSampler(dataset) if sampler is None else sampler
        self._position = 0 if sampler is None else sampler.position
        super().__init__(
            _Batches(dataset, assemble or dataset.batch),
            batch_size=None,
            sampler=BatchSampler(order, batch_size, drop_last),
            collate_fn=_unchanged,
            **options,
        )

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        """One epoch, or what is left of it."""
        done = 0 if self.shuffle is None else self.shuffle.start
        for found in super().__iter__():
            batch = found.batch() if isinstance(found, _Packed) else found
            done += batch.num_graphs
            self._position = done
            yield batch

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next epoch; the same epoch again changes nothing."""
        self._sampler().set_epoch(epoch)
        self._position = self._sampler().position

    def state_dict(self) -> dict[str, int]:
        """Where the epoch is, after the last batch that was handed out.

        Batches that workers have prepared ahead do not count.
        """
        return {**self._sampler().state_dict(), "position": self._position}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next epoch begin after the batch at which ``state`` was taken."""
        self._sampler().load_state_dict(state)
        self._position = self._sampler().position

    def _sampler(self) -> ShardShuffle:
        if self.shuffle is None:
            raise InputError("the loader reads in order: expected one with a ShardShuffle.")
        return self.shuffle


class _Batches(torch.utils.data.Dataset[Any]):
    """Lists of indices -> batches, from a worker packed."""

    def __init__(
        self, dataset: TrajectoryDataset, assemble: Callable[[Sequence[int]], Any]
    ) -> None:
        self.dataset, self.assemble = dataset, assemble

    def __getitem__(self, indices: list[int]) -> Any:
        in_worker = torch.utils.data.get_worker_info() is not None
        return self.dataset.packed(indices) if in_worker else self.assemble(indices)


def _unchanged(batch: Any) -> Any:
    return batch


def _check_runs(header: ShardHeader, base: str | None, runs: Sequence[str]) -> None:
    for k, (rollouts, predictions) in enumerate(header.runs):
        if base is not None and base not in predictions:
            raise InputError(
                f"{header.path}: simulation {k} has no predictions of run {base!r}: expected one "
                f"of {', '.join(sorted(predictions)) or 'none'} (base=None leaves them out)."
            )
        missing = sorted(set(runs) - rollouts)
        if missing:
            raise InputError(
                f"{header.path}: simulation {k} has no positions of run {missing[0]!r}: expected "
                f"some of {', '.join(sorted(rollouts))}."
            )


def _tensors(
    mesh: MeshArrays, motions: Sequence[MotionArrays], base: str | None, dtype: torch.dtype
) -> _Shard:
    def tensor(values: NDArray[Any]) -> Tensor:
        found = torch.from_numpy(values)
        return found.to(dtype) if found.is_floating_point() else found

    return _Shard(
        nodal={name: tensor(getattr(mesh, name)) for name in _MESH},
        cellwise={name: tensor(getattr(mesh, name)) for name in _CELLS},
        cells=tensor(mesh.cells),
        edge_index=tensor(mesh.edge_index),
        motions=[
            _Motion(
                positions=tensor(motion.positions),
                velocities=tensor(motion.velocities),
                steps={
                    "forces": tensor(motion.forces),
                    **({"predictions": tensor(motion.predictions[base])} if base else {}),
                },
                rollouts={f"run_{name}": tensor(x) for name, x in motion.rollouts.items()},
            )
            for motion in motions
        ],
    )


def _numbers(places: Sequence[_Place], dtype: torch.dtype) -> dict[str, Tensor]:
    """One number a window, (B,)."""
    which = np.array([(p.header.number, p.simulation, p.frame) for p in places])
    steps = np.array([p.header.time_step for p in places])
    seconds = torch.from_numpy(np.stack([which[:, 2] * steps, steps])).to(dtype)
    mesh, simulation, frame = torch.from_numpy(np.ascontiguousarray(which.T))
    return {
        "mesh": mesh, "simulation": simulation, "frame": frame, "time": seconds[0],
        "time_step": seconds[1],
    }  # fmt: skip


class _Sizes(NamedTuple):
    """Of each graph of a batch."""

    nodes: list[int]
    cells: list[int]
    edges: list[int]


def _sizes(places: Sequence[_Place]) -> _Sizes:
    return _Sizes(
        [len(place.shard.nodal["rest"]) for place in places],
        [len(place.shard.cells) for place in places],
        [place.shard.edge_index.shape[1] for place in places],
    )


def _parts(
    places: Sequence[_Place], sizes: _Sizes, length: int, dtype: torch.dtype
) -> dict[str, list[Tensor]]:
    """By field what is to be joined, in the order of `MeshSample`'s fields."""
    shards = [place.shard for place in places]
    windows = [place.motion.window(place.frame, length) for place in places]
    raised = list(zip(shards, _ends(sizes.nodes)[:-1].tolist(), strict=True))
    return {
        **{name: [fields[name] for fields in windows] for name in windows[0]},
        **{name: [values] for name, values in _numbers(places, dtype).items()},
        **{name: [shard.nodal[name] for shard in shards] for name in _MESH},
        **{name: [shard.cellwise[name] for shard in shards] for name in _CELLS},
        "cells": [shard.cells + first for shard, first in raised],
        "edge_index": [shard.edge_index + first for shard, first in raised],
    }


def _joined_along(name: str) -> int:
    return 1 if name == "edge_index" else 0


def _batch(values: dict[str, Tensor], sizes: _Sizes) -> Batch:
    """What ``Batch.from_data_list`` makes of the joined fields."""
    nodes, cells, edges = (_ends(each) for each in sizes)
    graphs, offsets = torch.arange(len(nodes)), nodes[:-1]
    ends = {
        **dict.fromkeys(_GRAPHS, graphs), **dict.fromkeys((*_CELLS, "cells"), cells),
        "edge_index": edges,
    }  # fmt: skip
    same = torch.zeros_like(offsets)
    batch = Batch(_base_cls=MeshSample)
    store = batch._store
    store.update(values)
    store._num_nodes, store.num_nodes = sizes.nodes, sum(sizes.nodes)
    store.batch = torch.from_numpy(np.repeat(np.arange(len(offsets)), sizes.nodes))
    store.ptr = nodes
    batch._num_graphs = len(offsets)
    batch._slice_dict = {name: ends.get(name, nodes) for name in values}
    batch._inc_dict = {name: offsets if name in _INDICES else same for name in values}
    return batch


@dataclass(frozen=True)
class _Packed:
    """A batch in one piece of shared memory, which passes between processes quickly."""

    memory: Tensor
    layout: dict[str, tuple[int, int, torch.dtype, list[int]]]
    sizes: _Sizes

    @classmethod
    def join(cls, parts: dict[str, list[Tensor]], sizes: _Sizes) -> _Packed:
        """Join the parts of each field, side by side."""
        layout, end = {}, 0
        for name, tensors in parts.items():
            dim, first = _joined_along(name), tensors[0]
            shape = list(first.shape)
            shape[dim] = sum(tensor.shape[dim] for tensor in tensors)
            start = -(-end // _ALIGNMENT) * _ALIGNMENT
            end = start + math.prod(shape) * first.element_size()
            layout[name] = (start, end, first.dtype, shape)
        storage = torch.UntypedStorage._new_shared(end)  # type: ignore[no-untyped-call]
        packed = cls(torch.empty(0, dtype=torch.uint8).set_(storage), layout, sizes)
        for name, tensors in parts.items():
            torch.cat(tensors, _joined_along(name), out=packed.field(name))
        return packed

    def field(self, name: str) -> Tensor:
        """A field, as a view."""
        start, end, dtype, shape = self.layout[name]
        return self.memory[start:end].view(dtype).view(shape)

    def pin_memory(self) -> _Packed:
        """The same in page-locked memory."""
        return replace(self, memory=self.memory.pin_memory())

    def batch(self) -> Batch:
        """The batch; its fields are views of the one piece."""
        return _batch({name: self.field(name) for name in self.layout}, self.sizes)


def _ends(sizes: Sequence[int]) -> Tensor:
    """Zero and the running sums."""
    return torch.from_numpy(np.cumsum([0, *sizes]))
