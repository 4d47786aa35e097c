"""The right stretch tensor S = (F^T F)^1/2 at the quadrature points, and viscous forces.

Kelvin-Voigt viscosity: with the small-strain law C : A = 2 mu A + (omega/3) tr(A) I of every
energy here, a viscosity tau (s) has the dissipation potential

    D = tau/2 sum_q dS/dt : C : dS/dt.

S does not change in any rigid motion, however fast, so nothing resists one.  As a function of
the configuration in F = U diag(s) V^T, with Z the solution of S Z + Z S = A (in the frame of V
a division of A_ij by s_i + s_j),

    A : dS      = 2 F Z : dF,
    S dS + dS S = dF^T F + F^T dF,
    dZ          from  S dZ + dZ S = dA - Z dS - dS Z

(derivatives of the equation S S = F^T F).  Where s_i + s_j = 0, which is the kink of
`energies`, that entry of Z and dS is set to zero.  Tensors are nine rows of Q points, row-major.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdcorrect.fem.cell_loops import CellLoop
from pdcorrect.fem.decomposition import OPTIONS, signed_svd_lanes
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.kernels import (
    deformation,
    nodal_forces,
    transform,
)

Array = NDArray[np.float64]

KINK = 1e-9
"""Of the largest stretch: s_i + s_j up to which an entry counts as one of a kink."""


def small_strain_stress(body: ElasticBody, A: Array) -> Array:
    """C : A times the points' volumes, J, for symmetric A (C, 9, Q)."""
    weights = body.point_weights
    out = 2.0 * weights[:, :1] * A
    out[:, ::4] += (weights[:, 1] / 3.0 * A[:, ::4].sum(axis=1))[:, None]
    return out


def stress_slopes(body: ElasticBody, A: Array, B: Array) -> tuple[Array, Array]:
    """Derivatives of A : C : B, summed over points, by each cell's mu and omega, m3, (C,)."""
    quadrature = body.quadrature
    traces = A[:, ::4].sum(axis=1) * B[:, ::4].sum(axis=1)
    by_mu = 2.0 * quadrature.weights * product(A, B)
    by_omega = quadrature.volume_weights * traces / 3.0
    return by_mu.sum(axis=1), by_omega.sum(axis=1)


def product(A: Array, B: Array) -> Array:
    """A : B at each point, (C, Q), for tensors (C, 9, Q)."""
    return np.asarray((A * B).sum(axis=1))


class Stretches:
    """S, ``tensor`` (C, 9, Q), at a configuration (N + B, 3), and its derivative there."""

    def __init__(self, body: ElasticBody, configuration: Array) -> None:
        self.body = body
        u = configuration - body.extended(body.positions)
        count, lanes = body.quadrature.weights.shape
        self._left, self._right = np.empty((count, 9, lanes)), np.empty((count, 9, lanes))
        self._values, self.tensor = np.empty((count, 3, lanes)), np.empty((count, 9, lanes))
        _decompose(
            count, u, body.space.local, body.quadrature.lanes,
            self._left, self._right, self._values, self.tensor,
        )  # fmt: skip

    def rates(self, x: Array) -> Array:
        """DS (C, 9, Q) for a change x (N + B, 3) of the configuration."""
        out = np.empty_like(self.tensor)
        cells, gradients = self.body.space.local, self.body.quadrature.lanes
        _rates(len(out), x, cells, gradients, *self._frames, out)
        return out

    def forces(self, A: Array) -> Array:
        """Derivatives (N + B, 3) of A : S by the configuration, for A (C, 9, Q)."""
        by_cell = np.empty((*self.body.space.local.shape, 3))
        _pull(len(A), self.body.quadrature.lanes, *self._frames, A, by_cell)
        return self.body.assembly.gathered(by_cell)

    def apply(self, A: Array, rate: float, x: Array, project: bool = False) -> Array:
        """Change (N + B, 3) of `forces` of A = rate C : (S - S'), by x (N + B, 3).

        ``project`` keeps C : dS only, which makes this positive semi-definite.
        """
        body = self.body
        by_cell = np.empty((*body.space.local.shape, 3))
        _apply(
            len(A), x, body.space.local, body.quadrature.lanes, *self._frames, body.point_weights,
            A, rate, project, by_cell,
        )  # fmt: skip
        return self.body.assembly.gathered(by_cell)

    def blocks(self, A: Array, rate: float, project: bool = False) -> Array:
        """The same as matrices of the cells, (C, L, L, 3, 3)."""
        body = self.body
        count, width = body.space.local.shape
        out = np.empty((count, width, width, 3, 3))
        _blocks(
            count, body.quadrature.lanes, *self._frames, body.point_weights, A, rate, project, out
        )
        return out

    @property
    def _frames(self) -> tuple[Array, Array, Array]:
        return self._left, self._right, self._values


@CellLoop
def _decompose(  # type: ignore[no-untyped-def]
    begin, end, u, cells, gradients, left, right, values, tensor
):
    lanes = gradients.shape[3]
    F, B, W = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((6, lanes))
    diagonal = np.zeros((9, lanes))
    for c in range(begin, end):
        deformation(u, cells[c], gradients[c], 1.0, F)
        signed_svd_lanes(F, left[c], values[c], right[c], B, W)
        for i in range(3):
            for q in range(lanes):
                diagonal[4 * i, q] = values[c, i, q]
        transform(right[c], diagonal, right[c], tensor[c], False)


