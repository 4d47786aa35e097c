"""Matrices of cells, and their internal modes eliminated from them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, cat

from pdcorrect.batch.cells import CellBatch, DistinctBodies, kinds, padded
from pdcorrect.batch.gpu import small_products
from pdcorrect.batch.triton_kernels import skinny_product
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.quadrature import alike

Array = NDArray[np.float64]


def alike_cells(problem: Problem) -> bool:
    """Whether shape functions and material are the same in all cells of a body."""
    materials, quadrature = problem.materials, problem.quadrature
    return problem.correction is None and quadrature.alike_gradients and all(
        alike(values)
        for values in (
            quadrature.weights, quadrature.volume_weights,
            materials.mu, materials.volume_weight, materials.density,
        )
    )  # fmt: skip


def scalar_blocks(problem: Problem, stiffness: float, volume_scale: float, one: bool) -> Array:
    """The elastic part of G of each cell, (C, L, L), N/m; of ``one`` if they are alike."""
    few = slice(1) if one else slice(None)
    weights, lanes = problem.point_weights[few], problem.quadrature.lanes[few]
    coefficient = stiffness * (2.0 * weights[:, 0] + volume_scale * weights[:, 1])
    rows = lanes.reshape(*lanes.shape[:2], -1)
    scaled = (lanes * coefficient[:, None, None, :]).reshape(rows.shape)
    return np.asarray(rows @ scaled.swapaxes(1, 2))


def rest_blocks(problem: Problem, stiffness: float, one: bool) -> Array:
    """The rest Hessian of each cell, (C, 3 L, 3 L), N/m; of ``one`` if they are alike."""
    few = slice(1) if one else slice(None)
    rest = problem.extended(problem.positions)
    blocks = stiffness * problem.linearise(rest, project=True, cells=few).blocks()
    count, width = blocks.shape[:2]
    return np.ascontiguousarray(blocks.swapaxes(2, 3)).reshape(count, 3 * width, 3 * width)


class Elimination:
    """The internal modes of cells, eliminated from a system and found afterwards.

    ``blocks`` (C or 1, w L, w L) are of each distinct problem's cells, one for all; ``owners`` (B,)
    which of them each scene has; ``nodes`` K a cell has, its other shape functions are modes; a
    node has ``width`` w unknowns: 1 where blocks are the same for all coordinates, or 3.  Matrices
    are kept in the type ``storage``.  The attribute ``blocks`` is of the nodes,
    (C or 1, w K, w K), with the modes eliminated.
    """

    def __init__(
        self,
        cells: CellBatch,
        blocks: Sequence[Array],
        owners: Tensor,
        nodes: int,
        width: int,
        storage: torch.dtype,
    ) -> None:
        self._cells, self._nodes, self._width, self._storage = cells, nodes, width, storage
        if not cells.sizes.modes:
            self.blocks = list(blocks)
            return
        parts = [_eliminated(b, width * self._nodes) for b in blocks]
        self.blocks = [kept for kept, _, _ in parts]
        self._inverse = self._stored([inverse for _, inverse, _ in parts])[owners]
        self._solved = self._stored([solved for _, _, solved in parts])[owners]

    def reduced(self, r: Tensor) -> Tensor:
        """Right-hand side (B, N, 3) of the nodes for that of configurations (B, U, 3)."""
        n = self._cells.sizes
        if not n.modes:
            return r
        back = self._times(self._solved.transpose(-1, -2), self._cells.modes(r))
        return r[:, : n.nodes] - self._cells.summed(back)

    def recovered(self, x: Tensor, r: Tensor) -> Tensor:
        """The whole solution (B, U, 3) for that of the nodes (B, N, 3) and right-hand side r."""
        n = self._cells.sizes
        if not n.modes:
            return x
        corners = self._times(self._solved, self._cells.local(x))
        found = self._times(self._inverse, self._cells.modes(r)) - corners
        return cat([x, found.reshape(n.scenes, n.modes, 3)], dim=1)

    def _stored(self, arrays: Sequence[Array]) -> Tensor:
        """(K, m, n) where all cells of each problem are alike, else (K, C, m, n)."""
        if all(len(a) == 1 for a in arrays):
            return self._cells.tensor(np.concatenate(arrays)).to(self._storage)
        count = self._cells.sizes.cells
        every = [np.broadcast_to(a, (count, *a.shape[1:])) if len(a) == 1 else a for a in arrays]
        return self._cells.tensor(padded(every, (count, *every[0].shape[1:]))).to(self._storage)

    def _times(self, matrices: Tensor, local: Tensor) -> Tensor:
        """Matrices times the values (B, C, k, 3) in each cell."""
        values = local.to(self._storage)
        if self._width == 3:
            flat = values.reshape(*local.shape[:2], -1, 1)
            values = cellwise(matrices, flat).reshape(*local.shape[:2], -1, 3)
        else:
            values = cellwise(matrices, values)
        return values.to(local.dtype)


def cellwise(matrices: Tensor, x: Tensor) -> Tensor:
    """A x for each cell, (B, m, n) or (B, C, m, n) times (B, C, n, k)."""
    if matrices.ndim == 4:
        return small_products(matrices, x)
    scenes, cells, n, k = x.shape
    rows = x.transpose(2, 3).reshape(scenes, cells * k, n) @ matrices.transpose(1, 2)
    return rows.reshape(scenes, cells, k, -1).transpose(2, 3)


def _eliminated(blocks: Array, nodes: int) -> tuple[Array, Array, Array]:
    """Blocks of the nodes with the modes eliminated, K_bb^-1 and K_bb^-1 K_bu."""
    inverse = np.asarray(np.linalg.inv(blocks[:, nodes:, nodes:]), dtype=np.float64)
    solved = inverse @ blocks[:, nodes:, :nodes]
    kept = blocks[:, :nodes, :nodes] - blocks[:, :nodes, nodes:] @ solved
    return np.ascontiguousarray(kept), inverse, solved


class Sharing:
    """Which scenes have the same mesh, material and clamps, and so one matrix.

    ``distinct`` is one of each kind, ``owners`` which of them each scene is.
    """

    def __init__(self, problems: Sequence[Problem], device: torch.device) -> None:
        bodies = DistinctBodies.of(problems)
        self.distinct, owners = kinds(bodies.distinct, _key)
        self.owners: list[int] = [owners[body] for body in bodies.owners]
        members: list[list[int]] = [[] for _ in self.distinct]
        for scene, owner in enumerate(self.owners):
            members[owner].append(scene)
        most = max(map(len, members))
        self._scenes = len(self.owners)
        filled = [row + [self._scenes] * (most - len(row)) for row in members]
        self._members = torch.tensor(filled, device=device)
        self._alone = most == 1
        self._full = len(members) * most == self._scenes

    def gathered(self, x: Tensor) -> Tensor:
        """(B, ...) -> (K, m, ...): side by side what shares a matrix, filled up with zeros."""
        if self._alone:
            return x[:, None]
        if not self._full:
            x = torch.cat([x, x.new_zeros(1, *x.shape[1:])])
        return x[self._members]

    def scattered(self, x: Tensor) -> Tensor:
        """The reverse of `gathered`."""
        if self._alone:
            return x[:, 0]
        out = x.new_zeros(self._scenes + 1, *x.shape[2:])
        out[self._members] = x
        return out[: self._scenes]


def _key(problem: Problem) -> bytes:
    digest = hashlib.blake2b()
    materials, mass = problem.materials, problem.mass_matrix
    for array in (
        problem.positions, problem.cells, problem.free, materials.mu, materials.volume_weight,
        mass.data, mass.indices,
    ):  # fmt: skip
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


class DenseInverse:
    """R -> A^-1 r on nodal fields (B, N, 3), zero where clamped.

    ``free`` (N, 3) are the components of each distinct problem that may move; matrices have
    ``width`` unknowns a node: 3, or 1 where one is the same for all coordinates.
    """

    def __init__(
        self,
        sharing: Sharing,
        free: Sequence[NDArray[np.bool_]],
        width: int,
        storage: torch.dtype,
        device: torch.device,
    ) -> None:
        self._sharing, self._width, self._free = sharing, width, list(free)
        self._axes = 1
        if width == 1 and any((f != f[:, :1]).any() for f in free):
            self._axes = 3
        size = width * max(map(len, free))
        shape = (len(free), self._axes, size, size)
        self._inverse = torch.zeros(shape, dtype=storage, device=device)

    def fill(self, i: int, matrix: Tensor) -> bool:
        """Invert one problem's matrix (w N, w N) into the store, if it is positive definite."""
        size = len(matrix)
        for axis in range(self._axes):
            free = self._free[i].ravel() if self._width == 3 else self._free[i][:, axis]
            keep = torch.as_tensor(free.astype(np.float64), device=matrix.device)
            held = (matrix * keep[:, None]).mul_(keep)
            held.diagonal().add_(1.0 - keep)
            factor, info = torch.linalg.cholesky_ex(held)
            if int(info):
                self._inverse[i] = 0.0
                return False
            inverse = torch.cholesky_inverse(factor).mul_(keep[:, None]).mul_(keep)
            self._inverse[i, axis, :size, :size] = inverse.to(self._inverse.dtype)
        return True

    def __call__(self, r: Tensor) -> Tensor:
        """Scenes with one inverse side by side."""
        shared = self._sharing.gathered(r.to(self._inverse.dtype))
        count, most, nodes, _ = shared.shape
        if self._width == 3:
            columns = shared.reshape(count, most, 1, 3 * nodes).permute(0, 2, 3, 1)
        elif self._axes == 1:
            columns = shared.permute(0, 2, 1, 3).reshape(count, 1, nodes, 3 * most)
        else:
            columns = shared.permute(0, 3, 2, 1)
        flat = skinny_product(self._inverse.flatten(0, 1), columns.flatten(0, 1))
        x = flat.reshape(count, self._axes, *flat.shape[1:])
        if self._width == 3:
            x = x.permute(0, 3, 1, 2).reshape(count, most, nodes, 3)
        elif self._axes == 1:
            x = x.reshape(count, nodes, most, 3).permute(0, 2, 1, 3)
        else:
            x = x.permute(0, 3, 2, 1)
        return self._sharing.scattered(x.to(r.dtype))


