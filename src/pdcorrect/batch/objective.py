"""What one step of a batch minimises: `pdcorrect.solvers.step` for B scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch import viscosity
from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.batch.gpu import one_kernel, small_products
from pdcorrect.batch.modes import relaxed
from pdcorrect.scene import Damping


class BatchMass:
    """M x for nodal fields (B, U, 3), kg, after `set_density`; internal modes have no mass.

    ``nodal`` (B, U), kg, are the row sums, ``density`` (B, C) is in kg/m3.
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


class Rayleigh:
    """`pdcorrect.solvers.damping.Rayleigh` for B scenes.

    Attributes
    ----------
    origin : (B, U, 3)
        m.
    tangent : tuple of Tensor
        Where damping by stiffness is taken; none without it.
    """

    def __init__(self, cells: CellBatch, mass: BatchMass, factors: Tensor, stiff: bool) -> None:
        self._cells, self._mass, self._factors = cells, mass, factors
        self.origin = torch.zeros_like(cells.rest)
        self.tangent: tuple[Tensor, ...] = ()
        if stiff:
            with torch.no_grad():  # or kernels are compiled for work with derivatives too
                like = cells.linearise(cells.rest, project=True)
            self.tangent = tuple(map(torch.zeros_like, like))

    def prepare(self, origin: Tensor, foreseen: Tensor) -> None:
        """Take these positions (B, N, 3) of a step, see `Scheme`, from now on."""
        if not self.tangent:
            self.origin[:, : origin.shape[1]] = origin
            return
        self.origin.copy_(relaxed(self._cells, origin))
        tangent = self._cells.linearise(relaxed(self._cells, foreseen), project=True)
        for kept, new in zip(self.tangent, tangent, strict=True):
            kept.copy_(new)

    def value_and_force(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """J (B,) and N (B, U, 3)."""
        force = self.apply(None, y - self.origin)
        return 0.5 * dot(y - self.origin, force), force

    def linearise(self, y: Tensor) -> None:
        """The second derivative does not depend on y."""

    def apply(self, tangent: None, x: Tensor) -> Tensor:
        """The second derivative times x."""
        out = self._mass(x, self._factors[0])
        if not self.tangent:
            return out
        return out + self._factors[1] * self._cells.apply(self.tangent, x)


class Viscous:
    """`pdcorrect.solvers.damping.Viscous` for B scenes.

    Attributes
    ----------
    rate : Tensor
        The strain rate's factor times the viscosity.
    before : (6, B C, Q)
        The stretches from which those at y are counted.
    strains_before : (B, C, 18)
        The same of a learned element's strains.
    whole : (B, C, 1)
        Where these do not fade at the step's start.
    """

    def __init__(self, cells: CellBatch, rate: Tensor) -> None:
        self._cells, self.rate = cells, rate
        self.before = cells.rest.new_zeros(6, *cells.volumes.shape[1:])
        self.strains_before = cells.rest.new_zeros(cells.sizes.scenes, cells.sizes.cells, 18)
        self.whole = torch.ones_like(self.strains_before[..., :1])

    def prepare(self, strains: Sequence[tuple[float, Tensor]]) -> None:
        """Count from these positions (B, N, 3), see `Scheme`, from now on."""
        cells = self._cells
        self.before.zero_()
        for a, place in strains:
            self.before.add_(viscosity.stretches(cells, relaxed(cells, place))[0], alpha=a)
        if cells.correction is not None:
            nodes = cells.rest[:, : cells.sizes.nodes]
            local = [(a, cells.local(x - nodes)) for a, x in strains]
            parts = [a * cells.correction.strains(u) for a, u in local]
            self.strains_before.copy_(torch.stack(parts).sum(dim=0))
            whole = [cells.correction.whole(u) for _, u in local]
            self.whole.copy_(torch.stack(whole).all(dim=0))

    def value_and_force(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """J (B,) and N (B, U, 3)."""
        cells = self._cells
        S, frames = viscosity.stretches(cells, y)
        change = S - self.before
        stress = viscosity.stress(change, self._weights)
        energy = viscosity.energies(cells, change, stress)
        forces = viscosity.forces(cells, frames, stress)
        if cells.correction is None:
            return energy, forces
        more, by_cell = cells.correction.viscous(
            cells.local(y - cells.rest), self.strains_before, self._learned_rate
        )
        return energy + more, forces + cells.of_corners(by_cell)

    def linearise(self, y: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """What `apply` needs: of the element, and of what a learned one adds."""
        cells, weights = self._cells, self._weights
        S, frames = viscosity.stretches(cells, y)
        tangent = (*frames, viscosity.stress(S - self.before, weights), weights)
        if cells.correction is None:
            return tangent, ()
        return tangent, cells.correction.linearise_viscous(
            cells.local(y - cells.rest), self.strains_before, self._learned_rate
        )

    def apply(self, tangent: tuple[tuple[Tensor, ...], tuple[Tensor, ...]], x: Tensor) -> Tensor:
        """The second derivative times x."""
        cells = self._cells
        out = viscosity.apply(cells, tangent[0], x)
        if cells.correction is None:
            return out
        by_cell = cells.correction.apply(tangent[1], cells.local(x), self._learned_rate)
        return out + cells.of_corners(by_cell)

    @property
    def _learned_rate(self) -> Tensor:
        return self.rate * self.whole

    @property
    def _weights(self) -> Tensor:
        return self.rate * self._cells.point_weights


class BatchObjective:
    """gamma of B steps; what a step depends on is copied into fixed tensors.

    So that recorded work can be replayed for the next step.

    Attributes
    ----------
    factors : (4,)
        c and d alpha, 1/s2; d beta; the strain rate's factor times the viscosity.
    rayleigh : Rayleigh or None
    viscous : Viscous or None
    free : (B, U, 3)
        1 where a component may move.
    target, forces : (B, U, 3)
        q (m) and the external forces (N).
    """

    def __init__(self, cells: CellBatch, damping: Damping) -> None:
        self.cells = cells
        self.mass = BatchMass(cells)
        self.factors = cells.rest.new_zeros(4)
        self.free = cells.free
        self.target, self.forces = torch.zeros_like(cells.rest), torch.zeros_like(cells.rest)
        self.rayleigh = self.viscous = None
        if damping.mass or damping.stiffness:
            stiff = damping.stiffness > 0.0
            self.rayleigh = Rayleigh(cells, self.mass, self.factors[1:3], stiff)
        if damping.viscosity:
            self.viscous = Viscous(cells, self.factors[3])
        self._damping = [term for term in (self.rayleigh, self.viscous) if term is not None]

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
        for term in self._damping:
            loss, force = term.value_and_force(y)
            value, scale, gradient = value + loss, scale + loss, gradient + force * self.free
        return value, gradient, scale

    def linearise(self, y: Tensor) -> tuple[Any, ...]:
        """What `hessian` needs at configurations, of each term."""
        return self.cells.linearise(y), *(term.linearise(y) for term in self._damping)

    def hessian(self, tangents: tuple[Any, ...], x: Tensor) -> Tensor:
        """H x on all components."""
        elastic, *others = tangents
        out = self.cells.apply(elastic, x) + self.mass(x, self.factors[0])
        for term, tangent in zip(self._damping, others, strict=True):
            out = out + term.apply(tangent, x)
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
