"""What muscle fibres add to the function that a step minimises, see `fem.fibres`.

Like the body's own elasticity they act at y, by their activation at the time of y: averages of
forces over a step, which some integrators take, are theirs too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.fibres import Fibres
from pdcorrect.solvers.integrators import StepEquation
from pdcorrect.state import State

Array = NDArray[np.float64]


class FibreTerm:
    """Energy of the fibres in one step from ``state``; ``time`` (s) is that of y."""

    def __init__(self, fibres: Fibres, rest: Array, stage: StepEquation, state: State) -> None:
        self._fibres, self._rest, self._stage, self._state = fibres, rest, stage, state
        self.time = state.time + (stage.end - state.time) / stage.gain

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """J and N, (N + B, 3)."""
        u, out = self._displacement(y), np.zeros_like(y)
        out[: len(u)] = -self._fibres.forces(u, self.time)
        return self._fibres.energy(u, self.time), out

    def tangent(self, y: Array, project: bool = False) -> FibreTangent:
        """The second derivative at y; ``project`` leaves out what is negative."""
        matrices = self._fibres.matrices(self._displacement(y), self.time, project)
        return FibreTangent(self._fibres, matrices)

    def relaxed_tangent(self, y: Array) -> FibreTangent:
        """The same at y if fibres were at rest there, whatever the time."""
        _, along = self._fibres.stretched(self._displacement(y))
        outer = along[:, :, None] * along[:, None, :]
        return FibreTangent(self._fibres, self._fibres.weights[:, None, None] * outer)

    def report(self, y: Array) -> dict[str, float]:
        """Work of the change of activation in the step, J."""
        fibres, start, end = self._fibres, self._state.time, self._stage.end
        before = self._state.positions - self._rest
        after = self._stage.moved(y[: len(before)]) - self._rest
        by_start, by_end = (fibres.tensions(u, time) for u, time in ((before, start), (after, end)))
        change = (fibres.activations(end) - fibres.activations(start))[fibres.owners]
        return {"actuator_work": -0.5 * float(change @ (by_start + by_end))}

    def slopes(self, y: Array, z: Array) -> tuple[Array, ...]:
        """Derivatives of z . forces by the stretches of each actuator's table, for z (N, 3)."""
        by_activation = self._fibres.pulls(self._displacement(y), z[: len(self._rest)])
        shares = self._fibres.shares(self.time)
        return tuple(slope * share for slope, share in zip(by_activation, shares, strict=True))

    def _displacement(self, y: Array) -> Array:
        return y[: len(self._rest)] - self._rest


@dataclass(frozen=True, eq=False)
class FibreTangent:
    """Second derivatives of the fibres' energy by their stretched vectors, (P, 3, 3), J."""

    fibres: Fibres
    matrices: Array

    def apply(self, x: Array) -> Array:
        """Times x (N + B, 3)."""
        A, out = self.fibres.stretching, np.zeros_like(x)
        nodes = A.shape[1]
        out[:nodes] = A.T @ np.einsum("pij,pj->pi", self.matrices, A @ x[:nodes])
        return out

    def add_to(self, blocks: Array) -> None:
        """Add to the cells' matrices (C, L, L, 3, 3)."""
        found = self.fibres.blocks(self.matrices)
        width = found.shape[1]
        np.add.at(blocks[:, :width, :width], self.fibres.cells, found)
