"""Second derivatives of the potentials of `turned_strains`.

They are derivatives of its formulas along all 21 amplitudes at once, each a lane.  With D = R^T dF,
R turns by R [r], S changes by D - [r] S and Y = (tr S - S)^-1 by Y (dS - tr dS) Y, where

    r = -Y axial(D).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pdcorrect.fem.cell_loops import CHUNK, CellLoop
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.fem.turned_strains import (
    COLUMNS,
    ROOT,
    ROWS,
    SHARES,
    THIRD,
    amplitudes,
    frames,
    new_cell,
    pull,
    spread,
    strained,
    stress,
)

_PLACE = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
"""Of the numbers of a symmetric tensor."""
_WAYS = 24
"""The 21 amplitudes, filled up to whole SIMD registers."""


@njit(**OPTIONS)
def _change_of_strains(cell, measures, ways):  # type: ignore[no-untyped-def]
    """Fill how a cell's numbers change along each way, one a lane of arrays (n, W).

    ``ways`` are these changes: X (21, W), those of the amplitudes times R^T, is given; r (3, W),
    the frame's turn; dS and dA (6, W), of S and A; dz (18, W), of z, and dZ, with its fading; room
    for `_change_of_pull`; and rates (3, W), A : dS and half of what q changes by times a^2.
    """
    S, Y, A, z = cell.S, cell.Y, cell.A, cell.z
    c, slope, e, down, grows, _, _, _ = measures
    X, r, dS, dA, dz, dZ, _, _, _, rates = ways
    for l in range(_WAYS):
        for i in range(3):
            r[i, l] = (
                Y[i, 0] * (X[5, l] - X[7, l])
                + Y[i, 1] * (X[6, l] - X[2, l])
                + Y[i, 2] * (X[1, l] - X[3, l])
            )
    for n in range(6):
        i, j = ROWS[n], COLUMNS[n]
        a, b = (i + 1) % 3, (i + 2) % 3
        p, q = (j + 1) % 3, (j + 2) % 3
        for l in range(_WAYS):
            dS[n, l] = 0.5 * (
                (X[3 * i + j, l] + X[3 * j + i, l])
                - (r[a, l] * S[b, j] - r[b, l] * S[a, j])
                - (r[p, l] * S[q, i] - r[q, l] * S[p, i])
            )
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        own, jk, ij, ik = i, 3 + i, 3 + k, 3 + j
        for l in range(_WAYS):
            dA[own, l] = S[j, j] * dS[k, l] + S[k, k] * dS[j, l] - 2.0 * S[j, k] * dS[jk, l]
            dA[jk, l] = (
                S[i, j] * dS[ik, l] + S[i, k] * dS[ij, l] - S[i, i] * dS[jk, l]
                - S[j, k] * dS[own, l]
            )  # fmt: skip
    for l in range(_WAYS):
        volume = A[0, 0] * dS[0, l] + A[1, 1] * dS[1, l] + A[2, 2] * dS[2, l]
        volume += 2.0 * (A[1, 2] * dS[3, l] + A[2, 0] * dS[4, l] + A[0, 1] * dS[5, l])
        trace = grows * volume - THIRD * (dS[0, l] + dS[1, l] + dS[2, l])
        for n in range(3):
            dz[n, l] = dS[n, l] + trace
            dz[3 + n, l] = 2.0 * ROOT * dS[3 + n, l]
        rates[0, l] = volume
    for m in range(6, 18, 3):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for l in range(_WAYS):
                dz[m + i, l] = X[3 + m + i, l] - (r[j, l] * z[m + k] - r[k, l] * z[m + j])
    for l in range(_WAYS):
        square = 0.0
        for n in range(18):
            square += SHARES[n] * z[n] * dz[n, l]
        rates[1, l] = square
    for n in range(18):
        for l in range(_WAYS):
            fade = slope * e * rates[0, l] + c * down * rates[1, l]
            dZ[n, l] = c * e * dz[n, l] + fade * z[n]


@njit(**OPTIONS)
def _change_of_pull(cell, g, measures, ways, out):  # type: ignore[no-untyped-def]
    """How what `pull` returns changes along each way, in the frame, out (21, W).

    g (18,) are the derivatives by c e z, dy (18, W) of ``ways`` their changes.
    """
    S, Y, A, T, z, y, w = cell.S, cell.Y, cell.A, cell.T, cell.z, cell.y, cell.w
    c, slope, e, down, grows, slope2, down2, grows2 = measures
    _, r, dS, dA, dz, _, dy, dT, dw, rates = ways
    along = 0.0
    for n in range(18):
        along += g[n] * z[n]
    trace = y[0] + y[1] + y[2]
    volume = trace * grows + along * slope * e
    for l in range(_WAYS):
        change = 0.0
        for n in range(18):
            change += dy[n, l] * z[n] + g[n] * dz[n, l]
        rates[2, l] = change
    for n in range(18):
        share = SHARES[n]
        for l in range(_WAYS):
            J, q = rates[0, l], rates[1, l]
            fall = rates[2, l] * c * down + along * (slope * J * down + c * down2 * q)
            dy[n, l] = (
                c * e * dy[n, l] + (slope * e * J + c * down * q) * g[n]
                + share * (fall * z[n] + along * c * down * dz[n, l])
            )  # fmt: skip
    for n in range(6):
        i, j = ROWS[n], COLUMNS[n]
        own, mean = (1.0, THIRD) if n < 3 else (ROOT, 0.0)
        for l in range(_WAYS):
            J, q, change = rates[0, l], rates[1, l], dy[0, l] + dy[1, l] + dy[2, l]
            more = change * grows + trace * grows2 * J + rates[2, l] * slope * e
            more += along * (slope2 * J * e + slope * down * q)
            dT[n, l] = own * dy[n, l] - mean * change + more * A[i, j] + volume * dA[n, l]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for l in range(_WAYS):
            total = 0.0
            for m in range(3):
                jm, km, im = _PLACE[j, m], _PLACE[k, m], _PLACE[i, m]
                total += S[j, m] * dT[km, l] - S[k, m] * dT[jm, l]
                total += 0.5 * (dS[jm, l] * (T[m, k] + T[k, m]) - dS[km, l] * (T[m, j] + T[j, m]))
                total += dS[im, l] * w[m] - dS[m, l] * w[i]
            for m in range(6, 18, 3):
                total += z[m + j] * dy[m + k, l] - z[m + k] * dy[m + j, l]
                total += dz[m + j, l] * y[m + k] - dz[m + k, l] * y[m + j]
            dw[3 + i, l] = total
    for i in range(3):
        for l in range(_WAYS):
            dw[i, l] = Y[i, 0] * dw[3, l] + Y[i, 1] * dw[4, l] + Y[i, 2] * dw[5, l]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for l in range(_WAYS):
            for b in range(3):
                out[3 * b + i, l] = dT[_PLACE[i, b], l] + r[j, l] * T[k, b] - r[k, l] * T[j, b]
            for m in range(6, 18, 3):
                out[3 + m + i, l] = dy[m + i, l] + r[j, l] * y[m + k] - r[k, l] * y[m + j]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for l in range(_WAYS):
            out[3 * k + j, l] += dw[i, l]
            out[3 * j + k, l] -= dw[i, l]


@CellLoop
def tangents(  # type: ignore[no-untyped-def]
    begin, end, u, cells, shapes, sizes, matrices, shift, project, out
):
    """Second derivatives of the same by the amplitudes v (7, 3) of the shapes, (C, 21, 21), N/m.

    ``project`` leaves out what makes them indefinite where K is not.
    """
    cell, column, g = new_cell(), np.empty((7, 3)), np.empty(18)
    X, r, dS, dA = np.zeros((21, _WAYS)), _ways(3), _ways(6), _ways(6)
    dz, dZ, dy, dT, dw, rates = _ways(18), _ways(18), _ways(18), _ways(6), _ways(6), _ways(3)
    ways, H = (X, r, dS, dA, dz, dZ, dy, dT, dw, rates), _ways(21)
    for low in range(begin, end, CHUNK):
        high = min(end, low + CHUNK)
        found = frames(u, cells[low:high], shapes[low:high], sizes[low:high])
        for c in range(low, high):
            measures = strained(cell, found, c - low, sizes[c])
            stress(matrices[c], cell.z, measures[0] * measures[2], g)
            if len(shift):
                g -= shift[c]
            cell.y[:] = g
            pull(cell, measures, column)
            for a in range(0, 21, 3):
                for i in range(3):
                    for j in range(3):
                        X[a + j, a + i] = cell.R[i, j]
            _change_of_strains(cell, measures, ways)
            _times_matrix(matrices[c], dZ, dy)
            if project:
                for kept in (r, dS, dA, dz, rates):
                    kept[:] = 0.0
            _change_of_pull(cell, g, measures, ways, H)
            for a in range(0, 21, 3):
                for i in range(3):
                    for l in range(21):
                        out[c, a + i, l] = (
                            cell.R[i, 0] * H[a, l]
                            + cell.R[i, 1] * H[a + 1, l]
                            + cell.R[i, 2] * H[a + 2, l]
                        )


@njit(**OPTIONS)
def _ways(rows):  # type: ignore[no-untyped-def]
    return np.empty((rows, _WAYS))


@njit(**OPTIONS)
def _times_matrix(K, x, out):  # type: ignore[no-untyped-def]
    """Out (18, W) = K x."""
    for n in range(18):
        for l in range(_WAYS):
            total = 0.0
            for m in range(18):
                total += K[n, m] * x[m, l]
            out[n, l] = total


@CellLoop
def products(begin, end, x, cells, shapes, tangent, by_cell):  # type: ignore[no-untyped-def]
    """The tangents (C, 21, 21) times x (N, 3), by cell, (C, 8, 3), N."""
    dv, out = np.empty((7, 3)), np.empty((7, 3))
    along = dv.reshape(21)
    for c in range(begin, end):
        amplitudes(x, cells[c], shapes[c], dv)
        for n in range(21):
            total = 0.0
            for m in range(21):
                total += tangent[c, n, m] * along[m]
            out[n // 3, n % 3] = total
        spread(out, shapes[c], 1.0, by_cell[c])


@CellLoop
def add_blocks(begin, end, tangent, shapes, blocks):  # type: ignore[no-untyped-def]
    """Add the tangents (C, 21, 21) to cells' matrices (C, L, L, 3, 3) of nodes."""
    half, row = np.empty((7, 8, 3, 3)), np.empty(8)
    flat = half.reshape(7, 72)
    for c in range(begin, end):
        for a in range(7):
            for i in range(3):
                for j in range(3):
                    for k in range(8):
                        total = 0.0
                        for b in range(7):
                            total += tangent[c, 3 * a + i, 3 * b + j] * shapes[c, b, k]
                        row[k] = total
                    for k in range(8):
                        half[a, k, i, j] = row[k]
        for l in range(8):
            out = blocks[c, l, :8].reshape(72)
            for n in range(72):
                total = 0.0
                for a in range(7):
                    total += shapes[c, a, l] * flat[a, n]
                out[n] += total
