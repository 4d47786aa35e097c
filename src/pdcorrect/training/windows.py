"""`StepBatch`: single steps of many bodies with the corrections that they need.

They come from the stored predictions of a data set, so no simulator runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.config import CorrectorConfig
from pdcorrect.corrector.features import Snapshot
from pdcorrect.corrector.placements import ballistic
from pdcorrect.data.config import TRAINING
from pdcorrect.data.reader import TrajectoryDataset, TrajectoryLoader
from pdcorrect.data.sampling import ShardShuffle
from pdcorrect.training.recordings import Base, Recording

_SHARE_OF_DEVICE = 0.3
"""Of a GPU's free memory, which the windows may fill."""


@dataclass(frozen=True, eq=False)
class StepBatch:
    """A step of B bodies with n nodes.

    Attributes
    ----------
    bodies : BodyGraph
    snapshot : Snapshot
    target : (n, 3)
        The correction that leads to the reference, m; for placement "guess" to the base
        model's answer.
    scale : (B,)
        Mean squared one-step error of the base model on each trajectory, m2.
    """

    bodies: BodyGraph
    snapshot: Snapshot
    target: Tensor
    scale: Tensor

    def with_noise(self, tau: float, relative: bool, generator: torch.Generator) -> StepBatch:
        """The same with Gaussian noise on the proposal, which the target takes back.

        ``tau`` is the deviation of a component, in m or, if ``relative``, in the root mean
        square of a component of the base model's one-step errors.
        """
        x = self.snapshot.proposed
        noise = torch.randn(x.shape, generator=generator, dtype=x.dtype, device=x.device)
        if relative:
            noise = noise * self.bodies.by_node((self.scale / 3.0).sqrt())[:, None]
        noise = torch.where(self.bodies.free, tau * noise, 0.0)
        snapshot = replace(self.snapshot, proposed=x + noise)
        return replace(self, snapshot=snapshot, target=self.target - noise)


class StepWindows:
    """Endless batches of windows of a data set's training split, on a device.

    Parameters
    ----------
    folder : path
    recordings : sequence of Recording
        Of the split, for the base model's errors.
    config : CorrectorConfig
    base : {"plain", "best"}
    device : str or torch.device
    workers : int
        Processes that read ahead; none if the split fits into the device's memory.
    """

    def __init__(
        self,
        folder: str | Path,
        recordings: Sequence[Recording],
        config: CorrectorConfig,
        base: Base,
        *,
        device: str | torch.device = "cpu",
        workers: int = 0,
    ) -> None:
        self.config, self.device = config, torch.device(device)
        self._history = "previous-correction" in config.node_features
        window = 2 if self._history else 1
        dataset = _DeviceDataset(folder, TRAINING, window=window, base=base)
        size = int(dataset.shard_bytes().sum())
        if _fits(size, self.device):
            dataset.keep_on(self.device, size)
            workers = 0
        self.dataset, self._workers = dataset, workers
        rows = max(r.mesh for r in recordings) + 1
        columns = max(r.number for r in recordings) + 1
        errors = torch.full((rows, columns), float("nan"), dtype=torch.float64)
        for r in recordings:
            errors[r.mesh, r.number] = r.one_step
        self._errors = errors.to(self.device)
        shards, first = np.unique(dataset.shard_numbers(), return_index=True)
        self._first = {
            dataset.headers[k].number: int(i) for k, i in zip(shards, first, strict=True)
        }
        self._rest: dict[int, dict[str, Tensor]] = {}

    def batch(self, indices: Sequence[int]) -> StepBatch:
        """Chosen windows."""
        return self.step_batch(self.dataset.batch(indices))

    def batches(
        self, size: int, *, seed: int, rank: int = 0, world_size: int = 1
    ) -> EndlessBatches:
        """Batches of ``size`` windows in random order, epoch after epoch."""
        shuffle = ShardShuffle(self.dataset, seed=seed, rank=rank, world_size=world_size)
        options: dict[str, Any] = {"pin_memory": self.device.type == "cuda" and self._workers > 0}
        if self._workers:
            options |= {"num_workers": self._workers, "persistent_workers": True}
        whole = len(shuffle) >= size
        loader = TrajectoryLoader(self.dataset, size, shuffle, drop_last=whole, **options)
        return EndlessBatches(self, loader)

    def step_batch(self, found: Any) -> StepBatch:
        """What a batch of samples says about its last step."""
        meshes = found.mesh.tolist()
        found = found.to(self.device, non_blocking=True)
        bodies = self._with_rest(BodyGraph.of_batch(found).to(dtype=torch.float64), meshes)
        positions, targets, predictions, forces = (
            getattr(found, name).to(torch.float64)
            for name in ("positions", "targets", "predictions", "forces")
        )
        velocities, previous = found.velocities.to(torch.float64), None
        if self._history:
            previous = targets[:, 0] - predictions[:, 0]
            step = bodies.by_node(bodies.time_step)[:, None]
            velocities = (targets[:, 0] - positions) / step
            positions = targets[:, 0]
        coarse = predictions[:, -1]
        state = Snapshot(positions, velocities, coarse, forces[:, -1], previous)
        target = targets[:, -1] - coarse
        if self.config.placement != "state":
            h: Any = bodies.by_node(bodies.time_step)[:, None]
            # the clamps of the stored coarse step are where they are prescribed
            start = ballistic(state, h, state.forces, bodies.mass, bodies.free, coarse)
            state = replace(state, proposed=start)
            target = coarse - start if self.config.placement == "guess" else target
        return StepBatch(bodies, state, target, self._errors[found.mesh, found.simulation])

    def _with_rest(self, bodies: BodyGraph, meshes: list[int]) -> BodyGraph:
        """The bodies with what is computed of their rest once for each mesh."""
        for mesh in set(meshes) - self._rest.keys():
            one = self.dataset.batch([self._first[mesh]]).to(self.device)
            alone = BodyGraph.of_batch(one).to(dtype=torch.float64)
            self._rest[mesh] = {name: getattr(alone, name) for name in _REST}
        for name in _REST:
            vars(bodies)[name] = torch.cat([self._rest[mesh][name] for mesh in meshes])
        return bodies


