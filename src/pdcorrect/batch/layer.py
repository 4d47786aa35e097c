"""`PDLayer`: implicit steps as a layer of a neural network (thesis section 3.3).

problems = [pc.discretise(scene) for scene in scenes]
layer = pc.PDLayer(pc.BatchStepper(problems, device="cuda"), steps=3)
positions, velocities = layer(positions, velocities, forces=network(features))
loss(positions).backward()
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.utils.checkpoint import checkpoint

from pdcorrect.batch.adjoint import BatchGradients
from pdcorrect.batch.cells import scene_name
from pdcorrect.batch.material import NAMES, BatchMaterial, by_cell, check_material
from pdcorrect.batch.states import (
    BatchState,
    Solved,
    check_finite,
    check_nodal,
    check_state,
    check_tensor,
    in_one,
    start_times,
)
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.solvers.implicit import positive, whole
from pdcorrect.state import Status

Mode = Literal["unrolled", "checkpointed", "detached"]
OnFailure = Literal["raise", "zero"]
Frame = tuple[Tensor, ...]
"""Positions, velocities and the entries of the memory in the order of their names."""
_INPUTS = ("positions", "velocities", "forces", *NAMES)
_CONSTANT = "previous_times"
"""Of a memory, what has no derivative."""


@dataclass(eq=False)
class _Call:
    """One call of a layer: what its steps, and later their derivatives, share and record.

    ``times`` (s) are at the start, ``statuses`` of the steps taken so far, ``failures`` step and
    scene of each derivative that failed, ``names`` of the memory before each step and after the
    last.
    """

    layer: PDLayer
    material: BatchMaterial
    times: tuple[float, ...]
    statuses: list[list[Status]] = field(default_factory=list)
    failures: list[tuple[int, int]] = field(default_factory=list)
    names: list[tuple[str, ...]] = field(default_factory=list)

    def before(self, step: int, frame: Frame) -> BatchState:
        """The state that a step starts from."""
        times = tuple(t + step * self.layer.stepper.time_step for t in self.times)
        memory = dict(zip(self.names[step], frame[2:], strict=True))
        return BatchState(frame[0], frame[1], times, memory)

    def stepped(
        self, step: int, statuses: list[Status], inputs: Mapping[str, Tensor | None]
    ) -> None:
        """Record a step of some inputs; repeated ones are recorded already."""
        if step == len(self.statuses):
            self.statuses.append(statuses)
        if Status.NOT_FINITE in statuses and self.layer.on_failure == "raise":
            for name, x in inputs.items():
                if x is not None:
                    check_finite(self.layer.stepper.problems, name, x)
        told = [f" {s.value}" for s in statuses]
        self._raise_for("", step, told, [s.ok for s in statuses])

    def differentiated(self, step: int, statuses: list[Status], ok: list[bool]) -> None:
        """Record a step's derivative."""
        self.failures.extend((step, i) for i, fine in enumerate(ok) if not fine)
        told = [f", whose step {s.value}" for s in statuses]
        self._raise_for("the derivative of ", step, told, ok)

    def _raise_for(self, what: str, step: int, told: list[str], ok: list[bool]) -> None:
        if all(ok) or self.layer.on_failure != "raise":
            return
        problems = self.layer.stepper.problems
        scenes = "; ".join(
            f"scene {scene_name(problems, i)}{words}"
            for i, (words, fine) in enumerate(zip(told, ok, strict=True))
            if not fine
        )
        raise ConvergenceError(
            f"{what}step {step + 1} of {self.layer.steps}: {scenes}. Expected {what}every step "
            "to converge: use smaller time steps, or on_failure='zero' to leave such scenes out."
        )


