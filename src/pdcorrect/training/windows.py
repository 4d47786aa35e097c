"""Single steps of many bodies with the corrections that they need, and batches of them.

They come from the stored predictions of a data set, so no simulator runs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.bodies import REST_OF_CELLS, REST_OF_EDGES, REST_OF_NODES, BodyGraph
from pdcorrect.corrector.corrector import Corrector, CorrectorConfig
from pdcorrect.corrector.features import Snapshot
from pdcorrect.data.configuration import TRAINING
from pdcorrect.data.reader import TrajectoryDataset, TrajectoryLoader
from pdcorrect.fem.problem import Base
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.losses import body_losses, network_precision
from pdcorrect.training.recipe import Stage
from pdcorrect.training.scenes import Recording, base_errors

Numbers = NDArray[np.int64]

_SHARE_OF_DEVICE = 0.3  # of a GPU's free memory, which the windows may fill
_FRAMES = ("positions", "velocities", "predictions", "forces")
_BODY = ("rest", "free", "mass", "young", "poisson", "density", "cell_size", "time_step")
_AT_REST = ("node_counts", *REST_OF_NODES, *REST_OF_EDGES, *REST_OF_CELLS)


@dataclass(frozen=True, eq=False)
class StepBatch:
    """A step of B bodies with n nodes."""

    bodies: BodyGraph
    snapshot: Snapshot
    target: Tensor  # (n, 3): the correction that leads to the reference, m
    scale: Tensor  # (B,): mean squared one-step error of the base model on each trajectory, m2

    def with_noise(self, tau: float, generator: torch.Generator) -> StepBatch:
        """The same with Gaussian noise on the proposal, which the target takes back.

        ``tau`` is the deviation of a component in the root mean square of a component of the
        base model's one-step errors.
        """
        x = self.snapshot.proposed
        noise = torch.randn(x.shape, generator=generator, dtype=x.dtype, device=x.device)
        noise = noise * self.bodies.by_node((self.scale / 3.0).sqrt())[:, None]
        noise = torch.where(self.bodies.free, tau * noise, 0.0)
        snapshot = replace(self.snapshot, proposed=x + noise)
        return replace(self, snapshot=snapshot, target=self.target - noise)


class StepWindows:
    """Single steps of a data set's training split, in one piece of memory.

    There is one table for each quantity, with all nodes of all frames.  It is on the device, or
    on the CPU if all would fill more than 0.3 of what is free on a GPU.  Of bodies all that is
    known at rest is computed once.  ``recordings`` are all of the split, for the base model's
    errors, and ``without`` are files that are left out, see `pdcorrect.data.folder.shard_paths`.
    """

    def __init__(
        self,
        folder: str | Path,
        recordings: Sequence[Recording],
        config: CorrectorConfig,
        base: Base,
        *,
        device: str | torch.device = "cpu",
        without: Collection[str] = (),
    ) -> None:
        self.device = torch.device(device)
        self._history = "previous-correction" in config.node_features
        self.dataset = TrajectoryDataset(
            folder, TRAINING, window=2 if self._history else 1, base=base, without=without
        )
        headers = self.dataset.headers
        files = {header.path: k for k, header in enumerate(headers)}
        self._numbers = np.zeros((len(headers), max(len(h.steps) for h in headers)), dtype=np.int64)
        for k, r in enumerate(recordings):
            self._numbers[files[r.path], r.number] = k
        self._errors = base_errors(recordings, self.device)
        self._nodes = np.array([h.nodes for h in headers])
        rows = np.zeros(self._numbers.shape, dtype=np.int64)
        for row, h in zip(rows, headers, strict=True):
            row[: len(h.steps)] = (np.array(h.steps) + 1) * h.nodes
        self._starts = (np.cumsum(rows) - rows.reshape(-1)).reshape(rows.shape)
        size, self._home = (int(rows.sum()), 3), self._chosen_home()
        self._frames = {name: torch.zeros(size, device=self._home) for name in _FRAMES}
        self._bodies: dict[int, BodyGraph] = {}
        for window in self.of_each_file().tolist():
            file = int(self.dataset.places([window])[0][0])
            body = BodyGraph.of_batch(self.dataset.batch([window]).to(self.device))
            self._bodies[file] = body.to(dtype=torch.float64)
            self._keep(file)
            self.dataset.forget()

    def _chosen_home(self) -> torch.device:
        """Where the tables are kept."""
        if self.device.type != "cuda":
            return self.device
        free = torch.cuda.mem_get_info(self.device)[0]
        fits = int(self.dataset.shard_bytes().sum()) < _SHARE_OF_DEVICE * free
        return self.device if fits else torch.device("cpu")

    def _keep(self, file: int) -> None:
        """Copy a file's frames to their places; a last frame has no step that follows it."""
        motions = self.dataset.decoded(file).motions
        for start, motion in zip(self._starts[file][: len(motions)], motions, strict=True):
            fields = {"positions": motion.positions, "velocities": motion.velocities}
            for name, values in (fields | motion.steps).items():
                flat = values.reshape(-1, 3)
                self._frames[name][start : start + len(flat)] = flat

    def batch(self, indices: Sequence[int] | Numbers, *, last: bool = True) -> StepBatch:
        """The last steps of chosen windows, or the first.

        Windows have two where the network sees the correction of the step before, else one.  Of
        a window's first step that correction is None, as where a simulation begins.
        """
        files, simulations, frames = self.dataset.places(indices)
        second = self._history and last
        nodes = self._nodes[files]
        starts = self._starts[files, simulations] + (frames + second) * nodes
        first = np.cumsum(nodes) - nodes
        rows = np.repeat(starts - first, nodes) + np.arange(nodes.sum())
        step = np.repeat(nodes, nodes)
        here, ahead = (torch.from_numpy(x).to(self._home) for x in (rows, rows + step))

        positions, velocities, coarse, forces = (self._taken(name, here) for name in _FRAMES)
        previous = None
        if second:
            before = torch.from_numpy(rows - step).to(self._home)
            previous = positions - self._taken("predictions", before)
        bodies = joined([self._bodies[file] for file in files.tolist()])
        state = Snapshot(positions, velocities, coarse, forces, previous)
        target = self._taken("positions", ahead) - coarse
        which = torch.from_numpy(self._numbers[files, simulations]).to(self.device)
        return StepBatch(bodies, state, target, self._errors.of(which).after(1))

    def _taken(self, name: str, rows: Tensor) -> Tensor:
        """Rows of a table, float64, on the device."""
        found = self._frames[name].index_select(0, rows).to(self.device, non_blocking=True)
        return found.to(torch.float64)

    def beginnings(self) -> Numbers:
        """Numbers of the windows with which simulations begin."""
        every = np.arange(len(self.dataset))
        return every[self.dataset.places(every)[2] == 0]

    def of_each_file(self) -> Numbers:
        """Numbers of one window of each file."""
        files, _, _ = self.dataset.places(np.arange(len(self.dataset)))
        return np.unique(files, return_index=True)[1]


