"""Derivatives of a batch's step: `pdcorrect.solvers.adjoint` for B scenes, in torch."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import torch
from torch import Tensor

from pdcorrect.batch.adjoint_terms import RayleighTerm, ViscousTerm, Written
from pdcorrect.batch.linear_solver import BatchConjugateGradients
from pdcorrect.batch.minimise import Mixing
from pdcorrect.batch.objective import largest_displacement
from pdcorrect.batch.states import (
    BatchResult,
    BatchState,
    Solved,
    check_nodal,
    check_state,
    in_one,
)
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.errors import InputError
from pdcorrect.scene import Material
from pdcorrect.scene.materials import lame_slopes
from pdcorrect.solvers.follower import MOST
from pdcorrect.solvers.implicit import positive
from pdcorrect.solvers.schemes import Linear

_TIMES_DIFFER = 1e-6
"""Of the step, or of the time, that times may be apart."""


class BatchGradients:
    """Derivatives of a loss by the inputs of one step of B scenes.

    Those that take more than the adjoint state are computed when first asked for; steps that
    the stepper takes meanwhile do not matter.

    Parameters
    ----------
    stepper : BatchStepper
    before : BatchState
    result : BatchResult or Solved
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

    Raises
    ------
    InputError
        If an argument is of another kind, shape, type or device, or the result is not of a
        step of the stepper from ``before``.
    """

    def __init__(
        self,
        stepper: BatchStepper,
        before: BatchState,
        result: Solved,
        grad_positions: Tensor | None = None,
        grad_velocities: Tensor | None = None,
        *,
        grad_memory: Mapping[str, Tensor] | None = None,
        forces: Tensor | None = None,
        tolerance: float = 1e-6,
    ) -> None:
        check_state(stepper.cells, before)
        if result.y.shape != stepper.cells.rest.shape:
            raise InputError(
                f"result has configurations {tuple(result.y.shape)}: expected "
                f"{tuple(stepper.cells.rest.shape)}, from a step of this stepper."
            )
        if isinstance(result, BatchResult):
            step = stepper.time_step
            for i, (start, end) in enumerate(zip(before.times, result.state.times, strict=True)):
                if abs(end - start - step) > _TIMES_DIFFER * (step + abs(end)):
                    raise InputError(
                        f"result is at {end:g} s in scene {i}, and before at {start:g} s: expected "
                        f"a step of {step:g} s from before."
                    )
        tolerance = positive("tolerance", tolerance)
        self._stepper, self._before, self._y = stepper, before, result.y
        self._nodes = stepper.cells.sizes.nodes
        self._free = stepper.staging.free
        self._sums: dict[str, Tensor] = {}
        with stepper.alone():
            self._stage = stepper.prepare(before, forces, result.y)
            self._material = stepper.present
            self._inertia = stepper.objective.factors[0].clone()
            by_y = self._pull_end(grad_positions, grad_velocities, grad_memory or {})
            kept = self._sums.pop("internal_forces_after", None)
            if kept is not None:
                kept = stepper.staging.extended(kept * self._free)
                by_y = by_y + self._inertia * stepper.objective.mass(kept)[:, : self._nodes]
                by_y = by_y - self._load_slopes("y", kept)
            fine = torch.tensor(in_one(result.statuses), device=by_y.device)
            solver = self._solve(by_y, fine, tolerance)
            kept = None if kept is None else torch.where(self.ok[:, None, None], kept, 0.0)
            self._push = self.x if kept is None else self.x - kept
            objective = stepper.objective
            self._written = Written(stepper) if stepper.cells.correction is not None else None
            given = stepper, self._stage, self._y, self.x, self._written
            self._rayleigh = RayleighTerm(*given) if objective.rayleigh is not None else None
            self._viscous = ViscousTerm(*given) if objective.viscous is not None else None
            self._pull_stage(by_y, solver.hessian(self.x)[:, : self._nodes])

    def _solve(self, by_y: Tensor, fine: Tensor, tolerance: float) -> BatchConjugateGradients:
        """Find ``x``; with loads that follow the body by a fixed point, x = H^-1 (g + J^T x)."""
        stepper = self._stepper
        g = stepper.staging.extended(by_y)
        share = 0.1 if stepper.loads.follow else 1.0
        solver = stepper.solve_adjoint(self._y, g, fine, share * tolerance)
        self.ok, self.iterations, x = fine & solver.converged, solver.steps, solver.x.clone()
        if stepper.loads.follow:
            image, mixed = x, Mixing(len(x))
            x = torch.zeros_like(x)
            left = self.ok
            for _ in range(MOST):
                x = mixed(x, image, left)
                more = stepper.staging.extended(self._load_slopes("y", x))
                solver = stepper.solve_adjoint(self._y, g + more, fine, share * tolerance)
                image, self.iterations = solver.x.clone(), self.iterations + solver.steps
                change = largest_displacement(image - x)
                left = left & (change > 0.5 * tolerance * largest_displacement(image))
                if not bool(left.any()):
                    break
            self.ok, x = self.ok & solver.converged & ~left, image
        self.x = torch.where(self.ok[:, None, None], x, 0.0)
        return solver

    def _load_slopes(self, name: str, x: Tensor) -> Tensor:
        """Derivatives of x . (loads in the equation) by y or positions they are sampled at."""
        nodes, stage, loads = self._nodes, self._stage, self._stepper.loads
        share = stage.scheme.sampled.coefficients.get(name, 0.0)
        if not share or not loads.follow:
            return torch.zeros_like(x[:, :nodes])
        slope = loads.pulled(stage.spans, stage.sampled(self._y[:, :nodes]), x[:, :nodes])
        return share * stage.scheme.load_factor * slope

    def _pull_end(
        self, positions: Tensor | None, velocities: Tensor | None, memory: Mapping[str, Tensor]
    ) -> Tensor:
        """Derivatives of the loss by y, from those by what follows from y."""
        scheme = self._stage.scheme
        unknown = sorted(set(memory) - set(scheme.memory))
        if unknown:
            raise InputError(
                f"grad_memory has {unknown[0]!r}: expected names of the memory after the step, "
                f"{', '.join(scheme.memory) or 'of which there are none'}."
            )
        self._pull(scheme.positions, None, self._given("grad_positions", positions))
        by_velocities = self._given("grad_velocities", velocities)
        self._pull(scheme.velocities, scheme.clamped_velocities, by_velocities)
        for name, g in memory.items():
            self._pull(*scheme.memory[name], self._given(name, g))
        return self._sums.pop("y")

    def _given(self, name: str, g: Tensor | None) -> Tensor:
        """A derivative by nodal values; zero at nodes that a scene does not have."""
        if g is None:
            return torch.zeros_like(self._before.positions)
        check_nodal(self._stepper.cells, name, g)
        return torch.where(self._stepper.cells.present_nodes[..., None], g, 0.0)

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
        return self._stage.scheme.load_factor * self._push[:, : self._nodes]

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
        return self._weights[1] * (1.0 if self._rule.volume_weight == "published" else 3.0)

    @property
    def young(self) -> Tensor:
        """By each cell's Young's modulus at fixed Poisson's ratio, (B, C), 1/Pa."""
        return self._by_modulus(0)

    @property
    def poisson(self) -> Tensor:
        """By each cell's Poisson's ratio at fixed Young's modulus, (B, C)."""
        return self._by_modulus(1)

    @cached_property
    def density(self) -> Tensor:
        """By each cell's density, (B, C), m3/kg; gravity included."""
        stage, mass = self._stage, self._stepper.objective.mass
        with self._stepper.alone():
            fall = self._stepper.loads.acceleration(stage.spans)
            push = stage.scheme.load_factor * self._push
            out = mass.row_slopes((push * fall).sum(dim=-1))
            out = out - self._inertia * mass.slopes(self._push, self._y - stage.target)
            return out if self._rayleigh is None else out + self._rayleigh.density

    # --- by damping ---------------------------------------------------------------------------

    @property
    def viscosity(self) -> Tensor:
        """By ``damping.viscosity``, (B,), 1/s."""
        return self._stage.scheme.strain_rate * self._by(self._viscous, "by_rate")

    @property
    def rayleigh_mass(self) -> Tensor:
        """By ``damping.mass``, (B,), s."""
        return self._stage.scheme.rate * self._by(self._rayleigh, "by_mass")

    @property
    def rayleigh_stiffness(self) -> Tensor:
        """By ``damping.stiffness``, (B,), 1/s."""
        return self._stage.scheme.rate * self._by(self._rayleigh, "by_stiffness")

    @cached_property
    def _weights(self) -> tuple[Tensor, Tensor]:
        with self._stepper.alone():
            parts = [self._stepper.cells.weight_slopes(self._y, -self.x)]
            parts += [term.weights for term in (self._rayleigh, self._viscous) if term is not None]
            if self._written is not None:
                parts.append(self._by_written(self._written))
            by_mu, by_omega = (torch.stack(each).sum(dim=0) for each in zip(*parts, strict=True))
            return by_mu * self._rule.has_shear_term, by_omega * self._rule.has_volume_term

    def _by_written(self, written: Written) -> tuple[Tensor, Tensor]:
        """Through what learned elements are written from, by mu and omega, (B, C)."""
        written.add_forces(self._y, -self.x)
        written.add_inertia(-self._push, self._inertia * (self._y - self._stage.target))
        if self._rayleigh is not None:
            written.add_inertia(-self.x, self._rayleigh.mass_offset)
        return written.weights(self.x)

    @property
    def _rule(self) -> Material:
        return self._stepper.problems[0].scene.material

    def _by_modulus(self, which: int) -> Tensor:
        """By Young's modulus (0) or Poisson's ratio (1); zero at cells that a scene lacks."""
        young, poisson, _ = self._material.values
        mu, lam = lame_slopes(young, poisson)[which]  # type: ignore[type-var]
        present = self._stepper.cells.present_cells
        return torch.where(present, self.mu * mu + self.lam * lam, 0.0)

    # --- internals --------------------------------------------------------------------------------

    def _by(self, term: RayleighTerm | ViscousTerm | None, name: str) -> Tensor:
        """One of a term's derivatives (B,); zero without the term."""
        found: Tensor = self.x.new_zeros(len(self.x)) if term is None else getattr(term, name)
        return found

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
        stage, stepper = self._stage, self._stepper
        scheme = stage.scheme
        momentum = stepper.objective.mass(self._push)[:, : self._nodes]
        scheme.past_forces.transpose(self._push[:, : self._nodes], self._sums)
        sampled = self._load_slopes("positions", self._push)
        Linear(positions=1.0).transpose(sampled, self._sums)
        if scheme.inertia:
            self._pull(scheme.target, scheme.clamped_target, self._inertia * momentum)
        if self._rayleigh is not None:
            self._pull(scheme.origin, scheme.clamped_origin, self._rayleigh.origin)
            self._pull(scheme.foreseen or scheme.start, scheme.clamped, self._rayleigh.place)
        if self._viscous is not None:
            for (_, place), slope in zip(scheme.strains, self._viscous.places, strict=True):
                place.transpose(slope, self._sums)
        back = torch.where(self._free, 0.0, by_y - image)
        if stepper.loads.follow:
            back = back + torch.where(self._free, 0.0, self._load_slopes("y", self.x))
        scheme.clamped.transpose(back, self._sums)
