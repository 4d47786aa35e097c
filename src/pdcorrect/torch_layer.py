"""`PDLayer`: implicit steps as a layer of a neural network (thesis section 3.3).

problems = [pc.discretise(scene) for scene in scenes]
layer = pc.PDLayer(pc.BatchStepper(problems, device="cuda"), steps=3)
positions, velocities = layer(positions, velocities, forces=network(features))
loss(positions).backward()
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pdcorrect.batch.adjoint import BatchGradients
from pdcorrect.batch.states import BatchState, Solved
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.errors import ConvergenceError, InputError

Mode = Literal["unrolled", "checkpointed", "detached"]
OnFailure = Literal["raise", "zero"]
_INPUTS = ("positions", "velocities", "forces", "young", "poisson", "density")


class PDLayer(nn.Module):
    """Some steps of a `BatchStepper`, differentiable by their inputs.

    Parameters
    ----------
    stepper : BatchStepper
        Of one scene or many.
    steps : int
        Taken in one call.
    mode : {"unrolled", "checkpointed", "detached"}
        Derivatives go back through all steps; the same, but steps are repeated for them
        instead of being kept; or each step's input state counts as given.
    on_failure : {"raise", "zero"}
        What happens when a scene's step, or the linear system of its derivative, fails:
        `ConvergenceError` with the scenes' names, or no derivatives from that scene.
        ``statuses`` tells in any case.
    tolerance : float
        Of the linear systems' residuals, relative.

    Attributes
    ----------
    statuses : list of list of Status
        Of the last call: for each step, each scene's.

    Notes
    -----
    All tensors are on the stepper's device; none is moved.  Where materials are given, first
    Hessians stay those of the stepper's problems, which costs iterations, not accuracy.
    Integrators with a memory (BDF2, generalised-alpha) start anew in each call.
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
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise InputError(f"steps = {steps!r}: expected a whole number of at least 1.")
        if stepper.integrator in ("bdf2", "generalised-alpha"):
            raise InputError(
                f"a layer with {stepper.integrator}, which needs a memory: expected "
                "backward-euler, midpoint or quasi-static."
            )
        self.stepper, self.steps, self.mode = stepper, steps, mode
        self.on_failure, self.tolerance = on_failure, tolerance
        self.statuses: list[list[Any]] = []

    def extra_repr(self) -> str:
        """For printing."""
        return f"{len(self.stepper.problems)} scenes, steps={self.steps}, mode={self.mode!r}"

    def forward(
        self,
        positions: Tensor,
        velocities: Tensor,
        forces: Tensor | None = None,
        *,
        young: Tensor | None = None,
        poisson: Tensor | None = None,
        density: Tensor | None = None,
        times: Sequence[float] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Positions and velocities after the steps.

        Parameters
        ----------
        positions, velocities : (B, N, 3) tensors
            m and m/s; (N, 3) for a stepper of one scene.
        forces : the same, optional
            Nodal forces besides the scenes' loads, N; (steps, B, N, 3) if they change.
        young, poisson, density : tensors that broadcast to (B, C), optional
            Pa, dimensionless, kg/m3; those of the problems by default.
        times : (B,) floats, optional
            At the start, s; 0 by default.

        Returns
        -------
        positions, velocities : tensors like the given ones

        Raises
        ------
        InputError
            If shapes, types or devices are not the stepper's.
        ConvergenceError
            If a scene fails, unless ``on_failure`` is "zero".
        """
        frames_p, frames_v = self.trajectory(
            positions, velocities, forces, young=young, poisson=poisson, density=density,
            times=times,
        )  # fmt: skip
        return frames_p[-1], frames_v[-1]

    def trajectory(
        self,
        positions: Tensor,
        velocities: Tensor,
        forces: Tensor | None = None,
        *,
        young: Tensor | None = None,
        poisson: Tensor | None = None,
        density: Tensor | None = None,
        times: Sequence[float] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Like `forward`, with all frames: (steps + 1, B, N, 3), frame 0 as given."""
        single = positions.ndim == 2
        if single:
            positions, velocities = positions[None], velocities[None]
            forces = None if forces is None else forces.unsqueeze(-3)
        self._check("positions", positions)
        self._check("velocities", velocities)
        material = [
            None if m is None else m.expand(self.stepper.material[0].shape)
            for m in (young, poisson, density)
        ]
        now = tuple(times) if times is not None else (0.0,) * len(self.stepper.problems)
        self.statuses = []
        frames = [(positions, velocities)]
        for k in range(self.steps):
            push = forces[k] if forces is not None and forces.ndim == 4 else forces
            if push is not None:
                self._check("forces", push)
            state = frames[-1]
            if self.mode == "detached" and k:
                state = (state[0].detach(), state[1].detach())
            inputs = (self, now, *state, push, *material)
            if self.mode == "checkpointed" and torch.is_grad_enabled():
                frames.append(checkpoint(_Step.apply, *inputs, use_reentrant=False))
            else:
                frames.append(_Step.apply(*inputs))  # type: ignore[no-untyped-call]
            now = tuple(t + self.stepper.time_step for t in now)
        out = tuple(torch.stack(parts) for parts in zip(*frames, strict=True))
        return (out[0][:, 0], out[1][:, 0]) if single else (out[0], out[1])

    def _check(self, name: str, x: Tensor) -> None:
        stepper = self.stepper
        n = stepper.cells.sizes
        wanted = (n.scenes, n.nodes, 3)
        if tuple(x.shape) != wanted or x.dtype != stepper.dtype or x.device != stepper.device:
            raise InputError(
                f"{name}: {tuple(x.shape)}, {x.dtype}, on {x.device}; expected {wanted}, "
                f"{stepper.dtype}, on {stepper.device}, as the stepper."
            )

    def failed(self, what: str, ok: Sequence[bool]) -> None:
        """Raise if scenes failed and the layer is to."""
        names = [
            f"{i} ({p.scene.name!r})"
            for i, (p, fine) in enumerate(zip(self.stepper.problems, ok, strict=True))
            if not fine
        ]
        if names and self.on_failure == "raise":
            raise ConvergenceError(
                f"{what} of scenes {', '.join(names)}: expected all to converge. Use smaller "
                "steps, or on_failure='zero' to leave such scenes out."
            )


class _Step(torch.autograd.Function):
    """One step and its adjoint."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx, layer, times, positions, velocities, forces, young, poisson, density
    ):
        stepper: BatchStepper = layer.stepper
        stepper.set_material(young, poisson, density)
        before = BatchState(positions.detach(), velocities.detach(), times)
        result = stepper(before, forces)
        layer.statuses.append(result.statuses)
        layer.failed("the step", [status.ok for status in result.statuses])
        ctx.layer, ctx.times, ctx.statuses = layer, times, result.statuses
        ctx.save_for_backward(positions, velocities, forces, young, poisson, density, result.y)
        return result.state.positions, result.state.velocities

    @staticmethod
    def backward(ctx, grad_positions, grad_velocities):  # type: ignore[no-untyped-def]
        *inputs, y = ctx.saved_tensors
        positions, velocities, forces, young, poisson, density = inputs
        layer, stepper = ctx.layer, ctx.layer.stepper
        stepper.set_material(young, poisson, density)
        before = BatchState(positions, velocities, ctx.times)
        gradients = BatchGradients(
            stepper, before, Solved(y, ctx.statuses), grad_positions, grad_velocities,
            forces=forces, tolerance=layer.tolerance,
        )  # fmt: skip
        layer.failed("the derivative", gradients.ok.tolist())
        needed = ctx.needs_input_grad[2:]
        found = [
            getattr(gradients, name) if need else None
            for name, need in zip(_INPUTS, needed, strict=True)
        ]
        ok = gradients.ok[:, None, None]
        for i, grad in enumerate(found):
            if grad is not None:
                found[i] = torch.where(ok if grad.ndim == 3 else ok[:, 0], grad, 0.0)
        return None, None, *found