def joined(bodies: Sequence[BodyGraph]) -> BodyGraph:
    """Graphs of one body each as one graph, with what they know of their bodies at rest."""
    device = bodies[0].rest.device
    nodes = np.array([len(b.rest) for b in bodies])
    first = np.cumsum(nodes) - nodes

    def each(values: Numbers, counts: Sequence[int] | Numbers) -> Tensor:
        return torch.from_numpy(np.repeat(values, counts)).to(device, non_blocking=True)

    edges, cells = (
        torch.cat([getattr(b, name) for b in bodies], dim)
        for name, dim in (("edge_index", 1), ("cells", 0))
    )
    found = BodyGraph(
        **{name: torch.cat([getattr(b, name) for b in bodies]) for name in _BODY},
        edge_index=edges + each(first, [b.edge_index.shape[1] for b in bodies]),
        cells=cells + each(first, [len(b.cells) for b in bodies])[:, None],
        graph=each(np.arange(len(bodies)), nodes),
    )
    known = {name: torch.cat([getattr(b, name) for b in bodies]) for name in _AT_REST}
    vars(found).update(known)
    return found


class OneStepBatches:
    """Losses of windows of the training split in random order, epoch after epoch.

    The last few of an epoch, fewer than a batch, are left out.
    """

    failed = 0
    """Scenes whose step failed: none is taken."""

    def __init__(self, windows: StepWindows, stage: Stage, seed: int, world: ProcessGroup) -> None:
        self._windows, self._stage, self._seed = windows, stage, (seed, world.rank)
        self._shuffle = TrajectoryLoader(
            windows.dataset, stage.batch, seed=seed, block=len(windows.dataset.headers),
            rank=world.rank, world_size=world.size,
        )  # fmt: skip
        self._order = self._shuffle.order()
        self._generator = torch.Generator(windows.device)

    def __len__(self) -> int:
        """Batches of an epoch."""
        return max(1, len(self._order) // self._stage.batch)

    def batch(self, iteration: int) -> StepBatch:
        """Batch number ``iteration`` of the stage."""
        epoch, place = divmod(iteration, len(self))
        if epoch != self._shuffle.epoch:
            self._shuffle.set_epoch(epoch)
            self._order = self._shuffle.order()
        first = place * self._stage.batch
        batch = self._windows.batch(self._order[first : first + self._stage.batch])
        if self._stage.noise.tau == 0.0:
            return batch
        self._generator.manual_seed(seed_of(*self._seed, iteration))
        return batch.with_noise(self._stage.noise.tau, self._generator)

    def loss(self, corrector: Corrector, iteration: int, steps: int) -> Tensor:
        """The mean loss of a batch; what is drawn depends on ``iteration``."""
        return one_step_loss(corrector, self.batch(iteration), self._stage)

    def state_dict(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Nothing: all depends on the number of the batch."""
        return {}, {}

    def load_state_dict(self, numbers: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """Nothing to do."""


def one_step_loss(corrector: Corrector, batch: StepBatch, stage: Stage) -> Tensor:
    """Mean loss of the bodies of a batch."""
    with network_precision(corrector, stage.amp):
        correction = corrector(batch.bodies, batch.snapshot)
    bodies, errors = batch.bodies, correction - batch.target
    each = body_losses(stage.loss, errors, bodies.node_sums, bodies.node_counts, batch.scale)
    return each.mean()


def seed_of(*names: int) -> int:
    """A seed for a stream of random numbers that is named by numbers."""
    return int(np.random.SeedSequence(names).generate_state(1, np.uint32)[0])
