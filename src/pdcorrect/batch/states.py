"""States of many scenes together, and what a step makes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.state import State, Status

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BatchState:
    """States of B scenes, padded: nodal tensors (B, N, 3), zero beyond a scene's nodes.

    Attributes
    ----------
    positions, velocities : (B, N, 3) tensors
        m and m/s.
    times : tuple of float
        s.
    memory : mapping of str to (B, N, 3) tensors
        See `State.memory`.
    """

    positions: Tensor
    velocities: Tensor
    times: tuple[float, ...]
    memory: Mapping[str, Tensor] = field(default_factory=dict)

    def where(self, which: Tensor, other: BatchState) -> BatchState:
        """These states in the scenes where ``which`` (B,) holds, another's in the rest.

        At these times, and with the entries of this memory, which are zero where the other has
        none.
        """
        at = which[:, None, None]
        return BatchState(
            torch.where(at, self.positions, other.positions),
            torch.where(at, self.velocities, other.velocities),
            self.times,
            {n: torch.where(at, x, other.memory.get(n, 0.0)) for n, x in self.memory.items()},
        )


@dataclass(frozen=True, eq=False)
class Solved:
    """The solutions y (B, U, 3) of a step's equations, which its derivatives need."""

    y: Tensor
    statuses: list[Status]


@dataclass(frozen=True, eq=False)
class BatchResult(Solved):
    """Outcome of a step of B scenes.

    Attributes
    ----------
    y : (B, U, 3) tensor
        Configurations.
    statuses : list of Status
    state : BatchState
    iterations, evaluations : (B,) int
    error_estimates : (B,)
        m; infinite where there is none.
    smallest_volume_ratios : (B,)
        Smallest det F of each body, see `ElasticBody.volume_ratios`.
    """

    state: BatchState
    iterations: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    error_estimates: Array
    smallest_volume_ratios: Array


def chosen(which: Tensor, one: BatchResult, other: BatchResult) -> BatchResult:
    """The outcome of some scenes, ``which`` (B,) bool, and for the rest another one's."""
    rows = which.cpu().numpy()
    pairs = zip(rows, one.statuses, other.statuses, strict=True)
    return BatchResult(
        torch.where(which[:, None, None], one.y, other.y),
        [first if row else second for row, first, second in pairs],
        one.state.where(which, other.state),
        np.where(rows, one.iterations, other.iterations),
        np.where(rows, one.evaluations, other.evaluations),
        np.where(rows, one.error_estimates, other.error_estimates),
        np.where(rows, one.smallest_volume_ratios, other.smallest_volume_ratios),
    )


def in_one(statuses: Sequence[Status]) -> list[bool]:
    """Whether each scene's step has a result, and not in smaller parts: so it has derivatives."""
    return [s.ok and s is not Status.SUBSTEPPED for s in statuses]


def together(cells: CellBatch, states: Sequence[State]) -> BatchState:
    """States of the scenes of a batch together."""
    names = set(states[0].memory)
    return BatchState(
        cells.nodal([s.positions for s in states]),
        cells.nodal([s.velocities for s in states]),
        tuple(s.time for s in states),
        {name: cells.nodal([s.memory[name] for s in states]) for name in names},
    )


def state_of(cells: CellBatch, batch: BatchState, i: int) -> State:
    """The state of one scene."""

    def host(x: Tensor) -> Array:
        rows: Array = x[i, : cells.node_counts[i]].detach().to("cpu", torch.float64).numpy().copy()
        return rows

    return State(
        host(batch.positions),
        host(batch.velocities),
        batch.times[i],
        {name: host(x) for name, x in batch.memory.items()},
    )
