"""`BatchCoarseStep`: a step of a `BatchStepper` that a network corrects, on its device."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pdcorrect.batch.objective import dot
from pdcorrect.batch.states import BatchResult, BatchState, chosen, state_of
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_bodies import BatchBodies, check_corrector
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import View
from pdcorrect.corrector.gate import Measured
from pdcorrect.corrector.placements import Velocity, check_velocity, moved
from pdcorrect.corrector.recorded import RecordedMeasures, stored_and_ratios
from pdcorrect.corrector.values import Values
from pdcorrect.errors import InputError


class BatchParts:
    """What both forms of a hybrid of many scenes have: its parts, checked."""

    def __init__(
        self,
        stepper: BatchStepper,
        corrector: Corrector,
        velocity: Velocity,
        recorded: bool = False,
    ) -> None:
        self.nodes = BatchBodies(stepper)
        self.corrector = check_corrector(corrector, stepper.device)
        check_velocity(velocity, stepper.integrator)
        self.stepper, self.velocity = stepper, velocity
        self.placement = corrector.config.placement
        self.measures = RecordedMeasures(stepper) if recorded else None

    def view(self, before: BatchState, coarse: Tensor | None, previous: Tensor | None) -> View:
        """What the network sees of a step."""
        self.check_previous(previous)
        return View(self.nodes.graph, self.nodes.snapshot(before, coarse, previous))

    def check_previous(self, previous: Tensor | None) -> None:
        """Refuse a correction of other bodies."""
        expected = self.nodes.graph.rest.shape
        if previous is not None and previous.shape != expected:
            raise InputError(
                f"previous: {tuple(previous.shape)}; expected the correction of the step before, "
                f"{tuple(expected)}, or None."
            )

    def moved(self, before: BatchState, after: BatchState, correction: Tensor) -> BatchState:
        """The state after a step with a correction (n, 3) added."""
        scheme = self.stepper.staging(before).scheme
        shift = self.nodes.padded(correction)
        positions, velocities, memory = moved(scheme, after, shift, self.velocity)
        return replace(after, positions=positions, velocities=velocities, memory=memory)


class WithNodes:
    """Nodal values of all scenes with and without padding."""

    _hybrid: BatchParts

    @property
    def bodies(self) -> BodyGraph:
        """The scenes as the network knows them, float64, on the stepper's device."""
        return self._hybrid.nodes.graph

    def flat(self, x: Tensor) -> Tensor:
        """Nodal values (B, N, ...) of scenes, float64, without padding: (n, ...)."""
        return self._hybrid.nodes.flat(x)

    def padded(self, x: Tensor) -> Tensor:
        """Values (n, ...) as (B, N, ...) in the stepper's type, zero in padding."""
        return self._hybrid.nodes.padded(x)


class BatchCoarseStep:
    """A `CoarseStep` of B scenes.

    Where y of the integrator is the end of the step (all but midpoint and generalised-alpha),
    the internal modes of a corrected answer stay those of the coarse one: relaxed again, which a
    single scene's `HybridStepper` does, they would only lower its energy, so the gate is
    never more lenient here.  Else y's modes belong to another time, and the gate relaxes those
    at the end of the step, scene by scene on the CPU.

    Parameters
    ----------
    parts : BatchParts
    state : BatchState
        Before the step.
    previous : (n, 3) or None
        Correction of the step before, m.
    """

    def __init__(self, parts: BatchParts, state: BatchState, previous: Tensor | None) -> None:
        self._parts, self._stepper = parts, parts.stepper
        self._state, self._previous = state, previous
        self._loads: Tensor | None = None

    @property
    def bodies(self) -> BodyGraph:
        """See `CoarseStep`."""
        return self._parts.nodes.graph

    def own(self, values: Values) -> Values:
        """See `CoarseStep`."""
        return values

    def view(self, answer: BatchResult | None) -> View:
        """See `CoarseStep`."""
        proposed = None if answer is None else answer.state.positions
        view = self._parts.view(self._state, proposed, self._previous)
        self._loads = self._parts.nodes.padded(view.snapshot.forces)
        return view

    def solved(self, added: Tensor | None = None, guess: Tensor | None = None) -> BatchResult:
        """See `CoarseStep`."""
        nodes = self._parts.nodes
        forces = None if added is None else nodes.forces(added)
        return self._stepper(self._state, forces, None if guess is None else nodes.padded(guess))

    def ok(self, answer: BatchResult) -> Tensor:
        """See `CoarseStep`."""
        fine = torch.tensor([s.ok for s in answer.statuses])
        return fine.to(self._stepper.device, non_blocking=True)

    def moved(self, answer: BatchResult, correction: Tensor) -> BatchResult:
        """See `CoarseStep`; only the state is another one."""
        return replace(answer, state=self._parts.moved(self._state, answer.state, correction))

    def measured(self, answer: BatchResult) -> Measured:
        """See `CoarseStep`."""
        state = answer.state
        assert self._loads is not None, "the network was asked before"
        with self._stepper.alone():
            work = dot(self._loads, state.positions - self._state.positions)
            return self._with_work(state, self._configuration(answer), work)

    def before(self) -> Measured | None:
        """See `CoarseStep`; None with internal modes, which states of batches do not have."""
        if self._stepper.cells.sizes.modes:
            return None
        with self._stepper.alone():
            nothing = torch.zeros_like(self._state.positions[:, 0, 0])
            return self._with_work(self._state, self._state.positions, nothing)

    def chosen(self, which: Tensor, one: BatchResult, other: BatchResult) -> BatchResult:
        """See `CoarseStep`."""
        return chosen(which, one, other)

    def _with_work(self, state: BatchState, y: Tensor, work: Tensor) -> Measured:
        recorded, motion = self._parts.measures, (state.positions, state.velocities, y)
        if recorded is not None:
            return recorded(*motion, work)
        stored, ratios = stored_and_ratios(self._stepper, *motion)
        return Measured(ratios, stored, work)

    def _configuration(self, answer: BatchResult) -> Tensor:
        """The end of the step, (B, U, 3)."""
        cells, positions = self._stepper.cells, answer.state.positions
        if cells.sizes.modes and self._stepper.staging(self._state).scheme.gain != 1.0:
            scenes = range(cells.sizes.scenes)
            ends = [state_of(cells, answer.state, i).positions for i in scenes]
            relaxed = [self._stepper.problem_now(i).relaxed(end) for i, end in enumerate(ends)]
            return cells.configurations(relaxed)
        return torch.cat([positions, answer.y[:, cells.sizes.nodes :]], dim=1)
