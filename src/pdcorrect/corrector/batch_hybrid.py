"""`BatchHybrid` and `HybridLayer`: steps of a `BatchStepper`, corrected by a network.

hybrid = BatchHybrid(pc.BatchStepper(problems, device="cuda"), corrector.to("cuda"))
result = hybrid(state)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from pdcorrect.batch.checks import check_nodal, check_state, start_times
from pdcorrect.batch.layer import OnFailure, PDLayer
from pdcorrect.batch.objective import by_scene, dot
from pdcorrect.batch.states import BatchResult, BatchState, chosen, state_of
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_bodies import BatchBodies, check_corrector
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrected_step import corrected_step
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import FeatureView
from pdcorrect.corrector.gate import Gate, GateMeasures, check_gate
from pdcorrect.corrector.graph_replay import (
    UNRECORDABLE,
    RecordedCorrector,
    RecordedMeasures,
    recordable,
    stored_and_ratios,
)
from pdcorrect.corrector.placements import Values, Velocity, check_velocity, moved
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

    def view(
        self, before: BatchState, coarse: Tensor | None, previous: Tensor | None
    ) -> FeatureView:
        """What the network sees of a step."""
        self.check_previous(previous)
        return FeatureView(self.nodes.graph, self.nodes.snapshot(before, coarse, previous))

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
        positions, velocities, memory = moved(
            scheme,
            after,
            shift,
            self.velocity,
            lambda x: _TimesMass.apply(self.stepper, x),  # type: ignore[no-untyped-call]
        )
        return replace(after, positions=positions, velocities=velocities, memory=memory)


class _TimesMass(torch.autograd.Function):
    """The mass matrix times nodal values (B, N, 3), both zero where clamped."""

    @staticmethod
    def forward(ctx: Any, stepper: BatchStepper, x: Tensor) -> Tensor:
        ctx.stepper = stepper
        free, staging = stepper.staging.free, stepper.staging
        moved = stepper.objective.mass(staging.extended(x.detach() * free))
        return moved[:, : x.shape[1]] * free

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        return None, _TimesMass.forward(ctx, ctx.stepper, grads[0])


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

    Where y of the integrator is the end of the step (all but midpoint),
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

    def view(self, answer: BatchResult | None) -> FeatureView:
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

    def measured(self, answer: BatchResult) -> GateMeasures:
        """See `CoarseStep`."""
        state = answer.state
        assert self._loads is not None, "the network was asked before"
        with self._stepper.alone():
            work = dot(self._loads, state.positions - self._state.positions)
            return self._with_work(state, self._configuration(answer), work)

    def before(self) -> GateMeasures | None:
        """See `CoarseStep`; None with internal modes, which states of batches do not have."""
        if self._stepper.cells.sizes.modes:
            return None
        with self._stepper.alone():
            nothing = torch.zeros_like(self._state.positions[:, 0, 0])
            return self._with_work(self._state, self._state.positions, nothing)

    def chosen(self, which: Tensor, one: BatchResult, other: BatchResult) -> BatchResult:
        """See `CoarseStep`."""
        return chosen(which, one, other)

    def _with_work(self, state: BatchState, y: Tensor, work: Tensor) -> GateMeasures:
        recorded, motion = self._parts.measures, (state.positions, state.velocities, y)
        if recorded is not None:
            return recorded(*motion, work)
        stored, ratios = stored_and_ratios(self._stepper, *motion)
        return GateMeasures(ratios, stored, work)

    def _configuration(self, answer: BatchResult) -> Tensor:
        """The end of the step, (B, U, 3)."""
        cells, positions = self._stepper.cells, answer.state.positions
        if cells.sizes.modes and self._stepper.staging(self._state).scheme.gain != 1.0:
            scenes = range(cells.sizes.scenes)
            ends = [state_of(cells, answer.state, i).positions for i in scenes]
            relaxed = [self._stepper.problem_now(i).relaxed(end) for i, end in enumerate(ends)]
            return cells.configurations(relaxed)
        return torch.cat([positions, answer.y[:, cells.sizes.nodes :]], dim=1)


@dataclass(frozen=True, eq=False)
class BatchHybridResult:
    """Outcome of a corrected step of B scenes with n nodes in all.

    Attributes
    ----------
    state : BatchState
    correction : (n, 3) tensor
        As applied, m: to positions, or, by the placement, as forces or to the first iterate.
        Zero where it was refused.
    coarse : BatchResult
        Of the coarse solver, its statuses too; with placement "force" under the corrected
        loads where they count.  Steps that converged to inverted cells are corrected like others.
    reasons : (B,) int64 tensor
        Numbers of `Reason`: why the plain coarse answer was kept; 0 where it was not.
    """

    state: BatchState
    correction: Tensor
    coarse: BatchResult
    reasons: Tensor

    @property
    def refused(self) -> Tensor:
        """Whether the plain coarse answer was kept, (B,) bool."""
        return self.reasons > 0


class BatchHybrid(WithNodes):
    """Steps many scenes and corrects each; no gradients.

    A scene whose correction is exactly zero, or refused, keeps its coarse step bit for bit.

    Parameters
    ----------
    stepper : BatchStepper
    corrector : Corrector
        Fitted, on the stepper's device.
    velocity : {"recomputed", "kept"}
        Of corrected states: what the integrator makes of the corrected positions, by backward
        Euler v = (p - p_before)/h, or the coarse solver's.  For placement "state".
    gate : Gate, optional
        What else is refused than corrections that are not finite, and those of scenes whose
        coarse step fails.
    recorded : bool
        Whether a GPU compiles the network and records its work, and the gate's, in the first step,
        to replay it in the others (see `RecordedCorrector`).  On the CPU it changes nothing.  On
        an H200 the first step takes about a minute, and a correction of 256 scenes a third of
        what it takes otherwise (``benchmarks``).

    Raises
    ------
    InputError
        If the parts do not fit each other, or the corrector cannot be recorded.
    """

    def __init__(
        self,
        stepper: BatchStepper,
        corrector: Corrector,
        *,
        velocity: Velocity = "recomputed",
        gate: Gate | None = None,
        recorded: bool = False,
    ) -> None:
        self._hybrid = BatchParts(stepper, corrector, velocity, recorded)
        self.stepper, self.corrector, self.gate = stepper, corrector, gate
        check_gate(gate)
        self._recorded: RecordedCorrector | None = None
        if recorded:
            if not recordable(corrector):
                raise InputError(UNRECORDABLE)
            self._recorded = RecordedCorrector(corrector)

    @torch.no_grad()
    def __call__(self, state: BatchState, previous: Tensor | None = None) -> BatchHybridResult:
        """Advance all scenes by one step.

        Parameters
        ----------
        state : BatchState
        previous : (n, 3) tensor, optional
            Correction of the step before, m, for networks that ask for it; zero by default.

        Raises
        ------
        InputError
            If the state is not the stepper's, or a tensor has another shape, type or device.
        """
        check_state(self.stepper.cells, state)
        with self.stepper.alone():
            step = BatchCoarseStep(self._hybrid, state, previous)
            answers = self.corrector if self._recorded is None else self._recorded
            answer, coarse, decision = corrected_step(step, answers, self.gate)
        return BatchHybridResult(answer.state, decision.correction, coarse, decision.reasons)


class HybridLayer(WithNodes, nn.Module):
    """One corrected step of many scenes, differentiable by the network's weights.

    Call it again with what it returned for more steps.  The corrector is a submodule.

    Parameters
    ----------
    stepper : BatchStepper
        With an integrator that needs no memory, see `PDLayer`.
    corrector : Corrector
        Fitted, on the stepper's device.
    through_solver : bool
        Whether derivatives go back through the coarse solver, the network's inputs and so
        earlier steps.  If not, the state that a call is given counts as fixed: each step's
        correction has derivatives by the weights through that step alone.
    velocity : {"recomputed", "kept"}
        See `BatchHybrid`.
    on_failure : {"raise", "zero"}
        See `PDLayer`.

    Attributes
    ----------
    steps : PDLayer
        The coarse step; its ``statuses`` are those of the last call.

    Raises
    ------
    InputError
        If the parts do not fit each other.

    Notes
    -----
    Scenes whose step fails, where that does not raise, have a correction of zero and no part in
    the derivatives by the weights.  Nothing is refused here.

    With placement "guess" positions and velocities do not depend on the network: only the
    correction does.  Derivatives by forces of the same step, for placement "force", go through
    the solver in any case.
    """

    def __init__(
        self,
        stepper: BatchStepper,
        corrector: Corrector,
        *,
        through_solver: bool,
        velocity: Velocity = "recomputed",
        on_failure: OnFailure = "raise",
    ) -> None:
        super().__init__()
        self._hybrid = BatchParts(stepper, corrector, velocity)
        self.corrector, self.through_solver = corrector, through_solver
        self.steps = PDLayer(stepper, on_failure=on_failure)

    def forward(
        self,
        positions: Tensor,
        velocities: Tensor,
        times: Sequence[float] | None = None,
        previous: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Positions and velocities (B, N, 3) after the step, and the correction (n, 3), m.

        Parameters
        ----------
        positions, velocities : (B, N, 3) tensors
            m and m/s.
        times : (B,) floats, optional
            At the start of the step, s; 0 by default.
        previous : (n, 3) tensor, optional
            Correction of the step before, m; zero by default.

        Raises
        ------
        InputError
            If a tensor has another shape, type or device.
        ConvergenceError
            If the coarse step or its derivative fails, unless ``on_failure`` is "zero".
        """
        hybrid, cells = self._hybrid, self._hybrid.stepper.cells
        check_nodal(cells, "positions", positions)
        check_nodal(cells, "velocities", velocities)
        hybrid.check_previous(previous)
        if not self.through_solver:
            positions, velocities = positions.detach(), velocities.detach()
            previous = None if previous is None else previous.detach()
        before = BatchState(positions, velocities, start_times(cells, times))
        if hybrid.placement == "force":
            after, correction = self._forced(before, previous)
        else:
            after, correction = self._corrected(before, self._step(before, None), previous)
        return after.positions, after.velocities, correction

    def _corrected(
        self, before: BatchState, after: BatchState, previous: Tensor | None
    ) -> tuple[BatchState, Tensor]:
        """The state after a step, corrected; scenes whose step failed have no part in it."""
        hybrid, ok = self._hybrid, self._converged()
        at_nodes = self.bodies.by_node(ok)[:, None]
        seen, known = self._at_rest_unless(ok, before, previous)
        guess, ok = hybrid.placement == "guess", by_scene(ok)
        proposed = None if guess else torch.where(ok, after.positions, seen.positions)
        correction = self.corrector.of_view(hybrid.view(seen, proposed, known))
        correction = torch.where(at_nodes, correction, 0.0)
        if guess:
            return after, correction
        moved = hybrid.moved(before, after, correction)
        final = replace(
            moved, positions=torch.where(ok, moved.positions, after.positions.detach()),
            velocities=torch.where(ok, moved.velocities, after.velocities.detach()),
        )  # fmt: skip
        return final, correction

    def _forced(self, before: BatchState, previous: Tensor | None) -> tuple[BatchState, Tensor]:
        """The state after a step under corrected loads; failed scenes as above.

        The network is asked before it is known which steps fail.  Those from states that are
        not finite will, and those under loads that are not: it is asked again without them.
        """
        hybrid, nodes = self._hybrid, self._hybrid.nodes
        known = [nodes.flat(before.positions), nodes.flat(before.velocities)]
        known = known if previous is None else [*known, previous]
        sound = self.bodies.sound(torch.cat(known, dim=1))
        seen, given = self._at_rest_unless(sound, before, previous)
        correction = self.corrector.of_view(hybrid.view(seen, None, given))
        answered = sound & self.bodies.sound(correction)
        if not torch.equal(answered, sound):
            seen, given = self._at_rest_unless(answered, before, previous)
            correction = self.corrector.of_view(hybrid.view(seen, None, given))
        at_nodes = self.bodies.by_node(answered)[:, None]
        after = self._step(before, nodes.forces(torch.where(at_nodes, correction, torch.nan)))
        ok = self._converged()
        at_nodes = self.bodies.by_node(ok)[:, None]
        _without_derivatives(seen.positions, ~by_scene(ok))
        _without_derivatives(seen.velocities, ~by_scene(ok))
        _without_derivatives(given, ~at_nodes)
        return after, torch.where(at_nodes, correction, 0.0)

    def _converged(self) -> Tensor:
        """Whether each scene's last step did, (B,) bool."""
        statuses = self.steps.statuses[-1]
        fine = torch.tensor([s.ok for s in statuses])
        return fine.to(self.bodies.rest.device, non_blocking=True)

    def _at_rest_unless(
        self, ok: Tensor, before: BatchState, previous: Tensor | None
    ) -> tuple[BatchState, Tensor | None]:
        """What the network is shown of a state: other scenes than those (B,) as at rest."""
        rest = self._hybrid.stepper.cells.rest[:, : before.positions.shape[1]]
        seen = replace(
            before, positions=torch.where(by_scene(ok), before.positions, rest),
            velocities=torch.where(by_scene(ok), before.velocities, 0.0),
        )  # fmt: skip
        if previous is not None:
            previous = torch.where(self.bodies.by_node(ok)[:, None], previous, 0.0)
        return seen, previous

    def _step(self, before: BatchState, forces: Tensor | None) -> BatchState:
        positions, velocities = self.steps(
            before.positions, before.velocities, forces, times=before.times
        )
        return BatchState(positions, velocities, before.times)


def _without_derivatives(x: Tensor | None, where: Tensor) -> None:
    """Make a tensor of a graph that exists already pass no derivatives back in some places."""
    if x is not None and x.requires_grad:
        x.register_hook(lambda grad: torch.where(where, 0.0, grad))  # type: ignore[no-untyped-call]
