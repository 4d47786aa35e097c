"""What one step of a batch minimises: `pdcorrect.solvers.step` for B scenes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.gpu import as_kernel, small_products
from pdcorrect.batch.shared_matrices import with_rows


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
        self._diagonal = all(p.mass_is_diagonal for p in distinct)
        self.density = cells.rest.new_zeros(n.scenes, n.cells)
        self.nodal = cells.rest.new_zeros(n.scenes, n.unknowns)

    def narrowed(self, cells: CellBatch, rows: Tensor) -> BatchMass:
        """Of some scenes, with their cells."""
        return with_rows(self, rows, "_blocks", "density", "nodal", _cells=cells)

    def set_density(self, density: Tensor) -> None:
        """Densities (B, C), kg/m3, from now on."""
        self.density.copy_(density)
        rows = self._blocks.sum(dim=-1) * self.density[..., None]
        self.nodal[:, : self._cells.sizes.nodes] = self._cells.summed_numbers(rows)

    def __call__(self, x: Tensor, factor: float = 1.0) -> Tensor:
        """A multiple of M x."""
        if self._diagonal:
            return (factor * self.nodal)[..., None] * x
        local = (factor * self.density)[..., None, None] * self._by_cell(x)
        return self._cells.summed(self._filled(local))

    def slopes(self, a: Tensor, b: Tensor) -> Tensor:
        """Derivatives of a . M b by the densities, (B, C), for (B, U, 3)."""
        return (self._local(a) * self._by_cell(b)).sum(dim=(2, 3))

    def row_slopes(self, x: Tensor) -> Tensor:
        """Derivatives (B, C) of the sum of x (B, U) times ``nodal`` by the densities."""
        columns = x[..., None].expand(-1, -1, 3).contiguous()
        return (self._blocks.sum(dim=-1) * self._local(columns)[..., 0]).sum(dim=2)

    def _by_cell(self, x: Tensor) -> Tensor:
        return small_products(self._blocks, self._local(x))

    def _local(self, x: Tensor) -> Tensor:
        return self._cells.local(x)

    def _filled(self, local: Tensor) -> Tensor:
        """Zeros for the cells' modes."""
        missing = self._cells.sizes.width - local.shape[2]
        return torch.nn.functional.pad(local, (0, 0, 0, missing))


class BatchObjective:
    """gamma of B steps; what a step depends on is copied into fixed tensors.

    So that recorded work can be replayed for the next step.

    Attributes
    ----------
    inertia, damping : float
        c and d alpha, 1/s2.
    free : (B, U, 3)
        1 where a component may move.
    target, origin, forces : (B, U, 3)
        q, o (m) and the external forces (N).
    """

    def __init__(self, cells: CellBatch) -> None:
        self.cells = cells
        self.mass = BatchMass(cells)
        self.inertia = self.damping = 0.0
        free = [np.where(p.free_unknowns, 1.0, 0.0) for p in cells.bodies.distinct]
        self.free = cells.repeated_configurations(free)
        self.target, self.origin, self.forces = (torch.zeros_like(cells.rest) for _ in range(3))

    def narrowed(self, rows: Tensor) -> BatchObjective:
        """Of some scenes, as it is now."""
        cells = self.cells.narrowed(rows)
        mass = self.mass.narrowed(cells, rows)
        names = ("free", "target", "origin", "forces")
        return with_rows(self, rows, *names, cells=cells, mass=mass)

    @property
    def factors(self) -> tuple[float, float]:
        """On mass and on stiffness in the Hessian."""
        return self.inertia + self.damping, 1.0

    def __call__(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gamma (B,), its gradient (B, U, 3), zero where clamped, and the size of its terms."""
        energy, elastic = self.cells.energy_and_forces(y)
        offset = y - self.target
        momentum = self.mass(offset, self.inertia)
        gradient, by_node = as_kernel(_terms, y.is_cuda)(
            elastic, offset, momentum, self.forces, y - self.cells.rest, self.free
        )
        kinetic, work = by_node.sum(dim=-1)
        value, scale = energy + kinetic - work, energy + kinetic + work.abs()
        if self.damping:
            offset = y - self.origin
            drag = self.mass(offset, self.damping)
            loss = 0.5 * dot(offset, drag)
            value, scale, gradient = value + loss, scale + loss, gradient + drag * self.free
        return value, gradient, scale

    def hessian(self, tangent: tuple[Tensor, Tensor, Tensor], x: Tensor) -> Tensor:
        """H x on all components, for a tangent of the cells."""
        out = self.cells.apply(tangent, x)
        return out + self.mass(x, self.inertia + self.damping) if self.inertia else out


def largest_displacement(x: Tensor) -> Tensor:
    """Largest node norm of each scene, (B,), for (B, U, 3)."""
    squares: Tensor = as_kernel(node_dot, x.is_cuda)(x, x)
    return torch.sqrt(squares.amax(dim=1))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products (B,) of (B, U, 3)."""
    by_node: Tensor = as_kernel(node_dot, a.is_cuda)(a, b)
    return by_node.sum(dim=1)


def by_scene(values: Tensor) -> Tensor:
    """(B,) as factors of (B, U, 3)."""
    return values[:, None, None]


# --- what is one kernel on a GPU -----------------------------------------------------------------


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
