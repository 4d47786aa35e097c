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
`energies`, that entry of Z and dS is set to zero.  Symmetric tensors are six numbers,
00 11 22 01 02 12.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdcorrect.fem.decomposition import OPTIONS, signed_svd_lanes
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.kernels import CHUNK, PARALLEL, deformation, gather_nodes, nodal_forces

Array = NDArray[np.float64]

KINK = 1e-9
"""Of the largest stretch: s_i + s_j up to which an entry counts as one of a kink."""


def small_strain_stress(body: ElasticBody, A: Array) -> Array:
    """C : A times the points' volumes, J, for symmetric A (C, 6, Q)."""
    weights = body.point_weights
    out = 2.0 * weights[:, :1] * A
    out[:, :3] += (weights[:, 1] / 3.0 * A[:, :3].sum(axis=1))[:, None]
    return out


def stress_slopes(body: ElasticBody, A: Array, B: Array) -> tuple[Array, Array]:
    """Derivatives of A : C : B, summed over points, by each cell's mu and omega, m3, (C,)."""
    quadrature = body.quadrature
    traces = A[:, :3].sum(axis=1) * B[:, :3].sum(axis=1)
    by_mu = 2.0 * quadrature.weights * product(A, B)
    by_omega = quadrature.volume_weights * traces / 3.0
    return by_mu.sum(axis=1), by_omega.sum(axis=1)


def product(A: Array, B: Array) -> Array:
    """A : B at each point, (C, Q), for symmetric tensors (C, 6, Q)."""
    both = A * B
    return np.asarray(both[:, :3].sum(axis=1) + 2.0 * both[:, 3:].sum(axis=1))


class Stretches:
    """S at a configuration (N + B, 3), and its derivative there.

    Attributes
    ----------
    body : ElasticBody
    tensor : (C, 6, Q)
        S.
    """

    def __init__(self, body: ElasticBody, configuration: Array) -> None:
        self.body = body
        u = configuration - body.extended(body.positions)
        count, lanes = body.quadrature.weights.shape
        self._left, self._right = np.empty((count, 9, lanes)), np.empty((count, 9, lanes))
        self._values, self.tensor = np.empty((count, 3, lanes)), np.empty((count, 6, lanes))
        _decompose(
            u, body.space.local, body.quadrature.lanes,
            self._left, self._right, self._values, self.tensor,
        )  # fmt: skip

    def rates(self, x: Array) -> Array:
        """DS (C, 6, Q) for a change x (N + B, 3) of the configuration."""
        out = np.empty_like(self.tensor)
        cells, gradients = self.body.space.local, self.body.quadrature.lanes
        _rates(x, cells, gradients, *self._frames, out)
        return out

    def forces(self, A: Array) -> Array:
        """Derivatives (N + B, 3) of A : S by the configuration, for A (C, 6, Q)."""
        by_cell = np.empty((*self.body.space.local.shape, 3))
        _pull(self.body.quadrature.lanes, *self._frames, A, by_cell)
        return self._gathered(by_cell)

    def apply(self, A: Array, rate: float, x: Array, project: bool = False) -> Array:
        """Change (N + B, 3) of `forces` of A = rate C : (S - S'), by x (N + B, 3).

        ``project`` keeps C : dS only, which makes this positive semi-definite.
        """
        body = self.body
        by_cell = np.empty((*body.space.local.shape, 3))
        _apply(
            x, body.space.local, body.quadrature.lanes, *self._frames, body.point_weights, A,
            rate, project, by_cell,
        )  # fmt: skip
        return self._gathered(by_cell)

    def blocks(self, A: Array, rate: float, project: bool = False) -> Array:
        """The same as matrices of the cells, (C, L, L, 3, 3)."""
        body = self.body
        count, width = body.space.local.shape
        out = np.empty((count, width, width, 3, 3))
        _blocks(body.quadrature.lanes, *self._frames, body.point_weights, A, rate, project, out)
        return out

    @property
    def _frames(self) -> tuple[Array, Array, Array]:
        return self._left, self._right, self._values

    def _gathered(self, by_cell: Array) -> Array:
        assembly, out = self.body.assembly, np.empty((self.body.unknowns, 3))
        gather_nodes(assembly.start, assembly.slots, by_cell.reshape(-1, 3), out)
        return out


