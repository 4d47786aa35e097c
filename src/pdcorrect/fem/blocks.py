"""What loops over cells are made of: gradients, forces, and cells taken together in blocks.

Threads share the cells in fixed contiguous chunks and every result is stored by
cell, then summed node by node in a fixed order; so results do not depend on the
number of threads.  Work arrays are made once a chunk, by the thread that takes it, and
none for a block, a cell or a quadrature point; only the eigenvalues of a point's 3x3 block,
where negative ones are raised to zero, come from LAPACK with arrays of their own.
"""

from __future__ import annotations

import os
from typing import Any

from numba import njit, prange

from pdcorrect.fem.decomposition import OPTIONS

# GNU OpenMP reads this when its threads start.  By default they spin while they wait, and a step
# takes longer as soon as other processes want the cores (benchmarks, case threads).
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

PARALLEL: dict[str, Any] = {**OPTIONS, "parallel": True}
REDUCE: dict[str, Any] = {**OPTIONS, "fastmath": {"contract", "nsz", "reassoc"}}
CHUNK = 16
"""Cells that one thread takes at a time."""
_LANES = 32
"""Quadrature points that are decomposed together.

Divisions and square roots take long to answer, but several can be under way: 32 take half the
time of four times 8 (``benchmarks``, case kernel).
"""
_WIDTH = 8
"""Lanes are filled up to a multiple of this, the numbers in the widest SIMD register."""


@njit(**OPTIONS)
def deformation(u, nodes, gradients, diagonal, F):  # type: ignore[no-untyped-def]
    """Diagonal I + sum_k u_k grad N_k, (9, Q), for nodal vectors u (N, 3); F for diagonal 1."""
    for i in range(3):
        for j in range(3):
            for q in range(F.shape[1]):
                F[3 * i + j, q] = diagonal if i == j else 0.0
    for k in range(nodes.shape[0]):
        node = nodes[k]
        for i in range(3):
            value = u[node, i]
            for j in range(3):
                for q in range(F.shape[1]):
                    F[3 * i + j, q] += value * gradients[k, j, q]


@njit(**REDUCE)
def nodal_forces(P, gradients, sign, out):  # type: ignore[no-untyped-def]
    """out[k, i] = sign sum_q P_ij dN_k/dx_j for P (9, Q), weights included."""
    for k in range(out.shape[0]):
        for i in range(3):
            total = 0.0
            for q in range(P.shape[1]):
                total += (
                    P[3 * i, q] * gradients[k, 0, q]
                    + P[3 * i + 1, q] * gradients[k, 1, q]
                    + P[3 * i + 2, q] * gradients[k, 2, q]
                )
            out[k, i] = sign * total


@njit(**REDUCE)
def total(a):  # type: ignore[no-untyped-def]
    """Sum of a vector."""
    out = 0.0
    for i in range(a.shape[0]):
        out += a[i]
    return out


@njit(**PARALLEL)
def gather_nodes(start, slots, values, out):  # type: ignore[no-untyped-def]
    """out[n] = sum of values[slot] over the (cell, local node) slots of node n.

    Parameters
    ----------
    start : (N + 1,), slots : (C K,)
        Slots of each node, compressed rows.
    values : (C K, 3), out : (N, 3)
    """
    for n in prange(len(start) - 1):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(start[n], start[n + 1]):
            slot = slots[i]
            x += values[slot, 0]
            y += values[slot, 1]
            z += values[slot, 2]
        out[n, 0], out[n, 1], out[n, 2] = x, y, z


@njit(**OPTIONS)
def block_shape(points):  # type: ignore[no-untyped-def]
    """Cells of ``points`` quadrature points in a block, and its lanes."""
    cells = max(1, _LANES // points)
    return cells, (cells * points + _WIDTH - 1) // _WIDTH * _WIDTH


@njit(**OPTIONS)
def put(one, j, cells, first, block):  # type: ignore[no-untyped-def]
    """Copy cell j's lanes (n, Q) into a block's (n, lanes).

    All cells' lanes without a volume term come before those with one.
    """
    points = one.shape[1]
    low, high = j * first, cells * first + j * (points - first)
    for i in range(one.shape[0]):
        for q in range(first):
            block[i, low + q] = one[i, q]
        for q in range(points - first):
            block[i, high + q] = one[i, first + q]


@njit(**OPTIONS)
def take(block, j, cells, first, one):  # type: ignore[no-untyped-def]
    """The reverse of `put`."""
    points = one.shape[1]
    low, high = j * first, cells * first + j * (points - first)
    for i in range(one.shape[0]):
        for q in range(first):
            one[i, q] = block[i, low + q]
        for q in range(points - first):
            one[i, first + q] = block[i, high + q]


@njit(**OPTIONS)
def fill(u, cells, gradients, weights, begin, end, first, one, F, w):  # type: ignore[no-untyped-def]
    """Deformation gradients F (9, lanes) and weights w (2, lanes) of cells begin ... end - 1.

    Lanes that no cell uses hold the identity and no weight.
    """
    size, _ = block_shape(one.shape[1])
    for i in range(9):
        for l in range(F.shape[1]):
            F[i, l] = 1.0 if i % 4 == 0 else 0.0
    w[:] = 0.0
    for c in range(begin, end):
        deformation(u, cells[c], gradients[c], 1.0, one)
        put(one, c - begin, size, first, F)
        put(weights[c], c - begin, size, first, w)


@njit(**OPTIONS)
def first_volume_lane(first, points, w):  # type: ignore[no-untyped-def]
    """First lane of a block with a volume term; the number of lanes where there is none."""
    size, lanes = block_shape(points)
    start = size * first
    for l in range(start, lanes):
        if w[1, l] > 0.0:
            return start
    return lanes
