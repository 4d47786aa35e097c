"""Derivatives of a batch's step: `pdcorrect.solvers.adjoint` for B scenes, in torch."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from pdcorrect.batch.states import BatchResult, BatchState, Solved
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.batch.threads import one_thread
from pdcorrect.errors import InputError
from pdcorrect.scene.materials import lame_slopes
from pdcorrect.solvers.linear import Linear
from pdcorrect.state import Status


class BatchGradients:
    """Derivatives of a loss by the inputs of one step of B scenes.

    Those that take more than the adjoint state are computed when first asked for.

    Parameters
    ----------
    stepper : BatchStepper
    before : BatchState
    result : BatchResult
        Of ``stepper(before, forces)``, with the material that the stepper has now.
    grad_positions, grad_velocities : (B, N, 3) tensors, optional
        Derivatives of the loss by the positions (1/m) and velocities (s/m) after the step.
    grad_memory : mapping of str to (B, N, 3) tensors, optional
    forces : (B, N, 3) tensor, optional
        The extra nodal forces that the step was given, N.
    tolerance : float
        Of each scene's linear system: its residual, relative.

    Attributes
    ----------
    x : (B, U, 3)
        The adjoint states; zero in scenes that failed.
    ok : (B,) bool
        Whether the step had a result, not in smaller parts, and its linear system was solved.
    iterations : int
        Of the slowest scene.
    """

    def __init__(
        self,
        stepper: BatchStepper,
        before: BatchState,
        result: BatchResult | Solved,
        grad_positions: Tensor | None = None,
        grad_velocities: Tensor | None = None,
        *,
        grad_memory: Mapping[str, Tensor] | None = None,
        forces: Tensor | None = None,
        tolerance: float = 1e-6,
    ) -> None:
        self._stepper, self._before, self._y = stepper, before, result.y
        self._after = {
            "positions": self._given("grad_positions", grad_positions),
            "velocities": self._given("grad_velocities", grad_velocities),
            **{n: self._given(n, g) for n, g in (grad_memory or {}).items()},
        }
        self._forces = forces
        self._scheme, self._known = stepper.prepare(before, forces)
        self._objective = stepper.objective
        self._nodes = stepper.cells.sizes.nodes
        self._free = self._objective.free[:, : self._nodes] > 0.5
        self._sums: dict[str, Tensor] = {}
        scheme = self._scheme
        self._pull(scheme.positions, None, self._after["positions"])
        self._pull(scheme.velocities, scheme.clamped_velocities, self._after["velocities"])
        for name, rows in scheme.memory.items():
            if name in self._after:
                self._pull(*rows, self._after[name])
        by_y = self._sums.pop("y")
        in_one = [s.ok and s is not Status.SUBSTEPPED for s in result.statuses]
        fine = torch.tensor(in_one, device=by_y.device)
        with one_thread(stepper.device):
            solver = stepper.solve_adjoint(self._y, stepper.extended(by_y), fine, tolerance)
        self.ok = fine & solver.converged
        self.iterations = solver.steps
        self.x = torch.where(self.ok[:, None, None], solver.x, 0.0)
        self._nodal = self.x[:, : self._nodes]
        self._pull_stage(by_y, solver.hessian(self.x)[:, : self._nodes])

    def _given(self, name: str, g: Tensor | None) -> Tensor:
        like = self._before.positions
        if g is None:
            return torch.zeros_like(like)
        if g.shape != like.shape or g.device != like.device:
            raise InputError(
                f"{name} is {tuple(g.shape)} on {g.device}: expected {tuple(like.shape)} on "
                f"{like.device}."
            )
        return g.to(like.dtype)

    # --- by the state and what acts on it ---------------------------------------------------

    @property
    def positions(self) -> Tensor:
        """By the positions at the start of the step, (B, N, 3), 1/m."""
        return self._sum("positions")

    @property
    def velocities(self) -> Tensor:
        """By the velocities at the start of the step, (B, N, 3), s/m."""
        return self._sum("velocities")

    @property
    def forces(self) -> Tensor:
        """By nodal forces during the step, (B, N, 3), 1/N."""
        return self._nodal

    @property
    def clamped_positions(self) -> Tensor:
        """By the prescribed positions at the end of the step, (B, N, 3), 1/m; 0 where free."""
        return torch.where(self._free, 0.0, self._sum("prescribed"))

    @property
    def memory(self) -> dict[str, Tensor]:
        """By the entries of the memory at the start of the step, each (B, N, 3)."""
        return {name: self._sum(name) for name in self._before.memory}

    # --- by the material ------------------------------------------------------------------------

    @property
    def mu(self) -> Tensor:
        """By each cell's mu, (B, C), 1/Pa."""
        return self._weights[0]

    @property
    def lam(self) -> Tensor:
        """By each cell's lambda, (B, C), 1/Pa."""
        rule = self._stepper.problems[0].scene.material.volume_weight
        return self._weights[1] * (1.0 if rule == "published" else 3.0)

    @property
    def young(self) -> Tensor:
        """By each cell's Young's modulus at fixed Poisson's ratio, (B, C), 1/Pa."""
        mu, lam = self._moduli_slopes[0]
        return self.mu * mu + self.lam * lam

    @property
    def poisson(self) -> Tensor:
        """By each cell's Poisson's ratio at fixed Young's modulus, (B, C)."""
        mu, lam = self._moduli_slopes[1]
        return self.mu * mu + self.lam * lam

    @cached_property
    def density(self) -> Tensor:
        """By each cell's density, (B, C), m3/kg; gravity included."""
        objective, stepper = self._objective, self._stepper
        mass = objective.mass
        fall = stepper.loads.acceleration(stepper.spans(self._scheme, self._before))
        out = mass.row_slopes((self.x * fall).sum(dim=-1))
        out = out - objective.inertia * mass.slopes(self.x, self._y - objective.target)
        if objective.damping:
            out = out - objective.damping * mass.slopes(self.x, self._y - objective.origin)
        return out

    @cached_property
    def _weights(self) -> tuple[Tensor, Tensor]:
        by_mu, by_omega = self._stepper.cells.weight_slopes(self._y, self.x)
        present = self._stepper.cells.terms
        return -by_mu * present[0], -by_omega * present[1]

    @property
    def _moduli_slopes(self) -> Any:
        young, poisson, _ = self._stepper.material
        return lame_slopes(young, poisson)  # type: ignore[type-var]

    # --- internals --------------------------------------------------------------------------------

    def _sum(self, name: str) -> Tensor:
        found = self._sums.get(name)
        return torch.zeros_like(self._before.positions) if found is None else found

    def _pull(self, on_free: Linear, on_clamped: Linear | None, g: Tensor) -> None:
        if on_clamped is None:
            on_free.transpose(g, self._sums)
            return
        on_free.transpose(torch.where(self._free, g, 0.0), self._sums)
        on_clamped.transpose(torch.where(self._free, 0.0, g), self._sums)

    def _pull_stage(self, by_y: Tensor, image: Tensor) -> None:
        scheme, objective, stepper = self._scheme, self._objective, self._stepper
        momentum = objective.mass(self.x)[:, : self._nodes]
        if scheme.inertia:
            self._pull(scheme.target, scheme.clamped_target, scheme.inertia * momentum)
        if objective.damping:
            self._pull(scheme.origin, scheme.clamped_origin, objective.damping * momentum)
        back = torch.where(self._free, 0.0, by_y - image)
        scheme.clamped.transpose(back, self._sums)
        if stepper.loads.follow:
            spans = stepper.spans(scheme, self._before)
            slope = stepper.loads.pulled(spans, scheme.loads_at(self._known), self._nodal)
            scheme.loads_at.transpose(slope, self._sums)
