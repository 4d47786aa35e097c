"""A cell's 18 strains z in the frame that turns with it, and a potential of them.

With a the cell's size, u_k the displacements of its corners and b_k, g_mk the rows of ``shapes``,

    F = I + sum_k u_k b_k^T,    h_m = sum_k g_mk u_k    (m = 1 ... 4),    F = R S,

z holds a E in Mandel's notation and the four vectors R^T h_m; h_m vanishes for affine
displacements.  E is the strain with the change of volume for its trace,

    E = S - I + (g(J) + 3 - tr S) I / 3,    J = det S,    g(J) = 3/2 (J^2 - 1) / (J^2 + 2),

which is S - I near rest.  At large strain its trace sees changes of volume only, as the energy's
own volume term does, and is bounded: with S - I a negative K bursts cells that are drawn out,
where that term grows less than quadratically.

A potential e(z) with y = de/dS and de/d(R^T h_m), a symmetric tensor Y and vectors y_m, has the
derivatives

    de/dF = R (a Y - [w]),    de/dh_m = R y_m,
    (tr S - S) w = sum_m R^T h_m x y_m + a axial(S Y),

[w] the matrix of the cross product with w, axial(A)_i = e_ijk A_jk: the second part is what the
frame's turning adds, without which forces would have no potential.

Everything here counts S and F times a, so that all numbers of z are lengths.

z counts times c(J) e(q), q = sum_n w_n z_n^2 / a^2 with the `SHARES` w.  c is 1 for J above `FADES`
and 0 below `GONE`: the frame is not defined where two stretches add up to nothing.  e is 1 for q
below `LARGE` and 0 above `HUGE`.  So cells that are crushed, inside out, folded or drawn out have
the element's own energy alone, which may get them back, and on the way there no force drives them
further: with the stiffest K energy grows all the way, but for cells drawn out in two directions
with a change of volume, where it falls by 1 % of its largest at nu = 0.45 and 12 % at 0.48.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from pdcorrect.fem.cell_loops import CHUNK, CellLoop
from pdcorrect.fem.decomposition import OPTIONS, scratch, signed_svd_lanes

ROOT = np.sqrt(0.5)
ROWS = np.array([0, 1, 2, 1, 2, 0])
COLUMNS = np.array([0, 1, 2, 2, 0, 1])
KINK = 1e-9
"""Of the size: sums of two stretches below it count as it."""
FADES, GONE = 0.6, 0.05
"""Values of J between which z fades."""
LARGE, HUGE = 0.1, 0.6
"""Values of q between which z fades; at 0.2 a corner can be inside out.

Both are so far apart that energy still grows on the way in where K is as large as C.
"""
SHARES = np.repeat([0.5, 1.0], [6, 12])
"""Of the squares of z's numbers in q: that of a cell stretched 1.4 times is 0.1, 2 times 0.6."""
_FADING, _SHRINKING, THIRD = 1.0 / (FADES - GONE), 1.0 / (HUGE - LARGE), 1.0 / 3.0


class Cell(NamedTuple):
    """One cell's arrays.

    The amplitudes v (7, 3) of its shapes; R, S and Y = (tr S - S)^-1; A, S's adjugate; z and
    the derivatives y by it (18,); and room: T, B (3, 3), t, w (3,).
    """

    v: Any
    R: Any
    S: Any
    Y: Any
    A: Any
    z: Any
    y: Any
    T: Any
    B: Any
    t: Any
    w: Any


