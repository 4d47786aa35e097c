"""What is computed at each quadrature point, on tensors (k, C, Q) of Q points in C cells.

Deformation is given by the displacement's gradient H = F - I.  Each function is written for
lists of components; on a GPU it is one kernel (see `pdcorrect.batch.triton_kernels`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial

import torch
from torch import Tensor

from pdcorrect.batch import energies
from pdcorrect.batch.decomposition import nearest_volume, product, signed_svd, transposed
from pdcorrect.batch.triton_kernels import PointFunction, at_points
from pdcorrect.fem.hyperelasticity import COROTATED

Tangent = tuple[Tensor, ...]
"""U (9, C, Q), V (9, C, Q) and the tangent (12, C, Q) in their frame; a batch of cells adds what
its learned elements need."""
Components = list[Tensor]


class Points:
    """Energy densities, stresses and tangents of one energy.

    Parameters
    ----------
    model : int
        See `energy_code`.
    first : int
        Points of a cell below it have no volume term.
    points : int
        Of each cell.
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

    def rotations(self, F: Tensor, moved: bool = False) -> Tensor:
        """Nearest rotations (9, L); the identity where F is not finite.

        Parameters
        ----------
        F : (9, L)
        moved : bool
            Whether F is the gradient H of a displacement.
        """
        finite = torch.nan_to_num(F)[..., None]
        (R,) = computed(_rotation_of_moved if moved else _rotation, [finite], (9,))
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


def _rotation_of_moved(H: Components) -> list[Components]:
    return _rotation(moved(H))


def _rotation(F: Components) -> list[Components]:
    U, _, V = signed_svd(F)
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
    density, t = energies.principal(model, s, _pair(nearest), *weights)
    scaled = [U[3 * i + j] * t[j] for i in range(3) for j in range(3)]
    return [[density], product(scaled, transposed(V))]


def _tangent_of(
    model: int, project: bool, s: Components, weights: Components, *nearest: Components
) -> list[Components]:
    mu, omega = weights
    return [energies.tangent(model, s, _pair(nearest), mu, omega, project)]


def _pair(nearest: Sequence[Components]) -> energies.Nearest:
    if not nearest:
        return None
    v, (k,) = nearest
    return v, k


def _product(U: Components, V: Components, T: Components, D: Components) -> list[Components]:
    return [energies.tangent_product(U, V, T, D)]
