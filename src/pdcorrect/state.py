"""`State` and `StepResult`: what a stepper takes and gives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError

Array = NDArray[np.float64]


class Status(Enum):
    """How a step ended; the value is the message.

    `ok` is true for every state that satisfies the step's equations to the
    tolerance, whatever it took to find it.
    """

    CONVERGED = "converged"
    RECOVERED = "converged after falling back to Newton-CG"
    SUBSTEPPED = "converged only with smaller time steps inside the frame"
    INVERTED = "converged, but with cells that are inverted or folded"
    ITERATION_LIMIT = "failed: iteration limit reached before the tolerance"
    LINE_SEARCH = "failed: no decrease along the search direction"
    NOT_FINITE = "failed: the state became infinite or NaN"

    @property
    def ok(self) -> bool:
        """Whether the step's equations are satisfied."""
        return self in (Status.CONVERGED, Status.RECOVERED, Status.SUBSTEPPED, Status.INVERTED)


@dataclass(frozen=True, eq=False)
class State:
    """Positions (m) and velocities (m/s), each (N, 3) float64, at a time (s).

    Attributes
    ----------
    memory : mapping of str to (N, 3) float64
        What the next step depends on besides, by name: for a time integrator accelerations and
        forces, or positions and velocities of an earlier frame; for a `HybridStepper` the
        correction before.  It belongs to these positions and velocities, and to one mesh, element
        and material: leave it out when you change them.
    """

    positions: Array
    velocities: Array
    time: float = 0.0
    memory: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        positions = _nodal("positions", self.positions)
        memory = {n: _nodal(f"memory {n!r}", a, positions) for n, a in self.memory.items()}
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "velocities", _nodal("velocities", self.velocities, positions))
        object.__setattr__(self, "memory", memory)
        if not math.isfinite(self.time):
            raise InputError(f"time = {self.time}: expected a finite number of seconds.")

    def __repr__(self) -> str:
        return f"State({len(self.positions)} nodes, t = {self.time:g} s)"


def _nodal(name: str, values: Array, positions: Array | None = None) -> Array:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name}: expected shape (N, 3), got {array.shape}.")
    if positions is not None and array.shape != positions.shape:
        raise InputError(f"{name}: expected shape {positions.shape}, got {array.shape}.")
    return array


@dataclass(frozen=True, eq=False)
class StepResult:
    """One step's outcome.

    Attributes
    ----------
    state : State
        The state after the step; after a failed step the best iterate.
    status : Status
        Whether and how the step converged.
    iterations : int
        Iterations of the minimisation, fallbacks included.
    residual : float
        Largest out-of-balance force on a free node component, N.
    error_estimate : float
        Estimated largest distance of a node from the step's exact solution, m.
    stats : mapping of str to float
        Energies (J) after the step and solver counters.
    modes : (B, 3) or None
        Internal modes at the end of the step, m, of elements that have some; None too where a
        network has moved the nodes.
    volume_ratios : (C,) or None
        Smallest det F of each cell of ``state``, see `ElasticBody.volume_ratios`; None where they
        were not measured.
    """

    state: State
    status: Status
    iterations: int
    residual: float
    error_estimate: float
    stats: Mapping[str, float] = field(default_factory=dict)
    modes: NDArray[np.float64] | None = None
    volume_ratios: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        return (
            f"StepResult({self.status.value}, {self.iterations} iterations, estimated error "
            f"{self.error_estimate:.2g} m, {self.state!r})"
        )


_SUMMED = frozenset({
    "evaluations", "external_work", "clamp_work", "damping_loss", "obstacle_work",
    "friction_loss", "actuator_work",
})  # fmt: skip
_LEAST = frozenset({"smallest_volume_ratio", "smallest_gap"})


def joined_stats(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Statistics of what was made in parts: sums, least values, and else the last part's."""
    out = {}
    for name, last in parts[-1].items():
        values = [part[name] for part in parts if name in part]
        out[name] = sum(values) if name in _SUMMED else min(values) if name in _LEAST else last
    return out
