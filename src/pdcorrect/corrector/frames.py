"""How the surroundings of each node are turned and stretched.

A cell's axes are the means of its four edges along each of its own directions.  The mean
over the cells of a node at rest has a rotation (polar decomposition): the node's frame at
rest.  The mean of the cells' deformation gradients F = R U (axes now times the inverse of
those at rest) turns it by R.  So a frame turns with the body, at rest too, and what is told
in frames does not depend on how the scene lies in space, nor on how it has turned since.
R does not depend on how a mesh orders the corners of its cells; the frame at rest does.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

import torch
from torch import Tensor

from pdcorrect.batch.gpu import one_kernel
from pdcorrect.fem.energies import nearest_rotation
from pdcorrect.fem.hexahedron import VTK_CORNERS

EDGE_MEANS = (2.0 * VTK_CORNERS - 1.0) / 4.0
"""What a cell's corners count in its axes, (8, 3)."""


def cell_axes(positions: Tensor, cells: Tensor) -> Tensor:
    """Axes of cells as columns, (c, 3, 3), m, for positions (n, 3) and cells (c, 8)."""
    corners = positions.index_select(0, cells.reshape(-1)).reshape(*cells.shape, 3)
    return torch.einsum("cki,kj->cij", corners, _edge_means(positions.dtype, positions.device))