_ROWS = np.array([0, 1, 2, 0, 0, 1])
_COLUMNS = np.array([0, 1, 2, 1, 2, 2])


@njit(**PARALLEL)
def _decompose(u, cells, gradients, left, right, values, tensor):  # type: ignore[no-untyped-def]
    count, lanes = cells.shape[0], gradients.shape[3]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        F, B, W = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((6, lanes))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            deformation(u, cells[c], gradients[c], 1.0, F)
            signed_svd_lanes(F, left[c], values[c], right[c], B, W)
            V, s = right[c], values[c]
            for n in range(6):
                i, j = _ROWS[n], _COLUMNS[n]
                for q in range(lanes):
                    total = 0.0
                    for a in range(3):
                        total += V[3 * i + a, q] * s[a, q] * V[3 * j + a, q]
                    tensor[c, n, q] = total


@njit(**OPTIONS)
def _inverse(sum_of_two, s, q):  # type: ignore[no-untyped-def]
    return 1.0 / sum_of_two if abs(sum_of_two) > KINK * s[0, q] else 0.0


@njit(**OPTIONS)
def _in_frame(V, A, q, out):  # type: ignore[no-untyped-def]
    """Out (3, 3) = V^T A V for a symmetric A (6, Q) at point q."""
    full = np.empty((3, 3))
    for n in range(6):
        full[_ROWS[n], _COLUMNS[n]] = full[_COLUMNS[n], _ROWS[n]] = A[n, q]
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += V[3 * a + i, q] * full[a, b] * V[3 * b + j, q]
            out[i, j] = total


@njit(**OPTIONS)
def _divided(s, q, A, out):  # type: ignore[no-untyped-def]
    """out_ij = A_ij / (s_i + s_j)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, j] * _inverse(s[i, q] + s[j, q], s, q)


@njit(**OPTIONS)
def _stretching(s, q, B, out):  # type: ignore[no-untyped-def]
    """Out = dS in the frame of V for B = U^T dF V, all (3, 3)."""
    for i in range(3):
        for j in range(3):
            inverse = _inverse(s[i, q] + s[j, q], s, q)
            out[i, j] = (s[i, q] * B[i, j] + s[j, q] * B[j, i]) * inverse
        out[i, i] = B[i, i]


@njit(**OPTIONS)
def _gradient(U, V, D, q, out):  # type: ignore[no-untyped-def]
    """Out (3, 3) = U^T D V for a change D (9, Q) of F."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += U[3 * a + i, q] * D[3 * a + b, q] * V[3 * b + j, q]
            out[i, j] = total


