"""`WindowTables`: windows of a data set in tables, gathered by index."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.bodies import KNOWN, REST_OF_CELLS, REST_OF_EDGES, REST_OF_NODES, BodyGraph
from pdcorrect.data.reader import TrajectoryDataset

Numbers = NDArray[np.int64]

_OF_NODES = ("rest", "free", "mass", "young", "poisson", "density", *REST_OF_NODES)
_OF_BODIES = ("cell_size", "time_step")


@dataclass(frozen=True, eq=False)
class StoredWindows:
    """B windows of k steps, of bodies with n nodes in all; numbers are float64.

    Attributes
    ----------
    bodies : BodyGraph
    positions, velocities : (n, 3)
        Of the reference in the first frame, m and m/s.
    targets, predictions, forces : (k, n, 3)
        Of each step: where the reference goes and the base model would, m, and loads, N.
    file, simulation : (B,) int64
        Number of the file in `TrajectoryDataset.headers`, and of the simulation in it.
    """

    bodies: BodyGraph
    positions: Tensor
    velocities: Tensor
    targets: Tensor
    predictions: Tensor
    forces: Tensor
    file: Tensor
    simulation: Tensor

    def to(self, device: torch.device) -> StoredWindows:
        """The same on a device."""
        if self.file.device == device:
            return self
        moved = {
            name: x.to(device, non_blocking=True)
            for name, x in vars(self).items()
            if name != "bodies"
        }
        bodies = self.bodies.to(device)
        for name in KNOWN:
            vars(bodies)[name] = vars(self.bodies)[name].to(device, non_blocking=True)
        return StoredWindows(bodies, **moved)


class WindowTables:
    """All windows of a data set in one piece of memory.

    There is one table for each quantity: all nodes, edges and cells of the meshes side by
    side, and all nodes of all frames.  A batch of any size takes the same few operations, and
    nothing waits for the device: what is known of sizes is known on the CPU.

    Parameters
    ----------
    dataset : TrajectoryDataset
        With predictions of a base model; its files are read one by one and not kept.
    alone : callable
        The body, float64, of the file of a window (its number).
    device : torch.device
    """

    def __init__(
        self,
        dataset: TrajectoryDataset,
        alone: Callable[[int], BodyGraph],
        device: torch.device,
    ) -> None:
        self._dataset, self._device = dataset, device
        headers = dataset.headers
        self._nodes = np.array([h.nodes for h in headers])
        most = max(len(h.steps) for h in headers)
        frames = np.zeros((len(headers), most), dtype=np.int64)
        for row, h in zip(frames, headers, strict=True):
            row[: len(h.steps)] = np.array(h.steps) + 1
        rows = frames * self._nodes[:, None]
        self._starts = (np.cumsum(rows) - rows.reshape(-1)).reshape(rows.shape)
        names = ("positions", "velocities", "predictions", "forces")
        size = (int(rows.sum()), 3)
        self._frames = {
            name: torch.zeros(size, dtype=dataset.dtype, device=device) for name in names
        }
        files, first = np.unique(dataset.shard_numbers(), return_index=True)
        bodies = []
        for file, window in zip(files.tolist(), first.tolist(), strict=True):
            bodies.append(alone(window).to(device))
            self._keep(file)
            dataset.forget()
        self._place = np.zeros(len(headers), dtype=np.int64)
        self._place[files] = np.arange(len(files))
        self._bodies = BodyTables(bodies)

    def _keep(self, file: int) -> None:
        """Copy a file's frames to their places; a last frame has no step that follows it."""
        motions = self._dataset.decoded(file).motions
        for start, motion in zip(self._starts[file][: len(motions)], motions, strict=True):
            fields = {"positions": motion.positions, "velocities": motion.velocities}
            for name, values in (fields | motion.steps).items():
                flat = values.reshape(-1, 3)
                self._frames[name][start : start + len(flat)] = flat

    def batch(self, indices: Sequence[int] | Numbers) -> StoredWindows:
        """The windows at ``indices``."""
        files, simulations, frames = self._dataset.places(indices)
        starts = self._starts[files, simulations] + frames * self._nodes[files]
        place = self._place[files]
        numbers = np.stack([place, starts, files, simulations])
        on_device = torch.from_numpy(numbers).to(self._device, non_blocking=True)
        which, start, file, simulation = on_device.unbind()
        bodies, nodes = self._bodies(place, which)
        first_rows = nodes.shifted(start)
        count = bodies.by_node(nodes.lengths)
        length = self._dataset.window
        rows = torch.stack([first_rows + j * count for j in range(length + 1)])

        def found(name: str, rows: Tensor) -> Tensor:
            taken = self._frames[name].index_select(0, rows.reshape(-1))
            return taken.to(torch.float64).reshape(*rows.shape, 3)

        positions = found("positions", rows)
        return StoredWindows(
            bodies,
            positions[0],
            found("velocities", first_rows),
            positions[1:],
            found("predictions", rows[:-1]),
            found("forces", rows[:-1]),
            file,
            simulation,
        )


