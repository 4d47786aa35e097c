"""What damping adds to a batch's derivatives: `pdcorrect.solvers.adjoint_terms` for B scenes."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch import viscosity
from pdcorrect.batch.correction import without_trace
from pdcorrect.batch.modes import Following, relaxed
from pdcorrect.batch.objective import dot
from pdcorrect.batch.step_equation import BatchStepEquation
from pdcorrect.batch.stepper import BatchStepper

Array = NDArray[np.float64]

_STEP = {torch.float64: 1e-4, torch.float32: 1e-2}
"""Of a deformation gradient's entry, for differences of fourth order of projected tangents."""
_PLACES, _FACTORS = (1, -1, 2, -2), (8.0, -8.0, -1.0, 1.0)


class Written:
    """Derivatives through what learned elements are written from, scene by scene on the CPU.

    Those by matrices and masses are gathered; `weights` pulls them back at once.

    Parameters
    ----------
    stepper : BatchStepper
    """

    def __init__(self, stepper: BatchStepper) -> None:
        self._stepper = stepper
        self._corrections = stepper.corrections()
        material = stepper.present
        self._mu, self._omega, self._density = (
            m.to("cpu", torch.float64).numpy()
            for m in (material.mu, material.volume_weight, material.density)
        )
        self._matrices = [np.zeros_like(c.matrices) for c in self._corrections]
        self._masses = [np.zeros_like(c.masses) for c in self._corrections]

    def add_forces(self, y: Tensor, x: Tensor) -> None:
        """Of x . dW/dy, for (B, U, 3)."""
        for i, c in enumerate(self._corrections):
            self._matrices[i] += c.matrix_slopes(self._moved(y, i), self._nodal(x, i))

    def add_inertia(self, a: Tensor, b: Tensor) -> None:
        """Of a . M b, for (B, U, 3)."""
        for i, c in enumerate(self._corrections):
            density = self._density[i, : len(c.cells), None, None]
            local = self._nodal(a, i)[c.cells], self._nodal(b, i)[c.cells]
            self._masses[i] += density * np.einsum("cki,cli->ckl", *local)

    def add_products(self, a: Tensor, b: Tensor) -> None:
        """Of a . K b, for strains (B, C, 18)."""
        for i, c in enumerate(self._corrections):
            left, right = (x[i, : len(c.cells)].to("cpu", torch.float64).numpy() for x in (a, b))
            both = left[:, :, None] * right[:, None]
            self._matrices[i] += 0.5 * (both + np.swapaxes(both, 1, 2))

    def add_tangents(self, y: Tensor, x: Tensor, z: Tensor, factor: float) -> Tensor:
        """Of factor x . K z, K projected at y; without the factor by y, (B, U, 3)."""
        by_y = torch.zeros_like(y)
        for i, c in enumerate(self._corrections):
            fields = self._moved(y, i), self._nodal(x, i), self._nodal(z, i)
            found, by_matrices = c.tangent_slopes(*fields)
            by_y[i, : len(found)] = torch.as_tensor(found).to(y)
            self._matrices[i] += factor * by_matrices
        return by_y

    def weights(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """All of them by mu and omega, (B, C)."""
        found = np.zeros((2, *self._mu.shape))
        for i, c in enumerate(self._corrections):
            if c.writer is not None:
                count = len(c.cells)
                weights = self._mu[i, :count], self._omega[i, :count]
                slopes = c.writer.slopes(*weights, self._matrices[i], self._masses[i])
                found[:, i, :count] = slopes
        by_mu, by_omega = (torch.as_tensor(f).to(like) for f in found)
        return by_mu, by_omega

    def _nodal(self, field: Tensor, i: int) -> Array:
        nodes = len(self._stepper.problems[i].positions)
        return np.asarray(field[i, :nodes].to("cpu", torch.float64).numpy())

    def _moved(self, y: Tensor, i: int) -> Array:
        return self._nodal(y, i) - self._stepper.problems[i].positions


class DampingTerms:
    """- x . (damping force at y) of the step that was prepared last, by what it starts from.

    Parameters
    ----------
    stepper : BatchStepper
    stage : BatchStepEquation
    y, x : (B, U, 3)
        The solution and the adjoint state.
    """

    def __init__(
        self, stepper: BatchStepper, stage: BatchStepEquation, y: Tensor, x: Tensor
    ) -> None:
        objective = stepper.objective
        self._stepper, self._cells, self._x = stepper, stepper.cells, x
        self.written = Written(stepper) if stepper.cells.correction is not None else None
        self._stiff, self._viscous = objective.stiff, objective.viscous
        self.has_rayleigh = objective.damped or objective.stiff
        _, _, self._stiffness, self._rate = objective.factors.clone()
        if self.has_rayleigh:
            self._origin = objective.origin.clone()
            self._offset = y - self._origin
            self._by_origin = objective.rayleigh(x)
        if objective.tangent is not None:
            self._at = relaxed(self._cells, stage.foreseen)
            self._along = self._cells.apply(objective.tangent, self._offset)
        if self._viscous:
            S, frames = viscosity.stretches(self._cells, y)
            self._change = S - objective.before
            self._rates = viscosity.rates(self._cells, frames, x)
            weights = self._rate * self._cells.point_weights
            self._stress = viscosity.stress(self._rates, weights)
            self._strains = [(a, relaxed(self._cells, place)) for a, place in stage.strains]
        self._against: Tensor | None = None
        if self._viscous and self._cells.correction is not None:
            here = self._cells.local(y - self._cells.rest)
            self._y = y
            correction = self._cells.correction
            self._against = without_trace(correction.strains(here) - objective.strains_before)
            rates = correction.rates(here, self._cells.local(x))
            self._written_rates = objective.whole * without_trace(rates)

    @cached_property
    def origin(self) -> Tensor:
        """By o, with its modes in equilibrium, (B, N, 3)."""
        if not self._stiff:
            return self._by_origin[:, : self._cells.sizes.nodes]
        return Following(self._cells, self._origin).reduced(self._by_origin)

    @cached_property
    def place(self) -> Tensor:
        """By where the stiffness is taken, with its modes in equilibrium, (B, N, 3)."""
        if not self._stiff:
            return torch.zeros_like(self._x[:, : self._cells.sizes.nodes])
        return Following(self._cells, self._at).reduced(self._by_place)

    @cached_property
    def places(self) -> list[Tensor]:
        """By each of the earlier positions that stretches are of, (B, N, 3)."""
        if not self._viscous:
            return []
        return [
            Following(self._cells, place).reduced(slope)
            for (_, place), slope in zip(self._strains, self._by_strains, strict=True)
        ]

    @cached_property
    def weights(self) -> tuple[Tensor, Tensor]:
        """By mu and omega, each (B, C)."""
        nothing = self._x.new_zeros(self._cells.sizes.scenes, self._cells.sizes.cells)
        total = [nothing, nothing]
        if self._viscous:
            slopes = viscosity.stress_slopes(self._cells, self._change, self._rates)
            total = [-self._rate * slope for slope in slopes]
            if self._against is not None and self.written is not None:
                self.written.add_products(-self._rate * self._written_rates, self._against)
            for (_, place), slope in zip(self._strains, self._by_strains, strict=True):
                total = self._with_modes(total, place, slope)
        if self._stiff:
            by_weights = self._tangent_slopes[1:]
            total = [a - self._stiffness * b for a, b in zip(total, by_weights, strict=True)]
            total = self._with_modes(total, self._at, self._by_place)
            total = self._with_modes(total, self._origin, self._by_origin)
        return total[0], total[1]

    def _with_modes(self, total: list[Tensor], y: Tensor, slope: Tensor) -> list[Tensor]:
        """Plus what the modes at y, which depend on the material, add."""
        modes = Following(self._cells, y).response(slope)
        more = self._cells.weight_slopes(y, -modes)
        return [a + b for a, b in zip(total, more, strict=True)]

    @property
    def by_viscosity(self) -> Tensor:
        """By the strain rate's factor times the viscosity, (B,)."""
        if not self._viscous:
            return self._x.new_zeros(len(self._x))
        out = -2.0 / self._rate * viscosity.energies(self._cells, self._change, self._stress)
        if self._against is None or self._cells.correction is None:
            return out
        stress = self._cells.correction.stress(self._against)
        return out - (self._written_rates * stress).sum(dim=(1, 2))

    @property
    def by_mass(self) -> Tensor:
        """By d alpha, (B,)."""
        if not self.has_rayleigh:
            return self._x.new_zeros(len(self._x))
        return -dot(self._x, self._stepper.objective.mass(self._offset))

    @property
    def by_stiffness(self) -> Tensor:
        """By d beta, (B,)."""
        if not self._stiff:
            return self._x.new_zeros(len(self._x))
        return -dot(self._x, self._along)

    @cached_property
    def _by_strains(self) -> list[Tensor]:
        """By the configurations there."""
        found = []
        for a, place in self._strains:
            _, frames = viscosity.stretches(self._cells, place)
            slope = viscosity.forces(self._cells, frames, self._stress)
            correction = self._cells.correction
            if correction is not None:
                stress = correction.viscous_stress(self._written_rates, self._rate)
                local = self._cells.local(place - self._cells.rest)
                slope = slope + self._cells.of_corners(correction.pulled(local, stress))
            found.append(a * slope)
        return found

    @cached_property
    def _by_place(self) -> Tensor:
        return -self._stiffness * self._tangent_slopes[0]

    @cached_property
    def _tangent_slopes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Derivatives of x . K (y - o) by the configuration (B, U, 3), mu and omega (B, C)."""
        cells = self._cells
        H = cells.gradients(self._at - cells.rest)
        D, E = cells.gradients(self._x), cells.gradients(self._offset)

        def product(H: Tensor, weights: Tensor) -> Tensor:
            tangent = cells.points.tangent(H, weights, project=True)
            return (D * cells.points.product(tangent, E)).sum(dim=0)

        step, slope = _STEP[H.dtype], torch.empty_like(H)
        for i in range(9):
            unit = torch.zeros_like(H)
            unit[i] = step
            slope[i] = self._difference(lambda t, e=unit: product(H + t * e, cells.point_weights))
        n, found = cells.sizes, []
        for term in (0, 1):
            unit = torch.zeros_like(cells.point_weights)
            unit[term] = step * (cells.point_weights[term] + cells.volumes[term])
            change = self._difference(lambda t, e=unit: product(H, cells.point_weights + t * e))
            share = torch.where(unit[term] > 0.0, cells.volumes[term] / unit[term], 0.0)
            found.append((change * share).reshape(n.scenes, n.cells, n.points).sum(dim=2))
        by_place, by_mu, by_omega = cells.gathered(slope / step), found[0], found[1]
        if self.written is not None:
            more = self.written.add_tangents(
                self._at, self._x, self._offset, -float(self._stiffness)
            )
            by_place = by_place + more
        return by_place, by_mu, by_omega

    @staticmethod
    def _difference(function) -> Tensor:  # type: ignore[no-untyped-def]
        """Derivative at 0 of a function of t by central differences of fourth order."""
        terms = [c * function(t) for t, c in zip(_PLACES, _FACTORS, strict=True)]
        return torch.stack(terms).sum(dim=0) / 12.0
