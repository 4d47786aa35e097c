"""`MeshSample` and batches of them: windows of decoded files as graphs of PyTorch Geometric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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


def batch_of(places: Sequence[WindowPlace], length: int, dtype: torch.dtype) -> Batch:
    """What ``Batch.from_data_list`` makes of the samples of some windows, at once."""
    shards = [place.shard for place in places]
    windows = [place.motion.window(place.frame, length) for place in places]
    counts = [len(shard.nodal["rest"]) for shard in shards]
    nodes = _ends(counts)
    cells = _ends([len(shard.cells) for shard in shards])
    edges = _ends([shard.edge_index.shape[1] for shard in shards])
    graphs, offsets = torch.arange(len(nodes)), nodes[:-1]
    raised = list(zip(shards, offsets.tolist(), strict=True))
    fields = {
        **{name: torch.cat([window[name] for window in windows]) for name in windows[0]},
        **window_numbers(places, dtype),
        **{name: torch.cat([shard.nodal[name] for shard in shards]) for name in _MESH},
        **{name: torch.cat([shard.cellwise[name] for shard in shards]) for name in _CELLS},
        "cells": torch.cat([shard.cells + first for shard, first in raised]),
        "edge_index": torch.cat([shard.edge_index + first for shard, first in raised], dim=1),
    }
    ends = {
        **dict.fromkeys(_GRAPHS, graphs), **dict.fromkeys((*_CELLS, "cells"), cells),
        "edge_index": edges,
    }  # fmt: skip
    same = torch.zeros_like(offsets)
    batch = Batch(_base_cls=MeshSample)
    store = batch._store
    store.update(fields)
    store._num_nodes, store.num_nodes = counts, sum(counts)
    store.batch = torch.repeat_interleave(torch.tensor(counts))
    store.ptr = nodes
    batch._num_graphs = len(offsets)
    batch._slice_dict = {name: ends.get(name, nodes) for name in fields}
    batch._inc_dict = {name: offsets if name in _INDICES else same for name in fields}
    return batch


def _ends(sizes: Sequence[int]) -> Tensor:
    """Zero and the running sums."""
    return torch.from_numpy(np.cumsum([0, *sizes]))