@njit(**OPTIONS)
def new_cell():  # type: ignore[no-untyped-def]
    """Room for a cell."""
    v, R, S, Y = np.empty((7, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    A, T, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    return Cell(v, R, S, Y, A, np.empty(18), np.empty(18), T, B, np.empty(3), np.empty(3))


@njit(**OPTIONS)
def _product(A, B, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(**OPTIONS)
def _times(A, x, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        out[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@njit(**OPTIONS)
def _axial(A, factor, out):  # type: ignore[no-untyped-def]
    out[0] = factor * (A[1, 2] - A[2, 1])
    out[1] = factor * (A[2, 0] - A[0, 2])
    out[2] = factor * (A[0, 1] - A[1, 0])


@njit(**OPTIONS)
def amplitudes(u, nodes, shapes, v):  # type: ignore[no-untyped-def]
    """V (7, 3): rows of shapes (7, 8) times the corners' displacements."""
    for a in range(7):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(8):
            s, n = shapes[a, k], nodes[k]
            x += s * u[n, 0]
            y += s * u[n, 1]
            z += s * u[n, 2]
        v[a, 0], v[a, 1], v[a, 2] = x, y, z


@njit(**OPTIONS)
def spread(A, shapes, sign, out):  # type: ignore[no-untyped-def]
    """Out (8, 3): sign times the transpose of `amplitudes` of A (7, 3)."""
    for k in range(8):
        for i in range(3):
            total = 0.0
            for a in range(7):
                total += shapes[a, k] * A[a, i]
            out[k, i] = sign * total


@njit(**OPTIONS)
def frames(u, cells, shapes, sizes):  # type: ignore[no-untyped-def]
    """Amplitudes (cells, 7, 3), and signed SVDs of a F, one cell a lane."""
    F, U, V, B, W, s, _, _ = scratch(CHUNK)
    v = np.empty((CHUNK, 7, 3))
    for l in range(CHUNK):
        c = min(l, len(cells) - 1)
        amplitudes(u, cells[c], shapes[c], v[l])
        for i in range(3):
            for j in range(3):
                F[3 * i + j, l] = v[l, j, i] + (sizes[c] if i == j else 0.0)
    signed_svd_lanes(F, U, s, V, B, W)
    return v, U, s, V


@njit(**OPTIONS)
def _polar(U, s, V, l, size, cell):  # type: ignore[no-untyped-def]
    """R, S and Y of lane l."""
    for i in range(3):
        for j in range(3):
            r, t, y = 0.0, 0.0, 0.0
            for a in range(3):
                r += U[3 * i + a, l] * V[3 * j + a, l]
                both = V[3 * i + a, l] * V[3 * j + a, l]
                t += both * s[a, l]
                y += both / max(s[(a + 1) % 3, l] + s[(a + 2) % 3, l], KINK * size)
            cell.R[i, j], cell.S[i, j], cell.Y[i, j] = r, t, y


@njit(**OPTIONS)
def _rise(t, rate):  # type: ignore[no-untyped-def]
    """From 0 at t = 0 to 1 at t = 1, with derivatives where t grows by ``rate``."""
    if t >= 1.0:
        return 1.0, 0.0, 0.0
    if not t > 0.0:
        return 0.0, 0.0, 0.0
    both = t * (1.0 - t)
    value = t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
    return value, 30.0 * rate * both**2, 60.0 * rate**2 * both * (1.0 - 2.0 * t)


@njit(**OPTIONS)
def _strains(cell, size):  # type: ignore[no-untyped-def]
    """Make z, still without fading, and A.

    Returns c and its derivative by A : dS, e and its by z . dz, that of tr E / 3 by A : dS, and
    the derivatives of these three.
    """
    v, R, S, A, z = cell.v, cell.R, cell.S, cell.A, cell.z
    for n in range(6):
        i, j = ROWS[n], COLUMNS[n]
        z[n] = S[i, j] - size if i == j else 2.0 * ROOT * S[i, j]
    for m in range(4):
        for i in range(3):
            z[6 + 3 * m + i] = R[0, i] * v[3 + m, 0] + R[1, i] * v[3 + m, 1] + R[2, i] * v[3 + m, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        A[i, i] = S[j, j] * S[k, k] - S[j, k] * S[j, k]
        A[j, k] = A[k, j] = S[i, j] * S[i, k] - S[i, i] * S[j, k]
    one = 1.0 / size
    J = one**3 * (S[0, 0] * A[0, 0] + S[0, 1] * A[0, 1] + S[0, 2] * A[0, 2])
    over = 1.0 / (J * J + 2.0)
    more = THIRD * (1.5 * size * (J * J - 1.0) * over - (z[0] + z[1] + z[2]))
    for i in range(3):
        z[i] += more
    grows = 3.0 * one**2 * J * over * over
    grows2 = 3.0 * one**5 * over * over * (1.0 - 4.0 * J * J * over)
    c, slope, slope2 = _rise((J - GONE) * _FADING, _FADING * one**3)
    q = 0.0
    for n in range(18):
        q += SHARES[n] * one**2 * (z[n] * z[n])
    e, down, down2 = _rise((HUGE - q) * _SHRINKING, -2.0 * one**2 * _SHRINKING)
    return c, slope, e, down, grows, slope2, down2, grows2


@njit(**OPTIONS)
def pull(cell, measures, out):  # type: ignore[no-untyped-def]
    """Out (7, 3): derivatives by v, R (T - [w]) transposed and R y_m, from those y by c e z."""
    _, R, S, Y, A, z, y, T, B, t, w = cell
    c, slope, e, down, grows, _, _, _ = measures
    along = 0.0
    for n in range(18):
        along += y[n] * z[n]
    for n in range(18):  # by z
        y[n] = c * e * y[n] + along * c * down * SHARES[n] * z[n]
    trace = y[0] + y[1] + y[2]
    for n in range(6):  # T: by S
        i, j = ROWS[n], COLUMNS[n]
        T[i, j] = T[j, i] = y[n] if i == j else ROOT * y[n]
    for i in range(3):
        T[i, i] -= THIRD * trace
        for j in range(3):
            T[i, j] += (trace * grows + along * slope * e) * A[i, j]
    _product(S, T, B)
    _axial(B, 1.0, t)
    for m in range(6, 18, 3):
        t[0] += z[m + 1] * y[m + 2] - z[m + 2] * y[m + 1]
        t[1] += z[m + 2] * y[m] - z[m] * y[m + 2]
        t[2] += z[m] * y[m + 1] - z[m + 1] * y[m]
    _times(Y, t, w)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        T[j, k] += w[i]
        T[k, j] -= w[i]
    for i in range(3):
        for j in range(3):
            out[j, i] = R[i, 0] * T[0, j] + R[i, 1] * T[1, j] + R[i, 2] * T[2, j]
        for m in range(4):
            out[3 + m, i] = R[i, 0] * y[6 + 3 * m] + R[i, 1] * y[7 + 3 * m] + R[i, 2] * y[8 + 3 * m]


@njit(**OPTIONS)
def strained(cell, found, l, size):  # type: ignore[no-untyped-def]
    """Make ``cell`` the one of lane l of what `frames` found; returns as `_strains`."""
    v, U, s, V = found
    cell.v[:] = v[l]
    _polar(U, s, V, l, size, cell)
    return _strains(cell, size)


@njit(**OPTIONS)
def stress(K, z, factor, out):  # type: ignore[no-untyped-def]
    """Out (18,) = factor K z, for symmetric K, whose rows are added up."""
    for n in range(18):
        out[n] = 0.0
    for m in range(18):
        share = factor * z[m]
        for n in range(18):
            out[n] += K[m, n] * share


@CellLoop
def energy_and_forces(  # type: ignore[no-untyped-def]
    begin, end, u, cells, shapes, sizes, matrices, shift, energy, by_cell
):
    """1/2 z . K z - shift . z of each cell, (C,), and its forces -d/du, (C, 8, 3).

    For displacements u (N, 3), m; shapes (C, 7, 8), a b_k and g_mk; sizes (C,), a, m; matrices
    (C, 18, 18), K, N/m; shift (C, 18), N, or empty.
    """
    cell, out = new_cell(), np.empty((7, 3))
    for low in range(begin, end, CHUNK):
        high = min(end, low + CHUNK)
        found = frames(u, cells[low:high], shapes[low:high], sizes[low:high])
        for c in range(low, high):
            measures = strained(cell, found, c - low, sizes[c])
            fades = measures[0] * measures[2]
            stress(matrices[c], cell.z, fades, cell.y)
            total = 0.0
            for n in range(18):
                less = shift[c, n] if len(shift) else 0.0
                total += fades * cell.z[n] * (0.5 * cell.y[n] - less)
                cell.y[n] -= less
            energy[c] = total
            pull(cell, measures, out)
            spread(out, shapes[c], -1.0, by_cell[c])


@CellLoop
def strains(begin, end, u, cells, shapes, sizes, out):  # type: ignore[no-untyped-def]
    """Z of each cell, out (C, 18), m."""
    cell = new_cell()
    for low in range(begin, end, CHUNK):
        high = min(end, low + CHUNK)
        found = frames(u, cells[low:high], shapes[low:high], sizes[low:high])
        for c in range(low, high):
            measures = strained(cell, found, c - low, sizes[c])
            out[c] = measures[0] * measures[2] * cell.z
