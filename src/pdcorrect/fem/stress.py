"""Stress at the quadrature points and its averages at the nodes.

Where volume and shear share their points, P = dPsi/dF at each point.  In elements whose volume
term has points p of its own (hex8-mean, hex8-bubble-mean: one; hex8-enhanced: nine) the energy
of a cell is

    W = sum_q w_q Psi_s(F_q) + sum_p v_p Psi_v(F_p),    F_p = sum_q (w_q a_qp / v_p) F_q,

so that dW/dF_q = w_q (P_s(F_q) + sum_p a_qp P_v(F_p)): the volume term's first Piola-Kirchhoff
stress is constant or linear in the cell and is added at each point, and the nodal forces are
-sum_q w_q P_q grad N.  Its Cauchy stress is that of those points,
sum_p a_qp P_v(F_p) F_p^T / det F_p, so both parts are symmetric.  P F^T / det F of the
sum would not be.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.energies import first_piola
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stress:
    """Stress at the quadrature points of all cells.

    Attributes
    ----------
    deformation : (C, Q, 3, 3)
        Deformation gradients F at the points that carry the corotated term.
    first_piola : (C, Q, 3, 3)
        P, force by area at rest, Pa; conjugate to F in the energy.
    cauchy : (C, Q, 3, 3)
        sigma, force by present area, Pa; symmetric.  Not finite where det F = 0.
    weights : (C, Q)
        Rest volume of each point, m3.
    cells : (C, K) int
        Node numbers.
    """

    deformation: Array
    first_piola: Array
    cauchy: Array
    weights: Array
    cells: NDArray[np.int64]

    @cached_property
    def von_mises(self) -> Array:
        """Von Mises stress at the points, (C, Q), Pa."""
        return von_mises(self.cauchy)

    @cached_property
    def nodal_cauchy(self) -> Array:
        """Cauchy stress averaged to the nodes, (N, 3, 3), Pa, see `at_nodes`."""
        return self.at_nodes(self.cauchy)

    def at_nodes(self, values: Array) -> Array:
        """Values (C, Q, ...) of the points averaged to the nodes, (N, ...).

        A node takes the mean over all points of the cells that touch it, weighted by
        their rest volume.  Inside a body of equal cells this is second order in the
        cell size; on its surface it is first order, since all points lie on one side.
        """
        values = np.asarray(values, dtype=np.float64)
        if values.shape[:2] != self.weights.shape:
            raise InputError(
                f"values {values.shape}: expected {self.weights.shape} and further axes, one "
                "value a quadrature point."
            )
        sums = np.einsum("cq,cq...->c...", self.weights, values).reshape(len(values), -1)
        touching = _touching(self.cells)
        volume = touching @ self.weights.sum(axis=1)
        return ((touching @ sums) / volume[:, None]).reshape(-1, *values.shape[2:])


def stress(problem: Problem, positions: Array) -> Stress:
    """Stress of a body with its nodes at positions (N, 3), m, internal modes in equilibrium.

    Raises
    ------
    InputError
        If the positions have a wrong shape or are not finite.
    """
    quadrature, energy = problem.quadrature, problem.scene.material.energy
    mu, omega = problem.materials.mu[:, None], problem.materials.volume_weight[:, None]
    moved = problem.relaxed(positions) - problem.extended(problem.positions)
    F = _deformation(moved[problem.space.local], quadrature.lanes)
    points, shares = quadrature.first_volume, problem.space.volume_shares()
    if shares is not None:
        F, own = F[:, :points], F[:, points:]
        shear, volume = first_piola(F, mu, 0.0, energy), first_piola(own, 0.0, omega, energy)
        P = shear + np.einsum("cqp,cpij->cqij", shares, volume)
        sigma = _cauchy(shear, F) + np.einsum("cqp,cpij->cqij", shares, _cauchy(volume, own))
    else:
        P = first_piola(F, mu, omega, energy)
        sigma = _cauchy(P, F)
    return Stress(F, P, sigma, quadrature.weights[:, : F.shape[1]], problem.cells)


def von_mises(cauchy: Array) -> Array:
    """Von Mises stress sqrt(3/2 dev : dev), (...), of stresses (..., 3, 3), both Pa."""
    pressure = np.trace(cauchy, axis1=-2, axis2=-1) / 3.0
    deviator = cauchy - pressure[..., None, None] * np.eye(3)
    return np.sqrt(1.5 * (deviator**2).sum(axis=(-2, -1)))


def _deformation(moved: Array, lanes: Array) -> Array:
    """F (C, Q, 3, 3) for displacements (C, L, 3), m, and gradients (C, L, 3, Q), 1/m."""
    count, width, _, points = lanes.shape
    gradient = moved.transpose(0, 2, 1) @ lanes.reshape(count, width, 3 * points)
    return np.eye(3) + gradient.reshape(count, 3, 3, points).transpose(0, 3, 1, 2)


def _cauchy(P: Array, F: Array) -> Array:
    """P F^T / det F."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return P @ np.swapaxes(F, -1, -2) / np.linalg.det(F)[..., None, None]


def _touching(cells: NDArray[np.int64]) -> sp.csr_matrix:
    """Which cells touch a node, (N, C), ones and zeros."""
    count, width = cells.shape
    columns = np.repeat(np.arange(count), width)
    return sp.csr_matrix((np.ones(cells.size), (cells.ravel(), columns)))
