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
frame's turning adds, without which forces would have no potential.  Second derivatives are exact
too.  Everything here counts S and F times a, so that all numbers of z are lengths.

z counts times c(J) e(q), q = sum_n w_n z_n^2 / a^2 with the `SHARES` w.  c is 1 for J above `FADES`
and 0 below `GONE`: the frame is not defined where two stretches add up to nothing.  e is 1 for q
below `LARGE` and 0 above `HUGE`.  So cells that are crushed, inside out, folded or drawn out have
the element's own energy alone, which may get them back, and on the way there no force drives them
further: with the stiffest K energy grows all the way, but for cells drawn out in two directions
with a change of volume, where it falls by 1 % of its largest at nu = 0.45 and 12 % at 0.48.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdcorrect.fem.decomposition import OPTIONS, scratch, signed_svd_lanes
from pdcorrect.fem.kernels import CHUNK, PARALLEL
from pdcorrect.fem.kernels import gather_nodes as gather_nodes

Array = NDArray[np.float64]

_ROOT = np.sqrt(0.5)
_ROWS = np.array([0, 1, 2, 1, 2, 0])
_COLUMNS = np.array([0, 1, 2, 2, 0, 1])
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


@njit(**OPTIONS)
def _tensor(y, out):  # type: ignore[no-untyped-def]
    """Symmetric tensor (3, 3) of the first six numbers."""
    for n in range(6):
        value = y[n] if n < 3 else _ROOT * y[n]
        out[_ROWS[n], _COLUMNS[n]] = out[_COLUMNS[n], _ROWS[n]] = value


