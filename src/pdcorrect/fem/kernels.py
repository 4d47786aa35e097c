"""Loops over cells: elastic energy, forces, and what the tangent needs."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numba import njit

from pdcorrect.fem.cell_loops import CHUNK, CellLoop
from pdcorrect.fem.decomposition import OPTIONS, scratch, signed_svd_lanes
from pdcorrect.fem.energies import principal_stress_lanes, principal_tangent_lanes, stress_lanes

# GNU OpenMP reads this when its threads start.  By default they spin while they wait, and a step
# takes longer as soon as other processes want the cores (benchmarks, case threads).
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

REDUCE: dict[str, Any] = {**OPTIONS, "fastmath": {"contract", "nsz", "reassoc"}}
_LANES = 32
"""Quadrature points that are decomposed together: 32 take half the time of four times 8."""

_WIDTH = 8
"""Lanes are filled up to a multiple of this, the numbers in the widest SIMD register."""


@njit(**OPTIONS)
def deformation(u, nodes, gradients, diagonal, F):  # type: ignore[no-untyped-def]
    """Diagonal I + sum_k u_k grad N_k, (9, Q), for nodal vectors u (N, 3); F for diagonal 1."""
    for i in range(3):
        for j in range(3):
            for q in range(F.shape[1]):
                F[3 * i + j, q] = diagonal if i == j else 0.0
    count, long = len(nodes), 3 * F.shape[1]  # directions and points as one index
    rows, out = gradients.reshape(len(gradients), long), F.reshape(3, long)
    for k in range(0, count, 2):  # two functions for each store; an odd last one twice, as 1 and 0
        l = min(k + 1, count - 1)
        n, m, share = nodes[k], nodes[l], 1.0 if l > k else 0.0
        a, b, c = u[n, 0], u[n, 1], u[n, 2]
        d, e, f = share * u[m, 0], share * u[m, 1], share * u[m, 2]
        for q in range(long):
            x, y = rows[k, q], rows[l, q]
            out[0, q] += a * x + d * y
            out[1, q] += b * x + e * y
            out[2, q] += c * x + f * y


@njit(**REDUCE)
def nodal_forces(P, gradients, sign, out):  # type: ignore[no-untyped-def]
    """out[k, i] = sign sum_q P_ij dN_k/dx_j for P (9, Q), weights included."""
    long = 3 * P.shape[1]  # directions and points as one index
    rows, stress = gradients.reshape(len(gradients), long), P.reshape(3, long)
    for k in range(len(out)):
        a, b, c = 0.0, 0.0, 0.0
        for q in range(long):
            a += stress[0, q] * rows[k, q]
            b += stress[1, q] * rows[k, q]
            c += stress[2, q] * rows[k, q]
        out[k, 0], out[k, 1], out[k, 2] = sign * a, sign * b, sign * c


@njit(**REDUCE)
def total(a):  # type: ignore[no-untyped-def]
    """Sum of a vector."""
    out = 0.0
    for i in range(a.shape[0]):
        out += a[i]
    return out


@CellLoop
def gather_nodes(begin, end, start, slots, values, out):  # type: ignore[no-untyped-def]
    """out[n] = sum of values[slot] over the slots of node n, see `Assembly`."""
    for n in range(begin, end):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(start[n], start[n + 1]):
            slot = slots[i]
            x += values[slot, 0]
            y += values[slot, 1]
            z += values[slot, 2]
        out[n, 0], out[n, 1], out[n, 2] = x, y, z


@njit(**OPTIONS)
def block_shape(points):  # type: ignore[no-untyped-def]
    """Cells of ``points`` quadrature points in a block, and its lanes.

    A power of two, so that blocks are the same whatever the number of threads.
    """
    cells = CHUNK
    while cells > 1 and 2 * cells * points > 5 * _LANES:
        cells //= 2
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


@CellLoop
def energy_and_forces(  # type: ignore[no-untyped-def]
    begin, end, model, u, cells, gradients, weights, first, energy, by_cell
):
    """Elastic energy (C,), J, of each cell, and its forces (C, K, 3), N, at displacements u (N, 3).

    ``model`` is an `energy_code`; ``weights`` (C, 2, Q), J, are mu and omega times rest volume; for
    points below ``first`` there is no volume term and no volume projection is computed.
    """
    points = weights.shape[2]
    size, lanes = block_shape(points)
    F, U, V, B, S, s, v, k = scratch(lanes)
    P, t, w = np.empty((9, lanes)), np.empty((3, lanes)), np.empty((2, lanes))
    density, part, one = np.empty((1, lanes)), np.empty((1, points)), np.empty((9, points))
    for low in range(begin, end, size):
        high = min(end, low + size)
        fill(u, cells, gradients, weights, low, high, first, one, F, w)
        signed_svd_lanes(F, U, s, V, B, S)
        lane = first_volume_lane(first, points, w)
        principal_stress_lanes(model, s, v, k, w[0], w[1], lane, density[0], t)
        stress_lanes(U, t, V, P)
        for c in range(low, high):
            take(density, c - low, size, first, part)
            energy[c] = total(part[0])
            take(P, c - low, size, first, one)
            nodal_forces(one, gradients[c], -1.0, by_cell[c])


@CellLoop
def smallest_determinants(begin, end, u, cells, gradients, out):  # type: ignore[no-untyped-def]
    """Smallest det F of each cell, out (C,), of the nodes' displacements u alone."""
    lanes = gradients.shape[3]
    F = np.empty((9, lanes))
    for c in range(begin, end):
        deformation(u, cells[c], gradients[c], 1.0, F)
        least = np.inf
        for q in range(lanes):
            determinant = (
                F[0, q] * (F[4, q] * F[8, q] - F[5, q] * F[7, q])
                + F[1, q] * (F[5, q] * F[6, q] - F[3, q] * F[8, q])
                + F[2, q] * (F[3, q] * F[7, q] - F[4, q] * F[6, q])
            )
            least = min(least, determinant)
        out[c] = least


