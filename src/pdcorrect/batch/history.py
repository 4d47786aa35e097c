"""Pairs of L-BFGS for a batch, in compact form (Byrd, Nocedal and Schnabel 1994).

As `pdcorrect.solvers.lbfgs.History`, but each scene fills its own ring of places, so that
scenes may accept steps in different iterations.  A place is known by its number; the
order of the pairs is only needed to find the oldest one, since removing the oldest pair
from an upper triangular R removes a row and a column from its inverse.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pdcorrect.batch.fused import as_kernel
from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.objective import node_dot

_CURVATURE = 1e-12


class BatchHistory:
    """S = steps and Z = changes of G^-1 g, (B, m, D), and their small matrices.

    All methods change the tensors in place.
    """

    def __init__(self, scenes: int, length: int, size: int, like: Tensor) -> None:
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=like.dtype, device=like.device)

        self._S, self._Z = zeros(scenes, length, size), zeros(scenes, length, size)
        self._r_inverse, self._yz = zeros(scenes, length, length), zeros(scenes, length, length)
        self._d = zeros(scenes, length)
        self._sg, self._zg = zeros(scenes, length), zeros(scenes, length)
        self._age = torch.full((scenes, length), -1, dtype=torch.int64, device=like.device)
        self._scenes = torch.arange(scenes, device=like.device)

    def narrowed(self, rows: Tensor) -> BatchHistory:
        """Of some scenes, as it is now."""
        names = ("_S", "_Z", "_r_inverse", "_yz", "_d", "_sg", "_zg", "_age")
        return with_rows(self, rows, *names, _scenes=self._scenes[: len(rows)])

    def clear(self, which: Tensor) -> None:
        """Forget all pairs of the scenes where ``which`` (B,) holds."""
        for small in (self._d, self._sg, self._zg):
            small.masked_fill_(which[:, None], 0.0)
        for matrix in (self._r_inverse, self._yz):
            matrix.masked_fill_(which[:, None, None], 0.0)
        self._age.masked_fill_(which[:, None], -1)

    @property
    def empty(self) -> Tensor:
        """Whether a scene has no pairs, (B,)."""
        return (self._age < 0).all(dim=1)

    def direction(self, x: Tensor) -> Tensor:
        """-H g (B, D) for the gradient that `append` was last given, with x = G^-1 g."""
        return self._product(self._sg, self._zg, x)

    def improved(self, r: Tensor, x: Tensor) -> Tensor:
        """H r (B, D) for any r, with x = G^-1 r: a better preconditioner than G."""
        return -self._product(_times(self._S, r), _times(self._Z, r), x)

    def _product(self, sg: Tensor, zg: Tensor, x: Tensor) -> Tensor:
        w = _times(self._r_inverse, sg)
        mixed = self._d * w + _times(self._yz, w) - zg
        back = _times(self._r_inverse.transpose(1, 2), mixed)
        ahead = torch.bmm(w[:, None], self._Z), torch.bmm(back[:, None], self._S)
        out: Tensor = as_kernel(_combined, x.is_cuda)(*ahead, x)
        return out

    def append(
        self, step: Tensor, change: Tensor, gradient: Tensor, new_gradient: Tensor, moved: Tensor
    ) -> None:
        """Add a pair to the scenes that ``moved`` (B,) between two gradients, all else (B, D).

        A pair without positive curvature is not stored.  Numbers that are not finite stay
        out, in whatever scene: what is stored is multiplied by zeros later.
        """
        sg, zg = _times(self._S, new_gradient), _times(self._Z, new_gradient)
        fields = [x.reshape(len(x), -1, 3) for x in (step, change, gradient, new_gradient)]
        by_node = as_kernel(_pair_products, step.is_cuda)(*fields)
        s_new, z_new, s_old, z_old, s_s = by_node.sum(dim=-1)
        y_s, y_z = s_new - s_old, z_new - z_old
        floor = _CURVATURE * torch.sqrt(y_z.abs() * s_s)
        good = moved & (y_s > floor) & (y_z > 0.0) & (y_s < math.inf)
        place = self._age.argmin(dim=1)
        unit = torch.nn.functional.one_hot(place, self._age.shape[1]).to(sg.dtype)
        unit = unit * good.to(sg.dtype)[:, None]
        kept = 1.0 - unit
        sy, zy = (sg - self._sg) * kept, (zg - self._zg) * kept
        both = kept[:, :, None] * kept[:, None, :]
        y_s = torch.where(good, y_s, torch.ones_like(y_s))
        self._r_inverse.mul_(both)
        column = (unit - _times(self._r_inverse, sy)) / y_s[:, None]
        new_pair = good[:, None, None]
        self._r_inverse.add_(torch.where(new_pair, column[:, :, None] * unit[:, None, :], 0.0))
        self._yz.mul_(both)
        cross = zy[:, :, None] * unit[:, None, :]
        corner = y_z[:, None, None] * unit[:, :, None] * unit[:, None, :]
        self._yz.add_(torch.where(new_pair, cross + cross.transpose(1, 2) + corner, 0.0))
        self._d.copy_(self._d * kept + y_s[:, None] * unit)
        seen = moved[:, None]
        new = (sg * kept + s_new[:, None] * unit, zg * kept + z_new[:, None] * unit)
        self._sg.copy_(torch.where(seen, new[0], self._sg))
        self._zg.copy_(torch.where(seen, new[1], self._zg))
        for pairs, value in ((self._S, step), (self._Z, change)):
            old = pairs[self._scenes, place]
            pairs[self._scenes, place] = torch.where(good[:, None], value, old)
        newest = self._age.amax(dim=1) + 1
        age = torch.where(unit > 0.0, newest[:, None], self._age)
        self._age.copy_(age)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.bmm(matrix, vector[:, :, None])[:, :, 0]


def _combined(plus: Tensor, minus: Tensor, x: Tensor) -> Tensor:
    return (plus - minus)[:, 0] - x


def _pair_products(s: Tensor, z: Tensor, old: Tensor, new: Tensor) -> Tensor:
    """Of (B, U, 3), what each node has in their inner products, (5, B, U)."""
    pairs = ((s, new), (z, new), (s, old), (z, old), (s, s))
    return torch.stack([node_dot(a, b) for a, b in pairs])
