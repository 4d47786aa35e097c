"""`BatchHybrid` and `HybridLayer`: steps of a `BatchStepper`, corrected by a network.

hybrid = BatchHybrid(pc.BatchStepper(problems, device="cuda"), corrector.to("cuda"))
result = hybrid(state)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pdcorrect.batch.layer import OnFailure, PDLayer
from pdcorrect.batch.objective import by_scene, dot
from pdcorrect.batch.states import (
    BatchResult,
    BatchState,
    check_nodal,
    check_state,
    chosen,
    start_times,
    state_of,
)
from pdcorrect.batch.step_equation import Spans
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector, check_corrector
from pdcorrect.corrector.features import FeatureView, Snapshot
from pdcorrect.corrector.gate import (
    CorrectedStep,
    Gate,
    GateMeasures,
    Velocity,
    check_gate,
    check_velocity,
    corrected_step,
    moved,
)
from pdcorrect.corrector.graph_replay import RecordedCorrector, RecordedMeasures, stored_and_ratios
from pdcorrect.errors import InputError
from pdcorrect.state import Status


def external_forces(stepper: BatchStepper, state: BatchState) -> Tensor:
    """All loads of the scenes (B, N, 3), N, in the step from a state; differentiable by it.

    Those that follow the body are sampled on the CPU, others do not leave the device.
    """
    stage = stepper.staging(state)
    found: Tensor = _Loads.apply(stepper, stage.spans, state.positions)  # type: ignore[no-untyped-call]
    return found


class _Loads(torch.autograd.Function):
    """Loads sampled at positions."""

    @staticmethod
    def forward(ctx: Any, stepper: BatchStepper, spans: Spans, at: Tensor) -> Tensor:
        ctx.stepper, ctx.spans = stepper, spans
        ctx.save_for_backward(at)
        with stepper.alone():
            return stepper.loads(spans, at)[:, : at.shape[1]].clone()

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, Tensor | None]:
        (at,) = ctx.saved_tensors
        stepper: BatchStepper = ctx.stepper
        if not stepper.loads.follow:
            return None, None, None
        with stepper.alone():
            return None, None, stepper.loads.pulled(ctx.spans, at, grad)


class BatchBodies:
    """The scenes of a stepper as the bodies of a graph: n nodes without padding.

    ``velocity`` is of corrected states, see `BatchHybrid`; ``measures`` record the gate's work.
    """

    def __init__(
        self, stepper: BatchStepper, velocity: Velocity = "recomputed", *, recorded: bool = False
    ) -> None:
        if not isinstance(stepper, BatchStepper):
            raise InputError(f"stepper is a {type(stepper).__name__}: expected a BatchStepper.")
        check_velocity(velocity, stepper.integrator)
        self.stepper, self.velocity, self._material = stepper, velocity, stepper.own
        self.measures = RecordedMeasures(stepper) if recorded else None
        self._own = self._graph = BodyGraph.of(
            stepper.problems, stepper.time_step, device=stepper.device, dtype=torch.float64
        )
        self._shape = tuple(stepper.node_mask.shape)
        self._rows = stepper.node_mask.reshape(-1).nonzero()[:, 0]

    @property
    def graph(self) -> BodyGraph:
        """With the material that the stepper has now; float64, on its device."""
        stepper, material = self.stepper, self.stepper.present
        if material is not self._material:
            cells, nodes = stepper.cells, self._shape[1]
            self._graph = (
                self._own
                if material is stepper.own
                else self._own.with_material(
                    self.flat(stepper.objective.mass.nodal[:, :nodes]),
                    *(values[cells.present_cells] for values in material.values),
                )
            )
            self._material = material
        return self._graph

    def flat(self, x: Tensor) -> Tensor:
        """Nodal values (B, N, ...) of scenes, float64, without padding: (n, ...)."""
        return x.reshape(-1, *x.shape[2:]).index_select(0, self._rows).to(self._own.rest.dtype)

    def padded(self, x: Tensor) -> Tensor:
        """Values (n, ...) as (B, N, ...) in the stepper's type, zero in padding."""
        scenes, nodes = self._shape
        out = x.new_zeros(scenes * nodes, *x.shape[1:]).index_copy(0, self._rows, x)
        return out.reshape(scenes, nodes, *x.shape[1:]).to(self.stepper.dtype)

    def view(self, state: BatchState, coarse: Tensor, previous: Tensor | None) -> FeatureView:
        """What the network sees of a step from ``state`` with the coarse answer (B, N, 3)."""
        self.check_previous(previous)
        loads = external_forces(self.stepper, state)
        parts = (state.positions, state.velocities, coarse, loads)
        positions, velocities, proposed, forces = map(self.flat, parts)
        snapshot = Snapshot(positions, velocities, proposed, forces, previous)
        return FeatureView(self.graph, snapshot)

    def check_previous(self, previous: Tensor | None) -> None:
        """Refuse a correction of other bodies."""
        expected = self._own.rest.shape
        if previous is not None and previous.shape != expected:
            raise InputError(
                f"previous: {tuple(previous.shape)}; expected the correction of the step before, "
                f"{tuple(expected)}, or None."
            )

    def moved(self, before: BatchState, after: BatchState, correction: Tensor) -> BatchState:
        """The state after a step with a correction (n, 3) added."""
        positions, velocities, memory = moved(
            self.stepper.staging(before).scheme, after, self.padded(correction), self.velocity,
            lambda x: _TimesMass.apply(self.stepper, x),  # type: ignore[no-untyped-call]
        )  # fmt: skip
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


