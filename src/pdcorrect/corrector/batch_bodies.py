"""`BatchBodies`: the scenes of a `BatchStepper` as one graph, and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pdcorrect.batch.loads import Spans
from pdcorrect.batch.states import BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import Snapshot
from pdcorrect.corrector.placements import as_forces, ballistic
from pdcorrect.errors import InputError


def check_corrector(corrector: object, device: torch.device) -> Corrector:
    """A corrector that can be asked on a device; others are refused.

    Raises
    ------
    InputError
        If it is of another kind, its normaliser was not fitted or it is elsewhere.
    """
    if not isinstance(corrector, Corrector):
        raise InputError(f"corrector is a {type(corrector).__name__}: expected a Corrector.")
    if not corrector.normaliser.fitted:
        raise InputError(
            "corrector: its normaliser has seen no data, so its inputs and output have no "
            "scale. Expected one that was trained or loaded."
        )
    found = corrector.normaliser.output_scale.device
    if found != device:
        raise InputError(
            f"corrector: on {found}, expected {device} as the coarse solver: move it there "
            f"with corrector.to({str(device)!r})."
        )
    return corrector


class BatchBodies:
    """The scenes of a stepper as the bodies of a graph: n nodes without padding."""

    def __init__(self, stepper: BatchStepper) -> None:
        if not isinstance(stepper, BatchStepper):
            raise InputError(f"stepper is a {type(stepper).__name__}: expected a BatchStepper.")
        self._stepper, self._material = stepper, stepper.own
        self._own = self._graph = BodyGraph.of(
            stepper.problems, stepper.time_step, device=stepper.device, dtype=torch.float64
        )
        self._shape = tuple(stepper.node_mask.shape)
        self._rows = stepper.node_mask.reshape(-1).nonzero()[:, 0]

    @property
    def graph(self) -> BodyGraph:
        """With the material that the stepper has now; float64, on its device."""
        stepper, material = self._stepper, self._stepper.present
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
        return out.reshape(scenes, nodes, *x.shape[1:]).to(self._stepper.dtype)

    def snapshot(
        self, state: BatchState, coarse: Tensor | None, previous: Tensor | None
    ) -> Snapshot:
        """A step from ``state``, with the coarse answer (B, N, 3) if there is one."""
        positions, velocities, forces = map(
            self.flat, (state.positions, state.velocities, external_forces(self._stepper, state))
        )
        if coarse is not None:
            return Snapshot(positions, velocities, self.flat(coarse), forces, previous)
        h, graph = self._stepper.time_step, self.graph
        start = Snapshot(positions, velocities, positions, forces, previous)
        held = self.flat(self._stepper.staging.prescribed([t + h for t in state.times]))
        return replace(start, proposed=ballistic(start, h, forces, graph.mass, graph.free, held))

    def forces(self, correction: Tensor) -> Tensor:
        """Nodal forces (B, N, 3), N, for a correction (n, 3)."""
        return self.padded(as_forces(correction, self._stepper.time_step, self.graph.mass))


def external_forces(stepper: BatchStepper, state: BatchState) -> Tensor:
    """All loads of the scenes (B, N, 3), N, in the step from a state.

    Those that follow the body are sampled on the CPU, others do not leave the device.
    Differentiable by the state, on which only the former depend.
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
