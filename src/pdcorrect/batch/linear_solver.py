"""Conjugate gradients with the true Hessians of a batch, for error estimates and adjoints."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pdcorrect.batch.gpu import Recorder, one_kernel
from pdcorrect.batch.objective import (
    BatchObjective,
    by_scene,
    dot,
    largest_displacement,
)


class BatchConjugateGradients:
    """Solve H x = b in each scene, H the Hessian at a configuration.

    As `pdcorrect.fem.multigrid`; scenes that are done, or meet negative
    curvature, stand still.

    Attributes
    ----------
    x : (B, U, 3)
    converged : (B,)
        Whether x is a solution.
    steps : int
        That the slowest scene took.
    """

    def __init__(
        self,
        objective: BatchObjective,
        precondition: Callable[[Tensor], Tensor],
        recorder: Recorder,
    ) -> None:
        self._objective, self._precondition = objective, precondition
        rest = objective.cells.rest
        self.x, self._b, self._y, self._r, self._d = (torch.zeros_like(rest) for _ in range(5))
        self._y.copy_(rest)
        numbers = rest.new_zeros(3, rest.shape[0])
        self._r_z, self._target, self._limit = numbers
        flags = torch.zeros(3, rest.shape[0], dtype=torch.bool, device=rest.device)
        self._which, self._active, self.converged = flags
        self._tolerance, self._share, self._settled = rest.new_zeros(3)
        self._busy = torch.zeros((), dtype=torch.bool, device=rest.device)
        self.steps = 0
        self._tangent: tuple[Any, ...] = ()
        self._begin = recorder(self._set_up)
        self._advance = recorder(self._step)

    def solve(
        self,
        y: Tensor,
        b: Tensor,
        start: Tensor | None,
        which: Tensor,
        *,
        tolerance: float,
        residual_share: float = math.inf,
        settled: float = math.inf,
        max_steps: int,
    ) -> None:
        """Set ``x`` and ``converged`` for the scenes where ``which`` (B,) holds.

        The Hessian is taken at ``y``; ``b`` is zero where clamped; both (B, U, 3), as ``start``.
        The rest is as in `pdcorrect.fem.multigrid.conjugate_gradients`, with ``settled`` the
        largest displacement of the last change, of the solution's.
        """
        self._y.copy_(y)
        self._b.copy_(b)
        self.x.copy_(torch.zeros_like(b) if start is None else start)
        self._which.copy_(which)
        self._tolerance.fill_(tolerance)
        self._share.fill_(residual_share)
        self._settled.fill_(settled)
        self._begin()
        self.steps = 0
        while self.steps < max_steps and bool(self._busy):
            self._advance()
            self.steps += 1

    def hessian(self, x: Tensor) -> Tensor:
        """H x on all components, at the y of the last solution."""
        return self._objective.hessian(self._tangent, x)

    def _product(self, x: Tensor) -> Tensor:
        return self.hessian(x) * self._objective.free

    def _set_up(self) -> None:
        self._tangent = self._objective.linearise(self._y)
        self._r.copy_(self._b - self._product(self.x))
        z = self._precondition(self._r)
        self._d.copy_(z)
        self._r_z.copy_(dot(self._r, z))
        self._target.copy_(self._tolerance**2 * self._r_z)
        self._limit.copy_(self._share**2 * dot(self._b, self._b))
        self.converged.copy_(self._which & (self._r_z == 0.0))
        self._active.copy_(self._which & (self._r_z > 0.0))
        self._busy.copy_(self._active.any())

    def _step(self) -> None:
        image = self._product(self._d)
        curvature = dot(self._d, image)
        active = self._active & (curvature > 0.0)
        alpha = torch.where(active, self._r_z / curvature, 0.0)
        change = by_scene(alpha) * self._d
        _advance(self.x, self._r, change, image, alpha, active)
        z = self._precondition(self._r)
        r_z = torch.where(active, dot(self._r, z), self._r_z)
        ratio = torch.where(active, r_z / self._r_z, 0.0)
        _turn(self._d, z, ratio, active)
        short = largest_displacement(change) <= self._settled * largest_displacement(self.x)
        done = (r_z <= self._target) & (dot(self._r, self._r) <= self._limit) & short
        self._r_z.copy_(r_z)
        self.converged.logical_or_(active & done)
        self._active.copy_(active & ~done & (r_z > 0.0) & torch.isfinite(r_z))
        self._busy.copy_(self._active.any())


@one_kernel
def _advance(
    x: Tensor, r: Tensor, change: Tensor, image: Tensor, alpha: Tensor, active: Tensor
) -> None:
    """Move x by ``change`` and the residual r by -alpha times its ``image``, where active (B,)."""
    x.add_(torch.where(by_scene(active), change, 0.0))
    r.sub_(torch.where(by_scene(active), by_scene(alpha) * image, 0.0))


@one_kernel
def _turn(d: Tensor, z: Tensor, ratio: Tensor, active: Tensor) -> None:
    d.copy_(torch.where(by_scene(active), z + by_scene(ratio) * d, d))