@njit(**OPTIONS)
def _stress(U, V, P, q, out):  # type: ignore[no-untyped-def]
    """Column q of out (9, Q) = U P V^T."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += U[3 * i + a, q] * P[a, b] * V[3 * j + b, q]
            out[3 * i + j, q] = total


@njit(**OPTIONS)
def _change(s, q, Z, B, shear, volume, project, P, dS, dA):  # type: ignore[no-untyped-def]
    """P (3, 3), the change of 2 F Z for B = U^T dF V; dS and dA (3, 3) are scratch."""
    _stretching(s, q, B, dS)
    trace = dS[0, 0] + dS[1, 1] + dS[2, 2]
    for i in range(3):
        for j in range(3):
            dA[i, j] = 2.0 * shear * dS[i, j]
            if not project:
                for k in range(3):
                    dA[i, j] -= Z[i, k] * dS[k, j] + dS[i, k] * Z[k, j]
        dA[i, i] += volume / 3.0 * trace
    _divided(s, q, dA, P)
    for i in range(3):
        for j in range(3):
            P[i, j] *= 2.0 * s[i, q]
            if not project:
                for k in range(3):
                    P[i, j] += 2.0 * B[i, k] * Z[k, j]


@njit(**PARALLEL)
def _rates(x, cells, gradients, left, right, values, out):  # type: ignore[no-untyped-def]
    count, lanes = cells.shape[0], gradients.shape[3]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        D, B, dS = np.empty((9, lanes)), np.empty((3, 3)), np.empty((3, 3))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            deformation(x, cells[c], gradients[c], 0.0, D)
            V = right[c]
            for q in range(lanes):
                _gradient(left[c], V, D, q, B)
                _stretching(values[c], q, B, dS)
                for n in range(6):
                    total = 0.0
                    for a in range(3):
                        for b in range(3):
                            total += V[3 * _ROWS[n] + a, q] * dS[a, b] * V[3 * _COLUMNS[n] + b, q]
                    out[c, n, q] = total


@njit(**PARALLEL)
def _pull(gradients, left, right, values, A, by_cell):  # type: ignore[no-untyped-def]
    count, lanes = gradients.shape[0], gradients.shape[3]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        P, T, Z = np.empty((9, lanes)), np.empty((3, 3)), np.empty((3, 3))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            for q in range(lanes):
                _in_frame(right[c], A[c], q, T)
                _divided(values[c], q, T, Z)
                for i in range(3):
                    for j in range(3):
                        T[i, j] = 2.0 * values[c, i, q] * Z[i, j]
                _stress(left[c], right[c], T, q, P)
            nodal_forces(P, gradients[c], 1.0, by_cell[c])


@njit(**PARALLEL)
def _apply(x, cells, gradients, left, right, values, weights, A, rate, project, by_cell):  # type: ignore[no-untyped-def]
    count, lanes = cells.shape[0], gradients.shape[3]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        D, P = np.empty((9, lanes)), np.empty((9, lanes))
        B, Z, T = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        dS, dA = np.empty((3, 3)), np.empty((3, 3))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            deformation(x, cells[c], gradients[c], 0.0, D)
            for q in range(lanes):
                _in_frame(right[c], A[c], q, T)
                _divided(values[c], q, T, Z)
                _gradient(left[c], right[c], D, q, B)
                shear, volume = rate * weights[c, 0, q], rate * weights[c, 1, q]
                _change(values[c], q, Z, B, shear, volume, project, T, dS, dA)
                _stress(left[c], right[c], T, q, P)
            nodal_forces(P, gradients[c], 1.0, by_cell[c])


@njit(**PARALLEL)
def _blocks(gradients, left, right, values, weights, A, rate, project, out):  # type: ignore[no-untyped-def]
    count, width, lanes = gradients.shape[0], gradients.shape[1], gradients.shape[3]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        P, Z = np.empty((9, lanes)), np.empty((lanes, 3, 3))
        B, T = np.empty((3, 3)), np.empty((3, 3))
        dS, dA, column = np.empty((3, 3)), np.empty((3, 3)), np.empty((width, 3))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            U, V = left[c], right[c]
            for q in range(lanes):
                _in_frame(V, A[c], q, T)
                _divided(values[c], q, T, Z[q])
            for k in range(width):
                for i in range(3):
                    for q in range(lanes):
                        for a in range(3):
                            for b in range(3):
                                along = 0.0
                                for j in range(3):
                                    along += V[3 * j + b, q] * gradients[c, k, j, q]
                                B[a, b] = U[3 * i + a, q] * along  # U^T (e_i x grad N_k) V
                        shear, volume = rate * weights[c, 0, q], rate * weights[c, 1, q]
                        _change(values[c], q, Z[q], B, shear, volume, project, T, dS, dA)
                        _stress(U, V, T, q, P)
                    nodal_forces(P, gradients[c], 1.0, column)
                    for l in range(width):
                        for j in range(3):
                            out[c, l, k, j, i] = column[l, j]
