"""What is computed in each cell of a learned element, see `pdcorrect.fem.turned_strains`.

Functions of lists of components, each one kernel on a GPU: 3x3 matrices row by row, the 18 numbers
z, amplitudes v (7, 3) of the cell's shapes, and eight numbers of how z fades: c and its first two
derivatives, those of tr E / 3, and e and its first two derivatives.  All lengths are times the
cell's size.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pdcorrect.batch.decomposition import product, signed_svd, transposed
from pdcorrect.batch.points import Components, moved
from pdcorrect.fem.turned_strains import FADES, GONE, HUGE, KINK, LARGE, SHARES

_ROOT = math.sqrt(0.5)
_SHEARS = ((1, 2), (2, 0), (0, 1))
_SHARES = [float(x) for x in SHARES]


def frame(v: Components, size: Components) -> list[Components]:
    """R, S, (tr S - S)^-1, S's adjugate, z before it fades, how it fades, and what is left of z."""
    (a,) = size
    U, s, V = signed_svd(moved([v[3 * j + i] / a for i in range(3) for j in range(3)]))
    sums = [torch.clamp(s[(i + 1) % 3] + s[(i + 2) % 3], min=KINK) for i in range(3)]
    R, S = product(U, transposed(V)), [a * x for x in _with_values(V, s)]
    inverse = [x / a for x in _with_values(V, [1.0 / x for x in sums])]
    A = _adjugate(S)
    J = _sum(S, A) / (3.0 * a * a * a)
    below = J * J + 2.0
    mean = (1.5 * a * (J * J - 1.0) / below - _trace(S)) / 3.0
    turned = [_dot(v[9 + 3 * m : 12 + 3 * m], R[i::3]) for m in range(4) for i in range(3)]
    z = [*_mandel(_plus_diagonal(S, mean)), *turned]
    q = _weighted(z, z) / (a * a)
    c = _rise((J - GONE) / (FADES - GONE), (FADES - GONE) * a * a * a)
    e = _rise((HUGE - q) / (HUGE - LARGE), (LARGE - HUGE) * 0.5 * a * a)
    first = 3.0 * J / (below * below * a * a)
    second = 3.0 * (2.0 - 3.0 * J * J) / (below * below * below * a * a * a * a * a)
    left = [c[0] * e[0] * x for x in z]
    return [R, S, inverse, A, z, [*c, first, second, *e], left]


def derivatives(
    R: Components, S: Components, inverse: Components, A: Components, z: Components,
    fades: Components, raw: Components,
) -> list[Components]:  # fmt: skip
    """Those by S and z's vectors (18), w, and those by v (21), from those by what is left of z."""
    c, slope, _, first, _, e, down, _ = fades
    along = _sum(raw, z)
    y = [c * e * r + along * c * down * w * x for r, x, w in zip(raw, z, _SHARES, strict=True)]
    trace = y[0] + y[1] + y[2]
    factor = trace * first + along * slope * e
    y = _added(y, [factor * x for x in A], trace)
    w = _applied(inverse, _torque(S, _tensor(y), z, y))
    return [y, w, _conjugates(R, _tensor(y), w, y)]


def rates(
    R: Components, S: Components, inverse: Components, A: Components, z: Components,
    fades: Components, dv: Components,
) -> list[Components]:  # fmt: skip
    """Changes of z and S, adjugate : dS, how the frame turns, and the change of what is left."""
    c, slope, _, first, _, e, down, _ = fades
    columns = [dv[0:3], dv[3:6], dv[6:9]]
    D = [_dot(R[i::3], column) for i in range(3) for column in columns]
    turn = _applied(inverse, [-x for x in _axial(D)])
    dS = [x - y for x, y in zip(D, _cross_columns(turn, S), strict=True)]
    grown = _sum(A, dS)
    dE = _plus_diagonal(dS, first * grown - _trace(dS) / 3.0)
    dh: Components = []
    for m in range(3, 7):
        own = [_dot(dv[3 * m : 3 * m + 3], R[i::3]) for i in range(3)]
        h = z[3 * m - 3 : 3 * m]
        dh += [x - y for x, y in zip(own, _cross(turn, h), strict=True)]
    dz = [*_mandel(dE), *dh]
    share = slope * e * grown + c * down * _weighted(z, dz)
    return [dz, dS, [grown], turn, [c * e * x + share * y for x, y in zip(dz, z, strict=True)]]


def changes(
    R: Components, S: Components, inverse: Components, A: Components, z: Components,
    fades: Components, raw: Components, y: Components, w: Components, dz: Components,
    dS: Components, grew: Components, turn: Components, more_raw: Components,
) -> list[Components]:  # fmt: skip
    """Change (21) of the derivatives by v: ``more_raw`` of those by what is left of z."""
    c, slope, bend, first, second, e, down, turned = fades
    (grown,) = grew
    longer, along = _weighted(z, dz), _sum(raw, z)
    across = _sum(more_raw, z) + _sum(raw, dz)
    ds = slope * e * grown + c * down * longer
    less = along * c * down
    more = across * c * down + along * (slope * grown * down + c * turned * longer)
    dy = [
        c * e * p + ds * r + share * (more * x + less * d)
        for p, r, x, d, share in zip(more_raw, raw, z, dz, _SHARES, strict=True)
    ]
    own = c * e * (raw[0] + raw[1] + raw[2])
    own = own + less * (_SHARES[0] * z[0] + _SHARES[1] * z[1] + _SHARES[2] * z[2])
    trace = dy[0] + dy[1] + dy[2]
    most = trace * first + across * slope * e + own * second * grown
    most = most + along * (bend * e * grown + slope * down * longer)
    factor = own * first + along * slope * e
    bent = _adjugates(S, dS)
    dy = _added(dy, [most * a + factor * b for a, b in zip(A, bent, strict=True)], trace)
    T = _tensor(y)
    torque = [
        a + b for a, b in zip(_torque(S, _tensor(dy), z, dy), _torque(dS, T, dz, y), strict=True)
    ]
    total, back = _trace(dS), _applied(dS, w)
    torque = [t - total * a + b for t, a, b in zip(torque, w, back, strict=True)]
    dT = [a + b for a, b in zip(_tensor(dy), _cross_columns(turn, _without(T, w)), strict=True)]
    vectors: Components = []
    for m in (6, 9, 12, 15):
        vectors += [a + b for a, b in zip(dy[m : m + 3], _cross(turn, y[m : m + 3]), strict=True)]
    return [_conjugates(R, dT, _applied(inverse, torque), [*dy[:6], *vectors])]