@CellLoop
def linearise_cells(  # type: ignore[no-untyped-def]
    begin, end, model, u, cells, gradients, weights, first, project, left, right, tangent
):
    """Everything the tangent needs at displacements u, for each cell.

    Writes ``left`` and ``right`` (C, 9, Q), the factors U and V of the signed
    SVD, and ``tangent`` (C, 12, Q), see `finish_tangent_lanes`, in J.
    """
    points = weights.shape[2]
    size, lanes = block_shape(points)
    F, U, V, B, S, s, v, k = scratch(lanes)
    T, w, one = np.empty((12, lanes)), np.empty((2, lanes)), np.empty((9, points))
    for low in range(begin, end, size):
        high = min(end, low + size)
        fill(u, cells, gradients, weights, low, high, first, one, F, w)
        signed_svd_lanes(F, U, s, V, B, S)
        lane = first_volume_lane(first, points, w)
        principal_tangent_lanes(model, s, v, k, w[0], w[1], lane, project, T)
        for c in range(low, high):
            take(U, c - low, size, first, left[c])
            take(V, c - low, size, first, right[c])
            take(T, c - low, size, first, tangent[c])


@CellLoop
def apply_linearised(  # type: ignore[no-untyped-def]
    begin, end, x, cells, gradients, left, right, tangent, by_cell
):
    """Tangent times x (N, 3), by cell (C, K, 3); other arguments as `linearise_cells`."""
    lanes = tangent.shape[2]
    D, A = np.empty((9, lanes)), np.empty((9, lanes))
    for c in range(begin, end):
        deformation(x, cells[c], gradients[c], 0.0, D)
        transform(left[c], D, right[c], A, True)
        _tangent_product(tangent[c], A)
        transform(left[c], A, right[c], D, False)
        nodal_forces(D, gradients[c], 1.0, by_cell[c])


@njit(**OPTIONS)
def transform(U, A, V, out, forward):  # type: ignore[no-untyped-def]
    """Out = U^T A V (forward) or U A V^T, all (9, Q)."""
    for i in range(3):
        l, m, n = (i, 3 + i, 6 + i) if forward else (3 * i, 3 * i + 1, 3 * i + 2)
        for q in range(A.shape[1]):
            u, v, w = U[l, q], U[m, q], U[n, q]
            x = u * A[0, q] + v * A[3, q] + w * A[6, q]
            y = u * A[1, q] + v * A[4, q] + w * A[7, q]
            z = u * A[2, q] + v * A[5, q] + w * A[8, q]
            for j in range(3):
                if forward:
                    out[3 * i + j, q] = x * V[j, q] + y * V[3 + j, q] + z * V[6 + j, q]
                else:
                    out[3 * i + j, q] = x * V[3 * j, q] + y * V[3 * j + 1, q] + z * V[3 * j + 2, q]


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


@CellLoop
def cell_stiffness(begin, end, gradients, left, right, tangent, out):  # type: ignore[no-untyped-def]
    """Tangent stiffness of each cell as node blocks, out (C, L, L, 3, 3), N/m."""
    width = gradients.shape[1]
    room, K = stiffness_room(width, tangent.shape[2]), np.empty((width, 3, width, 3))
    for c in range(begin, end):
        stiffness(gradients[c], left[c], right[c], tangent[c], room, K)
        for k in range(width):
            for l in range(k + 1):
                for i in range(3):
                    for j in range(3):
                        out[c, k, l, i, j] = K[k, i, l, j]
                        out[c, l, k, j, i] = K[k, i, l, j]


