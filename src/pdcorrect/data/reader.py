"""`TrajectoryDataset`: windows of a data set's simulations for PyTorch Geometric."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.folder import Damage, Folders, folders_of, read_files, shard_paths
from pdcorrect.data.samples import (
    DecodedShard,
    GraphSizes,
    MeshSample,
    PackedBatch,
    WindowPlace,
    batch_of,
    decode,
    decoded_bytes,
    graph_sizes,
    joined_along,
    joined_fields,
    window_numbers,
)
from pdcorrect.data.schema import REFERENCE
from pdcorrect.data.shard_reader import ShardHeader, read_header, read_shard
from pdcorrect.errors import InputError, require_extra

require_extra("torch_geometric", "learn")

import torch  # noqa: E402
from torch import Tensor  # noqa: E402
from torch.utils.data import BatchSampler, DataLoader, Sampler, SequentialSampler  # noqa: E402
from torch_geometric.data import Batch, Dataset  # noqa: E402


class ShardShuffle(Sampler[int]):
    """Windows in random order within random blocks of files.

    Each epoch shuffles the files, gives every rank an equal share of their windows (the
    last few, fewer than ranks, are left out), and shuffles the windows within blocks of
    ``block`` successive files.  Order depends on seed, epoch, rank and ``world_size`` alone:
    without `set_epoch` every epoch has the same.

    Parameters
    ----------
    dataset : TrajectoryDataset
    seed : int
    block : int, optional
        Files; by default as many as fit into the data set's cache.
    rank, world_size : int
        Of distributed training.

    Attributes
    ----------
    epoch : int
    position : int
        Windows of the epoch that were given out.
    start : int
        Where the next iteration begins.

    Raises
    ------
    InputError
        If there is no such rank, or there are fewer windows than ranks.
    """

    def __init__(
        self,
        dataset: TrajectoryDataset,
        *,
        seed: int = 0,
        block: int | None = None,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if not 0 <= rank < world_size:
            raise InputError(f"rank = {rank} of {world_size}: expected 0 to {world_size - 1}.")
        self._owners = dataset.shard_numbers()
        if len(self._owners) < world_size:
            raise InputError(f"{len(self._owners)} windows for {world_size} ranks: expected more.")
        self.seed, self.rank, self.world_size = seed, rank, world_size
        self.block = _fitting(dataset) if block is None else block
        self.epoch = self.position = self.start = 0

    def __len__(self) -> int:
        """Windows of a rank's epoch."""
        return len(self._owners) // self.world_size

    def __iter__(self) -> Iterator[int]:
        """What is left of the epoch."""
        self.position, self.start = self.start, 0
        for window in self.order()[self.position :].tolist():
            self.position += 1
            yield window

    def order(self) -> NDArray[np.int64]:
        """All windows of the rank's epoch, (len(self),)."""
        shards = np.unique(self._owners)
        rank_of = np.empty(shards[-1] + 1, dtype=np.int64)
        rank_of[self._random().permutation(shards)] = np.arange(len(shards))
        places = rank_of[self._owners]
        windows = np.argsort(places, kind="stable")
        own = windows[self.rank * len(self) : (self.rank + 1) * len(self)]
        _, turn = np.unique(places[own], return_inverse=True)
        noise = self._random(1 + self.rank).permutation(len(own))
        return own[np.lexsort([noise, turn // self.block])]

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next iteration; the same epoch again changes nothing."""
        if epoch != self.epoch:
            self.epoch, self.position, self.start = epoch, 0, 0

    def state_dict(self) -> dict[str, int]:
        """Where the epoch is; numbers only.

        A loader with workers asks for windows before it hands them out: use
        `TrajectoryLoader.state_dict` there.
        """
        names = ("seed", "epoch", "position", "block", "rank", "world_size")
        return {name: getattr(self, name) for name in names} | {"windows": len(self._owners)}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next iteration begin where ``state`` was taken.

        Raises
        ------
        InputError
            If it was taken with other windows, seed, block or ranks, whose order differs.
        """
        here = self.state_dict()
        for name in here.keys() - {"epoch", "position"}:
            if state.get(name) != here[name]:
                raise InputError(
                    f"the state has {name} = {state.get(name)}, the sampler {here[name]}: expected "
                    "the same, for the order of windows depends on it."
                )
        self.epoch = state["epoch"]
        self.position = self.start = state["position"]

    def _random(self, stream: int = 0) -> np.random.Generator:
        return np.random.default_rng((self.seed, self.epoch, stream))


def _fitting(dataset: TrajectoryDataset) -> int:
    """Files that the data set's cache holds, at least one."""
    sizes = np.sort(dataset.shard_bytes())[::-1]
    return max(1, int(np.searchsorted(np.cumsum(sizes), dataset.cache_bytes, side="right")))


CACHE_BYTES = 4 * 2**30
"""Default bound of the decoded files that a process keeps, bytes."""


class TrajectoryDataset(Dataset):  # type: ignore[misc]
    """Windows of ``window`` + 1 successive reference frames of a split's simulations.

    Item i is a `MeshSample` of a mesh with n nodes, E directed edges and c cells, for a
    window of k steps from frame t on:

    ==============================  =========================================================
    ``positions``                   (n, 3), the reference in frame t, m
    ``velocities``                  (n, 3), (p_t - p_(t-1)) / h, zero in frame 0, m/s
    ``targets``                     (n, k, 3), the reference in frames t + 1 .. t + k, m
    ``predictions``                 (n, k, 3), one step of the base model from the reference
                                    in frames t .. t + k - 1, not from its own last one, m;
                                    without ``base`` absent
    ``forces``                      (n, k, 3), loads of these steps, N
    ``run_NAME``                    (n, k + 1, 3), the run's own rollout in frames t .. t + k, m
    ``rest``, ``free``, ``mass``    (n, 3), m; (n, 3) bool; (n,), kg
    ``young``, ``poisson``,         (n,), means over the cells of a node, Pa, -, kg/m3; with
    ``density``                     ``cell_`` before the name (c,), for each cell
    ``edge_index``                  (2, E), each edge of a cell once in both directions
    ``cells``                       (c, 8), VTK order
    ``file``, ``mesh``,             (1,), number of the file in `headers`, of the mesh in its
    ``simulation``, ``frame``       split, of the simulation on the mesh, and t
    ``time``, ``time_step``         (1,), of frame t, and h, s
    ==============================  =========================================================

    Files are decoded when first needed and kept in memory.  No file stays open, so the
    data set may be forked, spawned and pickled; a pickled copy starts with an empty memory.
    `batch` assembles many windows at once and is much quicker than
    ``Batch.from_data_list``; `TrajectoryLoader` uses it.

    Parameters
    ----------
    folder : path, or sequence of paths
        Of the data set; of several, whose files follow one another.
    split : str
    window : int
        k.
    base : str, optional
        Run whose predictions are given, "plain", "best" or "total-mass"; None for data without.
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
    without : collection of str
        Files of each data set that are left out, such as ``training/mesh-0042``.

    Attributes
    ----------
    folders : tuple of Path
        Of the data sets.
    headers : list of ShardHeader
        Of the files.
    damaged : dict of Path to str
        Files that were left out, and what is wrong with them.

    Raises
    ------
    InputError
        If there is no such split, its simulations lack a run, or all are shorter than k; if a
        folder comes twice.
    FileFormatError
        If a file is damaged; with ``skip_damaged`` if all are.
    """

    def __init__(
        self,
        folder: Folders,
        split: str,
        *,
        window: int = 1,
        base: str | None = "plain",
        runs: Sequence[str] = (),
        cache_bytes: int = CACHE_BYTES,
        dtype: torch.dtype = torch.float32,
        skip_damaged: bool = False,
        without: Collection[str] = (),
    ) -> None:
        super().__init__()
        if not isinstance(window, (int, np.integer)) or window < 1:
            raise InputError(f"window = {window}: expected 1 step or more, a whole number.")
        self.folders, self.split = folders_of(folder), split
        self.window, self.base, self.runs, self.dtype = window, base, tuple(runs), dtype
        self.cache_bytes = cache_bytes
        self.damaged: Damage = {}
        paths = [path for each in self.folders for path in shard_paths(each, split, without)]
        self.headers = read_files(
            paths, partial(read_header, verify=skip_damaged), self.damaged if skip_damaged else None
        )
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
            names = ", ".join(map(str, self.folders))
            raise InputError(
                f"{names}, {split}: no simulation has {window} steps, the longest {longest}: "
                "expected a smaller window."
            )
        self._shards = RecentlyUsed(self._load, cache_bytes)

    def len(self) -> int:
        """Number of windows."""
        return int(self._starts[-1])

    def get(self, idx: int) -> MeshSample:
        """Window ``idx``; its tensors are copies."""
        place = self._place(idx)
        shard = place.shard
        fields = {
            **place.motion.window(place.frame, self.window), **window_numbers([place], self.dtype),
            **shard.nodal, **shard.cellwise, "cells": shard.cells, "edge_index": shard.edge_index,
        }  # fmt: skip
        copies = {name: values.clone().contiguous() for name, values in fields.items()}
        return MeshSample(num_nodes=len(shard.nodal["rest"]), **copies)

    def batch(self, indices: Sequence[int] | NDArray[np.int64]) -> Batch:
        """The windows at ``indices`` as one graph, equal to ``Batch.from_data_list``."""
        parts, sizes = self._collect(indices)
        values = {name: torch.cat(found, joined_along(name)) for name, found in parts.items()}
        return batch_of(values, sizes)

    def packed(self, indices: Sequence[int]) -> PackedBatch:
        """The same for another process."""
        return PackedBatch.join(*self._collect(indices))

    def _collect(
        self, indices: Sequence[int] | NDArray[np.int64]
    ) -> tuple[dict[str, list[Tensor]], GraphSizes]:
        chosen = self.indices()
        places = [self._place(chosen[int(i)]) for i in indices]
        sizes = graph_sizes(places)
        return joined_fields(places, sizes, self.window, self.dtype), sizes

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
        if len(numbers) and not 0 <= numbers.min() <= numbers.max() < self.len():
            raise IndexError(f"windows {numbers}: expected 0 to {self.len() - 1}")
        rows = np.searchsorted(self._starts, numbers, side="right") - 1
        files, simulations = self._owners[rows].T
        return files, simulations, numbers - self._starts[rows]

    def decoded(self, file: int) -> DecodedShard:
        """A file's tensors, which are kept as far as memory allows."""
        return self._shards[file]

    def forget(self) -> None:
        """Drop all decoded files from memory."""
        self._shards = RecentlyUsed(self._load, self.cache_bytes)

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

    def _place(self, idx: int) -> WindowPlace:
        if not 0 <= idx < self.len():
            raise IndexError(f"window {idx}: expected 0 to {self.len() - 1}")
        row = int(np.searchsorted(self._starts, idx, side="right")) - 1
        number, simulation = self._owners[row].tolist()
        shard = self._shards[number]
        return WindowPlace(
            number, self.headers[number], shard, simulation, shard.motions[simulation],
            idx - int(self._starts[row]),
        )  # fmt: skip

    def _load(self, number: int) -> DecodedShard:
        wanted: dict[str, Collection[str]] = dict.fromkeys(self.runs, ("positions",))
        if self.base is not None:
            wanted[self.base] = (*wanted.get(self.base, ()), "predictions")
        wanted[REFERENCE] = ("positions", "velocities")
        shard = read_shard(self.headers[number].path, runs=wanted, verify=False)
        return decode(shard, self.base, self.runs, self.dtype)


class RecentlyUsed:
    """Decoded files by number; the least recently used go first when they exceed ``limit`` bytes.

    The one asked for last always stays, however large.  A pickled copy is empty.
    """

    def __init__(self, load: Callable[[int], DecodedShard], limit: int) -> None:
        self.load, self.limit = load, limit
        self.bytes = 0
        self._files: OrderedDict[int, DecodedShard] = OrderedDict()

    def __len__(self) -> int:
        return len(self._files)

    def __contains__(self, number: int) -> bool:
        return number in self._files

    def __getitem__(self, number: int) -> DecodedShard:
        if number in self._files:
            self._files.move_to_end(number)
            return self._files[number]
        found = self.load(number)
        self._files[number] = found
        self.bytes += decoded_bytes(found)
        while self.bytes > self.limit and len(self._files) > 1:
            _, oldest = self._files.popitem(last=False)
            self.bytes -= decoded_bytes(oldest)
        return found

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "bytes": 0, "_files": OrderedDict()}


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
            batch = found.batch() if isinstance(found, PackedBatch) else found
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
        if not rollouts.issuperset(runs):
            raise InputError(
                f"{header.path}: simulation {k} has no positions of run "
                f"{min(set(runs) - rollouts)!r}: expected some of {', '.join(sorted(rollouts))}."
            )
