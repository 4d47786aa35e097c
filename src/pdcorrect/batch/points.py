"""What is computed at each quadrature point, on tensors (k, M) of M points.

Compiled, each function is one kernel for any number of points.  The decomposition, which
is the most of it, is a function of its own, so that it is compiled once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pdcorrect.batch import energies
from pdcorrect.batch.decomposition import nearest_volume, product, signed_svd, transposed
from pdcorrect.batch.fused import as_kernel
from pdcorrect.fem.hyperelasticity import COROTATED

Tangent = tuple[Tensor, Tensor, Tensor]
"""U (9, M), V (9, M) and the tangent (12, M) in their frame."""


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
    compiled : bool
    """

    def __init__(self, model: int, first: int, points: int, compiled: bool) -> None:
        self._model, self._first, self._points = model, first, points
        self._compiled = compiled

    def stress(self, F: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Psi (M,) and P (9, M) for F (9, M) and the weights of both terms (2, M)."""
        U, s, V = self.decomposed(F)
        v, k = self._nearest(s)
        out: tuple[Tensor, Tensor] = self._call(_stress)(self._model, U, s, V, v, k, weights)
        return out

    def tangent(self, F: Tensor, weights: Tensor) -> Tangent:
        """The derivative of P."""
        U, s, V = self.decomposed(F)
        v, k = self._nearest(s)
        return U, V, self._call(_tangent)(self._model, s, v, k, weights)

    def product(self, tangent: Tangent, D: Tensor) -> Tensor:
        """Tangent times D (9, M)."""
        out: Tensor = self._call(_product)(*tangent, D)
        return out

    def decomposed(self, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """U (9, M), s (3, M), V (9, M) of the signed SVD."""
        out: tuple[Tensor, Tensor, Tensor] = self._call(_decompose)(F)
        return out

    def rotations(self, F: Tensor) -> Tensor:
        """Nearest rotations (9, M); the identity where F is not finite."""
        out: Tensor = self._call(_rotate)(*self.decomposed(torch.nan_to_num(F)))
        return out

    def _call(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return as_kernel(function, self._compiled)

    def _nearest(self, s: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Nearest volume-preserving stretches v (3, M) and k (M,), where there is such a term."""
        if self._model != COROTATED or self._first >= self._points:
            return None, None
        if self._first == 0:
            found: tuple[Tensor, Tensor] = self._call(_nearest)(s)
            return found
        by_cell = s.reshape(3, -1, self._points)
        v, k = torch.ones_like(by_cell), torch.zeros_like(by_cell[0])
        part = by_cell[..., self._first :]
        found = self._call(_nearest)(part.reshape(3, -1))
        v[..., self._first :] = found[0].reshape(part.shape)
        k[..., self._first :] = found[1].reshape(part.shape[1:])
        return v.reshape(3, -1), k.reshape(-1)


def _decompose(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    U, s, V = signed_svd(list(F.unbind()))
    return torch.stack(U), torch.stack(s), torch.stack(V)


def _nearest(s: Tensor) -> tuple[Tensor, Tensor]:
    v, k = nearest_volume(list(s.unbind()))
    return torch.stack(v), k


def _rotate(U: Tensor, s: Tensor, V: Tensor) -> Tensor:
    return torch.stack(product(list(U.unbind()), transposed(list(V.unbind()))))


def _stress(
    model: int,
    U: Tensor,
    s: Tensor,
    V: Tensor,
    v: Tensor | None,
    k: Tensor | None,
    weights: Tensor,
) -> tuple[Tensor, Tensor]:
    nearest = None if v is None or k is None else (list(v.unbind()), k)
    density, t = energies.principal(model, list(s.unbind()), nearest, weights[0], weights[1])
    rows, columns = list(U.unbind()), transposed(list(V.unbind()))
    scaled = [rows[3 * i + j] * t[j] for i in range(3) for j in range(3)]
    return density, torch.stack(product(scaled, columns))


def _tangent(model: int, s: Tensor, v: Tensor | None, k: Tensor | None, weights: Tensor) -> Tensor:
    nearest = None if v is None or k is None else (list(v.unbind()), k)
    return torch.stack(energies.tangent(model, list(s.unbind()), nearest, weights[0], weights[1]))


def _product(U: Tensor, V: Tensor, T: Tensor, D: Tensor) -> Tensor:
    rows = [list(a.unbind()) for a in (U, V, T, D)]
    return torch.stack(energies.tangent_product(*rows))