@njit(**OPTIONS)
def _inverse(s, i, j, q):  # type: ignore[no-untyped-def]
    """1 / (s_i + s_j)."""
    both = s[i, q] + s[j, q]
    return 1.0 / both if abs(both) > KINK * s[0, q] else 0.0


@njit(**OPTIONS)
def _divided(s, A, out):  # type: ignore[no-untyped-def]
    """out_ij = A_ij / (s_i + s_j)."""
    for i in range(3):
        for j in range(3):
            for q in range(s.shape[1]):
                out[3 * i + j, q] = A[3 * i + j, q] * _inverse(s, i, j, q)


@njit(**OPTIONS)
def _stretching(s, B, out):  # type: ignore[no-untyped-def]
    """Out = dS in the frame of V for B = U^T dF V."""
    for i in range(3):
        for j in range(3):
            for q in range(s.shape[1]):
                both = s[i, q] * B[3 * i + j, q] + s[j, q] * B[3 * j + i, q]
                out[3 * i + j, q] = B[4 * i, q] if i == j else both * _inverse(s, i, j, q)


@njit(**OPTIONS)
def _change(s, Z, B, weights, rate, project, dS, dA, P):  # type: ignore[no-untyped-def]
    """P, the change of 2 F Z for B = U^T dF V, in the frames of U and V; dS and dA are scratch."""
    _stretching(s, B, dS)
    for i in range(3):
        for j in range(3):
            for q in range(s.shape[1]):
                change = 2.0 * rate * weights[0, q] * dS[3 * i + j, q]
                if i == j:
                    trace = dS[0, q] + dS[4, q] + dS[8, q]
                    change += rate * weights[1, q] / 3.0 * trace
                if not project:
                    for k in range(3):
                        change -= Z[3 * i + k, q] * dS[3 * k + j, q]
                        change -= dS[3 * i + k, q] * Z[3 * k + j, q]
                dA[3 * i + j, q] = change
    _divided(s, dA, P)
    for i in range(3):
        for j in range(3):
            for q in range(s.shape[1]):
                P[3 * i + j, q] *= 2.0 * s[i, q]
                if not project:
                    for k in range(3):
                        P[3 * i + j, q] += 2.0 * B[3 * i + k, q] * Z[3 * k + j, q]


@CellLoop
def _rates(begin, end, x, cells, gradients, left, right, values, out):  # type: ignore[no-untyped-def]
    lanes = gradients.shape[3]
    D, B, dS = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
    for c in range(begin, end):
        deformation(x, cells[c], gradients[c], 0.0, D)
        transform(left[c], D, right[c], B, True)
        _stretching(values[c], B, dS)
        transform(right[c], dS, right[c], out[c], False)


@CellLoop
def _pull(begin, end, gradients, left, right, values, A, by_cell):  # type: ignore[no-untyped-def]
    lanes = gradients.shape[3]
    T, Z = np.empty((9, lanes)), np.empty((9, lanes))
    for c in range(begin, end):
        transform(right[c], A[c], right[c], T, True)
        _divided(values[c], T, Z)
        for i in range(9):
            for q in range(lanes):
                Z[i, q] *= 2.0 * values[c, i // 3, q]
        transform(left[c], Z, right[c], T, False)
        nodal_forces(T, gradients[c], 1.0, by_cell[c])


@CellLoop
def _apply(  # type: ignore[no-untyped-def]
    begin, end, x, cells, gradients, left, right, values, weights, A, rate, project, by_cell
):
    lanes = gradients.shape[3]
    D, B, Z = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
    P, dS, dA = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
    for c in range(begin, end):
        transform(right[c], A[c], right[c], D, True)
        _divided(values[c], D, Z)
        deformation(x, cells[c], gradients[c], 0.0, D)
        transform(left[c], D, right[c], B, True)
        _change(values[c], Z, B, weights[c], rate, project, dS, dA, P)
        transform(left[c], P, right[c], D, False)
        nodal_forces(D, gradients[c], 1.0, by_cell[c])


@njit(inline="always", **OPTIONS)
def _unit_change(gradient, i, U, V, out):  # type: ignore[no-untyped-def]
    """Out (9, Q) = U^T (e_i x grad N) V: the change of F by a shape function's component i."""
    for a in range(3):
        for b in range(3):
            for q in range(out.shape[1]):
                along = (
                    V[b, q] * gradient[0, q]
                    + V[3 + b, q] * gradient[1, q]
                    + V[6 + b, q] * gradient[2, q]
                )
                out[3 * a + b, q] = U[3 * i + a, q] * along


@CellLoop
def _blocks(  # type: ignore[no-untyped-def]
    begin, end, gradients, left, right, values, weights, A, rate, project, out
):
    width, lanes = gradients.shape[1], gradients.shape[3]
    D, B, Z = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
    P, dS, dA = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
    column = np.empty((width, 3))
    for c in range(begin, end):
        transform(right[c], A[c], right[c], D, True)
        _divided(values[c], D, Z)
        for k in range(width):
            for i in range(3):
                _unit_change(gradients[c, k], i, left[c], right[c], B)
                _change(values[c], Z, B, weights[c], rate, project, dS, dA, P)
                transform(left[c], P, right[c], D, False)
                nodal_forces(D, gradients[c], 1.0, column)
                for l in range(width):
                    for j in range(3):
                        out[c, l, k, j, i] = column[l, j]
