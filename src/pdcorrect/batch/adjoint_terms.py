"""What damping adds to a batch's derivatives: `pdcorrect.solvers.adjoint_terms` for B scenes."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch import viscosity
from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.correction import without_trace
from pdcorrect.batch.modes import Following, relaxed
from pdcorrect.batch.objective import dot
from pdcorrect.batch.step_equation import BatchStepEquation
from pdcorrect.batch.stepper import BatchStepper

Array = NDArray[np.float64]
Weights = tuple[Tensor, Tensor]

_STEP = {torch.float64: 1e-4, torch.float32: 1e-2}
"""Of a deformation gradient's entry, for differences of fourth order of projected tangents."""


class Written:
    """Derivatives through what learned elements are written from, scene by scene on the CPU.

    Those by matrices and masses are gathered; `weights` pulls them back at once.
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


class RayleighTerm:
    """- x . (Rayleigh damping's force at y) of the step that was prepared last.

    By what the step starts from, for its solution and adjoint state y and x (B, U, 3).
    """

    def __init__(
        self,
        stepper: BatchStepper,
        stage: BatchStepEquation,
        y: Tensor,
        x: Tensor,
        written: Written | None,
    ) -> None:
        damping = stepper.objective.rayleigh
        assert damping is not None
        self._mass, self._cells, self._x = stepper.objective.mass, stepper.cells, x
        self._written = written
        self._alpha, self._stiffness = stepper.objective.factors[1:3].clone()
        self._origin = damping.origin.clone()
        self._offset = y - self._origin
        self._by_origin = damping.apply(None, x)
        self._stiff = bool(damping.tangent)
        if self._stiff:
            self._at = relaxed(self._cells, stage.foreseen)
            self._along = self._cells.apply(damping.tangent, self._offset)

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
    def weights(self) -> Weights:
        """By mu and omega, each (B, C)."""
        n = self._cells.sizes
        if not self._stiff:
            return self._x.new_zeros(n.scenes, n.cells), self._x.new_zeros(n.scenes, n.cells)
        _, by_mu, by_omega = self._tangent_slopes
        total = -self._stiffness * by_mu, -self._stiffness * by_omega
        total = with_modes(self._cells, total, self._at, self._by_place)
        return with_modes(self._cells, total, self._origin, self._by_origin)

    @property
    def density(self) -> Tensor:
        """By each cell's density, (B, C)."""
        return -self._mass.slopes(self._x, self.mass_offset)

    @property
    def mass_offset(self) -> Tensor:
        """What the mass matrix is multiplied by, (B, U, 3), N/kg."""
        return self._alpha * self._offset

    @property
    def by_mass(self) -> Tensor:
        """By d alpha, (B,)."""
        return -dot(self._x, self._mass(self._offset))

    @property
    def by_stiffness(self) -> Tensor:
        """By d beta, (B,)."""
        return -dot(self._x, self._along) if self._stiff else self._x.new_zeros(len(self._x))

    @cached_property
    def _by_place(self) -> Tensor:
        return -self._stiffness * self._tangent_slopes[0]

    @cached_property
    def _tangent_slopes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Derivatives of x . K (y - o) by the configuration (B, U, 3), mu and omega (B, C)."""
        cells = self._cells
        H = cells.gradients(self._at - cells.rest)
        D, E = cells.gradients(self._x), cells.gradients(self._offset)

        def slope(unit: Tensor, weight: Tensor) -> Tensor:
            """By central differences of fourth order along changes of H and of the weights."""
            total = torch.zeros_like(unit[0])
            for t, c in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
                weights = cells.point_weights + t * weight
                tangent = cells.points.tangent(H + t * unit, weights, project=True)
                total += c * (D * cells.points.product(tangent, E)).sum(dim=0)
            return total / 12.0

        step, by_H, none = _STEP[H.dtype], torch.empty_like(H), torch.zeros_like(H)
        for i in range(9):
            unit = torch.zeros_like(H)
            unit[i] = step
            by_H[i] = slope(unit, torch.zeros_like(cells.point_weights))
        n, found = cells.sizes, []
        for term in (0, 1):
            unit = torch.zeros_like(cells.point_weights)
            unit[term] = step * (cells.point_weights[term] + cells.volumes[term])
            share = torch.where(unit[term] > 0.0, cells.volumes[term] / unit[term], 0.0)
            change = slope(none, unit) * share
            found.append(change.reshape(n.scenes, n.cells, n.points).sum(dim=2))
        by_place = cells.gathered(by_H / step)
        if self._written is not None:
            by_place = by_place + self._written.add_tangents(
                self._at, self._x, self._offset, -float(self._stiffness)
            )
        return by_place, found[0], found[1]


class ViscousTerm:
    """- x . (viscosity's force at y), likewise."""

    def __init__(
        self,
        stepper: BatchStepper,
        stage: BatchStepEquation,
        y: Tensor,
        x: Tensor,
        written: Written | None,
    ) -> None:
        damping, cells = stepper.objective.viscous, stepper.cells
        assert damping is not None
        self._cells, self._written, self._rate = cells, written, damping.rate.clone()
        S, frames = viscosity.stretches(cells, y)
        self._change = S - damping.before
        self._rates = viscosity.rates(cells, frames, x)
        self._stress = viscosity.stress(self._rates, self._rate * cells.point_weights)
        self._strains = [(a, relaxed(cells, place)) for a, place in stage.strains]
        if cells.correction is not None:
            here = cells.local(y - cells.rest)
            self._against = without_trace(cells.correction.strains(here) - damping.strains_before)
            rates = cells.correction.rates(here, cells.local(x))
            self._learned_rates = damping.whole * without_trace(rates)

    @cached_property
    def places(self) -> list[Tensor]:
        """By each of the earlier positions that stretches are of, (B, N, 3)."""
        return [
            Following(self._cells, place).reduced(slope)
            for (_, place), slope in zip(self._strains, self._slopes, strict=True)
        ]

    @cached_property
    def weights(self) -> Weights:
        """By mu and omega, each (B, C)."""
        by_mu, by_omega = viscosity.stress_slopes(self._cells, self._change, self._rates)
        total = -self._rate * by_mu, -self._rate * by_omega
        if self._written is not None:
            self._written.add_products(-self._rate * self._learned_rates, self._against)
        for (_, place), slope in zip(self._strains, self._slopes, strict=True):
            total = with_modes(self._cells, total, place, slope)
        return total

    @property
    def by_rate(self) -> Tensor:
        """By the strain rate's factor times the viscosity, (B,)."""
        out = -2.0 / self._rate * viscosity.energies(self._cells, self._change, self._stress)
        if self._cells.correction is None:
            return out
        stress = self._cells.correction.stress(self._against)
        return out - (self._learned_rates * stress).sum(dim=(1, 2))

    @cached_property
    def _slopes(self) -> list[Tensor]:
        """By the configurations there."""
        found, correction = [], self._cells.correction
        for a, place in self._strains:
            _, frames = viscosity.stretches(self._cells, place)
            slope = viscosity.forces(self._cells, frames, self._stress)
            if correction is not None:
                stress = correction.viscous_stress(self._learned_rates, self._rate)
                local = self._cells.local(place - self._cells.rest)
                slope = slope + self._cells.of_corners(correction.pulled(local, stress))
            found.append(a * slope)
        return found


def with_modes(cells: CellBatch, total: Weights, y: Tensor, slope: Tensor) -> Weights:
    """Plus what the modes at y, which depend on the material, add."""
    more = cells.weight_slopes(y, -Following(cells, y).response(slope))
    return total[0] + more[0], total[1] + more[1]
