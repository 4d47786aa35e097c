"""`SingleCoarseStep`: a step of `ProjectiveDynamics` or `Newton` that a network corrects."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.features import FeatureView, Snapshot
from pdcorrect.corrector.gate import GateMeasures
from pdcorrect.corrector.placements import Values, Velocity, as_forces, ballistic, moved
from pdcorrect.solvers.implicit import ImplicitStepper
from pdcorrect.state import State, Status, StepResult

Array = NDArray[np.float64]


class OneBody:
    """What a `Decision` asks about one body, in arrays."""

    def by_node(self, values: Values) -> Values:
        """Values (1,), which are those of all nodes."""
        return values

    def some(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether any flag is set, (1,)."""
        return np.array([flags.any()])

    def sound(self, values: Array) -> NDArray[np.bool_]:
        """Whether all values are finite, (1,)."""
        return np.array([np.isfinite(values).all()])


class SingleCoarseStep:
    """A `CoarseStep` of one scene, on the CPU.

    Parameters
    ----------
    coarse : ImplicitStepper
    bodies : BodyGraph
        Its scene, float64.
    velocity : {"recomputed", "kept"}
        Of corrected answers.
    state : State
        Before the step.
    forces : (N, 3) or None
        Besides the scene's loads, N.
    previous : (N, 3) or None
        Correction of the step before, m.

    Attributes
    ----------
    seconds : float
        Wall clock in the coarse solver.
    """

    def __init__(
        self,
        coarse: ImplicitStepper,
        bodies: BodyGraph,
        velocity: Velocity,
        state: State,
        forces: Array | None = None,
        previous: Array | None = None,
    ) -> None:
        self._coarse, self._graph, self._velocity = coarse, bodies, velocity
        self._problem, self._state, self._forces = coarse.problem, state, forces
        self._previous, self.seconds = previous, 0.0
        stage = coarse.integrate(self._problem, state, coarse.time_step)
        loads = self._problem.external_forces(*stage.loads_over, state.positions)
        self._loads: Array = loads if forces is None else loads + forces

    @property
    def bodies(self) -> OneBody:
        """See `CoarseStep`."""
        return OneBody()

    def own(self, values: Values) -> Values:
        """See `CoarseStep`."""
        return np.asarray(values)

    def view(self, answer: StepResult | None) -> FeatureView:
        """See `CoarseStep`."""
        state, problem = self._state, self._problem
        h, mass, free = self._coarse.time_step, problem.mass, problem.free
        proposed: Array = (
            ballistic(state, h, self._loads, mass, free, problem.clamped_positions(state.time + h))
            if answer is None
            else answer.state.positions
        )
        arrays = state.positions, state.velocities, proposed, self._loads
        positions, velocities, after, loads = map(_tensor, arrays)
        old = None if self._previous is None else _tensor(self._previous)
        return FeatureView(self._graph, Snapshot(positions, velocities, after, loads, old))

    def solved(self, added: Array | None = None, guess: Array | None = None) -> StepResult:
        """See `CoarseStep`; the work of a correction's forces is no ``external_work``."""
        started, forces = time.perf_counter(), self._forces
        push: Array | None = None
        if added is not None:
            push = as_forces(added, self._coarse.time_step, self._problem.mass)
            forces = push if forces is None else forces + push
        answer = self._coarse(self._state, forces, guess=guess)
        self.seconds += time.perf_counter() - started
        if push is None:
            return answer
        work = answer.stats["external_work"] - float(np.vdot(push, self._way(answer)))
        return replace(answer, stats={**answer.stats, "external_work": work})

    def ok(self, answer: StepResult) -> NDArray[np.bool_]:
        """See `CoarseStep`."""
        return np.array([answer.status.ok])

    def moved(self, answer: StepResult, correction: Array) -> StepResult:
        """See `CoarseStep`; statistics are those of the corrected state."""
        scheme = self._coarse.integrate.scheme(self._state, self._coarse.time_step)
        problem = self._problem
        positions, velocities, memory = moved(
            scheme, answer.state, correction, self._velocity,
            lambda x: problem.mass_times(x) * problem.free,
        )  # fmt: skip
        state = State(positions, velocities, answer.state.time, memory)
        ratios = self._problem.volume_ratios(positions)
        ratio = float(ratios.min())
        work = answer.stats["external_work"] + float(np.vdot(self._loads, correction))
        stats = {
            **answer.stats,
            "elastic_energy": self._problem.energy(positions, answer.modes),
            "kinetic_energy": self._kinetic(state),
            "external_work": work,
            "smallest_volume_ratio": ratio,
        }
        status = _status(answer.status, ratio)
        return replace(
            answer, state=state, status=status, stats=stats, modes=None, volume_ratios=ratios
        )

    def measured(self, answer: StepResult) -> GateMeasures:
        """See `CoarseStep`."""
        stored = answer.stats["elastic_energy"] + answer.stats["kinetic_energy"]
        ratios = answer.volume_ratios
        if ratios is None:
            ratios = self._problem.volume_ratios(answer.state.positions)
        return _measured(ratios, stored, float(np.vdot(self._loads, self._way(answer))))

    def before(self) -> GateMeasures:
        """See `CoarseStep`."""
        positions = self._state.positions
        stored = self._problem.energy(positions) + self._kinetic(self._state)
        return _measured(self._problem.volume_ratios(positions), stored, 0.0)

    def chosen(self, which: NDArray[np.bool_], one: StepResult, other: StepResult) -> StepResult:
        """See `CoarseStep`."""
        return one if which.item() else other

    def _way(self, answer: StepResult) -> Array:
        way: Array = answer.state.positions - self._state.positions
        return way

    def _kinetic(self, state: State) -> float:
        return 0.5 * float(np.vdot(state.velocities, self._problem.mass_times(state.velocities)))


def _measured(ratios: Array, stored: float, work: float) -> GateMeasures:
    return GateMeasures(ratios[None], np.array([stored]), np.array([work]))


def _tensor(array: Array) -> Tensor:
    """Of the same memory, which nobody writes to, or of a copy where torch would warn of that."""
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _status(coarse: Status, ratio: float) -> Status:
    """Of a corrected state with a smallest det F.

    How the coarse step was found stays; whether cells are inverted is the corrected state's.
    """
    if coarse not in (Status.CONVERGED, Status.INVERTED):
        return coarse
    return Status.INVERTED if ratio <= 0.0 else Status.CONVERGED
