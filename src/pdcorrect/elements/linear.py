"""The linear problem on coarse meshes, with derivatives by the cells' matrices, and its loss."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.elements.answers import Answers
from pdcorrect.fem.cell_correction import cell_shapes
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.learned import BOUND, own_mass, own_stiffness, root, scalar_map, strain_map
from pdcorrect.fem.neighbourhood import cell_graph, neighbours_of

Array = NDArray[np.float64]

_LOADS, _MODES = 12, 12
FLOORS = (0.004, 0.004, 0.004, 0.001)
"""Below which errors hardly count: of displacements, energies, shapes and squared frequencies."""
WEIGHTS = (1.0, 1.0, 1.0, 3.0)
_SMALLEST = 1e-4
"""Added to squared ratios before their root."""


@lru_cache(maxsize=1)
def unit_strains() -> Array:
    """T (18, 24) of a unit cell, see `strain_map`."""
    return strain_map(cell_shapes(VTK_CORNERS[None].astype(float))[0][0])


class Sample(NamedTuple):
    """One body: what the network sees, and what its answers are judged by; arrays of NumPy."""

    numbers: Array
    neighbours: NDArray[np.int64]
    near: Array
    K: Array
    M: Array
    stiff_root: Array
    heavy_root: Array
    young: Array
    density: Array
    rows: NDArray[np.int64]
    free: NDArray[np.bool_]
    foundation: float
    forces: Array
    displacements: Array
    energies: Array
    squares: Array
    modes: Array


def sample(body: Answers) -> Sample:
    """Prepare one body."""
    poisson = float(body.poisson)
    K, M = body.stiffness, body.mass
    count = len(body.cells)
    index = body.places[body.cells[:, 0]]
    corners = body.held[body.cells].astype(float)
    neighbours = neighbours_of(body.cells, index)
    graph = cell_graph(neighbours, body.young, np.full(count, poisson), corners)
    rows = (3 * body.cells[:, :, None] + np.arange(3)).reshape(count, 24)
    return Sample(
        graph.numbers.astype(np.float32), graph.neighbours,
        corners.any(axis=1).astype(float), K, M,
        root(own_stiffness(K, unit_strains())), root(own_mass(M)),
        body.young, body.density, rows, ~np.repeat(body.held, 3), float(body.foundation),
        body.forces.reshape(len(body.forces), -1).astype(float),
        body.displacements.reshape(len(body.forces), -1).astype(float),
        body.energies, body.squares, body.modes.reshape(len(body.modes), -1).astype(float),
    )  # fmt: skip


class Batch(NamedTuple):
    """Bodies of a batch, their cells one after the other; solved as padded dense systems.

    Attributes
    ----------
    numbers : (C, 37), neighbours : (C, 27), near, young, density : (C,)
    owner : (C,)
        Body of each cell.
    K : (B, 24, 24), M : (B, 8, 8), stiff_root : (B, 18, 18), heavy_root : (B, 7, 7)
        Of its unit cell.
    rows : (C, 24)
        Place of each displacement among the body's, which are padded to n.
    solve : (C, 24)
        Place among the free ones, padded to m; m itself where held.
    places : (B, m)
        Of the free ones among all; n where padded.
    foundation : (B,), forces, displacements : (B, L, n), energies : (B, L)
    loaded : (B, L)
        Whether there is such a load.
    squares : (B, M), modes : (B, M, n)
    """

    numbers: Tensor
    neighbours: Tensor
    near: Tensor
    owner: Tensor
    K: Tensor
    M: Tensor
    stiff_root: Tensor
    heavy_root: Tensor
    young: Tensor
    density: Tensor
    rows: Tensor
    solve: Tensor
    places: Tensor
    foundation: Tensor
    forces: Tensor
    displacements: Tensor
    energies: Tensor
    loaded: Tensor
    squares: Tensor
    modes: Tensor

    def to(self, device: str) -> Batch:
        """On a device."""
        return Batch(*(x.to(device) for x in self))


def collate(samples: Sequence[Sample]) -> Batch:
    """Bodies of similar size."""
    size = len(samples)
    n = max(s.forces.shape[1] for s in samples)
    m = max(int(s.free.sum()) for s in samples)
    solve, places = [], np.full((size, m), n)
    forces, displacements = np.zeros((size, _LOADS, n + 1)), np.zeros((size, _LOADS, n + 1))
    energies, loaded = np.ones((size, _LOADS)), np.zeros((size, _LOADS))
    modes = np.zeros((size, _MODES, n + 1))
    for i, s in enumerate(samples):
        number = np.where(s.free, np.cumsum(s.free) - 1, m)
        solve.append(number[s.rows])
        places[i, : s.free.sum()] = np.flatnonzero(s.free)
        count, width = s.forces.shape
        forces[i, :count, :width], displacements[i, :count, :width] = s.forces, s.displacements
        energies[i, :count], loaded[i, :count] = s.energies, 1.0
        modes[i, :, :width] = s.modes
    stacked = {
        name: np.stack([getattr(s, name) for s in samples])
        for name in ("K", "M", "stiff_root", "heavy_root", "squares")
    }
    joined = {
        name: np.concatenate([getattr(s, name) for s in samples])
        for name in ("numbers", "near", "young", "density", "rows")
    }
    ends = np.cumsum([len(s.rows) for s in samples])
    joined["neighbours"] = np.concatenate(
        [
            np.where(s.neighbours == len(s.rows), ends[-1], s.neighbours + end - len(s.rows))
            for s, end in zip(samples, ends, strict=True)
        ]
    )
    owner = np.repeat(np.arange(size), [len(s.rows) for s in samples])
    arrays = dict(
        **stacked, **joined, owner=owner, solve=np.concatenate(solve), places=places,
        foundation=np.array([s.foundation for s in samples]), forces=forces,
        displacements=displacements, energies=energies, loaded=loaded, modes=modes,
    )  # fmt: skip
    return Batch(**{k: torch.as_tensor(v) for k, v in arrays.items()})


class Errors(NamedTuple):
    """Squared relative errors of each body: displacements and energies (B, L), shapes and squared
    frequencies (B, M).
    """

    displacements: Tensor
    energies: Tensor
    shapes: Tensor
    squares: Tensor


class _Solved(torch.autograd.Function):
    """X of A X = B (..., m, m) and (..., m, L), A symmetric and positive.

    One factorisation serves X and its derivatives; `torch.linalg.solve` would differentiate
    through it at several times the cost.  Nothing here waits for a GPU, see `training.Recorded`.
    """

    @staticmethod
    def forward(ctx: Any, A: Tensor, B: Tensor) -> Tensor:
        factor = torch.linalg.cholesky_ex(A).L  # positive by construction: no look at its success
        X = _backward(factor, _forward(factor, B))
        ctx.save_for_backward(factor, X)
        return X

    @staticmethod
    def backward(ctx: Any, slopes: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        factor, X = ctx.saved_tensors
        by_B = _backward(factor, _forward(factor, slopes))
        return -by_B @ X.mT, by_B


_BLOCK = 512
"""Largest triangle that torch gives cuBLAS; larger ones go to a library that waits."""


def _forward(L: Tensor, B: Tensor) -> Tensor:
    """X of L X = B, L lower triangular."""
    h = L.shape[-1] // 2
    if 2 * h <= _BLOCK:
        return torch.linalg.solve_triangular(L, B, upper=False)
    top = _forward(L[..., :h, :h], B[..., :h, :])
    rest = B[..., h:, :] - L[..., h:, :h] @ top
    return torch.cat([top, _forward(L[..., h:, h:], rest)], dim=-2)


def _backward(L: Tensor, B: Tensor) -> Tensor:
    """X of L^T X = B."""
    h = L.shape[-1] // 2
    if 2 * h <= _BLOCK:
        return torch.linalg.solve_triangular(L.mT, B, upper=True)
    below = _backward(L[..., h:, h:], B[..., h:, :])
    rest = B[..., :h, :] - L[..., h:, :h].mT @ below
    return torch.cat([_backward(L[..., :h, :h], rest), below], dim=-2)


def _solved(A: Tensor, B: Tensor) -> Tensor:
    return _Solved.apply(A, B)  # type: ignore[no-any-return, no-untyped-call]


def _bounded(N: Tensor) -> Tensor:
    """See `fem.learned.bounded`."""
    one = torch.eye(N.shape[-1], dtype=N.dtype, device=N.device)
    return 2.0 * BOUND * _solved(one + N @ N, N)


@lru_cache(maxsize=4)
def _maps(like: tuple[torch.device, torch.dtype]) -> tuple[Tensor, Tensor]:
    """`unit_strains` and `scalar_map`."""
    device, dtype = like
    T, P = (torch.as_tensor(x(), dtype=dtype, device=device) for x in (unit_strains, scalar_map))
    return T, P


def errors(batch: Batch, N: Tensor | None, H: Tensor | None) -> Errors:
    """Of the coarse models with matrices N (C, 18, 18) and H (C, 7, 7); without learning if None.

    A mode with the fine model's omega^2 should satisfy u = omega^2 K^-1 M phi = phi, and
    phi . M phi / phi . M u is by how much omega^2 is off.
    """
    K, M = batch.K[batch.owner], batch.M[batch.owner]
    if N is not None and H is not None:
        T, P = _maps((K.device, K.dtype))
        gate = torch.ones(len(N), 18, dtype=K.dtype, device=K.device)
        gate[:, :6] = batch.near[:, None]
        N = N.to(K) * gate[:, :, None] * gate[:, None, :]
        left = batch.stiff_root[batch.owner] @ T
        K = K + left.mT @ _bounded(N) @ left
        below = batch.heavy_root[batch.owner] @ P
        M = M + below.mT @ _bounded(H.to(K)) @ below
    K = K * batch.young[:, None, None]
    M = M * batch.density[:, None, None]
    one = torch.eye(3, dtype=K.dtype, device=K.device)
    spread = (M[:, :, None, :, None] * one[:, None]).reshape(-1, 24, 24)
    K = K + batch.foundation[batch.owner, None, None] * spread
    size, m = batch.places.shape
    flat = batch.owner[:, None, None] * (m + 1) ** 2
    flat = flat + batch.solve[:, :, None] * (m + 1) + batch.solve[:, None, :]
    A = torch.zeros(size * (m + 1) ** 2, dtype=K.dtype, device=K.device)
    A = A.index_add(0, flat.flatten(), K.flatten()).reshape(size, m + 1, m + 1)[:, :m, :m]
    n = batch.forces.shape[2] - 1
    A = A + torch.diag_embed((batch.places == n).to(K))

    def times(matrices: Tensor, x: Tensor) -> Tensor:
        """Cell matrices (C, 24, 24) times fields (B, L, n + 1)."""
        places = batch.rows[:, None].expand(-1, x.shape[1], -1)
        local = torch.gather(x.index_select(0, batch.owner), 2, places) @ matrices.mT
        out = torch.zeros_like(x).flatten(0, 1)
        line = batch.owner[:, None] * x.shape[1] + torch.arange(x.shape[1], device=x.device)
        where = line[:, :, None] * (n + 1) + places
        return out.flatten().index_add(0, where.flatten(), local.flatten()).reshape(x.shape)

    inertia = times(spread, batch.modes)
    index = batch.places[:, None].expand(-1, _LOADS + _MODES, -1)
    held = batch.displacements.scatter(2, index[:, :_LOADS], 0.0)
    right = torch.cat([batch.forces - times(K, held), inertia], dim=1)
    answers = _solved(A, torch.gather(right, 2, index).mT).mT
    answers = torch.zeros_like(right).scatter(2, index, answers)
    answers = torch.cat([answers[..., :n], torch.zeros_like(answers[..., n:])], dim=2)
    u, v = held + answers[:, :_LOADS], batch.squares[:, :, None] * answers[:, _LOADS:]
    size_u = (batch.displacements**2).sum(dim=2) + 1e-30
    by_load = ((u - batch.displacements) ** 2).sum(dim=2) / size_u * batch.loaded
    energy = ((u * times(K, u)).sum(dim=2) / batch.energies - 1.0) ** 2 * batch.loaded
    shapes = ((v - batch.modes) ** 2).sum(dim=2) / (batch.modes**2).sum(dim=2)
    ratio = (batch.modes * inertia).sum(dim=2) / (v * inertia).sum(dim=2)
    return Errors(by_load, energy, shapes, (ratio - 1.0) ** 2)


def loss(found: Errors, base: Errors) -> Tensor:
    """Of each body, (B,): errors over those without learning, with floors.

    Loads count alike, and of modes the lower ones more: motions are mostly made of them.
    """
    modes = torch.arange(_MODES, device=found.squares.device)
    lower = (1.0 / (1.0 + modes / 2.0)).to(found.squares)
    total = torch.zeros_like(found.squares[:, 0])
    kinds = zip(found, base, FLOORS, WEIGHTS, (False, False, True, True), strict=True)
    for errors, without, floor, weight, of_modes in kinds:
        if of_modes:
            errors, without = ((x @ lower / lower.sum())[:, None] for x in (errors, without))
        there = (without > 0.0).to(without)  # bodies have fewer loads than places for them
        ratio = (errors / (without + floor**2) + _SMALLEST).sqrt()
        total = total + weight * (ratio * there).sum(dim=1) / there.sum(dim=1).clamp_min(1.0)
    return total / sum(WEIGHTS)


def means(found: Sequence[Errors]) -> dict[str, float]:
    """Relative errors, mean over bodies; of frequencies as `errors` estimates them."""
    count = [(e.displacements > 0.0).sum(dim=1).clamp_min(1) for e in found]
    u = [(e.displacements.sum(dim=1) / n).sqrt() for e, n in zip(found, count, strict=True)]
    return {
        "displacements": float(torch.cat(u).mean()),
        "first frequency": float(torch.cat([0.5 * e.squares[:, 0].sqrt() for e in found]).mean()),
        "frequencies": float(torch.cat([0.5 * e.squares.sqrt().mean(dim=1) for e in found]).mean()),
    }
