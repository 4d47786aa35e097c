"""States of many scenes together, and what a step makes of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, scene_name
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
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


# --- checks ---------------------------------------------------------------------------------------


def check_tensor(cells: CellBatch, name: str, x: Tensor) -> None:
    """Refuse what is no tensor of the batch's type on its device."""
    kind = f"{x.dtype} on {x.device}" if isinstance(x, Tensor) else f"a {type(x).__name__}"
    if kind != f"{cells.dtype} on {cells.rest.device}":
        raise InputError(
            f"{name}: {kind}; expected a tensor of {cells.dtype} on {cells.rest.device}, as the "
            "stepper: convert it, or make the stepper with other dtype= and device=."
        )


def check_nodal(cells: CellBatch, name: str, x: Tensor) -> None:
    """Refuse what is not (B, N, 3) of the batch's type on its device."""
    check_tensor(cells, name, x)
    wanted = (cells.sizes.scenes, cells.sizes.nodes, 3)
    if tuple(x.shape) != wanted:
        raise InputError(
            f"{name}: {tuple(x.shape)}; expected {wanted}: scenes, nodes of the largest one, 3."
        )


def check_finite(problems: Sequence[Problem], name: str, x: Tensor) -> None:
    """Refuse a nodal tensor with NaN or infinity, in padding too, naming scene and node."""
    bad = (~torch.isfinite(x).all(dim=2)).nonzero()
    if len(bad):
        scene, node = bad[0].tolist()
        raise InputError(
            f"{name} of node {node} in scene {scene_name(problems, scene)} is "
            f"{x[scene, node].tolist()}: expected finite numbers."
        )


def check_states(cells: CellBatch, states: Sequence[State]) -> tuple[State, ...]:
    """The states; refused where there is not one for each scene, or shapes are wrong."""
    states = tuple(states)
    if len(states) != len(cells.node_counts):
        raise InputError(f"{len(states)} states: expected {len(cells.node_counts)}, one a scene.")
    for i, (state, count) in enumerate(zip(states, cells.node_counts, strict=True)):
        if len(state.positions) != count:
            raise InputError(f"state {i} has {len(state.positions)} nodes: expected {count}.")
    names = set(states[0].memory)
    if any(set(s.memory) != names for s in states):
        raise InputError("some states have a memory that others lack: expected all or none.")
    return states


def check_state(cells: CellBatch, state: BatchState) -> None:
    """Refuse what is no state of the batch."""
    check_nodal(cells, "positions", state.positions)
    check_nodal(cells, "velocities", state.velocities)
    _finite_times(cells, state.times)
    for name, x in state.memory.items():
        check_nodal(cells, f"memory {name!r}", x)


def start_times(cells: CellBatch, times: Sequence[float] | None) -> tuple[float, ...]:
    """One time for each scene, s; zeros if there are none."""
    return (0.0,) * cells.sizes.scenes if times is None else _finite_times(cells, times)


def _finite_times(cells: CellBatch, times: Sequence[float]) -> tuple[float, ...]:
    scenes = cells.sizes.scenes
    try:
        found = tuple(float(t) for t in times)
    except (TypeError, ValueError):
        found = ()
    if len(found) != scenes or not all(map(math.isfinite, found)):
        raise InputError(f"times = {times!r}: expected {scenes} finite numbers, one a scene.")
    return found
