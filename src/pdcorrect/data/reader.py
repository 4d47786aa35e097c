"""Windows of a data set's simulations for PyTorch Geometric, one by one and in batches."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.folder import Damage, read_files, shard_paths
from pdcorrect.data.schema import REFERENCE, ShardHeader, Simulation, read_header, read_shard
from pdcorrect.errors import InputError, require_extra
from pdcorrect.fem.graph import mesh_edges, node_means, velocities

require_extra("torch_geometric", "learn")

import torch  # noqa: E402
from torch import Tensor  # noqa: E402
from torch_geometric.data import Batch, Data, Dataset  # noqa: E402

Numbers = NDArray[np.int64]
CACHE_BYTES = 4 * 2**30
"""Default bound of the decoded files that a process keeps, bytes."""
_MODULI = ("young", "poisson", "density")
_WHOLE = ("file", "mesh", "simulation", "frame")
_OF_WINDOWS = (*_WHOLE, "time", "time_step")  # one number a window
_INDICES = ("cells", "edge_index")


class MeshSample(Data):
    """A window of a simulation on its mesh; batching renumbers ``cells`` like ``edge_index``."""

    def __inc__(self, key: str, value: Any, *args: Any, **kwargs: Any) -> Any:
        """By how much the next graph's values are raised."""
        return self.num_nodes if key == "cells" else super().__inc__(key, value, *args, **kwargs)


@dataclass(frozen=True, eq=False)
class DecodedMotion:
    """Tensors of a simulation, frame first; ``steps`` and ``rollouts`` by the name of the field."""

    positions: Tensor
    velocities: Tensor
    steps: dict[str, Tensor]
    rollouts: dict[str, Tensor]

    def window(self, frame: int, length: int) -> dict[str, Tensor]:
        """Node by node what happens in ``length`` steps from a frame, as views."""
        last = frame + length
        ahead = {"targets": self.positions[frame + 1 : last + 1]}
        ahead |= {name: values[frame:last] for name, values in self.steps.items()}
        ahead |= {name: values[frame : last + 1] for name, values in self.rollouts.items()}
        return {
            "positions": self.positions[frame],
            "velocities": self.velocities[frame],
            **{name: values.transpose(0, 1) for name, values in ahead.items()},
        }


@dataclass(frozen=True, eq=False)
class DecodedShard:
    """Tensors of a file: the fields of all its samples, and its simulations."""

    mesh: dict[str, Tensor]
    motions: list[DecodedMotion]


