"""What one step of a batch minimises: `pdcorrect.solvers.step` for B scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch import viscosity
from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.batch.gpu import one_kernel, small_products
from pdcorrect.batch.points import Tangent
from pdcorrect.scene import Damping


class BatchMass:
    """M x for nodal fields (B, U, 3), kg, after `set_density`; internal modes have no mass.

    Attributes
    ----------
    nodal : (B, U)
        Row sums, kg.
    density : (B, C)
        kg/m3.
    """

    def __init__(self, cells: CellBatch) -> None:
        self._cells = cells
        n = cells.sizes
        distinct = cells.bodies.distinct
        nodes = distinct[0].cells.shape[1]
        blocks = [p.space.cell_masses(p.mass_rule) for p in distinct]
        self._blocks = cells.repeated(blocks, n.cells, nodes, nodes)
        self._plain = self._blocks
        self._diagonal = all(p.mass_is_diagonal for p in distinct)
        self.density = cells.rest.new_zeros(n.scenes, n.cells)
        self.nodal = cells.rest.new_zeros(n.scenes, n.unknowns)

    def write(self, masses: Sequence[NDArray[np.float64]]) -> None:
        """Add what learned elements add in each scene, (C, K, K) at density 1, from now on."""
        if self._blocks is self._plain:
            self._blocks = self._plain.clone()
        added = self._cells.tensor(padded(masses, tuple(self._plain.shape[1:])))
        self._blocks.copy_(self._plain + added)  # in place, for recorded work

    def set_density(self, density: Tensor) -> None:
        """Densities (B, C), kg/m3, from now on."""
        self.density.copy_(density)
        rows = self._blocks.sum(dim=-1) * self.density[..., None]
        self.nodal[:, : self._cells.sizes.nodes] = self._cells.summed_numbers(rows)

    def __call__(self, x: Tensor, factor: Tensor | float = 1.0) -> Tensor:
        """A multiple of M x."""
        if self._diagonal:
            return (factor * self.nodal)[..., None] * x
        local = (factor * self.density)[..., None, None] * self._by_cell(x)
        return self._cells.of_corners(local)

    def slopes(self, a: Tensor, b: Tensor) -> Tensor:
        """Derivatives of a . M b by the densities, (B, C), for (B, U, 3)."""
        return (self._cells.local(a) * self._by_cell(b)).sum(dim=(2, 3))

    def row_slopes(self, x: Tensor) -> Tensor:
        """Derivatives (B, C) of the sum of x (B, U) times ``nodal`` by the densities."""
        columns = x[..., None].expand(-1, -1, 3).contiguous()
        return (self._blocks.sum(dim=-1) * self._cells.local(columns)[..., 0]).sum(dim=2)

    def _by_cell(self, x: Tensor) -> Tensor:
        return small_products(self._blocks, self._cells.local(x))


class Tangents(NamedTuple):
    """Of the elastic energy and of viscosity, if there is any, at the same configurations.

    The last is that of a learned element's viscosity.
    """

    elastic: Tangent
    viscous: tuple[Tensor, ...] | None
    written: Tensor | None = None


class BatchObjective:
    """gamma of B steps; what a step depends on is copied into fixed tensors.

    So that recorded work can be replayed for the next step.

    Attributes
    ----------
    factors : (4,)
        c and d alpha, 1/s2; d beta; the strain rate's factor times the viscosity.
    damped, stiff, viscous : bool
        Whether the last three are not zero, now and later.
    free : (B, U, 3)
        1 where a component may move.
    target, origin, forces : (B, U, 3)
        q, o (m) and the external forces (N).
    tangent : Tangent or None
        Where damping by stiffness is taken.
    before : (6, B C, Q)
        The stretches from which those of viscosity are counted.
    strains_before : (B, C, 18)
        The same of a learned element's strains.
    """

    def __init__(self, cells: CellBatch, damping: Damping) -> None:
        self.cells = cells
        self.mass = BatchMass(cells)
        self.factors = cells.rest.new_zeros(4)
        self.damped, self.stiff = damping.mass > 0.0, damping.stiffness > 0.0
        self.viscous = damping.viscosity > 0.0
        free = [np.where(p.free_unknowns, 1.0, 0.0) for p in cells.bodies.distinct]
        self.free = cells.repeated_configurations(free)
        self.target, self.origin, self.forces = (torch.zeros_like(cells.rest) for _ in range(3))
        points = cells.volumes.shape[1:]
        self.tangent: Tangent | None = None
        if self.stiff:
            in_cells = points[0], 1
            self.tangent = tuple(
                cells.rest.new_zeros(k, *(points if i < 3 else in_cells))
                for i, k in enumerate(cells.tangent_sizes())
            )
        self.before = cells.rest.new_zeros(6 if self.viscous else 0, *points)
        written = self.viscous and cells.correction is not None
        n = cells.sizes
        self.strains_before = cells.rest.new_zeros(n.scenes, n.cells if written else 0, 18)
        self.whole = torch.ones_like(self.strains_before[..., :1])

    def __call__(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gamma (B,), its gradient (B, U, 3), zero where clamped, and the size of its terms."""
        energy, elastic = self.cells.energy_and_forces(y)
        offset = y - self.target
        momentum = self.mass(offset, self.factors[0])
        gradient, by_node = _terms(
            elastic, offset, momentum, self.forces, y - self.cells.rest, self.free
        )
        kinetic, work = by_node.sum(dim=-1)
        value, scale = energy + kinetic - work, energy + kinetic + work.abs()
        if self.damped or self.stiff:
            offset = y - self.origin
            drag = self.rayleigh(offset)
            loss = 0.5 * dot(offset, drag)
            value, scale, gradient = value + loss, scale + loss, gradient + drag * self.free
        if self.viscous:
            loss, drag = self._viscous(y)
            value, scale, gradient = value + loss, scale + loss, gradient + drag * self.free
        return value, gradient, scale

    def rayleigh(self, x: Tensor) -> Tensor:
        """Rayleigh damping's second derivative times x (B, U, 3)."""
        out = self.mass(x, self.factors[1]) if self.damped else torch.zeros_like(x)
        if self.tangent is None:
            return out
        return out + self.factors[2] * self.cells.apply(self.tangent, x)

    def _viscous(self, y: Tensor) -> tuple[Tensor, Tensor]:
        S, frames = viscosity.stretches(self.cells, y)
        change = S - self.before
        stress = viscosity.stress(change, self._viscous_weights)
        energy = viscosity.energies(self.cells, change, stress)
        forces, cells = viscosity.forces(self.cells, frames, stress), self.cells
        if cells.correction is None:
            return energy, forces
        more, by_cell = cells.correction.viscous(
            cells.local(y - cells.rest), self.strains_before, self.written_rate
        )
        return energy + more, forces + cells.of_corners(by_cell)

    @property
    def written_rate(self) -> Tensor:
        """Of what a learned element adds to viscosity, (B, C, 1)."""
        return self.factors[3] * self.whole

    @property
    def _viscous_weights(self) -> Tensor:
        return self.factors[3] * self.cells.point_weights

    def linearise(self, y: Tensor) -> Tangents:
        """What `hessian` needs at configurations."""
        if not self.viscous:
            return Tangents(self.cells.linearise(y), None)
        S, frames = viscosity.stretches(self.cells, y)
        weights = self._viscous_weights
        viscous = (*frames, viscosity.stress(S - self.before, weights), weights)
        written, cells = None, self.cells
        if cells.correction is not None:
            written = cells.correction.linearise_viscous(
                cells.local(y - cells.rest), self.strains_before, self.written_rate
            )
        return Tangents(cells.linearise(y), viscous, written)

    def hessian(self, tangents: Tangents, x: Tensor) -> Tensor:
        """H x on all components."""
        out = self.cells.apply(tangents.elastic, x)
        out = out + self.mass(x, self.factors[0] + self.factors[1])
        if self.tangent is not None:
            out = out + self.factors[2] * self.cells.apply(self.tangent, x)
        if tangents.viscous is not None:
            out = out + viscosity.apply(self.cells, tangents.viscous, x)
        if tangents.written is not None and self.cells.correction is not None:
            changes = self.cells.correction.apply(
                tangents.written, self.cells.local(x), self.written_rate
            )
            out = out + self.cells.of_corners(changes)
        return out


def largest_displacement(x: Tensor) -> Tensor:
    """Largest node norm of each scene, (B,), for (B, U, 3)."""
    return torch.sqrt(_by_node(x, x).amax(dim=1))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products (B,) of (B, U, 3)."""
    return _by_node(a, b).sum(dim=1)


def by_scene(values: Tensor) -> Tensor:
    """(B,) as factors of (B, U, 3)."""
    return values[:, None, None]


@one_kernel
def _terms(
    elastic: Tensor,
    offset: Tensor,
    momentum: Tensor,
    forces: Tensor,
    displacement: Tensor,
    free: Tensor,
) -> tuple[Tensor, Tensor]:
    """The gradient, and each node's share in kinetic energy and work, (2, B, U)."""
    shares = 0.5 * node_dot(offset, momentum), node_dot(forces, displacement)
    return (momentum - elastic - forces) * free, torch.stack(shares)


def node_dot(a: Tensor, b: Tensor) -> Tensor:
    """What each node has in the inner product of (B, U, 3), (B, U); part of larger kernels."""
    x, y, z = (a * b).unbind(dim=-1)
    return x + y + z


_by_node = one_kernel(node_dot)
