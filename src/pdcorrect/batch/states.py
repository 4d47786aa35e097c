"""States of many scenes together, and what a step makes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, Sizes
from pdcorrect.batch.minimise import HISTORY
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


@dataclass(frozen=True, eq=False)
class Solved:
    """The solutions of a step's equations, which its derivatives need.

    Attributes
    ----------
    y : (B, U, 3) tensor
        Configurations.
    statuses : list of Status
    """

    y: Tensor
    statuses: list[Status]


@dataclass(frozen=True, eq=False)
class BatchResult(Solved):
    """Outcome of a step of B scenes.

    Attributes
    ----------
    y, statuses
        See `Solved`.
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
    rows, at = which.cpu().numpy(), which[:, None, None]
    a, b = one.state, other.state
    pairs = zip(rows, one.statuses, other.statuses, strict=True)
    return BatchResult(
        torch.where(at, one.y, other.y),
        [first if row else second for row, first, second in pairs],
        BatchState(
            torch.where(at, a.positions, b.positions),
            torch.where(at, a.velocities, b.velocities),
            a.times,
            {name: torch.where(at, x, b.memory[name]) for name, x in a.memory.items()},
        ),
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

    def nodal(arrays: Sequence[Array]) -> Tensor:
        return cells.nodal(arrays)[:, : cells.sizes.nodes]

    return BatchState(
        nodal([s.positions for s in states]),
        nodal([s.velocities for s in states]),
        tuple(s.time for s in states),
        {name: nodal([s.memory[name] for s in states]) for name in names},
    )


def apart(cells: CellBatch, batch: BatchState) -> list[State]:
    """The scenes' states one by one."""
    return [state_of(cells, batch, i) for i in range(len(cells.node_counts))]


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


def with_states(cells: CellBatch, batch: BatchState, new: Mapping[int, State]) -> BatchState:
    """The same states, but other ones in some scenes, all with the same memory."""

    def nodal(x: Tensor, arrays: Mapping[int, Array]) -> Tensor:
        out = x.clone()
        for i, array in arrays.items():
            out[i, : len(array)] = cells.tensor(array)
        return out

    return BatchState(
        nodal(batch.positions, {i: s.positions for i, s in new.items()}),
        nodal(batch.velocities, {i: s.velocities for i, s in new.items()}),
        batch.times,
        {
            name: nodal(x, {i: s.memory[name] for i, s in new.items()})
            for name, x in batch.memory.items()
        },
    )


_LIBRARIES = 4e8
"""Bytes of the libraries' work spaces and of small tensors."""

_INVERTING = 6
"""Matrices in double precision while one is inverted."""

_VECTORS, _NUMBERS_A_POINT = 40, 120
"""Of working memory: configurations, and numbers at each quadrature point."""

_GRIDS = 420
"""Bytes a node of the finest mesh, of all finer levels of multigrid and a cycle's work on them."""

_MATRIX = 4 * 24**2 * 8 // 7
"""Bytes of a cell's matrix with its share of those of coarser cells."""


def expected_bytes(
    sizes: Sizes, distinct: int, width: int, coarse: int = 0, matrices: int = 0
) -> int:
    """Expected peak memory of steps and derivatives on a GPU, in double precision.

    4 K (w N)^2 bytes for K distinct inverses of bodies of N nodes, with w = 3 for the first
    Hessian "rest" and 1 for others, and the larger of

    - 48 (w N)^2, while one of them is made;
    - B (24 U (2 m + 40) + 960 C Q) for B scenes of U nodes and internal modes and C cells of
      Q points, with m pairs of L-BFGS, while steps are taken;

    and 0.4 GB.  Within a third of what was measured from 64 coarse scenes or one fine one
    on (``benchmarks``, batch.py).

    With the first Hessian "multigrid", N is that of the coarsest mesh, and the levels above
    take 420 B N' + 2633 n bytes more for N' nodes and n unlike cells.

    Parameters
    ----------
    sizes : Sizes
    distinct : int
        Scenes with unlike mesh, material or clamps.
    width : int
        Unknowns a node of the first Hessian: 3 for "rest" and "multigrid", else 1.
    coarse : int
        Nodes of the coarsest mesh with "multigrid", else 0.
    matrices : int
        Cells that have a matrix of their own with "multigrid".
    """
    square = (width * (coarse or sizes.nodes)) ** 2
    levels = sizes.scenes * sizes.nodes * _GRIDS + matrices * _MATRIX if coarse else 0
    vectors = 24 * sizes.unknowns * (2 * HISTORY + _VECTORS)
    points = 8 * sizes.cells * sizes.points * _NUMBERS_A_POINT
    working = sizes.scenes * (vectors + points)
    dense = 4 * distinct * square
    return int(dense + levels + max(8 * _INVERTING * square, working) + _LIBRARIES)
