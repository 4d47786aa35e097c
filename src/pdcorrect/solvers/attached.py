"""Energies that a scene attaches to the body, in a step: fibres of muscles, oblique rollers.

Fibres act at y, as they are at the time of y, like the body's own elasticity: averages of forces
over a step, which some integrators take, are theirs too.  Rollers hold at the end of the step,
p'(y), as clamps do: with g = dp'/dy their term is W(p')/g, whose forces are those at p'.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.fibres import Fibres
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.rollers import Rollers
from pdcorrect.solvers.integrators import StepEquation
from pdcorrect.state import State

Array = NDArray[np.float64]


class Tangent(Protocol):
    """A second derivative: its product with x (N + B, 3), and its sum with cells' matrices."""

    def apply(self, x: Array) -> Array: ...
    def add_to(self, blocks: Array) -> None: ...


class AttachedTerm:
    """Of one step from ``state``."""

    def __init__(self, problem: Problem, stage: StepEquation, state: State) -> None:
        self._problem, self._stage, self._state = problem, stage, state
        self._middle = state.time + (stage.end - state.time) / stage.gain
        self._rest = problem.positions

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """J and N, (N + B, 3)."""
        value, out, nodes = 0.0, np.zeros_like(y), len(self._rest)
        factor = self._stage.load_factor
        for part, place, time in self._acting(y):
            share = factor if part.at_end else 1.0
            energy, forces = part.energy_and_forces(place, time)
            value += share / (self._stage.gain if part.at_end else 1.0) * energy
            out[:nodes] -= share * forces
        return value, out

    def end_forces(self, y: Array) -> Array:
        """Of those that act at the end of the step, in the equation, (N, 3), N."""
        out = np.zeros_like(self._rest)
        for part, place, time in self._acting(y):
            if part.at_end:
                out += self._stage.load_factor * part.energy_and_forces(place, time)[1]
        return out

    def end_slopes(self, y: Array, z: Array) -> Array:
        """Derivatives of z . `end_forces` by the positions after the step, (N, 3), for z (N, 3)."""
        out = np.zeros_like(z)
        for part, place, time in self._acting(y):
            if part.at_end:
                out -= self._stage.load_factor * part.tangent(place, time).apply(z)
        return out

    def tangents(self, y: Array, project: bool = False) -> list[Tangent]:
        """The second derivatives at y; ``project`` leaves out what is negative."""
        share = self._stage.load_factor * self._stage.gain
        return [
            part.tangent(place, time, project, share if part.at_end else 1.0)
            for part, place, time in self._acting(y)
        ]

    def work(self, y: Array) -> dict[str, float]:
        """What changes of activation put in during the step, J."""
        fibres, nodes = self._problem.fibres, len(self._rest)
        if fibres is None:
            return {}
        before = self._state.positions - self._rest, self._state.time
        after = self._stage.moved(y[:nodes]) - self._rest, self._stage.end
        return {"actuator_work": fibres.work(before, after)}

    def activation_slopes(self, y: Array, z: Array) -> tuple[Array, ...]:
        """Derivatives of z . forces by the stretches of each actuator's table, for z (N + B, 3)."""
        fibres, nodes = self._problem.fibres, len(self._rest)
        assert fibres is not None
        by_activation = fibres.pulls(y[:nodes] - self._rest, z[:nodes])
        shares = fibres.shares(self._middle)
        return tuple(slope * share for slope, share in zip(by_activation, shares, strict=True))

    def _acting(self, y: Array) -> Iterator[tuple[Fibres | Rollers, Array, float]]:
        """Each part with the displacements (N, 3) and the time at which it acts."""
        nodal = y[: len(self._rest)]
        for part in self._problem.attached:
            if part.at_end:
                yield part, self._stage.moved(nodal) - self._rest, self._stage.end
            else:
                yield part, nodal - self._rest, self._middle
