"""`MeshSample` and batches of them: windows of decoded files as graphs of PyTorch Geometric."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdcorrect.data.schema import REFERENCE, Shard, Simulation
from pdcorrect.data.shard_reader import ShardHeader
from pdcorrect.errors import require_extra
from pdcorrect.fem.graph import mesh_edges, node_means, velocities

require_extra("torch_geometric", "learn")

import torch  # noqa: E402
from torch import Tensor  # noqa: E402
from torch_geometric.data import Batch, Data  # noqa: E402

_MODULI = ("young", "poisson", "density")
_MESH = ("rest", "free", "mass", *_MODULI)
_CELLS = tuple(f"cell_{name}" for name in _MODULI)
_GRAPHS = ("file", "mesh", "simulation", "frame", "time", "time_step")
_INDICES = ("cells", "edge_index")
_ALIGNMENT = 64
"""Bytes."""


class MeshSample(Data):
    """A window of a simulation on its mesh; batching renumbers ``cells`` like ``edge_index``."""

    def __inc__(self, key: str, value: Any, *args: Any, **kwargs: Any) -> Any:
        """By how much the next graph's values are raised."""
        return self.num_nodes if key == "cells" else super().__inc__(key, value, *args, **kwargs)


@dataclass(frozen=True, eq=False)
class DecodedMotion:
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
class DecodedShard:
    """Tensors of a file."""

    nodal: dict[str, Tensor]
    cellwise: dict[str, Tensor]
    cells: Tensor
    edge_index: Tensor
    motions: list[DecodedMotion]


def decoded_bytes(shard: DecodedShard) -> int:
    """What a file's tensors take."""
    found = [shard.cells, shard.edge_index, *shard.nodal.values(), *shard.cellwise.values()]
    for motion in shard.motions:
        found += [motion.positions, motion.velocities]
        found += [*motion.steps.values(), *motion.rollouts.values()]
    return sum(tensor.numel() * tensor.element_size() for tensor in found)


class WindowPlace(NamedTuple):
    """Where a window is."""

    file: int
    header: ShardHeader
    shard: DecodedShard
    simulation: int
    motion: DecodedMotion
    frame: int


def decode(shard: Shard, base: str | None, runs: Sequence[str], dtype: torch.dtype) -> DecodedShard:
    """A file's arrays as tensors, floats of ``dtype``.

    Parameters
    ----------
    shard : Shard
    base : str or None
        Run whose predictions are wanted.
    runs : sequence of str
        Runs whose rollouts are wanted.
    dtype : torch.dtype
    """

    def tensor(values: Any) -> Tensor:
        found = torch.from_numpy(values)
        return found.to(dtype) if found.is_floating_point() else found

    def motion(simulation: Simulation) -> DecodedMotion:
        reference = simulation.runs[REFERENCE]
        positions: Any = reference.positions
        if reference.velocities is None:
            speeds = velocities(positions[:-1], float(shard.attributes["time_step"]))
        else:
            speeds = reference.velocities[:-1]
        steps = {"forces": tensor(simulation.forces)}
        if base:
            steps["predictions"] = tensor(simulation.runs[base].predictions)
        rollouts = {f"run_{name}": tensor(simulation.runs[name].positions) for name in runs}
        return DecodedMotion(tensor(positions), tensor(speeds), steps, rollouts)

    cells = shard.cells.astype(np.int64)
    means = {n: node_means(getattr(shard, n), cells, len(shard.points)) for n in _MODULI}
    nodal = {"rest": shard.points, "free": shard.free, "mass": shard.mass, **means}
    return DecodedShard(
        nodal={name: tensor(values) for name, values in nodal.items()},
        cellwise={f"cell_{name}": tensor(getattr(shard, name)) for name in _MODULI},
        cells=tensor(cells),
        edge_index=tensor(mesh_edges(cells)),
        motions=[motion(simulation) for simulation in shard.simulations],
    )


