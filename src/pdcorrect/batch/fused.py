"""Work on cells that a GPU does in one kernel each, where torch's own operations take several.

Products with a small matrix for each cell are memory-bound, but matrix libraries treat
them as if they were large; gathering nodal values and summing cells' values would copy
them on the way.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor


def as_kernel(function: Callable[..., Any], on_gpu: bool) -> Callable[..., Any]:
    """On a GPU the function as one kernel for tensors of any size; else as it is."""
    return _compiled(function) if on_gpu else function


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return torch.compile(function, dynamic=True)


def small_products(matrices: Tensor, x: Tensor) -> Tensor:
    """A x for each cell, (..., m, n) times (..., n, k)."""
    out: Tensor = as_kernel(_products, True)(matrices, x) if x.is_cuda else matrices @ x
    return out


def rows_of(u: Tensor, numbers: Tensor) -> Tensor:
    """Rows of u (M, k) by their numbers (L,)."""
    out: Tensor = as_kernel(_rows, u.is_cuda)(u, numbers)
    return out


def at_corners(x: Tensor, corners: Tensor) -> Tensor:
    """Values (B, C, K, 3) of fields (B, M, 3) at each scene's own rows ``corners`` (B, C, K)."""
    out: Tensor = as_kernel(_at_corners, x.is_cuda)(x, corners)
    return out


def in_cells(u: Tensor, corners: Tensor, modes: int) -> Tensor:
    """The same by component, (B, C, 3, K), followed by the cells' modes, (B, C, 3, L).

    Modes are the last rows of u (B, U, 3), cell by cell.
    """
    out: Tensor = as_kernel(_in_cells, u.is_cuda)(u, corners, modes)
    return out


def assembled(local: Tensor, slots: Tensor, corners: int) -> Tensor:
    """Fields (B, U, 3) of the cells' values (B, C, L, 3).

    Of L, ``corners`` are summed at the nodes, whose ``slots`` (B N, most) say where they are
    found (see `sums`); the others are modes, which have one cell each.
    """
    scenes = len(local)
    kernel = as_kernel(_summed, local.is_cuda)
    nodal: Tensor = kernel(local, slots, corners).reshape(scenes, -1, 3)
    if local.shape[2] == corners:
        return nodal
    return torch.cat([nodal, local[:, :, corners:].reshape(scenes, -1, 3)], dim=1)


def _products(matrices: Tensor, x: Tensor) -> Tensor:
    terms = [matrices[..., i, None] * x[..., i, None, :] for i in range(x.shape[-2])]
    return _sum(terms)


def _rows(u: Tensor, numbers: Tensor) -> Tensor:
    return u[numbers]


def _at_corners(x: Tensor, corners: Tensor) -> Tensor:
    scene = torch.arange(len(corners), device=x.device)[:, None, None]
    return x[scene, corners]


def _in_cells(u: Tensor, corners: Tensor, modes: int) -> Tensor:
    values = _at_corners(u, corners)
    if modes:
        scenes, cells, _ = corners.shape
        own = u[:, u.shape[1] - modes :].reshape(scenes, cells, -1, 3)
        values = torch.cat([values, own], dim=2)
    return values.transpose(2, 3).contiguous()


def _summed(local: Tensor, slots: Tensor, corners: int) -> Tensor:
    return sums(local[:, :, :corners].reshape(-1, 3), slots)


def sums(values: Tensor, numbers: Tensor) -> Tensor:
    """Sums (M, k) of rows of values (L, k) by their numbers (M, n), in this order.

    A number of L stands for nothing.
    """
    count = len(values)

    def term(column: Tensor) -> Tensor:
        row = values[torch.clamp(column, max=count - 1)]
        return torch.where((column < count)[:, None], row, 0.0)

    first, *others = numbers.unbind(dim=1)
    total = term(first)
    for column in others:
        total = total + term(column)
    return total


def _sum(terms: list[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total