@cache
def _edge_means(dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.as_tensor(EDGE_MEANS, dtype=dtype, device=device)


def node_axes(positions: Tensor, cells: Tensor, counts: Tensor) -> Tensor:
    """Means of the axes of the cells that touch a node, (n, 3, 3), m.

    ``counts`` (n,) are the numbers of these cells.
    """
    return _node_means(cell_axes(positions, cells), cells, counts)


def node_gradients(positions: Tensor, inverses: Tensor, cells: Tensor, counts: Tensor) -> Tensor:
    """Means of the deformation gradients of the cells that touch a node, (n, 3, 3).

    ``inverses`` (c, 3, 3) are those of the cells' axes at rest, 1/m; ``counts`` as above.
    """
    return _node_means(product(cell_axes(positions, cells), inverses), cells, counts)


def _node_means(values: Tensor, cells: Tensor, counts: Tensor) -> Tensor:
    corners = cells.reshape(-1)
    each = values[:, None].expand(-1, cells.shape[1], -1, -1).reshape(-1, 3, 3)
    sums = values.new_zeros(len(counts), 3, 3).index_add(0, corners, each)
    return sums / counts[:, None, None]


def turned(R: Tensor, x: Tensor) -> Tensor:
    """R x for matrices (n, 3, 3) and vectors (n, 3)."""
    return product(R, x[..., None])[..., 0]


def turned_back(R: Tensor, x: Tensor) -> Tensor:
    """R^T x."""
    return product(R.transpose(1, 2), x[..., None])[..., 0]


def product(A: Tensor, B: Tensor) -> Tensor:
    """A B of each node or edge, matrices (n, 3, 3) and (n, 3, k).

    Libraries treat such matrices on a GPU as if they were large: see `unrolled_products`.
    """
    if A.is_cuda and _unrolled.get():
        return _product(A.contiguous(), B.contiguous())
    return A @ B


@contextmanager
def unrolled_products() -> Iterator[None]:
    """Within it a GPU multiplies small matrices by code that is compiled for them.

    For work without derivatives that is recorded: call by call a compiled function takes longer
    to be called than the library's.
    """
    before = _unrolled.set(True)
    try:
        yield
    finally:
        _unrolled.reset(before)


_unrolled: ContextVar[bool] = ContextVar("unrolled", default=False)


@one_kernel
def _product(A: Tensor, B: Tensor) -> Tensor:
    first, second, third = (A[:, :, i, None] * B[:, i, None] for i in range(3))
    return first + second + third


_NEWTON_STEPS = 8
_FLATTEST = 1e-3 * 3.0**-1.5
"""Least determinant that a rotation is made of, where the matrix has norm 1."""


def polar_rotations(matrices: Tensor) -> Tensor:
    """Rotations R of M = R U for matrices (n, 3, 3) with positive determinants.

    Can be differentiated.  Where the determinant is not positive, or tiny beside the matrix,
    R is the identity.
    """
    found: Tensor = _Polar.apply(matrices)  # type: ignore[no-untyped-call]
    return found


def turns_between(R: Tensor, S: Tensor) -> Tensor:
    """Axial parts (n, 3) of R^T S: sine of the angle from R to S times the axis, told in R."""
    return 0.5 * torch.linalg.cross(S, R, dim=2).sum(dim=1)


class _Polar(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrices: Tensor) -> Tensor:
        R = _on_cpu(matrices) if matrices.device.type == "cpu" else together(matrices)
        ctx.save_for_backward(matrices, R)
        return R

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        R, X, G = (x.permute(1, 2, 0) for x in (ctx.saved_tensors[1], ctx.saved_tensors[0], grad))
        X, size, usable = _unit(X)
        X = torch.where(usable, X, R)
        U, Q = ((R[:, :, None] * x[:, None]).sum(dim=0) for x in (X, G))
        A = _identity(U) * U.diagonal().sum(dim=1) - U
        C = _cofactors(A)
        q = _axial(Q.flatten(0, 1))
        z = (C * q[:, None]).sum(dim=0) / (_determinants(A, C) * size)
        back = torch.linalg.cross(R, z.expand_as(R), dim=1)
        return torch.where(usable, back, 0.0).permute(2, 0, 1)


def _on_cpu(matrices: Tensor) -> Tensor:
    """`polar_rotations` by signed SVDs, without derivatives."""
    size = matrices.square().sum(dim=(1, 2)).sqrt()
    usable = torch.linalg.det(matrices) > _FLATTEST * size**3
    identity = torch.eye(3, dtype=matrices.dtype)
    found = nearest_rotation(torch.where(usable[:, None, None], matrices, identity).numpy())
    return torch.from_numpy(found).to(matrices.dtype)


def together(matrices: Tensor) -> Tensor:
    """`polar_rotations` by operations on all matrices, without derivatives."""
    X, _, usable = _unit(matrices.permute(1, 2, 0).contiguous())  # long rows are quicker
    identity = _identity(X)
    X = torch.where(usable, X, identity)
    for _ in range(_NEWTON_STEPS):
        C = _cofactors(X)
        inverse = C / _determinants(X, C)
        scale = (inverse.square().sum(dim=(0, 1)) / X.square().sum(dim=(0, 1))).sqrt().sqrt()
        X = (0.5 * scale) * X + inverse / (2.0 * scale)
    return torch.where(usable, X, identity).permute(2, 0, 1).contiguous()


def _unit(X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Matrices (3, 3, n) over their norms, these (n,), and which have a rotation."""
    squares = X.square().sum(dim=(0, 1))
    size = torch.where(squares > 0.0, squares, 1.0).sqrt()
    X = X / size
    usable = _determinants(X, _cofactors(X)) > _FLATTEST
    return X, torch.where(usable, size, 1.0), usable


def _identity(X: Tensor) -> Tensor:
    return torch.eye(3, dtype=X.dtype, device=X.device)[..., None]


def _cofactors(A: Tensor) -> Tensor:
    """Det A A^-T of (3, 3, n)."""
    rows = torch.cat([A, A[:2]])
    B = torch.cat([rows, rows[:, :2]], dim=1)
    return B[1:4, 1:4] * B[2:, 2:] - B[1:4, 2:] * B[2:, 1:4]


def _determinants(A: Tensor, cofactors: Tensor) -> Tensor:
    """Of (3, 3, n), (n,)."""
    return (A[0] * cofactors[0]).sum(dim=0)


def _axial(nine: Tensor) -> Tensor:
    """Axial vectors (3, n) of A - A^T, for the components (9, n) of A."""
    here, there = _off_diagonal(nine.device)
    return nine.index_select(0, here) - nine.index_select(0, there)


@cache
def _off_diagonal(device: torch.device) -> tuple[Tensor, Tensor]:
    """Where zy, xz and yx are in the nine of a matrix, and yz, zx and xy."""
    with torch.inference_mode(False):
        return torch.tensor([7, 2, 3], device=device), torch.tensor([5, 6, 1], device=device)