class PDLayer(nn.Module):
    """Some steps of a `BatchStepper`, differentiable by their inputs.

    Parameters
    ----------
    stepper : BatchStepper
        Of one scene or many.
    steps : int
        Taken in one call.
    mode : {"unrolled", "checkpointed", "detached"}
        Derivatives go back through all steps; the same, but only the states at the ends of
        about sqrt(steps) segments are kept, and steps are repeated; or each step's input
        state counts as given.
    on_failure : {"raise", "zero"}
        What happens when a scene's step, or the linear system of its derivative, fails:
        `ConvergenceError` with the step, the scenes' names and statuses, or no derivatives
        from that scene.  So with a material out of its range and with numbers that are not
        finite, which raise `InputError`.
        ``statuses`` and ``failed_derivatives`` tell in any case.
    tolerance : float
        Of the linear systems' residuals, relative.

    Attributes
    ----------
    statuses : list of list of Status
        Of the last call: for each step, each scene's.
    failed_derivatives : list of (int, int)
        Step and scene of each derivative that was looked for and not found, in all backward
        passes through the last call.
    memory : dict of str to (B, N, 3) tensor
        `State.memory` after the last call, for ``memory`` of the next one.

    Notes
    -----
    All tensors are on the stepper's device; others are refused, none is moved.  Loads that
    follow the body are sampled on the CPU in each step, and scenes that the batch does not
    solve are stepped there.  Where materials are given, first Hessians stay those of the
    stepper's problems, which costs iterations, not accuracy; the stepper's own material is
    back after the call.  There are no second derivatives.
    """

    def __init__(
        self,
        stepper: BatchStepper,
        steps: int = 1,
        *,
        mode: Mode = "unrolled",
        on_failure: OnFailure = "raise",
        tolerance: float = 1e-6,
    ) -> None:
        super().__init__()
        if mode not in ("unrolled", "checkpointed", "detached"):
            raise InputError(f"mode = {mode!r}: expected unrolled, checkpointed or detached.")
        if on_failure not in ("raise", "zero"):
            raise InputError(f"on_failure = {on_failure!r}: expected raise or zero.")
        self.stepper, self.steps, self.mode = stepper, whole("steps", steps, 1), mode
        self.on_failure, self.tolerance = on_failure, positive("tolerance", tolerance)
        self.statuses: list[list[Status]] = []
        self.failed_derivatives: list[tuple[int, int]] = []
        self.memory: dict[str, Tensor] = {}

    @property
    def differentiable(self) -> Tensor:
        """Whether each scene has derivatives through all steps of the last call, (B,) bool.

        That is, whether each step converged, and in one part.  A derivative's own linear
        system may still fail, see ``failed_derivatives``.
        """
        scenes = torch.ones(len(self.stepper.problems), dtype=torch.bool)
        for row in self.statuses:
            scenes &= torch.tensor(in_one(row))
        return scenes.to(self.stepper.device)

    def extra_repr(self) -> str:
        """For printing."""
        return f"{len(self.stepper.problems)} scenes, steps={self.steps}, mode={self.mode!r}"

    def forward(
        self,
        positions: Tensor,
        velocities: Tensor,
        forces: Tensor | None = None,
        *,
        young: Tensor | float | None = None,
        poisson: Tensor | float | None = None,
        density: Tensor | float | None = None,
        times: Sequence[float] | None = None,
        memory: Mapping[str, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Positions and velocities after the steps.

        Parameters
        ----------
        positions, velocities : (B, N, 3) tensors
            m and m/s; (N, 3) for a stepper of one scene.
        forces : the same, optional
            Nodal forces besides the scenes' loads, N; (steps, B, N, 3) if they change.
        young, poisson, density : numbers or tensors that broadcast to (B, C), optional
            Pa, dimensionless, kg/m3; those that the stepper has by default.  One value a
            scene is (B, 1).
        times : (B,) floats, optional
            At the start, s; 0 by default.  Loads and clamps that change in time need them
            in every call but the first.
        memory : mapping of str to (B, N, 3) tensors, optional
            Of the state at the start, as the attribute ``memory`` after the call before; an
            integrator that has one begins without.

        Returns
        -------
        positions, velocities : tensors like the given ones

        Raises
        ------
        InputError
            If shapes, types or devices are not the stepper's; unless ``on_failure`` is
            "zero", also if a material is out of its range, before any step, or a number is
            not finite, after the step that fails by it.
        ConvergenceError
            If a scene fails otherwise, unless ``on_failure`` is "zero".
        """
        material = young, poisson, density
        frame, _ = self._run(positions, velocities, forces, material, times, memory)
        return frame[0], frame[1]

    def trajectory(
        self, positions: Tensor, velocities: Tensor, forces: Tensor | None = None, **options: Any
    ) -> tuple[Tensor, Tensor]:
        """Like `forward`, of the same options, with all frames: (steps + 1, B, N, 3).

        Frame 0 is as given.
        """
        material = [options.pop(name, None) for name in NAMES]
        _, frames = self._run(positions, velocities, forces, material, keep=True, **options)
        out = [torch.stack(parts) for parts in zip(*frames, strict=True)]
        return out[0], out[1]

    def _run(
        self,
        positions: Tensor,
        velocities: Tensor,
        forces: Tensor | None,
        material: Sequence[Tensor | float | None],
        times: Sequence[float] | None = None,
        memory: Mapping[str, Tensor] | None = None,
        keep: bool = False,
    ) -> tuple[Frame, list[Frame]]:
        """The last frame and, if they are to be kept, all."""
        stepper, cells = self.stepper, self.stepper.cells
        single = stepper.batched(positions) is not positions
        positions, velocities = map(stepper.batched, (positions, velocities))
        remembered = {name: stepper.batched(x) for name, x in sorted((memory or {}).items())}
        start = BatchState(positions, velocities, start_times(cells, times), remembered)
        check_state(cells, start)
        pushes = self._pushes(forces, single)
        pairs = zip(NAMES, material, strict=True)
        given = [by_cell(cells, name, value) for name, value in pairs]
        values = stepper.with_material(given)
        if self.on_failure == "raise" and values is not stepper.present:
            check_material(cells, stepper.problems, values)
        call = _Call(self, values, start.times, names=[tuple(remembered)])
        self.statuses, self.failed_derivatives = call.statuses, call.failures
        frame: Frame = (positions, velocities, *remembered.values())
        frames = [frame]
        repeated = self.mode == "checkpointed" and torch.is_grad_enabled()
        length = math.isqrt(self.steps - 1) + 1 if repeated else self.steps
        for first in range(0, self.steps, length):
            inputs = (call, first, keep, frame, pushes[first : first + length], given)
            if repeated:
                new = checkpoint(_segment, *inputs, use_reentrant=False)
            else:
                new = _segment(*inputs)
            frame = new[-1]
            frames.extend(new if keep else [])
        frames = [f[:2] for f in frames]
        if single:
            frames = [tuple(x[0] for x in f) for f in frames]
            frame = tuple(x[0] for x in frame)
        self.memory = dict(zip(call.names[-1], frame[2:], strict=True))
        return frame, frames

    def _pushes(self, forces: Tensor | None, single: bool) -> list[Tensor | None]:
        """Extra forces of each step; ``single`` if they come without the scenes' dimension."""
        if forces is None:
            return [None] * self.steps
        check_tensor(self.stepper.cells, "forces", forces)
        forces = forces.unsqueeze(-3) if single and forces.ndim > 1 else forces
        each = list(forces) if forces.ndim == 4 else [forces] * self.steps
        if len(each) != self.steps:
            raise InputError(
                f"forces of {len(each)} steps: expected one set, or one for each of the layer's "
                f"{self.steps} steps."
            )
        for push in each:
            check_nodal(self.stepper.cells, "forces", push)
        return list(each)


def _segment(
    call: _Call,
    first: int,
    keep: bool,
    frame: Frame,
    pushes: Sequence[Tensor | None],
    material: Sequence[Tensor | None],
) -> list[Frame]:
    """Some steps from number ``first`` on: their frames, or only the last one."""
    frames: list[Frame] = []
    for k, push in enumerate(pushes, first):
        if call.layer.mode == "detached" and k:
            frame = tuple(x.detach() for x in frame)
        inputs = (frame[0], frame[1], push, *material, *frame[2:])
        frame = _Step.apply(call, k, *inputs)  # type: ignore[no-untyped-call]
        frames = [*frames, frame] if keep else [frame]
    return frames


class _Step(torch.autograd.Function):
    """One step and its adjoint."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx, call, step, positions, velocities, forces, young, poisson, density, *memory
    ):
        stepper: BatchStepper = call.layer.stepper
        before = call.before(step, (positions, velocities, *memory))
        with stepper.using(call.material):
            result = stepper(before, forces)
        inputs = {"positions": positions, "velocities": velocities, "forces": forces}
        call.stepped(step, result.statuses, inputs)
        after = result.state
        names = tuple(sorted(after.memory))
        if step + 1 == len(call.names):
            call.names.append(names)
        modes = result.y[:, stepper.cells.sizes.nodes :].clone()
        ctx.call, ctx.step, ctx.statuses = call, step, result.statuses
        ctx.save_for_backward(positions, velocities, forces, after.positions, modes, *memory)
        kept = [after.memory[name] for name in names]
        ctx.mark_non_differentiable(
            *(x for name, x in zip(names, kept, strict=True) if name == _CONSTANT)
        )
        return after.positions, after.velocities, *kept

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx, grad_positions, grad_velocities, *grad_memory):  # type: ignore[no-untyped-def]
        positions, velocities, forces, after, modes, *memory = ctx.saved_tensors
        call, stepper = ctx.call, ctx.call.layer.stepper
        before = call.before(ctx.step, (positions, velocities, *memory))
        grads = dict(zip(call.names[ctx.step + 1], grad_memory, strict=True))
        grads = {k: g for k, g in grads.items() if k != _CONSTANT and g is not None}
        with stepper.using(call.material):
            y = stepper.staging.solution(before, after, modes)
            gradients = BatchGradients(
                stepper, before, Solved(y, ctx.statuses), grad_positions, grad_velocities,
                grad_memory=grads, forces=forces, tolerance=call.layer.tolerance,
            )  # fmt: skip
        call.differentiated(ctx.step, ctx.statuses, gradients.ok.tolist())
        ok = gradients.ok[:, None, None]
        by_memory = gradients.memory
        found = [
            getattr(gradients, name) if needed else None
            for name, needed in zip(_INPUTS, ctx.needs_input_grad[2:], strict=False)
        ]
        needed = ctx.needs_input_grad[2 + len(_INPUTS) :]
        pairs = zip(call.names[ctx.step], needed, strict=True)
        found += [by_memory[name] if wanted else None for name, wanted in pairs]
        out = [
            None if g is None else torch.where(ok if g.ndim == 3 else ok[:, 0], g, 0.0)
            for g in found
        ]
        return None, None, *out
