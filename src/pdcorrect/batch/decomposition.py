"""Signed SVD and nearest volume-preserving stretch of many matrices, in torch.

The algorithms of `pdcorrect.fem.decomposition` with a fixed number of steps, so that a
compiler can make one kernel of them.  A matrix is a list of nine tensors of one shape,
row-major.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of a symmetric matrix (6) in their order."""
_SWEEPS = {torch.float64: 5, torch.float32: 3}
_VOLUME_STEPS = 8
_UNIT_VOLUME = {torch.float64: 1e-8, torch.float32: 1e-3}
"""Difference of a root's volume from one; where there is no root it is of the order of one."""
LARGE_VOLUME = 4.0
"""Above this det F the nearest unit-determinant matrix may not be unique (see `extreme`)."""
_TINY = {torch.float64: 1e-300, torch.float32: 1e-37}
_RANK = {torch.float64: 1e-14, torch.float32: 1e-6}


def tiny(a: Tensor) -> float:
    """A number that changes nothing but keeps a division finite."""
    return _TINY[a.dtype]


def _diagonal(A: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """Eigenvalues (3) and eigenvectors (9) of a symmetric matrix (6), by Jacobi's sweeps."""
    S, one, zero = list(A), torch.ones_like(A[0]), torch.zeros_like(A[0])
    V = [one, zero, zero, zero, one, zero, zero, zero, one]
    for _ in range(_SWEEPS[one.dtype]):
        _rotate(S, V, 0, 1, 3, 4, 5)
        _rotate(S, V, 0, 2, 4, 3, 5)
        _rotate(S, V, 1, 2, 5, 3, 4)
    return S[:3], V


def _jacobi(gap: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cosine, sine and tangent of the rotation that makes [[a, d], [d, a + gap]] diagonal."""
    tangent = torch.where(gap < 0, -2.0, 2.0) * d
    tangent = tangent / (gap.abs() + torch.sqrt(gap * gap + 4.0 * d * d) + tiny(d))
    cosine = torch.rsqrt(1.0 + tangent * tangent)
    return cosine, tangent * cosine, tangent


def _rotate(S: list[Tensor], V: list[Tensor], p: int, q: int, pq: int, pr: int, qr: int) -> None:
    """Jacobi rotation that zeroes entry (p, q) of S = [00 11 22 01 02 12]."""
    d = S[pq]
    cosine, sine, tangent = _jacobi(S[q] - S[p], d)
    S[p], S[q], S[pq] = S[p] - tangent * d, S[q] + tangent * d, torch.zeros_like(d)
    S[pr], S[qr] = cosine * S[pr] - sine * S[qr], sine * S[pr] + cosine * S[qr]
    _turn(V, p, q, cosine, sine)


def _turn(A: list[Tensor], p: int, q: int, cosine: Tensor, sine: Tensor) -> None:
    for i in (0, 3, 6):
        x, y = A[i + p], A[i + q]
        A[i + p], A[i + q] = cosine * x - sine * y, sine * x + cosine * y


def _order(B: list[Tensor], V: list[Tensor], i: int, j: int) -> None:
    """Exchange columns i < j (one negated, so det V stays +1) where column j is longer."""
    swap = _squares(B, j) > _squares(B, i)
    for A in (B, V):
        for row in (0, 3, 6):
            x, y = A[row + i], A[row + j]
            A[row + i], A[row + j] = torch.where(swap, y, x), torch.where(swap, -x, y)


def _squares(B: list[Tensor], j: int) -> Tensor:
    return B[j] * B[j] + B[3 + j] * B[3 + j] + B[6 + j] * B[6 + j]


def signed_svd(F: list[Tensor]) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """U (9), s (3), V (9) with F = U diag(s) V^T, both rotations proper, s1 >= s2 >= |s3|."""
    _, V = _diagonal([F[a] * F[b] + F[3 + a] * F[3 + b] + F[6 + a] * F[6 + b] for a, b in _UPPER])
    B = product(F, V)
    _order(B, V, 0, 1)
    _order(B, V, 0, 2)
    _order(B, V, 1, 2)
    _polish(B, V)
    _order(B, V, 1, 2)
    return _orthonormalise(B, V)


def _polish(B: list[Tensor], V: list[Tensor]) -> None:
    """Make columns 1 and 2 of B orthogonal to their own size, which F^T F cannot resolve."""
    gap = _squares(B, 2) - _squares(B, 1)
    cosine, sine, _ = _jacobi(gap, B[1] * B[2] + B[4] * B[5] + B[7] * B[8])
    for A in (B, V):
        _turn(A, 1, 2, cosine, sine)


def _orthonormalise(
    B: list[Tensor], V: list[Tensor]
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """U and s from the (nearly orthogonal, sorted) columns of B = F V."""
    small = tiny(B[0])
    first = torch.sqrt(_squares(B, 0))
    x = [B[i] / (first + small) for i in (0, 3, 6)]
    for k in range(3):  # no matrix at all: U = V
        x[k] = torch.where(first > 0, x[k], V[3 * k])
    y = [B[i] for i in (1, 4, 7)]
    y = _less(y, x)
    second = torch.sqrt(_dot(y, y))
    flat = second <= _RANK[B[0].dtype] * first
    y = [a / (second + small) for a in y]
    # rank 0 or 1: the missing left vectors are the right ones, turned as little as needed
    near = _less([V[i] for i in (1, 4, 7)], x)
    far = _less([V[i] for i in (2, 5, 8)], x)
    use_far = _dot(near, near) < 1e-6
    spare = [torch.where(use_far, b, a) for a, b in zip(near, far, strict=True)]
    scale = torch.rsqrt(_dot(spare, spare) + small)
    y = [torch.where(flat, scale * b, a) for a, b in zip(y, spare, strict=True)]
    z = [
        x[1] * y[2] - x[2] * y[1],
        x[2] * y[0] - x[0] * y[2],
        x[0] * y[1] - x[1] * y[0],
    ]
    third = z[0] * B[2] + z[1] * B[5] + z[2] * B[8]
    zero = torch.zeros_like(first)
    s = [first, torch.where(flat, zero, second), torch.where(flat, zero, third)]
    U = [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]]
    return U, s, V


def _dot(x: list[Tensor], y: list[Tensor]) -> Tensor:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _less(y: list[Tensor], x: list[Tensor]) -> list[Tensor]:
    """Y without its part along the unit vector x."""
    along = _dot(x, y)
    return [b - along * a for a, b in zip(x, y, strict=True)]


def product(A: list[Tensor], B: list[Tensor]) -> list[Tensor]:
    """A B."""
    return [
        A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j]
        for i in range(3)
        for j in range(3)
    ]


def transposed(A: list[Tensor]) -> list[Tensor]:
    """A^T."""
    return [A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]]


def positive_part(A: list[Tensor]) -> list[Tensor]:
    """A symmetric matrix (6), 00 11 22 01 02 12, with its negative eigenvalues raised to zero."""
    values, V = _diagonal(A)
    values = [torch.clamp(x, min=0.0) for x in values]
    return [
        values[0] * V[3 * i] * V[3 * j]
        + values[1] * V[3 * i + 1] * V[3 * j + 1]
        + values[2] * V[3 * i + 2] * V[3 * j + 2]
        for i, j in _UPPER
    ]


def nearest_volume(s: list[Tensor]) -> tuple[list[Tensor], Tensor]:
    """Nearest stretch of unit volume v (3) and multiplier k for s (3).

    Where det F exceeds `LARGE_VOLUME` there may be two candidates: the root next to s, and
    one with the third direction flattened.  Either may be missing.
    """
    near = _volume_root(s, _first_stretch(s))
    v, k, cost = _stretches(s, near)
    flat = _volume_root(s, _first_flattened(s))
    w, other, flat_cost = _stretches(s, flat)
    use = (s[0] * s[1] * s[2] > LARGE_VOLUME) & (flat_cost < cost)
    chosen = [torch.where(use, b, a) for a, b in zip(v, w, strict=True)]
    return chosen, torch.where(use, other, k)


def _first_stretch(s: list[Tensor]) -> Tensor:
    """A bound above the root v3 next to s3.

    From there Newton's method converges monotonically: the volume is convex in v3 above
    s3 / 2.  The bounds follow from v1 >= v2 >= v3, and v1 >= s1 where s is to expand, else
    v1 >= s1 / 2 and v3 <= s3.
    """
    a, b, c = s
    one, small = torch.ones_like(c), tiny(c)
    expand = torch.minimum(torch.rsqrt(a + small), 1.0 / (a * b + small))
    shrink = torch.minimum(torch.sqrt(2.0 / (a + small)), c)
    return torch.minimum(torch.where(a * b * c > 1.0, shrink, expand), one)


def _first_flattened(s: list[Tensor]) -> Tensor:
    """The smaller v3 of unit volume where s2 = s3 and s1 is much larger; 1 for small volumes."""
    volume = s[0] * s[1] * s[2]
    large = volume > LARGE_VOLUME
    share = torch.sqrt(torch.clamp(1.0 - 4.0 / torch.where(large, volume, 4.0), min=0.0))
    return torch.where(large, 0.5 * s[2] * (1.0 - share), 1.0)


def _volume_root(s: list[Tensor], c: Tensor) -> Tensor:
    """Newton's method for v3 of v1 v2 v3 = 1."""
    small = tiny(c)
    for _ in range(_VOLUME_STEPS):
        kappa = c * (c - s[2])
        root_a = torch.sqrt((s[0] * s[0] + 4.0 * kappa).abs())
        root_b = torch.sqrt((s[1] * s[1] + 4.0 * kappa).abs())
        a, b = 0.5 * (s[0] + root_a) + small, 0.5 * (s[1] + root_b) + small
        slope = a * b + c * (2.0 * c - s[2]) * (b / (root_a + small) + a / (root_b + small))
        c = torch.maximum(c - (a * b * c - 1.0) / slope, 0.1 * c)
    return c


def _stretches(s: list[Tensor], c: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
    """Of the stationary family with v3 = c: v, the multiplier and |v - s|^2.

    The last is infinite where the volume is not one.
    """
    k = c * (c - s[2])
    a = 0.5 * (s[0] + torch.sqrt(torch.clamp(s[0] * s[0] + 4.0 * k, min=0.0)))
    b = 0.5 * (s[1] + torch.sqrt(torch.clamp(s[1] * s[1] + 4.0 * k, min=0.0)))
    cost = (a - s[0]) ** 2 + (b - s[1]) ** 2 + (c - s[2]) ** 2
    unit = (a * b * c - 1.0).abs() < _UNIT_VOLUME[c.dtype]
    return [a, b, c], k, torch.where(unit, cost, math.inf)
