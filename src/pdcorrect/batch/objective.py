"""What one step of a batch minimises: `pdcorrect.solvers.step` for B scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.fem.problem import Problem


class BatchMass:
    """M x for nodal fields (B, U, 3), kg; internal modes have no mass."""

    def __init__(self, cells: CellBatch, problems: Sequence[Problem]) -> None:
        self.nodal = cells.nodal([p.mass for p in problems])
        self._diagonal = all(p.mass_is_diagonal for p in problems)
        if not self._diagonal:
            columns, values = zip(*(_rows(p) for p in problems), strict=True)
            most = max(c.shape[1] for c in columns)
            n = cells.sizes
            offsets = np.arange(n.scenes)[:, None, None] * n.unknowns
            places = padded(columns, (n.unknowns, most)) + offsets
            self._columns = torch.as_tensor(places.reshape(-1), device=cells.device)
            self._values = cells.tensor(padded(values, (n.unknowns, most)))

    def __call__(self, x: Tensor) -> Tensor:
        if self._diagonal:
            return self.nodal[..., None] * x
        picked = x.reshape(-1, 3)[self._columns].reshape(*self._values.shape, 3)
        return (self._values[..., None] * picked).sum(dim=2)


def _rows(problem: Problem) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Columns and values of each row of the mass matrix, (N, most)."""
    matrix = problem.mass_matrix.tocsr()
    counts = np.diff(matrix.indptr)
    place = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], counts)
    rows = np.repeat(np.arange(len(counts)), counts)
    columns = np.zeros((len(counts), counts.max()), dtype=np.int64)
    values = np.zeros(columns.shape)
    columns[rows, place], values[rows, place] = matrix.indices, matrix.data
    return columns, values


class BatchObjective:
    """gamma of B steps; what a step depends on is copied into fixed tensors.

    So that a recorded graph of kernels can be replayed for the next step.

    Attributes
    ----------
    inertia, damping : float
        c and d alpha, 1/s2.
    free : (B, U, 3)
        1 where a component may move.
    target, origin, forces : (B, U, 3)
        q, o (m) and the external forces (N).
    """

    def __init__(self, cells: CellBatch, problems: Sequence[Problem]) -> None:
        self.cells = cells
        self.mass = BatchMass(cells, problems)
        self.inertia = self.damping = 0.0
        self.free = cells.configurations([np.where(p.free_unknowns, 1.0, 0.0) for p in problems])
        self.target, self.origin, self.forces = (torch.zeros_like(cells.rest) for _ in range(3))

    @property
    def factors(self) -> tuple[float, float]:
        """On mass and on stiffness in the Hessian."""
        return self.inertia + self.damping, 1.0

    def __call__(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gamma (B,), its gradient (B, U, 3), zero where clamped, and the size of its terms."""
        value, gradient, scale = self.balance(y)
        return value, gradient * self.free, scale

    def balance(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same with the gradient on all components."""
        energy, elastic = self.cells.energy_and_forces(y)
        offset = y - self.target
        momentum = self.inertia * self.mass(offset)
        kinetic = 0.5 * (offset * momentum).sum(dim=(1, 2))
        work = (self.forces * (y - self.cells.rest)).sum(dim=(1, 2))
        gradient = momentum - elastic - self.forces
        value, scale = energy + kinetic - work, energy + kinetic + work.abs()
        if self.damping:
            offset = y - self.origin
            drag = self.damping * self.mass(offset)
            loss = 0.5 * (offset * drag).sum(dim=(1, 2))
            value, scale, gradient = value + loss, scale + loss, gradient + drag
        return value, gradient, scale

    def hessian(self, tangent: tuple[Tensor, Tensor, Tensor], x: Tensor) -> Tensor:
        """H x on all components, for a tangent of the cells."""
        out = self.cells.apply(tangent, x)
        return out + (self.inertia + self.damping) * self.mass(x) if self.inertia else out


def largest_displacement(x: Tensor) -> Tensor:
    """Largest node norm of each scene, (B,), for (B, U, 3)."""
    return torch.sqrt((x * x).sum(dim=-1).amax(dim=1))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products (B,) of (B, U, 3)."""
    return (a * b).sum(dim=(1, 2))


def by_scene(values: Any) -> Any:
    """(B,) as factors of (B, U, 3)."""
    return values[:, None, None]
