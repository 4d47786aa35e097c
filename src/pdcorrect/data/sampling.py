"""`ShardShuffle`: a random order of windows that still reads file by file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError, require_extra

require_extra("torch", "learn")

from torch.utils.data import Sampler  # noqa: E402

if TYPE_CHECKING:
    from pdcorrect.data.reader import TrajectoryDataset


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
        If a number is out of range, or there are fewer windows than ranks.
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
        if seed < 0:
            raise InputError(f"seed = {seed}: expected 0 or more.")
        if not 0 <= rank < world_size:
            raise InputError(f"rank = {rank} of {world_size}: expected 0 to {world_size - 1}.")
        if block is not None and block < 1:
            raise InputError(f"block = {block}: expected 1 file or more.")
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