class TrajectoryDataset(Dataset):  # type: ignore[misc]
    """Windows of ``window`` + 1 successive reference frames of a split's simulations.

    Item i is a `MeshSample` whose fields ``docs/datasets.md`` lists, of ``dtype`` but for indices
    and masks.

    Files are decoded when first needed and kept in memory.  No file stays open, so the
    data set may be forked, spawned and pickled; a pickled copy starts with an empty memory.
    `batch`, which `TrajectoryLoader` uses, is much quicker than ``Batch.from_data_list``.

    Parameters
    ----------
    folder : path
    split : str
    window : int
        k, steps of a window.
    base : str, optional
        Run whose predictions are given, "plain", "best" or "total-mass"; None for data without.
    runs : sequence of str
        Runs whose own rollouts are given.
    cache_bytes : int
        Of the decoded files that are kept, by `shard_bytes`; the last one read always is.
    dtype : torch.dtype
    skip_damaged : bool
        Leave out files that are damaged; all files are read once to find them.
    without : collection of str
        Files that are left out, such as ``training/mesh-0042``.

    Attributes
    ----------
    headers : list of ShardHeader
        Of the files.
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
        without: Collection[str] = (),
    ) -> None:
        super().__init__()
        if not isinstance(window, (int, np.integer)) or window < 1:
            raise InputError(f"window = {window}: expected 1 step or more, a whole number.")
        self.split = split
        self.window, self.base, self.runs, self.dtype = window, base, tuple(runs), dtype
        self.cache_bytes = cache_bytes
        self.damaged: Damage = {}
        self.headers = read_files(
            shard_paths(folder, split, without), partial(read_header, verify=skip_damaged),
            self.damaged if skip_damaged else None,
        )  # fmt: skip
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
                f"{folder}, {split}: no simulation has {window} steps, the longest {longest}: "
                "expected a smaller window."
            )
        self._kept: OrderedDict[int, DecodedShard] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": OrderedDict()}

    def len(self) -> int:
        """Number of windows."""
        return int(self._starts[-1])

    def get(self, idx: int) -> MeshSample:
        """Window ``idx``; its tensors are copies."""
        return self._batch(self._places(np.array([idx]))).get_example(0)

    def batch(self, indices: Sequence[int] | Numbers) -> Batch:
        """The windows at ``indices`` as one graph, equal to ``Batch.from_data_list``."""
        return self._batch(self.places(indices))

    def _batch(self, places: tuple[Numbers, Numbers, Numbers]) -> Batch:
        windows = [self._window(*map(int, place)) for place in zip(*places, strict=True)]
        nodes, cells, edges = (
            _ends([w[name].shape[-1] for w in windows])
            for name in ("mass", "cell_young", "edge_index")
        )
        graphs, offsets = torch.arange(len(nodes)), nodes[:-1]
        batch = Batch(_base_cls=MeshSample)
        slices, raised = {}, {}
        for name in windows[0]:
            parts = [w[name] for w in windows]
            slices[name], raised[name] = nodes, torch.zeros_like(offsets)
            if name in _OF_WINDOWS:
                dtype = torch.int64 if name in _WHOLE else self.dtype
                batch[name], slices[name] = torch.tensor(parts, dtype=dtype), graphs
                continue
            if name in _INDICES:
                parts = [x + first for x, first in zip(parts, offsets.tolist(), strict=True)]
                raised[name] = offsets
            if name.startswith("cell"):
                slices[name] = cells
            if name == "edge_index":
                batch[name], slices[name] = torch.cat(parts, 1), edges
            else:
                batch[name] = torch.cat(parts)
        store = batch._store
        store._num_nodes, store.num_nodes = nodes.diff().tolist(), int(nodes[-1])
        store.batch, store.ptr = torch.repeat_interleave(graphs[:-1], nodes.diff()), nodes
        batch._num_graphs, batch._slice_dict, batch._inc_dict = len(windows), slices, raised
        return batch

    def places(self, indices: Sequence[int] | Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """Of the windows at ``indices``: file of the split, simulation of the file, frame, (B,)."""
        numbers, chosen = np.asarray(indices, dtype=np.int64), self.indices()
        if not isinstance(chosen, range):
            numbers = np.asarray(chosen, dtype=np.int64)[numbers]
        return self._places(numbers)

    def decoded(self, file: int) -> DecodedShard:
        """A file's tensors, which are kept as far as memory allows."""
        if file not in self._kept:
            self._kept[file] = self._load(file)
            sizes = self.shard_bytes()
            while len(self._kept) > 1 and sizes[list(self._kept)].sum() > self.cache_bytes:
                self._kept.popitem(last=False)
        self._kept.move_to_end(file)
        return self._kept[file]

    def forget(self) -> None:
        """Drop all decoded files from memory."""
        self._kept.clear()

    def shard_numbers(self) -> Numbers:
        """For each window the number of its file in the split, (len(self),)."""
        return self.places(range(len(self)))[0]

    def shard_bytes(self) -> Numbers:
        """What each file takes in memory, about, bytes."""
        width = torch.empty((), dtype=self.dtype).element_size()
        arrays = 3 + (self.base is not None) + len(self.runs)
        return np.array([
            sum(h.steps) * h.nodes * 3 * width * arrays + h.nodes * 150 + h.cells * 100
            for h in self.headers
        ])  # fmt: skip

    def _places(self, numbers: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        if len(numbers) and not 0 <= numbers.min() <= numbers.max() < self.len():
            raise IndexError(f"windows {numbers}: expected 0 to {self.len() - 1}")
        rows = np.searchsorted(self._starts, numbers, side="right") - 1
        files, simulations = self._owners[rows].T
        return files, simulations, numbers - self._starts[rows]

    def _window(self, file: int, simulation: int, frame: int) -> dict[str, Any]:
        """The fields of a sample: views of tensors, and numbers."""
        shard, header = self.decoded(file), self.headers[file]
        return {
            **shard.motions[simulation].window(frame, self.window), **shard.mesh,
            "file": file, "mesh": header.number, "simulation": simulation, "frame": frame,
            "time": frame * header.time_step, "time_step": header.time_step,
        }  # fmt: skip

    def _load(self, number: int) -> DecodedShard:
        wanted: dict[str, Collection[str]] = dict.fromkeys(self.runs, ("positions",))
        if self.base is not None:
            wanted[self.base] = (*wanted.get(self.base, ()), "predictions")
        wanted[REFERENCE] = ("positions", "velocities")
        shard = read_shard(self.headers[number].path, runs=wanted)
        cells, moduli = shard.cells.astype(np.int64), {n: getattr(shard, n) for n in _MODULI}
        mesh = {
            "rest": shard.points, "free": shard.free, "mass": shard.mass,
            **{name: node_means(x, cells, len(shard.points)) for name, x in moduli.items()},
            **{f"cell_{name}": x for name, x in moduli.items()},
            "cells": cells, "edge_index": mesh_edges(cells),
        }  # fmt: skip
        step = float(shard.attributes["time_step"])
        return DecodedShard(
            {name: self._tensor(values) for name, values in mesh.items()},
            [self._motion(simulation, step) for simulation in shard.simulations],
        )

    def _motion(self, simulation: Simulation, step: float) -> DecodedMotion:
        reference = simulation.runs[REFERENCE]
        positions: Any = reference.positions
        if reference.velocities is None:
            speeds = velocities(positions[:-1], step)
        else:
            speeds = reference.velocities[:-1]
        steps = {"forces": self._tensor(simulation.forces)}
        if self.base is not None:
            steps["predictions"] = self._tensor(simulation.runs[self.base].predictions)
        rollouts = {f"run_{n}": self._tensor(simulation.runs[n].positions) for n in self.runs}
        return DecodedMotion(self._tensor(positions), self._tensor(speeds), steps, rollouts)

    def _tensor(self, values: Any) -> Tensor:
        """Floats in the data set's type."""
        found = torch.from_numpy(values)
        return found.to(self.dtype) if found.is_floating_point() else found


def _ends(sizes: Sequence[int]) -> Tensor:
    """Zero and the running sums."""
    return torch.from_numpy(np.cumsum([0, *sizes]))


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


class TrajectoryLoader:
    """Batches of windows in random order, epoch after epoch.

    Each epoch shuffles the files, gives every rank of ``world_size`` an equal share of their
    windows (the last few, fewer than ranks, are left out), and shuffles the windows within blocks
    of ``block`` successive files, by default as many as fit into the data set's cache.  Order
    depends on seed, epoch, rank and ``world_size`` alone.

    Attributes
    ----------
    epoch : int
        Of the next batch.
    position : int
        Windows of the epoch that were given out.

    Raises
    ------
    InputError
        If there is no such rank, or there are fewer windows than ranks.
    """

    def __init__(
        self,
        dataset: TrajectoryDataset,
        batch_size: int,
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
        if block is None:
            sizes = np.cumsum(np.sort(dataset.shard_bytes())[::-1])
            block = max(1, int(np.searchsorted(sizes, dataset.cache_bytes, side="right")))
        self.dataset, self.batch_size = dataset, batch_size
        self.seed, self.block, self.rank, self.world_size = seed, block, rank, world_size
        self.epoch = self.position = 0

    def __len__(self) -> int:
        """Batches of an epoch."""
        return -(-(len(self._owners) // self.world_size) // self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        """What is left of the epoch; the next iteration is of the next one."""
        order = self.order()
        while self.position < len(order):
            chosen = order[self.position : self.position + self.batch_size]
            self.position += len(chosen)
            yield self.dataset.batch(chosen)
        self.set_epoch(self.epoch + 1)

    def order(self) -> Numbers:
        """All windows of the rank's epoch."""
        shards, share = np.unique(self._owners), len(self._owners) // self.world_size
        rank_of = np.empty(shards[-1] + 1, dtype=np.int64)
        rank_of[self._random().permutation(shards)] = np.arange(len(shards))
        places = rank_of[self._owners]
        windows = np.argsort(places, kind="stable")
        own = windows[self.rank * share : (self.rank + 1) * share]
        _, turn = np.unique(places[own], return_inverse=True)
        noise = self._random(1 + self.rank).permutation(len(own))
        return own[np.lexsort([noise, turn // self.block])]

    def set_epoch(self, epoch: int) -> None:
        """Go to the beginning of an epoch; the same epoch again changes nothing."""
        if epoch != self.epoch:
            self.epoch, self.position = epoch, 0

    def state_dict(self) -> dict[str, int]:
        """Where the epoch is, after the last batch that was handed out; numbers only."""
        names = ("seed", "epoch", "position", "block", "rank", "world_size")
        return {name: getattr(self, name) for name in names} | {"windows": len(self._owners)}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on from where ``state`` was taken."""
        here = self.state_dict()
        for name in here.keys() - {"epoch", "position"}:
            if state.get(name) != here[name]:
                raise InputError(
                    f"the state has {name} = {state.get(name)}, the loader {here[name]}: expected "
                    "the same, for the order of windows depends on it."
                )
        self.epoch, self.position = state["epoch"], state["position"]

    def _random(self, stream: int = 0) -> np.random.Generator:
        return np.random.default_rng((self.seed, self.epoch, stream))
