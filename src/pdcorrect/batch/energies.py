"""Energy densities, stresses and tangents in torch, as `pdcorrect.fem.energies` has them."""

from __future__ import annotations

import torch
from torch import Tensor

from pdcorrect.batch.decomposition import positive_part, product, tiny, transposed
from pdcorrect.fem.hyperelasticity import COROTATED, NEO_HOOKEAN

_KINK = 1e-9
_PAIRS = ((0, 1), (0, 2), (1, 2))


Nearest = tuple[list[Tensor], Tensor] | None
"""The nearest stretch of unit volume and its multiplier; None without a volume term."""


def principal(
    model: int, s: list[Tensor], nearest: Nearest, mu: Tensor, omega: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Psi and the principal stresses (3) for stretches s (3) and the weights of both terms."""
    e = [x - 1.0 for x in s]
    if model == COROTATED:
        density = mu * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
        t = [2.0 * mu * x for x in e]
        if nearest is not None:
            v, k = nearest
            g = [k / x for x in v]
            density = density + 0.5 * omega * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            t = [a - omega * b for a, b in zip(t, g, strict=True)]
        return density, t
    lam = omega / 3.0
    if model == NEO_HOOKEAN:
        pairs = e[0] * e[1] + e[1] * e[2] + e[2] * e[0]
        triple = e[0] * e[1] * e[2]
        change = e[0] + e[1] + e[2] + pairs + triple
        rest = 0.5 * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) - pairs - triple
        density = mu * rest + 0.5 * (mu + lam) * change * change
        q = (mu + lam) * change - mu
        t = [mu * s[i] + q * s[(i + 1) % 3] * s[(i + 2) % 3] for i in range(3)]
        return density, t
    x = [a + 0.5 * a * a for a in e]
    trace = x[0] + x[1] + x[2]
    density = mu * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]) + 0.5 * lam * trace * trace
    return density, [a * (2.0 * mu * b + lam * trace) for a, b in zip(s, x, strict=True)]


def tangent(
    model: int,
    s: list[Tensor],
    nearest: Nearest,
    mu: Tensor,
    omega: Tensor,
    project: bool = False,
) -> list[Tensor]:
    """The tangent (12) in the frame of the SVD; ``project`` raises negative eigenvalues to zero.

    The diagonal block 00 11 22 01 02 12; then for the pairs 01 02 12 the factors p and m
    of P_ij = p F_ij + m F_ji.
    """
    T = _corotated(s, nearest, mu, omega) if model == COROTATED else _other(model, s, mu, omega)
    if project:
        T = [*positive_part(T[:6]), *(torch.clamp(x, min=0.0) for x in T[6:])]
    for pair in range(3):
        symmetric, antisymmetric = T[6 + pair], T[9 + pair]
        T[6 + pair] = 0.5 * (symmetric + antisymmetric)
        T[9 + pair] = 0.5 * (symmetric - antisymmetric)
    return T


def _corotated(s: list[Tensor], nearest: Nearest, mu: Tensor, omega: Tensor) -> list[Tensor]:
    zero = torch.zeros_like(s[0])
    twice = 2.0 * mu + zero
    T = [twice, twice, twice, zero, zero, zero, twice, twice, twice]
    apart = []
    for a, b in _PAIRS:
        total = s[a] + s[b]
        apart.append(total > _KINK * (s[0] + tiny(s[0])))
        quotient = 2.0 * mu * (total - 2.0) / torch.where(apart[-1], total, 1.0)
        T.append(torch.where(apart[-1], quotient, zero))
    if nearest is None:
        return T
    v, k = nearest
    d = [2.0 * a - b for a, b in zip(v, s, strict=True)]
    total = d[1] * d[2] / v[0] + d[0] * d[2] / v[1] + d[0] * d[1] / v[2]
    regular = total.abs() > _KINK * (v[0] + v[1] + v[2])
    scale = omega / torch.where(regular, total, 1.0)
    scale, whole = torch.where(regular, scale, zero), torch.where(regular, omega + zero, zero)
    T[0] = T[0] + whole - scale * v[0] * (d[1] / v[2] + d[2] / v[1])
    T[1] = T[1] + whole - scale * v[1] * (d[0] / v[2] + d[2] / v[0])
    T[2] = T[2] + whole - scale * v[2] * (d[0] / v[1] + d[1] / v[0])
    T[3], T[4], T[5] = scale * d[2], scale * d[1], scale * d[0]
    for pair, (a, b) in enumerate(_PAIRS):
        vv = v[a] * v[b]
        less = torch.where(apart[pair], vv - k, 1.0)
        T[9 + pair] = T[9 + pair] - torch.where(apart[pair], omega * k / less, zero)
        plus = (vv + k).abs() > _KINK * vv
        more = omega * k / torch.where(plus, vv + k, 1.0)
        T[6 + pair] = T[6 + pair] + torch.where(plus, more, zero)
    return T


def _other(model: int, s: list[Tensor], mu: Tensor, omega: Tensor) -> list[Tensor]:
    lam = omega / 3.0
    change = s[0] * s[1] * s[2] - 1.0
    trace = 0.5 * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2] - 3.0)
    q = (mu + lam) * change - mu
    diagonal, off, symmetric, antisymmetric = [], [], [], []
    for i in range(3):
        x, y, z = s[i], s[(i + 1) % 3], s[(i + 2) % 3]
        if model == NEO_HOOKEAN:
            diagonal.append(mu + (mu + lam) * y * y * z * z)
        else:
            diagonal.append(mu * (3.0 * x * x - 1.0) + lam * (x * x + trace))
    for a, b in _PAIRS:
        x, y, z = s[a], s[b], s[3 - a - b]
        if model == NEO_HOOKEAN:
            off.append((mu + lam) * x * y * z * z + q * z)
            symmetric.append(mu - q * z)
            antisymmetric.append(mu + q * z)
        else:
            both = x * x + y * y - 1.0
            off.append(lam * x * y)
            symmetric.append(lam * trace + mu * (both + x * y))
            antisymmetric.append(lam * trace + mu * (both - x * y))
    return [*diagonal, *off, *symmetric, *antisymmetric]


def tangent_product(
    U: list[Tensor], V: list[Tensor], T: list[Tensor], D: list[Tensor]
) -> list[Tensor]:
    """Tangent : D (9), for U and V of the SVD and what `tangent` returned."""
    A = product(product(transposed(U), D), V)
    x, y, z = A[0], A[4], A[8]
    A[0] = T[0] * x + T[3] * y + T[4] * z
    A[4] = T[3] * x + T[1] * y + T[5] * z
    A[8] = T[4] * x + T[5] * y + T[2] * z
    for pair, (i, j) in enumerate(_PAIRS):
        x, y = A[3 * i + j], A[3 * j + i]
        A[3 * i + j] = T[6 + pair] * x + T[9 + pair] * y
        A[3 * j + i] = T[6 + pair] * y + T[9 + pair] * x
    return product(product(U, A), transposed(V))