@njit(**OPTIONS)
def stiffness_room(width, points):  # type: ignore[no-untyped-def]
    """Work arrays of `stiffness`: (30 + 9, W), (L, 3, W), (9, 9, W), (9, 3 W) and (3, 3 W)."""
    lanes = (points + _WIDTH - 1) // _WIDTH * _WIDTH
    frames, g, C = np.zeros((39, lanes)), np.zeros((width, 3, lanes)), np.empty((9, 9, lanes))
    return frames, g, C, np.empty((9, 3 * lanes)), np.empty((3, 3 * lanes))


@njit(**REDUCE)
def stiffness(gradients, U, V, T, room, out):  # type: ignore[no-untyped-def]
    """One cell's tangent stiffness, the blocks k >= l of out (L, 3, L, 3), N/m.

    At each point the elasticity C_im,jn in space, then H_ij,n = sum_m dN_k/dx_m C_im,jn for each
    function k, and with n and the points as one long index the products with dN_l/dx_n.
    """
    frames, g, C, H, tiled = room
    points, lanes, long = T.shape[1], frames.shape[1], H.shape[1]
    for q in range(points):
        for i in range(9):
            frames[i, q], frames[9 + i, q] = U[i, q], V[i, q]
        for i in range(12):
            frames[18 + i, q] = T[i, q]
    g[:, :, :points] = gradients
    _elasticity(frames[:9], frames[9:18], frames[18:30], frames[30:], C)
    rows, flat = C.reshape(27, long), g.reshape(len(g), long)
    for k in range(len(g)):
        for m in range(3):
            for n in range(3):
                for q in range(lanes):
                    tiled[m, n * lanes + q] = g[k, m, q]
        for i in range(3):
            for j in range(3):
                x, y, z = 9 * i + j, 9 * i + 3 + j, 9 * i + 6 + j
                for q in range(long):
                    H[3 * i + j, q] = (
                        tiled[0, q] * rows[x, q]
                        + tiled[1, q] * rows[y, q]
                        + tiled[2, q] * rows[z, q]
                    )
        for l in range(k + 1):
            for i in range(3):
                a, b, c = 0.0, 0.0, 0.0
                for q in range(long):
                    a += H[3 * i, q] * flat[l, q]
                    b += H[3 * i + 1, q] * flat[l, q]
                    c += H[3 * i + 2, q] * flat[l, q]
                out[k, i, l, 0], out[k, i, l, 1], out[k, i, l, 2] = a, b, c


@njit(**OPTIONS)
def _elasticity(U, V, T, A, out):  # type: ignore[no-untyped-def]
    """dP_im/dF_jn of each lane, out (9, 9, W), for the tangent in the frame of the SVD.

    Column jn is U A V^T with A (9, W) the tangent times U^T e_j e_n^T V.
    """
    lanes = T.shape[1]
    for f in range(9):
        j, n = 3 * (f // 3), 3 * (f % 3)
        for i in range(3):
            for m in range(3):
                for q in range(lanes):
                    A[3 * i + m, q] = U[j + i, q] * V[n + m, q]
        _tangent_product(T, A)
        for m in range(3):
            for q in range(lanes):
                a, b, c = V[3 * m, q], V[3 * m + 1, q], V[3 * m + 2, q]
                x = A[0, q] * a + A[1, q] * b + A[2, q] * c
                y = A[3, q] * a + A[4, q] * b + A[5, q] * c
                z = A[6, q] * a + A[7, q] * b + A[8, q] * c
                for i in range(3):
                    out[3 * i + m, f, q] = (
                        U[3 * i, q] * x + U[3 * i + 1, q] * y + U[3 * i + 2, q] * z
                    )


@njit(**OPTIONS)
def add_blocks(target, blocks, data):  # type: ignore[no-untyped-def]
    """data[target[i]] += blocks[i] for node blocks (n, 3, 3)."""
    for i in range(len(target)):
        for a in range(3):
            for b in range(3):
                data[target[i], a, b] += blocks[i, a, b]


@njit(**OPTIONS)
def sparse_times(starts, columns, entries, x):  # type: ignore[no-untyped-def]
    """A matrix in compressed rows times x (n, 3)."""
    out = np.zeros((len(starts) - 1, 3))
    for row in range(len(out)):
        for k in range(starts[row], starts[row + 1]):
            for i in range(3):
                out[row, i] += entries[k] * x[columns[k], i]
    return out


@njit(**OPTIONS)
def scatter(cells, values, count):  # type: ignore[no-untyped-def]
    """Sums (count, 3) of values (C, K, 3) at the nodes of cells (C, K)."""
    out = np.zeros((count, 3))
    for c in range(len(cells)):
        for k in range(cells.shape[1]):
            for i in range(3):
                out[cells[c, k], i] += values[c, k, i]
    return out
