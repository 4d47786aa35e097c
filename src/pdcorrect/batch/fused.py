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


def sums_of_rows(values: Tensor, numbers: Tensor) -> Tensor:
    """Sums (M, k) of rows of values (L, k) by their numbers (M, n), in this order.

    A number of L stands for nothing.
    """
    out: Tensor = as_kernel(sums, values.is_cuda)(values, numbers)
    return out


def _products(matrices: Tensor, x: Tensor) -> Tensor:
    terms = [matrices[..., i, None] * x[..., i, None, :] for i in range(x.shape[-2])]
    return _sum(terms)


def _rows(u: Tensor, numbers: Tensor) -> Tensor:
    return u[numbers]


def sums(values: Tensor, numbers: Tensor) -> Tensor:
    """`sums_of_rows` as part of a larger kernel."""
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
