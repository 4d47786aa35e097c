"""Signed SVD and nearest volume-preserving stretch, several matrices at once.

Arrays are lane-ordered: entry (i, l) belongs to matrix l, so that the inner
loops run over neighbouring numbers and compile to SIMD instructions.  A 3x3
matrix is nine rows, row-major.

Signed SVD: F = U diag(s) V^T with det U = det V = +1 and s1 >= s2 >= |s3|; s3
carries the sign of det F.  The nearest rotation is R = U V^T also for inverted
F.  It is unique unless s2 + s3 = 0.

Nearest matrix with unit determinant: V(F) = U diag(v) V^T, where v minimises
|v - s|^2 subject to v1 v2 v3 = 1.  Stationarity gives v_i (v_i - s_i) = k for
one multiplier k and the global minimum has all v_i > 0.  It is found as the
root of v1 v2 v3 = 1 in the unknown v3, with k = v3 (v3 - s3) and
v_i = (s_i + sqrt(s_i^2 + 4 k)) / 2.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from numba import njit
from numba.core.caching import FunctionCache

from pdcorrect.errors import PdcorrectWarning


def _kept() -> bool:
    """Whether compiled kernels can be kept on disk; if not, a `PdcorrectWarning` says so."""
    try:
        FunctionCache(_kept)  # type: ignore[no-untyped-call]
    except RuntimeError:  # no folder that can be written
        warnings.warn(
            "compiled kernels cannot be kept, so every program compiles them anew, which takes "
            "minutes: set NUMBA_CACHE_DIR to a folder that can be written.",
            PdcorrectWarning,
            stacklevel=2,
        )
        return False
    return True


OPTIONS: dict[str, Any] = {
    "cache": _kept(), "error_model": "numpy", "fastmath": {"contract", "nsz"},
    "no_cfunc_wrapper": True,
}  # fmt: skip
"""numba settings of all kernels: IEEE division, fused multiply-add allowed."""

_SWEEPS = 12
_NEWTON_STEPS = 40
_SETTLED = 1e-9
"""Last change of the smallest stretch: its error is of the order of the square."""
_LARGE_VOLUME = 4.0
"""Above this det F the nearest unit-determinant matrix may not be unique."""


@njit(inline="always", **OPTIONS)
def _jacobi(a, b, d):  # type: ignore[no-untyped-def]
    """Cosine, sine and tangent of the rotation that makes [[a, d], [d, b]] diagonal."""
    gap = b - a
    tangent = math.copysign(2.0, gap) * d
    tangent /= abs(gap) + math.sqrt(gap * gap + 4.0 * d * d) + 1e-300
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    return cosine, tangent * cosine, tangent


@njit(inline="always", **OPTIONS)
def _turn(A, p, q, cosine, sine, l):  # type: ignore[no-untyped-def]
    """Turn columns p and q of A in lane l."""
    for i in range(3):
        x, y = A[3 * i + p, l], A[3 * i + q, l]
        A[3 * i + p, l] = cosine * x - sine * y
        A[3 * i + q, l] = sine * x + cosine * y


@njit(inline="always", **OPTIONS)
def _rotate(S, V, p, q, pq, pr, qr):  # type: ignore[no-untyped-def]
    """Jacobi rotation that zeroes entry (p, q) of S = [00 11 22 01 02 12] in every lane."""
    for l in range(S.shape[1]):
        a, b, d, e, f = S[p, l], S[q, l], S[pq, l], S[pr, l], S[qr, l]
        cosine, sine, tangent = _jacobi(a, b, d)
        S[p, l] = a - tangent * d
        S[q, l] = b + tangent * d
        S[pq, l] = 0.0
        S[pr, l] = cosine * e - sine * f
        S[qr, l] = sine * e + cosine * f
        _turn(V, p, q, cosine, sine, l)


@njit(inline="always", **OPTIONS)
def _order(B, V, i, j):  # type: ignore[no-untyped-def]
    """Exchange columns i < j (one negated, so det V stays +1) where column j is longer."""
    for l in range(B.shape[1]):
        own, other = 0.0, 0.0
        for a in range(3):
            own += B[3 * a + i, l] * B[3 * a + i, l]
            other += B[3 * a + j, l] * B[3 * a + j, l]
        swap = other > own
        for a in range(3):
            x, y = B[3 * a + i, l], B[3 * a + j, l]
            B[3 * a + i, l], B[3 * a + j, l] = y if swap else x, -x if swap else y
            x, y = V[3 * a + i, l], V[3 * a + j, l]
            V[3 * a + i, l], V[3 * a + j, l] = y if swap else x, -x if swap else y


@njit(**OPTIONS)
def signed_svd_lanes(F, U, s, V, B, S):  # type: ignore[no-untyped-def]
    """Signed SVD of F (9, L) into U (9, L), s (3, L), V (9, L); B (9, L), S (6, L) are scratch.

    V comes from Jacobi sweeps on F^T F; U from orthonormalising the columns of
    F V, which needs no division by the smallest singular value.
    """
    lanes = F.shape[1]
    for l in range(lanes):
        S[0, l] = F[0, l] * F[0, l] + F[3, l] * F[3, l] + F[6, l] * F[6, l]
        S[1, l] = F[1, l] * F[1, l] + F[4, l] * F[4, l] + F[7, l] * F[7, l]
        S[2, l] = F[2, l] * F[2, l] + F[5, l] * F[5, l] + F[8, l] * F[8, l]
        S[3, l] = F[0, l] * F[1, l] + F[3, l] * F[4, l] + F[6, l] * F[7, l]
        S[4, l] = F[0, l] * F[2, l] + F[3, l] * F[5, l] + F[6, l] * F[8, l]
        S[5, l] = F[1, l] * F[2, l] + F[4, l] * F[5, l] + F[7, l] * F[8, l]
        for i in range(9):
            V[i, l] = 1.0 if i % 4 == 0 else 0.0
    for _ in range(_SWEEPS):
        worst = 0.0
        for l in range(lanes):
            off = S[3, l] * S[3, l] + S[4, l] * S[4, l] + S[5, l] * S[5, l]
            size = S[0, l] + S[1, l] + S[2, l]
            worst = max(worst, off - 1e-32 * size * size)
        if not worst > 0.0:
            break
        _rotate(S, V, 0, 1, 3, 4, 5)
        _rotate(S, V, 0, 2, 4, 3, 5)
        _rotate(S, V, 1, 2, 5, 3, 4)
    for i in range(3):
        for j in range(3):
            for l in range(lanes):
                B[3 * i + j, l] = (
                    F[3 * i, l] * V[j, l]
                    + F[3 * i + 1, l] * V[3 + j, l]
                    + F[3 * i + 2, l] * V[6 + j, l]
                )
    _order(B, V, 0, 1)
    _order(B, V, 0, 2)
    _order(B, V, 1, 2)
    _polish(B, V)
    _order(B, V, 1, 2)
    _orthonormalise(B, V, U, s)


@njit(inline="always", **OPTIONS)
def _polish(B, V):  # type: ignore[no-untyped-def]
    """Make columns 1 and 2 of B orthogonal to their own size, which F^T F cannot resolve."""
    for l in range(B.shape[1]):
        a, b, d = 0.0, 0.0, 0.0
        for i in range(3):
            x, y = B[3 * i + 1, l], B[3 * i + 2, l]
            a, b, d = a + x * x, b + y * y, d + x * y
        cosine, sine, _ = _jacobi(a, b, d)
        _turn(B, 1, 2, cosine, sine, l)
        _turn(V, 1, 2, cosine, sine, l)


@njit(**OPTIONS)
def _orthonormalise(B, V, U, s):  # type: ignore[no-untyped-def]
    """U and s from the (nearly orthogonal, sorted) columns of B = F V."""
    degenerate = False
    for l in range(B.shape[1]):
        x0, x1, x2 = B[0, l], B[3, l], B[6, l]
        first = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        scale = 1.0 / (first + 1e-300)
        x0, x1, x2 = x0 * scale, x1 * scale, x2 * scale
        y0, y1, y2 = B[1, l], B[4, l], B[7, l]
        along = x0 * y0 + x1 * y1 + x2 * y2
        y0, y1, y2 = y0 - along * x0, y1 - along * x1, y2 - along * x2
        second = math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
        degenerate |= not second > 1e-14 * first
        scale = 1.0 / (second + 1e-300)
        y0, y1, y2 = y0 * scale, y1 * scale, y2 * scale
        z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        U[0, l], U[3, l], U[6, l] = x0, x1, x2
        U[1, l], U[4, l], U[7, l] = y0, y1, y2
        U[2, l], U[5, l], U[8, l] = z0, z1, z2
        s[0, l], s[1, l] = first, second
        s[2, l] = z0 * B[2, l] + z1 * B[5, l] + z2 * B[8, l]
    if degenerate:
        for l in range(B.shape[1]):
            if not s[1, l] > 1e-14 * s[0, l]:
                _complete_basis(V, U, s, l)


@njit(**OPTIONS)
def _complete_basis(V, U, s, l):  # type: ignore[no-untyped-def]
    """Rank 0 or 1: the missing left vectors are the right ones, turned as little as needed."""
    if s[0, l] == 0.0:
        for i in range(9):
            U[i, l] = V[i, l]
        s[0, l], s[1, l], s[2, l] = 0.0, 0.0, 0.0
        return
    x, y, length = U[0:9:3, l].copy(), U[0:9:3, l].copy(), 0.0
    for column in range(1, 3):
        if length < 1e-3:
            y = V[column:9:3, l].copy()
            y -= (x[0] * y[0] + x[1] * y[1] + x[2] * y[2]) * x
            length = math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    y /= length
    U[1, l], U[4, l], U[7, l] = y[0], y[1], y[2]
    U[2, l] = x[1] * y[2] - x[2] * y[1]
    U[5, l] = x[2] * y[0] - x[0] * y[2]
    U[8, l] = x[0] * y[1] - x[1] * y[0]
    s[1, l], s[2, l] = 0.0, 0.0


@njit(**OPTIONS)
def nearest_volume_lanes(s, v, k, first):  # type: ignore[no-untyped-def]
    """Nearest stretch of unit volume v (3, L) and multiplier k (L,) for s (3, L).

    Only lanes from ``first`` on are computed.
    """
    lanes = s.shape[1]
    for l in range(first, lanes):
        # near the unit of volume a step of Newton's method for k, from k = 0
        a, b, c = s[0, l], s[1, l], s[2, l]
        volume = a * b * c
        squares = a * a * b * b + (a * a + b * b) * c * c
        guess = c + (1.0 - volume) * a * b / squares
        near = c > 0.5 and volume > 0.5 and volume < 2.0
        v[2, l] = guess if near and guess > 0.2 else 1.0
    for _ in range(_NEWTON_STEPS):
        change = 0.0
        for l in range(first, lanes):
            c = v[2, l]
            kappa = c * (c - s[2, l])
            root_a = math.sqrt(abs(s[0, l] * s[0, l] + 4.0 * kappa))
            root_b = math.sqrt(abs(s[1, l] * s[1, l] + 4.0 * kappa))
            a = 0.5 * (s[0, l] + root_a) + 1e-300
            b = 0.5 * (s[1, l] + root_b) + 1e-300
            # d(abc)/dc = ab + c (dk/dc) (b / root_a + a / root_b)
            slope = a * b + c * (2.0 * c - s[2, l]) * (
                b / (root_a + 1e-300) + a / (root_b + 1e-300)
            )
            step = (a * b * c - 1.0) / slope
            c_new = max(c - step, 0.1 * c)
            change = max(change, abs(c_new - c) - 1e-15 * c)
            v[0, l], v[1, l], v[2, l], k[l] = a, b, c_new, kappa
        if not change > _SETTLED:
            break
    for l in range(first, lanes):
        volume = s[0, l] * s[1, l] * s[2, l]
        if volume > _LARGE_VOLUME:
            c = _smallest_stretch_large(s[0, l], s[1, l], s[2, l])
            v[2, l] = c
        c = v[2, l]
        k[l] = c * (c - s[2, l])
        v[0, l] = 0.5 * (s[0, l] + math.sqrt(max(s[0, l] * s[0, l] + 4.0 * k[l], 0.0)))
        v[1, l] = 0.5 * (s[1, l] + math.sqrt(max(s[1, l] * s[1, l] + 4.0 * k[l], 0.0)))


@njit(**OPTIONS)
def _product_and_cost(c, s1, s2, s3):  # type: ignore[no-untyped-def]
    """v1 v2 v3 - 1 and |v - s|^2 of the stationary family with v3 = c."""
    k = c * (c - s3)
    a = 0.5 * (s1 + math.sqrt(max(s1 * s1 + 4.0 * k, 0.0)))
    b = 0.5 * (s2 + math.sqrt(max(s2 * s2 + 4.0 * k, 0.0)))
    return a * b * c - 1.0, (a - s1) ** 2 + (b - s2) ** 2 + (c - s3) ** 2


@njit(**OPTIONS)
def _smallest_stretch_large(s1, s2, s3):  # type: ignore[no-untyped-def]
    """v3 of the global minimum when det F is large: the better of the outermost roots in (0, s3).

    The product v1 v2 v3 may rise, fall and rise again as v3 grows; its first
    root (v3 small: one direction flattened) and its last one are the local
    minima.  Both are bracketed by walking a grid from either end.
    """
    best, best_cost = 0.0, math.inf
    for side in range(2):
        low, high = 0.0, s3
        for i in range(1, 201):
            c = s3 * i / 200.0 if side == 0 else s3 * (200.0 - i) / 200.0
            value, _ = _product_and_cost(c, s1, s2, s3)
            if side == 0 and value >= 0.0:
                low, high = s3 * (i - 1) / 200.0, c
                break
            if side == 1 and value <= 0.0:
                low, high = c, s3 * (201.0 - i) / 200.0
                break
        for _ in range(100):
            middle = 0.5 * (low + high)
            value, _ = _product_and_cost(middle, s1, s2, s3)
            if value > 0.0:
                high = middle
            else:
                low = middle
        c = 0.5 * (low + high)
        _, cost = _product_and_cost(c, s1, s2, s3)
        if cost < best_cost:
            best, best_cost = c, cost
    return best


@njit(**OPTIONS)
def scratch(lanes):  # type: ignore[no-untyped-def]
    """Work arrays F, U, V, B (9, L), S (6, L), s, v (3, L) and k (L,) for L matrices."""
    F, U, V = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
    B, S = np.empty((9, lanes)), np.empty((6, lanes))
    return F, U, V, B, S, np.empty((3, lanes)), np.empty((3, lanes)), np.empty(lanes)