class BatchCoarseStep:
    """A `CoarseStep` of B scenes; ``previous`` (n, 3) is the correction of the step before, m.

    Where y of the integrator is the end of the step (all but midpoint), the internal modes of a
    corrected answer stay those of the coarse one: relaxed again, which a single scene's
    `HybridStepper` does, they would only lower its energy, so the gate is never more lenient here.
    Else y's modes belong to another time, and the gate relaxes those at the end of the step, scene
    by scene on the CPU.
    """

    def __init__(self, nodes: BatchBodies, state: BatchState, previous: Tensor | None) -> None:
        self._nodes, self._stepper = nodes, nodes.stepper
        self._state, self._previous = state, previous
        self._loads: Tensor | None = None

    def solved(self) -> BatchResult:
        """See `CoarseStep`."""
        return self._stepper(self._state)

    def view(self, answer: BatchResult) -> FeatureView:
        """See `CoarseStep`."""
        view = self._nodes.view(self._state, answer.state.positions, self._previous)
        self._loads = self._nodes.padded(view.snapshot.forces)
        return view

    def ok(self, answer: BatchResult) -> Tensor:
        """See `CoarseStep`."""
        return _converged(answer.statuses, self._stepper.device)

    def moved(self, answer: BatchResult, correction: Tensor) -> BatchResult:
        """See `CoarseStep`; only the state is another one."""
        return replace(answer, state=self._nodes.moved(self._state, answer.state, correction))

    def measured(self, answer: BatchResult) -> GateMeasures:
        """See `CoarseStep`."""
        state, recorded = answer.state, self._nodes.measures
        assert self._loads is not None, "the network was asked before"
        with self._stepper.alone():
            work = dot(self._loads, state.positions - self._state.positions)
            motion = state.positions, state.velocities, self._configuration(answer)
            if recorded is not None:
                return recorded(*motion, work)
            stored, ratios = stored_and_ratios(self._stepper, *motion)
            return GateMeasures(ratios, stored, work)

    def chosen(self, which: Tensor, one: BatchResult, other: BatchResult) -> BatchResult:
        """See `CoarseStep`."""
        return chosen(which, one, other)

    def _configuration(self, answer: BatchResult) -> Tensor:
        """The end of the step, (B, U, 3)."""
        cells, positions = self._stepper.cells, answer.state.positions
        if cells.sizes.modes and self._stepper.staging(self._state).scheme.gain != 1.0:
            scenes = range(cells.sizes.scenes)
            ends = [state_of(cells, answer.state, i).positions for i in scenes]
            relaxed = [self._stepper.problem_now(i).relaxed(end) for i, end in enumerate(ends)]
            return cells.configurations(relaxed)
        return torch.cat([positions, answer.y[:, cells.sizes.nodes :]], dim=1)