@njit(**OPTIONS)
def _product(A, B, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(**OPTIONS)
def _add_cross(a, b, factor, out):  # type: ignore[no-untyped-def]
    out[0] += factor * (a[1] * b[2] - a[2] * b[1])
    out[1] += factor * (a[2] * b[0] - a[0] * b[2])
    out[2] += factor * (a[0] * b[1] - a[1] * b[0])


@njit(**OPTIONS)
def _add_axial(A, factor, out):  # type: ignore[no-untyped-def]
    out[0] += factor * (A[1, 2] - A[2, 1])
    out[1] += factor * (A[2, 0] - A[0, 2])
    out[2] += factor * (A[0, 1] - A[1, 0])


@njit(**OPTIONS)
def _times(A, x, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        out[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@njit(**OPTIONS)
def _amplitudes(u, nodes, shapes, v):  # type: ignore[no-untyped-def]
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
def _spread(A, shapes, sign, out):  # type: ignore[no-untyped-def]
    """Out (8, 3): sign times the transpose of `_amplitudes` of A (7, 3)."""
    for k in range(8):
        for i in range(3):
            total = 0.0
            for a in range(7):
                total += shapes[a, k] * A[a, i]
            out[k, i] = sign * total


@njit(**OPTIONS)
def _frames(u, cells, shapes, sizes, v, F, U, s, V, B, W):  # type: ignore[no-untyped-def]
    """Amplitudes v (cells, 7, 3), and signed SVDs of a F, one cell a lane."""
    for l in range(F.shape[1]):
        c = min(l, len(cells) - 1)
        _amplitudes(u, cells[c], shapes[c], v[l])
        for i in range(3):
            for j in range(3):
                F[3 * i + j, l] = v[l, j, i] + (sizes[c] if i == j else 0.0)
    signed_svd_lanes(F, U, s, V, B, W)


@njit(**OPTIONS)
def _add_tensor(factor, G, y):  # type: ignore[no-untyped-def]
    """Add a symmetric tensor to the first six numbers."""
    for n in range(6):
        i, j = _ROWS[n], _COLUMNS[n]
        y[n] += factor * (G[i, j] if i == j else G[i, j] / _ROOT)


@njit(**OPTIONS)
def _adjugate(S, out):  # type: ignore[no-untyped-def]
    """Of a symmetric S."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, i] = S[j, j] * S[k, k] - S[j, k] * S[j, k]
        out[j, k] = out[k, j] = S[i, j] * S[i, k] - S[i, i] * S[j, k]


@njit(**OPTIONS)
def _add_adjugate_change(factor, S, dS, y):  # type: ignore[no-untyped-def]
    """Add a multiple of the adjugate's change to the first six numbers."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        own = dS[j, j] * S[k, k] + S[j, j] * dS[k, k] - 2.0 * S[j, k] * dS[j, k]
        other = dS[i, j] * S[i, k] + S[i, j] * dS[i, k] - dS[i, i] * S[j, k] - S[i, i] * dS[j, k]
        y[i] += factor * own
        y[3 + i] += factor * other / _ROOT


@njit(**OPTIONS)
def _rise(t, width):  # type: ignore[no-untyped-def]
    """From 0 at t = 0 to 1 at t = 1, and its first two derivatives by ``width`` times t."""
    if t >= 1.0:
        return 1.0, 0.0, 0.0
    if not t > 0.0:
        return 0.0, 0.0, 0.0
    first = 30.0 * t * t * (1.0 - t) ** 2 / width
    second = 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t) / width**2
    return t * t * t * (10.0 - 15.0 * t + 6.0 * t * t), first, second


@njit(**OPTIONS)
def _measures(S, size, A, z):  # type: ignore[no-untyped-def]
    """Make z's first six numbers, those of S - I, E's, and A (3, 3) the adjugate of S.

    Returns c and its two derivatives by A : dS, those of tr E / 3, and e and its two by z . dz.
    """
    _adjugate(S, A)
    J = (S[0, 0] * A[0, 0] + S[0, 1] * A[0, 1] + S[0, 2] * A[0, 2]) / size**3
    below = J * J + 2.0
    more = (1.5 * size * (J * J - 1.0) / below - (z[0] + z[1] + z[2])) / 3.0
    for i in range(3):
        z[i] += more
    first = 3.0 * J / (below * below * size**2)
    second = 3.0 * (2.0 - 3.0 * J * J) / (below**3 * size**5)
    c, slope, bend = _rise((J - GONE) / (FADES - GONE), (FADES - GONE) * size**3)
    q = 0.0
    for n in range(18):
        q += SHARES[n] * z[n] * z[n] / size**2
    e, down, turn = _rise((HUGE - q) / (HUGE - LARGE), (LARGE - HUGE) * 0.5 * size**2)
    return c, slope, bend, first, second, e, down, turn


@njit(**OPTIONS)
def _to_stretch(z, y, A, fades):  # type: ignore[no-untyped-def]
    """From the derivatives y by c e z to those by z and, of the first six, by S."""
    c, slope, _, first, _, e, down, _ = fades
    along = 0.0
    for n in range(18):
        along += y[n] * z[n]
    for n in range(18):
        y[n] = c * e * y[n] + along * c * down * SHARES[n] * z[n]
    trace = y[0] + y[1] + y[2]
    _add_tensor(trace * first + along * slope * e, A, y)
    for i in range(3):
        y[i] -= trace / 3.0


@njit(**OPTIONS)
def _strains(v, U, s, V, l, size, R, S, Y, G, z):  # type: ignore[no-untyped-def]
    """R, S, (tr S - S)^-1 and z of lane l; the rest as `_measures`, G being its A."""
    floor = KINK * size
    for i in range(3):
        for j in range(3):
            r, t, y = 0.0, 0.0, 0.0
            for a in range(3):
                r += U[3 * i + a, l] * V[3 * j + a, l]
                both = V[3 * i + a, l] * V[3 * j + a, l]
                t += both * s[a, l]
                y += both / max(s[(a + 1) % 3, l] + s[(a + 2) % 3, l], floor)
            R[i, j], S[i, j], Y[i, j] = r, t, y
    for n in range(6):
        i, j = _ROWS[n], _COLUMNS[n]
        z[n] = S[i, j] - size if i == j else S[i, j] / _ROOT
    for m in range(4):
        for i in range(3):
            z[6 + 3 * m + i] = R[0, i] * v[3 + m, 0] + R[1, i] * v[3 + m, 1] + R[2, i] * v[3 + m, 2]
    return _measures(S, size, G, z)


@njit(**OPTIONS)
def _turning(z, y, S, Y, T, A, t, w):  # type: ignore[no-untyped-def]
    """w; T becomes the tensor of y, A and t are scratch."""
    _tensor(y, T)
    _product(S, T, A)
    t[:] = 0.0
    _add_axial(A, 1.0, t)
    for m in range(4):
        _add_cross(z[6 + 3 * m : 9 + 3 * m], y[6 + 3 * m : 9 + 3 * m], 1.0, t)
    _times(Y, t, w)


@njit(**OPTIONS)
def _less_cross(T, w, out):  # type: ignore[no-untyped-def]
    """T - [w]."""
    out[:] = T
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[j, k] += w[i]
        out[k, j] -= w[i]


@njit(**OPTIONS)
def _conjugates(R, T, w, y, A, out):  # type: ignore[no-untyped-def]
    """Out (7, 3): R (T - [w]) transposed, R y_m; A is scratch."""
    _less_cross(T, w, A)
    for i in range(3):
        for j in range(3):
            out[j, i] = R[i, 0] * A[0, j] + R[i, 1] * A[1, j] + R[i, 2] * A[2, j]
        for m in range(4):
            out[3 + m, i] = R[i, 0] * y[6 + 3 * m] + R[i, 1] * y[7 + 3 * m] + R[i, 2] * y[8 + 3 * m]


@njit(**OPTIONS)
def _change(  # type: ignore[no-untyped-def]
    dv, R, S, Y, T, w, z, y, K, factor, fades, raw, G, D, A, B, dT, t, turn, dz, dy, dw, out
):
    """Out (7, 3): change of `_conjugates` by dv (7, 3); dz (18,) that of z.

    Without y's own second part where ``factor`` is 0: then the result is positive where K is.
    ``fades`` and G, the adjugate, are of `_measures`; ``raw`` are the derivatives by c e z.
    """
    for i in range(3):
        for j in range(3):
            D[i, j] = R[0, i] * dv[j, 0] + R[1, i] * dv[j, 1] + R[2, i] * dv[j, 2]
    t[:] = 0.0
    _add_axial(D, -1.0, t)
    _times(Y, t, turn)  # the frame turns by R [turn]
    for j in range(3):  # dS = D - [turn] S, column by column
        B[0, j] = D[0, j] - (turn[1] * S[2, j] - turn[2] * S[1, j])
        B[1, j] = D[1, j] - (turn[2] * S[0, j] - turn[0] * S[2, j])
        B[2, j] = D[2, j] - (turn[0] * S[1, j] - turn[1] * S[0, j])
    for n in range(6):
        i, j = _ROWS[n], _COLUMNS[n]
        dz[n] = B[i, j] if i == j else 0.5 * (B[i, j] + B[j, i]) / _ROOT
    c, slope, bend, first, second, e, down, turned = fades
    grown = 0.0
    for i in range(3):
        for j in range(3):
            grown += G[i, j] * B[i, j]
    for i in range(3):
        dz[i] += first * grown - (B[0, 0] + B[1, 1] + B[2, 2]) / 3.0
    for m in range(4):
        part = dz[6 + 3 * m : 9 + 3 * m]
        for i in range(3):
            part[i] = R[0, i] * dv[3 + m, 0] + R[1, i] * dv[3 + m, 1] + R[2, i] * dv[3 + m, 2]
        _add_cross(turn, z[6 + 3 * m : 9 + 3 * m], -1.0, part)
    longer = 0.0
    for n in range(18):
        longer += SHARES[n] * z[n] * dz[n]
    ds = slope * e * grown + c * down * longer
    for n in range(18):
        total = 0.0
        for l in range(18):
            total += K[n, l] * (c * e * dz[l] + ds * z[l])
        dy[n] = total
    along, across = 0.0, 0.0
    for n in range(18):
        along += raw[n] * z[n]
        across += dy[n] * z[n] + factor * raw[n] * dz[n]
    along *= factor
    more = across * c * down + along * (slope * grown * down + c * turned * longer)
    own, less = factor * c * e * (raw[0] + raw[1] + raw[2]), along * c * down
    own += less * SHARES[0] * (z[0] + z[1] + z[2])
    for n in range(18):
        dy[n] = c * e * dy[n] + factor * ds * raw[n] + SHARES[n] * (more * z[n] + less * dz[n])
    trace = dy[0] + dy[1] + dy[2]
    both = trace * first + across * slope * e + own * second * grown
    _add_tensor(both + along * (bend * e * grown + slope * down * longer), G, dy)
    _add_adjugate_change(own * first + along * slope * e, S, B, dy)
    for i in range(3):
        dy[i] -= trace / 3.0
    _tensor(dy, dT)
    t[:] = 0.0
    _product(S, dT, A)
    _add_axial(A, 1.0, t)
    for m in range(4):
        here = slice(6 + 3 * m, 9 + 3 * m)
        _add_cross(z[here], dy[here], 1.0, t)
        _add_cross(dz[here], y[here], factor, t)
    if factor != 0.0:
        _product(B, T, A)
        _add_axial(A, 1.0, t)
        trace = B[0, 0] + B[1, 1] + B[2, 2]
        for i in range(3):
            t[i] -= trace * w[i] - (B[i, 0] * w[0] + B[i, 1] * w[1] + B[i, 2] * w[2])
    _times(Y, t, dw)
    if factor != 0.0:  # R turns: [turn] (T - [w]) and turn x y_m
        _less_cross(T, w, D)
        for j in range(3):
            dT[0, j] += turn[1] * D[2, j] - turn[2] * D[1, j]
            dT[1, j] += turn[2] * D[0, j] - turn[0] * D[2, j]
            dT[2, j] += turn[0] * D[1, j] - turn[1] * D[0, j]
        for m in range(4):
            _add_cross(turn, y[6 + 3 * m : 9 + 3 * m], 1.0, dy[6 + 3 * m : 9 + 3 * m])
    _conjugates(R, dT, dw, dy, A, out)


@njit(**PARALLEL)
def energy_and_forces(u, cells, shapes, sizes, matrices, shift, energy, by_cell):  # type: ignore[no-untyped-def]
    """1/2 z . K z - shift . z of each cell, (C,), and its forces -d/du, (C, 8, 3).

    For displacements u (N, 3), m; shapes (C, 7, 8), a b_k and g_mk; sizes (C,), a, m; matrices
    (C, 18, 18), K, N/m; shift (C, 18), N, or empty.
    """
    count = cells.shape[0]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        begin, end = chunk * CHUNK, min(count, (chunk + 1) * CHUNK)
        F, U, V, N, W, s, _, _ = scratch(CHUNK)
        v, z, y = np.empty((CHUNK, 7, 3)), np.empty(18), np.empty(18)
        R, S, Y = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        T, A, G = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        out, t, w = np.empty((7, 3)), np.empty(3), np.empty(3)
        here = slice(begin, end)
        _frames(u, cells[here], shapes[here], sizes[here], v, F, U, s, V, N, W)
        for c in range(begin, end):
            l = c - begin
            fades = _strains(v[l], U, s, V, l, sizes[c], R, S, Y, G, z)
            total = 0.0
            for n in range(18):
                row = 0.0
                for m in range(18):
                    row += matrices[c, n, m] * z[m]
                row *= fades[0] * fades[5]
                less = shift[c, n] if len(shift) else 0.0
                total += fades[0] * fades[5] * z[n] * (0.5 * row - less)
                y[n] = row - less
            energy[c] = total
            _to_stretch(z, y, G, fades)
            _turning(z, y, S, Y, T, A, t, w)
            _conjugates(R, T, w, y, A, out)
            _spread(out, shapes[c], -1.0, by_cell[c])


@njit(**PARALLEL)
def strains(u, cells, shapes, sizes, out):  # type: ignore[no-untyped-def]
    """Z of each cell, out (C, 18), m."""
    count = cells.shape[0]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        begin, end = chunk * CHUNK, min(count, (chunk + 1) * CHUNK)
        F, U, V, N, W, s, _, _ = scratch(CHUNK)
        v, G = np.empty((CHUNK, 7, 3)), np.empty((3, 3))
        R, S, Y = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        here = slice(begin, end)
        _frames(u, cells[here], shapes[here], sizes[here], v, F, U, s, V, N, W)
        for c in range(begin, end):
            l = c - begin
            fades = _strains(v[l], U, s, V, l, sizes[c], R, S, Y, G, out[c])
            for n in range(18):
                out[c, n] *= fades[0] * fades[5]


@njit(**PARALLEL)
def tangents(u, cells, shapes, sizes, matrices, shift, project, out):  # type: ignore[no-untyped-def]
    """Second derivatives of the same by the amplitudes v (7, 3) of the shapes, (C, 21, 21), N/m.

    ``project`` leaves out what makes them indefinite where K is not.
    """
    count = cells.shape[0]
    factor = 0.0 if project else 1.0
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        begin, end = chunk * CHUNK, min(count, (chunk + 1) * CHUNK)
        F, U, V, N, W, s, _, _ = scratch(CHUNK)
        v, z, y = np.empty((CHUNK, 7, 3)), np.empty(18), np.empty(18)
        R, S, Y = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        T, A, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        D, dT, column = np.empty((3, 3)), np.empty((3, 3)), np.empty((7, 3))
        t, w, turn, dw = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
        dv, dz, dy = np.zeros((7, 3)), np.empty(18), np.empty(18)
        raw, G = np.empty(18), np.empty((3, 3))
        here = slice(begin, end)
        _frames(u, cells[here], shapes[here], sizes[here], v, F, U, s, V, N, W)
        for c in range(begin, end):
            l = c - begin
            fades = _strains(v[l], U, s, V, l, sizes[c], R, S, Y, G, z)
            for n in range(18):
                row = 0.0
                for m in range(18):
                    row += matrices[c, n, m] * z[m]
                y[n] = raw[n] = fades[0] * fades[5] * row - (shift[c, n] if len(shift) else 0.0)
            _to_stretch(z, y, G, fades)
            _turning(z, y, S, Y, T, A, t, w)
            if project:
                y[:] = 0.0
            for a in range(7):
                for i in range(3):
                    dv[a, i] = 1.0
                    _change(
                        dv, R, S, Y, T, w, z, y, matrices[c], factor, fades, raw, G,
                        D, A, B, dT, t, turn, dz, dy, dw, column,
                    )  # fmt: skip
                    dv[a, i] = 0.0
                    for b in range(7):
                        for j in range(3):
                            out[c, 3 * b + j, 3 * a + i] = column[b, j]


@njit(**PARALLEL)
def add_blocks(tangent, shapes, blocks):  # type: ignore[no-untyped-def]
    """Add the tangents (C, 21, 21) to cells' matrices (C, L, L, 3, 3) of nodes."""
    for c in prange(len(shapes)):
        half = np.empty((7, 3, 8, 3))
        for a in range(7):
            for i in range(3):
                for k in range(8):
                    for j in range(3):
                        total = 0.0
                        for b in range(7):
                            total += tangent[c, 3 * a + i, 3 * b + j] * shapes[c, b, k]
                        half[a, i, k, j] = total
        for l in range(8):
            for k in range(8):
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for a in range(7):
                            total += shapes[c, a, l] * half[a, i, k, j]
                        blocks[c, l, k, i, j] += total


@njit(**PARALLEL)
def apply_tangents(x, cells, shapes, tangent, by_cell):  # type: ignore[no-untyped-def]
    """The tangents times x (N, 3), by cell, (C, 8, 3)."""
    for c in prange(cells.shape[0]):
        dv, out = np.empty((7, 3)), np.empty((7, 3))
        _amplitudes(x, cells[c], shapes[c], dv)
        flat, to = dv.reshape(21), out.reshape(21)
        for n in range(21):
            total = 0.0
            for m in range(21):
                total += tangent[c, n, m] * flat[m]
            to[n] = total
        _spread(out, shapes[c], 1.0, by_cell[c])