class BodyTables:
    """Bodies side by side, of which any, in any order and number, become one graph.

    Parameters
    ----------
    bodies : sequence of BodyGraph
        Graphs of one body each.
    """

    def __init__(self, bodies: Sequence[BodyGraph]) -> None:
        device = bodies[0].rest.device
        self._nodes = _Ranges([len(b.rest) for b in bodies], device)
        self._edges = _Ranges([b.edge_index.shape[1] for b in bodies], device)
        self._cells = _Ranges([len(b.cells) for b in bodies], device)
        names = (*_OF_NODES, *REST_OF_EDGES, *REST_OF_CELLS, *_OF_BODIES, "cells")
        self._tables = {name: torch.cat([getattr(b, name) for b in bodies]) for name in names}
        self._tables["edge_index"] = torch.cat([b.edge_index for b in bodies], dim=1)

    def __call__(self, chosen: Numbers, which: Tensor) -> tuple[BodyGraph, _Joined]:
        """The graph of bodies by their numbers, on the CPU and the device, and its nodes."""
        nodes, edges, cells = (
            ranges.joined(chosen, which) for ranges in (self._nodes, self._edges, self._cells)
        )

        def taken(names: Sequence[str], rows: Tensor) -> dict[str, Tensor]:
            return {name: self._tables[name].index_select(0, rows) for name in names}

        nodal, on_edges = taken(_OF_NODES, nodes.rows), taken(REST_OF_EDGES, edges.rows)
        rest = {name: nodal.pop(name) for name in REST_OF_NODES}
        ends = self._tables["edge_index"].index_select(1, edges.rows)
        corners = self._tables["cells"].index_select(0, cells.rows)
        bodies = BodyGraph(
            **nodal,
            **taken(_OF_BODIES, which),
            edge_index=ends + nodes.first.index_select(0, edges.owner),
            cells=corners + nodes.first.index_select(0, cells.owner)[:, None],
            graph=nodes.owner,
        )
        vars(bodies).update(rest | on_edges | taken(REST_OF_CELLS, cells.rows))
        vars(bodies)["node_counts"] = nodes.lengths.to(bodies.rest.dtype)
        return bodies, nodes


class _Joined(NamedTuple):
    """B ranges of rows of a table one after the other, m rows in all.

    ``rows`` (m,) of the table, ``owner`` (m,) the range that each is of, ``first`` (B,) where
    each range begins in the result, ``lengths`` (B,).
    """

    rows: Tensor
    owner: Tensor
    first: Tensor
    lengths: Tensor

    def shifted(self, starts: Tensor) -> Tensor:
        """Rows (m,) of ranges that begin elsewhere in a table, (B,)."""
        return _counted(starts, self.first, self.owner)


class _Ranges:
    """Rows of a table that belong together, range after range."""

    def __init__(self, lengths: Sequence[int], device: torch.device) -> None:
        self._host = np.array(lengths)
        self._lengths = torch.from_numpy(self._host).to(device)
        self._starts = self._lengths.cumsum(0) - self._lengths

    def joined(self, chosen: Numbers, which: Tensor) -> _Joined:
        """Some of them, by numbers (B,) on the CPU and on the device."""
        lengths = self._lengths.index_select(0, which)
        first = lengths.cumsum(0) - lengths
        owner = torch.repeat_interleave(lengths, output_size=int(self._host[chosen].sum()))
        starts = self._starts.index_select(0, which)
        return _Joined(_counted(starts, first, owner), owner, first, lengths)


def _counted(starts: Tensor, first: Tensor, owner: Tensor) -> Tensor:
    """Rows that count up from (B,) starts, where the results begin at (B,) ``first``."""
    everything = torch.arange(len(owner), device=owner.device)
    return everything + (starts - first).index_select(0, owner)