def _converged(statuses: Sequence[Status], device: torch.device) -> Tensor:
    """Whether each scene's step did, (B,) bool."""
    return torch.tensor([s.ok for s in statuses]).to(device, non_blocking=True)


BatchHybridResult = CorrectedStep[BatchResult]
"""Outcome of a corrected step of B scenes.

Statuses are the coarse solver's; steps that converged to inverted cells are corrected like others.
"""


class BatchHybrid:
    """Steps many scenes and corrects each; no gradients.

    A scene whose correction is exactly zero, or refused, keeps its coarse step bit for bit.

    Parameters
    ----------
    stepper : BatchStepper
    corrector : Corrector
        Fitted, on the stepper's device.
    velocity : {"recomputed", "kept"}
        Of corrected states: what the integrator makes of the corrected positions, by backward
        Euler v = (p - p_before)/h, or the coarse solver's.
    gate : Gate, optional
        What else is refused than corrections that are not finite, and those of scenes whose
        coarse step fails.
    recorded : bool
        Whether a GPU compiles the network and records its work, and the gate's, in the first step,
        to replay it in the others (see `RecordedCorrector`).  On the CPU it changes nothing.  On
        an H200 the first step takes about a minute, and a correction of 256 scenes a third of
        what it takes otherwise (``benchmarks``).

    Attributes
    ----------
    nodes : BatchBodies
        The scenes as the network knows them: its ``graph``, and nodal values with and without
        padding.

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
        self.nodes = BatchBodies(stepper, velocity, recorded=recorded)
        self.stepper, self.gate = stepper, gate
        self.corrector = check_corrector(corrector, stepper.device)
        check_gate(gate)
        self._recorded = RecordedCorrector(corrector) if recorded else None

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
            step = BatchCoarseStep(self.nodes, state, previous)
            answers = self.corrector if self._recorded is None else self._recorded
            return corrected_step(step, answers, self.gate)


class HybridLayer(nn.Module):
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
    nodes : BatchBodies
        See `BatchHybrid`.
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
        self.nodes = BatchBodies(stepper, velocity)
        self.corrector = check_corrector(corrector, stepper.device)
        self.steps, self.through_solver = PDLayer(stepper, on_failure=on_failure), through_solver

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
        nodes, cells = self.nodes, self.nodes.stepper.cells
        check_nodal(cells, "positions", positions)
        check_nodal(cells, "velocities", velocities)
        nodes.check_previous(previous)
        if not self.through_solver:
            positions, velocities = positions.detach(), velocities.detach()
            previous = None if previous is None else previous.detach()
        before = BatchState(positions, velocities, start_times(cells, times))
        p, v = self.steps(positions, velocities, times=before.times)
        after = BatchState(p, v, before.times)
        converged = _converged(self.steps.statuses[-1], nodes.stepper.device)
        ok, at_nodes = by_scene(converged), nodes.graph.by_node(converged)[:, None]
        # the network is shown scenes whose step failed as at rest
        rest = cells.rest[:, : positions.shape[1]]
        seen = replace(
            before, positions=torch.where(ok, positions, rest),
            velocities=torch.where(ok, velocities, 0.0),
        )  # fmt: skip
        proposed = torch.where(ok, after.positions, seen.positions)
        known = None if previous is None else torch.where(at_nodes, previous, 0.0)
        correction = self.corrector.of_view(nodes.view(seen, proposed, known))
        correction = torch.where(at_nodes, correction, 0.0)
        moved = nodes.moved(before, after, correction)
        return (
            torch.where(ok, moved.positions, after.positions.detach()),
            torch.where(ok, moved.velocities, after.velocities.detach()),
            correction,
        )
