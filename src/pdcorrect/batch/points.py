"""What is computed at each quadrature point, on tensors (k, C, Q) of Q points in C cells.

Deformation is given by the displacement's gradient H = F - I.  Each function is written for
lists of components; on a GPU it is one kernel (see `pdcorrect.batch.triton_kernels`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial

import torch
from torch import Tensor

from pdcorrect.batch.decomposition import (
    nearest_volume,
    positive_part,
    product,
    signed_svd,
    tiny,
    transposed,
)
from pdcorrect.batch.triton_kernels import PointFunction, at_points
from pdcorrect.fem.hyperelasticity import COROTATED, ENERGIES

Tangent = tuple[Tensor, ...]
"""U (9, C, Q), V (9, C, Q) and the tangent (12, C, Q) in their frame; a batch of cells adds what
its learned elements need."""
Components = list[Tensor]


class Points:
    """Energy densities, stresses and tangents of one energy, see `energy_code`.

    Of a cell's ``points`` those below the ``first`` have no volume term.
    """

    def __init__(self, model: int, first: int, points: int) -> None:
        self._model, self._first, self._points = model, first, points

    def stress(self, H: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Psi (C, Q) and P (9, C, Q) for H (9, C, Q) and the weights of both terms (2, C, Q)."""
        U, s, V = computed(_decompose, [H], (9, 3, 9))
        known = [U, s, V, weights, *self._nearest(s)]
        density, P = computed(_stress(self._model), known, (1, 9), cell_by_cell=True)
        return density[0], P

    def tangent(self, H: Tensor, weights: Tensor, project: bool = False) -> Tangent:
        """The derivative of P; ``project`` makes it positive semi-definite."""
        U, s, V = computed(_decompose, [H], (9, 3, 9))
        known = [s, weights, *self._nearest(s)]
        (T,) = computed(_tangent(self._model, project), known, (12,))
        return U, V, T

    def product(self, tangent: Tangent, D: Tensor) -> Tensor:
        """Tangent times D (9, C, Q)."""
        (out,) = computed(_product, [*tangent, D], (9,), cell_by_cell=True)
        return out

    def rotations(self, H: Tensor) -> Tensor:
        """Nearest rotations (9, L) of I + H; the identity where H is not finite."""
        (R,) = computed(_rotation, [torch.nan_to_num(H)[..., None]], (9,))
        return R[..., 0]

    def volume_ratios(self, H: Tensor) -> Tensor:
        """Det F (C, Q) of H (9, C, Q)."""
        (out,) = computed(_volume_ratio, [H], (1,))
        return out[0]

    def _nearest(self, s: Tensor) -> list[Tensor]:
        """Nearest volume-preserving stretches v (3, C, Q) and k (1, C, Q), if there is a term.

        Where only the last points of a cell have one the others are as if neither stretched nor
        stressed.
        """
        if self._model != COROTATED or self._first >= self._points:
            return []
        if not self._first:
            return computed(_nearest, [s], (3, 1))
        v, k = torch.ones_like(s), torch.zeros_like(s[:1])
        found = computed(_nearest, [s[..., self._first :]], (3, 1))
        v[..., self._first :], k[..., self._first :] = found
        return [v, k]


def deformation(rows: Tensor, gradients: Tensor) -> Tensor:
    """Displacement gradients (9, B C, Q) of cells, on a GPU.

    ``rows`` (B, C, 3, L) are displacements, ``gradients`` (B, L, 3 Q), or (B, C, L, 3 Q), those of
    shape functions.  One kernel: matrix libraries are made for larger products.
    """
    scenes, cells = rows.shape[:2]
    *several, width, _ = gradients.shape
    by_function = gradients.reshape(*several, 3 * width, -1)
    if gradients.ndim == 3:
        by_function = by_function[:, None].expand(-1, cells, -1, -1)
    points = by_function.shape[-1]
    u = rows.flatten(2)[..., None].expand(-1, -1, -1, points)
    out = rows.new_empty(9, scenes, cells, points)
    at_points(_gradient, [u.movedim(2, 0), by_function.movedim(2, 0)], [out])
    return out.flatten(1, 2)


