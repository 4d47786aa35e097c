"""Muscle fibres: elastic energy of their stretch, with a rest length that changes in time.

    W = sum_p w_p/2 (l_p - r_p)^2 V_p,    l = |F m|,

over the quadrature points p of an actuator's cells (Du et al. 2021, DiffPD, section 3.2).  F is
that of the nodes alone, without a cell's internal modes, so F m = m + A u is linear in the
displacements u and A one sparse matrix for all fibres.  The term is the distance from a set,
fibres of length r, as projective dynamics wants it: A^T w V A belongs to the global matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.fem.assembly import sparse_times
from pdcorrect.fem.clamps import Selector
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.scene import Actuator
from pdcorrect.scene.regions import unit_vector

Array = NDArray[np.float64]

_SHORTEST = 1e-12
"""Stretch below which a fibre has no direction."""


@dataclass(frozen=True, eq=False)
class Fibres:
    """The fibres of all actuators of a scene.

    Attributes
    ----------
    tables : tuple of (rows, 2)
        Of the actuators: times (s) and stretches.
    owners : (P,)
        Actuator of each point.
    rest : (P, 3)
        M.
    weights : (P,)
        W V, J.
    stretching : (P, N) sparse
        A, 1/m.
    cells, gradients
        Cells (c,) and A in each, (c, Q, K), for the points in order.
    """

    tables: tuple[Array, ...]
    owners: NDArray[np.int64]
    rest: Array
    weights: Array
    stretching: sp.csr_matrix
    cells: NDArray[np.int64]
    gradients: Array
    at_end: ClassVar[bool] = False

    @classmethod
    def of(cls, actuators: tuple[Actuator, ...], body: ElasticBody, selector: Selector) -> Fibres:
        """Those of a scene's actuators; `SceneError` where a region has no cell."""
        width, volumes = body.cells.shape[1], body.quadrature.weights
        points = np.flatnonzero(volumes.any(axis=0))  # others carry the volume term only
        cells, gradients, rest, owners, weights = [], [], [], [], []
        for i, actuator in enumerate(actuators):
            found = selector.cells(actuator.region, f"actuators[{i}].region")
            m = unit_vector(actuator.direction)
            lanes = body.quadrature.lanes[found, :width][..., points]
            cells.append(found)
            gradients.append(np.einsum("i,ckiq->cqk", m, lanes))
            rest.append(np.tile(m, (len(found) * len(points), 1)))
            owners.append(np.full(len(found) * len(points), i))
            weights.append(actuator.stiffness * volumes[np.ix_(found, points)].ravel())
        owner_cells, gradient = np.concatenate(cells), np.concatenate(gradients)
        nodes = np.repeat(body.cells[owner_cells], len(points), axis=0)
        starts = np.arange(0, nodes.size + 1, width)
        stretching = sp.csr_matrix(
            (gradient.ravel(), nodes.ravel(), starts), shape=(len(nodes), len(body.positions))
        )
        return cls(
            tuple(np.array(a.activation) for a in actuators), np.concatenate(owners),
            np.concatenate(rest), np.concatenate(weights), stretching, owner_cells, gradient,
        )  # fmt: skip

    @cached_property
    def _transposed(self) -> sp.csr_matrix:
        return self.stretching.T.tocsr()

    def activations(self, time: float) -> Array:
        """R of each actuator at a time (s)."""
        return np.array([np.interp(time, table[:, 0], table[:, 1]) for table in self.tables])

    def shares(self, time: float) -> tuple[Array, ...]:
        """Derivatives of each actuator's r at a time (s) by the stretches of its table, (rows,)."""
        return tuple(
            np.array([np.interp(time, table[:, 0], unit) for unit in np.eye(len(table))])
            for table in self.tables
        )

    def stretched(self, u: Array) -> tuple[Array, Array]:
        """Length l (P,) and direction (P, 3) of fibres for displacements u (N, 3), m."""
        fibres = self.rest + sparse_times(self.stretching, u)
        length = np.linalg.norm(fibres, axis=1)
        return length, fibres / np.maximum(length, _SHORTEST)[:, None]

    def tensions(self, u: Array, time: float) -> Array:
        """W V (l - r), (P,), J: derivatives of the energy by l."""
        excess = self.stretched(u)[0] - self.activations(time)[self.owners]
        return np.asarray(self.weights * excess)

    def energy_and_forces(self, u: Array, time: float) -> tuple[float, Array]:
        """J, and of the fibres on the nodes, (N, 3), N."""
        length, along = self.stretched(u)
        excess = length - self.activations(time)[self.owners]
        tensions = self.weights * excess
        return 0.5 * float(excess @ tensions), -sparse_times(
            self._transposed, tensions[:, None] * along
        )

    def matrices(self, u: Array, time: float, project: bool = False) -> Array:
        """Second derivatives of the energy by F m, (P, 3, 3), J.

        ``project`` raises those across fibres shorter than r, which are negative, to zero.
        """
        length, along = self.stretched(u)
        across = 1.0 - self.activations(time)[self.owners] / np.maximum(length, _SHORTEST)
        if project:
            across = np.maximum(across, 0.0)
        outer = along[:, :, None] * along[:, None, :]
        out = across[:, None, None] * (np.eye(3) - outer) + outer
        return np.asarray(self.weights[:, None, None] * out)

    def laplacian(self) -> sp.csr_matrix:
        """A^T w V A, (N, N), N/m: their share of the global matrix, for each coordinate."""
        return sp.csr_matrix(self.stretching.T @ sp.diags(self.weights) @ self.stretching)

    def pulls(self, u: Array, z: Array) -> Array:
        """Derivatives of z . forces by each actuator's r, for z (N, 3); (actuators,)."""
        _, along = self.stretched(u)
        work = self.weights * np.einsum("pi,pi->p", along, self.stretching @ z)
        return np.bincount(self.owners, work, minlength=len(self.tables)).astype(np.float64)

    def tangent(
        self, u: Array, time: float, project: bool = False, factor: float = 1.0
    ) -> FibreTangent:
        """The second derivative times a factor; ``project`` leaves out what is negative."""
        return FibreTangent(self, factor * self.matrices(u, time, project))

    def rest_tangent(self) -> FibreTangent:
        """That of the body at rest if fibres were at rest too, whatever the time."""
        outer = self.rest[:, :, None] * self.rest[:, None, :]
        return FibreTangent(self, self.weights[:, None, None] * outer)

    def work(self, before: tuple[Array, float], after: tuple[Array, float]) -> float:
        """Of the change of activation between two displacements and times, J."""
        start, end = self.tensions(*before), self.tensions(*after)
        change = (self.activations(after[1]) - self.activations(before[1]))[self.owners]
        return -0.5 * float(change @ (start + end))

    def blocks(self, matrices: Array) -> Array:
        """A^T H A by cell, (c, K, K, 3, 3), N/m, for H (P, 3, 3), J, in the order of ``cells``."""
        A = self.gradients
        cells, points, nodes = A.shape
        H = matrices.reshape(cells, points, 1, 3, 3)
        weighted = (A[..., None, None] * H).reshape(cells, points, -1)
        return np.asarray(np.swapaxes(A, 1, 2) @ weighted).reshape(cells, nodes, nodes, 3, 3)


@dataclass(frozen=True, eq=False)
class FibreTangent:
    """Second derivatives of the fibres' energy by their stretched vectors, (P, 3, 3), J."""

    fibres: Fibres
    matrices: Array

    def apply(self, x: Array) -> Array:
        """Times x (N + B, 3)."""
        out, changes = np.zeros_like(x), sparse_times(self.fibres.stretching, x)
        tensions = np.einsum("pij,pj->pi", self.matrices, changes)
        forces = sparse_times(self.fibres._transposed, tensions)
        out[: len(forces)] = forces
        return out

    def add_to(self, blocks: Array) -> None:
        """Add to the cells' matrices (C, L, L, 3, 3)."""
        found = self.fibres.blocks(self.matrices)
        width = found.shape[1]
        np.add.at(blocks[:, :width, :width], self.fibres.cells, found)