def _rise(t: Tensor, width: Tensor) -> Components:
    """From 0 at t = 0 to 1 at t = 1, and its first two derivatives by ``width`` times t."""
    t = torch.clamp(t, min=0.0)
    t = torch.where(t > 1.0, torch.ones_like(t), t)
    rest = 1.0 - t
    first = 30.0 * t * t * rest * rest / width
    second = 60.0 * t * rest * (1.0 - 2.0 * t) / (width * width)
    return [t * t * t * (10.0 - 15.0 * t + 6.0 * t * t), first, second]


def _sum(a: Components, b: Components) -> Tensor:
    """Sum of the products."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def _weighted(a: Components, b: Components) -> Tensor:
    """Sum of the products of two z, times `SHARES`."""
    return _SHARES[0] * _sum(a[:6], b[:6]) + _sum(a[6:], b[6:])


def _plus(a: Components, b: Components) -> Components:
    return [x + y for x, y in zip(a, b, strict=True)]


def _dot(a: Components, b: Components) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Components, b: Components) -> Components:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _applied(A: Components, x: Components) -> Components:
    """A x."""
    return [_dot(A[3 * i : 3 * i + 3], x) for i in range(3)]


def _trace(A: Components) -> Tensor:
    return A[0] + A[4] + A[8]


def _plus_diagonal(A: Components, x: Tensor) -> Components:
    """A + x I."""
    return [a + x if i in (0, 4, 8) else a for i, a in enumerate(A)]


def _with_values(V: Components, d: Components) -> Components:
    """V diag(d) V^T."""
    scaled = [x * d[i % 3] for i, x in enumerate(V)]
    return product(scaled, transposed(V))


def _axial(A: Components) -> Components:
    """e_ijk A_jk."""
    return [A[5] - A[7], A[6] - A[2], A[1] - A[3]]


def _cross_columns(a: Components, A: Components) -> Components:
    """[a] A."""
    columns = [_cross(a, A[j::3]) for j in range(3)]
    return [columns[j][i] for i in range(3) for j in range(3)]


def _without(T: Components, w: Components) -> Components:
    """T - [w]."""
    return [
        T[0], T[1] + w[2], T[2] - w[1],
        T[3] - w[2], T[4], T[5] + w[0],
        T[6] + w[1], T[7] - w[0], T[8],
    ]  # fmt: skip


def _mandel(A: Components) -> Components:
    """Mandel's notation (6) of A's symmetric part."""
    shears = [_ROOT * (A[3 * i + j] + A[3 * j + i]) for i, j in _SHEARS]
    return [A[0], A[4], A[8], *shears]


def _tensor(y: Components) -> Components:
    """The reverse, of the first six."""
    yz, zx, xy = (_ROOT * x for x in y[3:6])
    return [y[0], xy, zx, xy, y[1], yz, zx, yz, y[2]]


def _added(y: Components, tensor: Components, trace: Tensor) -> Components:
    """Y with a tensor more, less a third of a trace."""
    more = _mandel(_plus_diagonal(tensor, -trace / 3.0))
    return [*_plus(y[:6], more), *y[6:]]


def _adjugate(S: Components) -> Components:
    """Of a symmetric matrix."""
    a, b, c, d, e, f = S[0], S[4], S[8], S[5], S[2], S[1]
    xy, zx, yz = d * e - c * f, d * f - b * e, e * f - a * d
    return [b * c - d * d, xy, zx, xy, a * c - e * e, yz, zx, yz, a * b - f * f]


def _adjugates(A: Components, B: Components) -> Components:
    """Change of A's adjugate by B, both symmetric."""
    both = product(A, B)
    a, b = _trace(A), _trace(B)
    change = [
        both[i] + both[j] - a * B[i] - b * A[i] for i, j in enumerate((0, 3, 6, 1, 4, 7, 2, 5, 8))
    ]
    return _plus_diagonal(change, a * b - _trace(both))


def _torque(S: Components, T: Components, h: Components, y: Components) -> Components:
    """The axial vector of S T, and the sum of the vectors' h x y."""
    total = _axial(product(S, T))
    for m in (6, 9, 12, 15):
        total = _plus(total, _cross(h[m : m + 3], y[m : m + 3]))
    return total


def _conjugates(R: Components, T: Components, w: Components, y: Components) -> Components:
    """R (T - [w]) transposed, then R y_m, (7, 3)."""
    first = transposed(product(R, _without(T, w)))
    return [*first, *(x for m in (6, 9, 12, 15) for x in _applied(R, y[m : m + 3]))]