def window_numbers(places: Sequence[WindowPlace], dtype: torch.dtype) -> dict[str, Tensor]:
    """One number a window, (B,)."""
    which = np.array([(p.file, p.header.number, p.simulation, p.frame) for p in places])
    steps = np.array([p.header.time_step for p in places])
    seconds = torch.from_numpy(np.stack([which[:, 3] * steps, steps])).to(dtype)
    file, mesh, simulation, frame = torch.from_numpy(np.ascontiguousarray(which.T))
    return {
        "file": file, "mesh": mesh, "simulation": simulation, "frame": frame,
        "time": seconds[0], "time_step": seconds[1],
    }  # fmt: skip


class GraphSizes(NamedTuple):
    """Of each graph of a batch."""

    nodes: list[int]
    cells: list[int]
    edges: list[int]


def graph_sizes(places: Sequence[WindowPlace]) -> GraphSizes:
    """Of the graphs of some windows."""
    return GraphSizes(
        [len(place.shard.nodal["rest"]) for place in places],
        [len(place.shard.cells) for place in places],
        [place.shard.edge_index.shape[1] for place in places],
    )


def joined_fields(
    places: Sequence[WindowPlace], sizes: GraphSizes, length: int, dtype: torch.dtype
) -> dict[str, list[Tensor]]:
    """By field what is to be joined, in the order of `MeshSample`'s fields."""
    shards = [place.shard for place in places]
    windows = [place.motion.window(place.frame, length) for place in places]
    raised = list(zip(shards, _ends(sizes.nodes)[:-1].tolist(), strict=True))
    return {
        **{name: [fields[name] for fields in windows] for name in windows[0]},
        **{name: [values] for name, values in window_numbers(places, dtype).items()},
        **{name: [shard.nodal[name] for shard in shards] for name in _MESH},
        **{name: [shard.cellwise[name] for shard in shards] for name in _CELLS},
        "cells": [shard.cells + first for shard, first in raised],
        "edge_index": [shard.edge_index + first for shard, first in raised],
    }


def joined_along(name: str) -> int:
    """The dimension in which a field's parts are put side by side."""
    return 1 if name == "edge_index" else 0


def batch_of(values: dict[str, Tensor], sizes: GraphSizes) -> Batch:
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
class PackedBatch:
    """A batch in one piece of shared memory, which passes between processes quickly."""

    memory: Tensor
    layout: dict[str, tuple[int, int, torch.dtype, list[int]]]
    sizes: GraphSizes

    @classmethod
    def join(cls, parts: dict[str, list[Tensor]], sizes: GraphSizes) -> PackedBatch:
        """Join the parts of each field, side by side."""
        layout, end = {}, 0
        for name, tensors in parts.items():
            dim, first = joined_along(name), tensors[0]
            shape = list(first.shape)
            shape[dim] = sum(tensor.shape[dim] for tensor in tensors)
            start = -(-end // _ALIGNMENT) * _ALIGNMENT
            end = start + math.prod(shape) * first.element_size()
            layout[name] = (start, end, first.dtype, shape)
        storage = torch.UntypedStorage._new_shared(end)  # type: ignore[no-untyped-call]
        packed = cls(torch.empty(0, dtype=torch.uint8).set_(storage), layout, sizes)
        for name, tensors in parts.items():
            torch.cat(tensors, joined_along(name), out=packed.field(name))
        return packed

    def field(self, name: str) -> Tensor:
        """A field, as a view."""
        start, end, dtype, shape = self.layout[name]
        return self.memory[start:end].view(dtype).view(shape)

    def pin_memory(self) -> PackedBatch:
        """The same in page-locked memory."""
        return replace(self, memory=self.memory.pin_memory())

    def batch(self) -> Batch:
        """The batch; its fields are views of the one piece."""
        return batch_of({name: self.field(name) for name in self.layout}, self.sizes)


def _ends(sizes: Sequence[int]) -> Tensor:
    """Zero and the running sums."""
    return torch.from_numpy(np.cumsum([0, *sizes]))