_REST = ("rest_inverses", "rest_frames", "rest_edges", "rest_turns")
"""Cached properties of `BodyGraph`."""


class EndlessBatches:
    """Epoch after epoch of a loader; remembers where it is."""

    def __init__(self, windows: StepWindows, loader: TrajectoryLoader) -> None:
        self._windows, self._loader = windows, loader
        self._epoch: Iterator[Any] | None = None
        self._number = 0

    def __len__(self) -> int:
        """Batches of an epoch."""
        return len(self._loader)

    def __next__(self) -> StepBatch:
        """The next batch."""
        while True:
            if self._epoch is None:
                self._epoch = iter(self._loader)
            found = next(self._epoch, None)
            if found is not None:
                return self._windows.step_batch(found)
            self._number += 1
            self._loader.set_epoch(self._number)
            self._epoch = None

    def state_dict(self) -> dict[str, int]:
        """Where it is; numbers only."""
        return self._loader.state_dict()

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Go on where a state was taken."""
        self._loader.load_state_dict(dict(state))
        self._number, self._epoch = state["epoch"], None


class _DeviceDataset(TrajectoryDataset):
    """A data set whose decoded files are kept in a device's memory."""

    _device: torch.device | None = None

    def keep_on(self, device: torch.device, size: int) -> None:
        """Keep all files, which take ``size`` bytes, on a device."""
        self._device = device
        self.cache_bytes = self._shards.limit = max(2 * size, self.cache_bytes)

    def _load(self, number: int) -> Any:
        shard = super()._load(number)
        if self._device is None or self._device.type == "cpu":
            return shard

        def moved(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: x.to(self._device) for name, x in values.items()}

        motions = [
            replace(
                motion,
                positions=motion.positions.to(self._device),
                velocities=motion.velocities.to(self._device),
                steps=moved(motion.steps),
                rollouts=moved(motion.rollouts),
            )
            for motion in shard.motions
        ]
        return replace(
            shard,
            nodal=moved(shard.nodal),
            cellwise=moved(shard.cellwise),
            cells=shard.cells.to(self._device),
            edge_index=shard.edge_index.to(self._device),
            motions=motions,
        )


def _fits(size: int, device: torch.device) -> bool:
    if device.type != "cuda":
        return False
    free, _ = torch.cuda.mem_get_info(device)
    return size < _SHARE_OF_DEVICE * free