def summed_blocks(
    cells: NDArray[np.int64], blocks: Array, nodes: int, device: torch.device
) -> Tensor:
    """Matrix (w N, w N) in double precision of cells' blocks (C or 1, w K, w K)."""
    width = blocks.shape[1] // cells.shape[1]
    size = width * nodes
    numbers = (width * cells[:, :, None] + np.arange(width)).reshape(len(cells), -1)
    rows = torch.as_tensor(numbers, device=device)
    values = torch.as_tensor(blocks, device=device).expand(len(cells), -1, -1)
    places = (rows[:, :, None] * size + rows[:, None, :]).reshape(-1)
    matrix = torch.zeros(size * size, dtype=torch.float64, device=device)
    return matrix.index_add_(0, places, values.reshape(-1)).reshape(size, size)


def add_mass(matrix: Tensor, problem: Problem, factor: float) -> None:
    """Add a multiple of a problem's mass matrix to a matrix (w N, w N)."""
    width = len(matrix) // len(problem.positions)
    mass = problem.mass_matrix.tocoo()
    values = torch.as_tensor(factor * mass.data, device=matrix.device)
    for k in range(width):
        rows = torch.as_tensor(width * mass.row.astype(np.int64) + k, device=matrix.device)
        columns = torch.as_tensor(width * mass.col.astype(np.int64) + k, device=matrix.device)
        matrix.view(-1).index_add_(0, rows * len(matrix) + columns, values)