def _gradient(u: Components, gradients: Components) -> list[Components]:
    """H of displacements (3, L) and gradients (L, 3)."""
    width = len(u) // 3
    H: Components = []
    for i in range(3):
        for j in range(3):
            total = u[i * width] * gradients[j]
            for k in range(1, width):
                total = total + u[i * width + k] * gradients[3 * k + j]
            H.append(total)
    return [H]


def computed(
    function: PointFunction, inputs: list[Tensor], sizes: Sequence[int], cell_by_cell: bool = False
) -> list[Tensor]:
    """Results (k, C, Q) of ``sizes`` k; in memory (C, k, Q) if ``cell_by_cell``."""
    first = inputs[0]
    if not first.is_cuda:
        found = function(*(list(x.unbind()) for x in inputs))
        axis = 1 if cell_by_cell else 0
        return [torch.stack(list(x), dim=axis).movedim(axis, 0) for x in found]
    out = _room(first, sizes, cell_by_cell)
    at_points(function, inputs, out)
    return out


def _room(x: Tensor, sizes: Sequence[int], cell_by_cell: bool) -> list[Tensor]:
    """Tensors (k, C, Q) for results at the points of x."""
    _, cells, points = x.shape
    if cell_by_cell:
        return [x.new_empty(cells, k, points).transpose(0, 1) for k in sizes]
    return [x.new_empty(k, cells, points) for k in sizes]


def moved(H: Components) -> Components:
    """F = I + H."""
    return [h + 1.0 if i in (0, 4, 8) else h for i, h in enumerate(H)]


def _volume_ratio(H: Components) -> list[Components]:
    a, b, c, d, e, f, g, h, i = moved(H)
    return [[a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)]]


def _decompose(H: Components) -> tuple[Components, Components, Components]:
    return signed_svd(moved(H))


def _rotation(H: Components) -> list[Components]:
    U, _, V = signed_svd(moved(H))
    return [product(U, transposed(V))]


def _nearest(s: Components) -> list[Components]:
    v, k = nearest_volume(s)
    return [v, [k]]


@cache
def _stress(model: int) -> PointFunction:
    """The same object for the same model, see `at_points`."""
    return partial(_stress_of, model)


@cache
def _tangent(model: int, project: bool) -> PointFunction:
    return partial(_tangent_of, model, project)


def _stress_of(
    model: int,
    U: Components,
    s: Components,
    V: Components,
    weights: Components,
    *nearest: Components,
) -> list[Components]:
    """Psi, and P row by row."""
    density, t = principal_stress(model, s, nearest, *weights)
    scaled = [U[3 * i + j] * t[j] for i in range(3) for j in range(3)]
    return [[density], product(scaled, transposed(V))]


def _tangent_of(
    model: int, project: bool, s: Components, weights: Components, *nearest: Components
) -> list[Components]:
    mu, omega = weights
    return [principal_tangent(model, s, nearest, mu, omega, project)]


def _product(U: Components, V: Components, T: Components, D: Components) -> list[Components]:
    return [tangent_product(U, V, T, D)]


# --- energies, see `pdcorrect.fem.energies` ---------------------------------------------------

_KINK = 1e-9
_PAIRS = ((0, 1), (0, 2), (1, 2))


Nearest = Sequence[Components]
"""The nearest stretch of unit volume (3) and its multiplier (1); nothing without a volume term."""


def principal_stress(
    model: int, s: list[Tensor], nearest: Nearest, mu: Tensor, omega: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Psi and the principal stresses (3) for stretches s (3) and the weights of both terms."""
    e = [x - 1.0 for x in s]
    if model == COROTATED:
        density = mu * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
        t = [2.0 * mu * x for x in e]
        if nearest:
            v, (k,) = nearest
            g = [k / x for x in v]
            density = density + 0.5 * omega * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            t = [a - omega * b for a, b in zip(t, g, strict=True)]
        return density, t
    stress, _ = ENERGIES[model]
    density, t = stress(s, mu, omega / 3.0)
    return density, list(t)


def principal_tangent(
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
    if model == COROTATED:
        T = _corotated(s, nearest, mu, omega)
    else:
        _, tangent = ENERGIES[model]
        T = list(tangent(s, mu, omega / 3.0))
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
    if not nearest:
        return T
    v, (k,) = nearest
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
