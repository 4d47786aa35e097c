"""What is computed at each quadrature point, on tensors (k, C, Q) of Q points in C cells.

Deformation is given by the displacement's gradient H = F - I.  Compiled, each function is one
kernel for any number of points.  The decomposition, which is the most of it, is a function of
its own, so that it is compiled once.
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
"""U (9, C, Q), V (9, C, Q) and the tangent (12, C, Q) in their frame."""


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

    def stress(self, H: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Psi (C, Q) and P (9, C, Q) for H (9, C, Q) and the weights of both terms (2, C, Q)."""
        U, s, V = self._decomposed(H)
        v, k = self._nearest(s)
        density, P = self._call(_stress)(self._model, U, s, V, v, k, weights)
        return density, P.transpose(0, 1)

    def tangent(self, H: Tensor, weights: Tensor) -> Tangent:
        """The derivative of P."""
        U, s, V = self._decomposed(H)
        v, k = self._nearest(s)
        return U, V, self._call(_tangent)(self._model, s, v, k, weights)

    def product(self, tangent: Tangent, D: Tensor) -> Tensor:
        """Tangent times D (9, C, Q)."""
        out: Tensor = self._call(_product)(*tangent, D)
        return out.transpose(0, 1)

    def rotations(self, F: Tensor, moved: bool = False) -> Tensor:
        """Nearest rotations (9, L); the identity where F is not finite.

        Parameters
        ----------
        F : (9, L)
        moved : bool
            Whether F is the gradient H of a displacement.
        """
        finite = torch.nan_to_num(F)
        U, _, V = self._decomposed(_two_in_a_cell(finite) if self._compiled else finite, moved)
        out: Tensor = self._call(_rotate)(U, V)
        return out.reshape(9, -1)[:, : F.shape[1]]

    def volume_ratios(self, H: Tensor) -> Tensor:
        """Det F of H (9, ...)."""
        out: Tensor = self._call(_volume_ratio)(H)
        return out

    def _decomposed(self, H: Tensor, moved: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """U (9, ...), s (3, ...), V (9, ...) of the signed SVD of F = I + H, or of H itself.

        A tensor says which: compiling takes minutes, and a flag would be compiled twice.
        """
        identity = H.new_full((), 1.0 if moved else 0.0)
        out: tuple[Tensor, Tensor, Tensor] = self._call(_decompose)(H, identity)
        return out

    def _call(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return as_kernel(function, self._compiled)

    def _nearest(self, s: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Nearest volume-preserving stretches v (3, C, p) and k (C, p) at the last p points.

        Those that have a volume term; None if there is none.
        """
        if self._model != COROTATED or self._first >= self._points:
            return None, None
        found: tuple[Tensor, Tensor] = self._call(_nearest)(s[..., self._first :])
        return found


def _moved(H: Tensor, identity: Tensor | float = 1.0) -> list[Tensor]:
    """F = I + H; with 0 in place of 1, H."""
    return [h + identity if i in (0, 4, 8) else h for i, h in enumerate(H.unbind())]


def _volume_ratio(H: Tensor) -> Tensor:
    a, b, c, d, e, f, g, h, i = _moved(H)
    return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)


def _two_in_a_cell(F: Tensor) -> Tensor:
    """Matrices (9, L) as points (9, C, 2), in memory as `CellBatch.gradients` has its own.

    Kernels are compiled for the number of dimensions and their order.  A zero matrix is added to an
    odd number of them.
    """
    even = torch.nn.functional.pad(F, (0, F.shape[1] % 2))
    return even.reshape(9, -1, 2).transpose(0, 1).contiguous().transpose(0, 1)


def _decompose(H: Tensor, identity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    U, s, V = signed_svd(_moved(H, identity))
    return torch.stack(U), torch.stack(s), torch.stack(V)


def _nearest(s: Tensor) -> tuple[Tensor, Tensor]:
    v, k = nearest_volume(list(s.unbind()))
    return torch.stack(v), k


def _everywhere(v: Tensor | None, k: Tensor | None, points: int) -> energies.Nearest:
    """For all points of a cell: neither stretched nor stressed where there is no volume term."""
    if v is None or k is None:
        return None
    first = points - k.shape[-1]
    if not first:
        return list(v.unbind()), k
    none = torch.zeros_like(k[..., :1]).expand(-1, first)
    return [torch.cat([1.0 + none, a], dim=-1) for a in v.unbind()], torch.cat([none, k], dim=-1)


def _rotate(U: Tensor, V: Tensor) -> Tensor:
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
    """Psi (C, Q), and P (C, 9, Q)."""
    nearest = _everywhere(v, k, s.shape[-1])
    density, t = energies.principal(model, list(s.unbind()), nearest, weights[0], weights[1])
    rows, columns = list(U.unbind()), transposed(list(V.unbind()))
    scaled = [rows[3 * i + j] * t[j] for i in range(3) for j in range(3)]
    return density, torch.stack(product(scaled, columns), dim=1)


def _tangent(model: int, s: Tensor, v: Tensor | None, k: Tensor | None, weights: Tensor) -> Tensor:
    nearest = _everywhere(v, k, s.shape[-1])
    return torch.stack(energies.tangent(model, list(s.unbind()), nearest, weights[0], weights[1]))


def _product(U: Tensor, V: Tensor, T: Tensor, D: Tensor) -> Tensor:
    rows = [list(a.unbind()) for a in (U, V, T, D)]
    return torch.stack(energies.tangent_product(*rows), dim=1)
