"""Loops over cells with a linearised energy: products, stiffness, and its assembly."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from pdcorrect.fem.blocks import CHUNK, PARALLEL, REDUCE, deformation, gather_nodes, nodal_forces
from pdcorrect.fem.decomposition import OPTIONS


@njit(**PARALLEL)
def apply_linearised(  # type: ignore[no-untyped-def]
    x, cells, gradients, left, right, tangent, by_cell, start, slots, out
):
    """Tangent times x (N, 3), out (N, 3); other arguments as `energy_and_forces`."""
    count, lanes = cells.shape[0], tangent.shape[2]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        D, A = np.empty((9, lanes)), np.empty((9, lanes))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            deformation(x, cells[c], gradients[c], 0.0, D)
            _transform(left[c], D, right[c], A, True)
            _tangent_product(tangent[c], A)
            _transform(left[c], A, right[c], D, False)
            nodal_forces(D, gradients[c], 1.0, by_cell[c])
    gather_nodes(start, slots, by_cell.reshape(-1, 3), out)


@njit(**OPTIONS)
def _transform(U, A, V, out, forward):  # type: ignore[no-untyped-def]
    """Out = U^T A V (forward) or U A V^T, all (9, Q)."""
    for i in range(3):
        for j in range(3):
            for q in range(A.shape[1]):
                total = 0.0
                for a in range(3):
                    left = U[3 * a + i, q] if forward else U[3 * i + a, q]
                    for b in range(3):
                        right = V[3 * b + j, q] if forward else V[3 * j + b, q]
                        total += left * A[3 * a + b, q] * right
                out[3 * i + j, q] = total


@njit(**OPTIONS)
def _tangent_product(T, A):  # type: ignore[no-untyped-def]
    """A <- tangent : A in the frame of the SVD, in place."""
    for q in range(A.shape[1]):
        x, y, z = A[0, q], A[4, q], A[8, q]
        A[0, q] = T[0, q] * x + T[3, q] * y + T[4, q] * z
        A[4, q] = T[3, q] * x + T[1, q] * y + T[5, q] * z
        A[8, q] = T[4, q] * x + T[5, q] * y + T[2, q] * z
        for pair in range(3):
            i, j = pair // 2, 1 + (pair + 1) // 2
            x, y = A[3 * i + j, q], A[3 * j + i, q]
            A[3 * i + j, q] = T[6 + pair, q] * x + T[9 + pair, q] * y
            A[3 * j + i, q] = T[6 + pair, q] * y + T[9 + pair, q] * x


@njit(**PARALLEL)
def cell_stiffness(cells, gradients, left, right, tangent, out):  # type: ignore[no-untyped-def]
    """Tangent stiffness of each cell as node blocks, out (C, L, L, 3, 3), N/m."""
    count, width, lanes = cells.shape[0], cells.shape[1], tangent.shape[2]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        A, P = np.empty((9, lanes)), np.empty((9, lanes))
        K = np.empty((width, 3, width, 3))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            stiffness(gradients[c], left[c], right[c], tangent[c], A, P, K)
            for k in range(width):
                for l in range(width):
                    for i in range(3):
                        for j in range(3):
                            high = K[k, i, l, j] if k >= l else K[l, j, k, i]
                            out[c, k, l, i, j] = high


@njit(**REDUCE)
def stiffness(gradients, U, V, T, A, P, out):  # type: ignore[no-untyped-def]
    """Lower triangle of one cell's tangent stiffness, out (L, 3, L, 3), N/m.

    The stress P that a unit amplitude of function k in direction i causes does work
    on all other functions.  A (9, Q) and P (9, Q) are scratch.
    """
    lanes = T.shape[1]
    for k in range(gradients.shape[0]):
        for i in range(3):
            for a in range(3):
                for b in range(3):
                    for q in range(lanes):
                        along = (
                            V[b, q] * gradients[k, 0, q]
                            + V[3 + b, q] * gradients[k, 1, q]
                            + V[6 + b, q] * gradients[k, 2, q]
                        )
                        A[3 * a + b, q] = U[3 * i + a, q] * along  # U^T (e_i x grad N_k) V
            _tangent_product(T, A)
            _transform(U, A, V, P, False)
            for l in range(k + 1):
                for j in range(3):
                    total = 0.0
                    for q in range(lanes):
                        total += (
                            P[3 * j, q] * gradients[l, 0, q]
                            + P[3 * j + 1, q] * gradients[l, 1, q]
                            + P[3 * j + 2, q] * gradients[l, 2, q]
                        )
                    out[k, i, l, j] = total


@njit(**OPTIONS)
def add_blocks(target, blocks, data):  # type: ignore[no-untyped-def]
    """data[target[i]] += blocks[i] for node blocks (n, 3, 3)."""
    for i in range(len(target)):
        for a in range(3):
            for b in range(3):
                data[target[i], a, b] += blocks[i, a, b]
