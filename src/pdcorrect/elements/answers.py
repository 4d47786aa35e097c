"""Linear answers of fine models at the nodes of coarse ones: what an element is learned from.

Each coarse cell is cut into 4 x 4 x 4 cells of the best element without learning.  One factor a
body gives its displacements under static loads and the lowest modes of its vibrations.  Loads of
the coarse model are those of the fine one by virtual work: F_c = P^T F_f with the trilinear
interpolation P, so both models see the same load.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.ndimage as ndi
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from pdcorrect.elements.bodies import Grid, VoxelBody, nodes_of
from pdcorrect.fem.assembly import Assembly, summed_cells
from pdcorrect.fem.factorisation import factorise
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.problem import discretise
from pdcorrect.scene import Scene

Array = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)

REFINEMENT = 4
MODES = 12
_WEAK, _FOUNDATION = 1e-2, 0.05
"""Foundations of free bodies: to find the lowest frequency, and as a share of its square."""
_LEAST = 1e-6
"""Largest number of a load over the largest area of a node: loads below it are rounding."""
_CORNERS = VTK_CORNERS.astype(int)


class Answers(NamedTuple):
    """Of one body: its coarse mesh of unit cells, and what the fine model does.

    Attributes
    ----------
    places : (N, 3) int
        Of the coarse nodes on the grid.
    cells : (C, 8) int
        VTK order.
    young, density : (C,)
    held : (N,) bool
    forces, displacements : (L, N, 3)
        Static loads of the coarse model, and the fine answers, of size 1 in the mean; where
        ``held`` the displacements are prescribed.
    energies : (L,)
        Twice the fine model's energies.
    foundation : float
        Stiffness over mass, 1/s2, of springs that hold each node of a body with no held one.
    squares, modes : (M,), (M, N, 3)
        Squared angular frequencies, ascending, the foundation's included; shapes of unit mass in
        the fine model.
    stiffness, mass : (24, 24), (8, 8)
        See `unit_cell`.
    """

    places: NDArray[np.int64]
    cells: NDArray[np.int64]
    young: Array
    density: Array
    poisson: float
    held: NDArray[np.bool_]
    forces: Array
    displacements: Array
    energies: Array
    foundation: float
    squares: Array
    modes: Array
    stiffness: Array
    mass: Array


class VoxelMesh(NamedTuple):
    """Nodes (N, 3) and cells (C, 8), in VTK order, of a grid of unit cells; numbers of the nodes
    by place, -1 where there is none.
    """

    places: NDArray[np.int64]
    cells: NDArray[np.int64]
    numbers: NDArray[np.int64]

    @classmethod
    def of(cls, solid: Grid) -> VoxelMesh:
        """All solid cells, in the order of `numpy.argwhere`."""
        nodes = nodes_of(solid)
        numbers = np.full(nodes.shape, -1)
        numbers[nodes] = np.arange(nodes.sum())
        corners = np.argwhere(solid)[:, None] + _CORNERS
        return cls(np.argwhere(nodes), numbers[tuple(np.moveaxis(corners, -1, 0))], numbers)


@lru_cache(maxsize=64)
def unit_cell(poisson: float) -> tuple[Array, Array]:
    """Stiffness (24, 24) of a unit cell of modulus 1, modes eliminated, and mass (8, 8), density 1.

    Of the best element without learning; VTK order, component i of corner k in row 3 k + i.
    """
    scene = Scene(
        body={"shape": "beam", "cells": [1, 1, 1], "cell_size": 1.0},
        material={"young": 1.0, "poisson": poisson, "density": 1.0},
        time={"step": 1.0, "frames": 1},
        solver={"element": "hex8-enhanced", "mass": "averaged"},
    )
    problem = discretise(scene)
    rows = (3 * problem.cells[0][:, None] + np.arange(3)).ravel()
    K = problem.stiffness(problem.positions).toarray()[np.ix_(rows, rows)]
    M = problem.mass_matrix.toarray()[np.ix_(problem.cells[0], problem.cells[0])]
    return K, M


def answers(body: VoxelBody, rng: np.random.Generator) -> Answers:
    """What the fine model of a body does under loads drawn from ``rng``."""
    coarse = VoxelMesh.of(body.solid)
    fine = VoxelMesh.of(_refined(body.solid))
    P = _interpolation(coarse, fine)
    scale = 1.0 / REFINEMENT
    young, density = _refined(body.young), _refined(body.density)
    solid = _refined(body.solid)
    K1, M1 = unit_cell(body.poisson)
    count = len(fine.places)
    assembly = Assembly(fine.cells, count)
    blocks = K1.reshape(8, 3, 8, 3).transpose(0, 2, 1, 3)
    K = assembly.matrix(scale * young[solid][:, None, None, None, None] * blocks)
    weights = scale**3 * density[solid]
    M = summed_cells(fine.cells, weights[:, None, None] * M1, count)
    held = body.held[tuple(coarse.places.T)]
    fixed = (P @ held.astype(float)) > 1.0 - 1e-9
    free = np.flatnonzero(np.repeat(~fixed, 3))
    points: Array = np.asarray(scale * fine.places, dtype=np.float64)
    mass = sp.csr_matrix(sp.kron(M, sp.eye_array(3)))
    foundation = 0.0 if fixed.any() else _foundation(K, mass, points)
    if foundation:
        K = sp.csr_matrix(K + foundation * mass)
    factor = factorise(sp.csr_matrix(K[free][:, free]), "cholespy", unknowns=3)
    loads = _loads(fine, points, weights, fixed, rng)
    if foundation:
        loads = _balanced(loads, mass, points)
    moved = _moved_clamps(body.held, coarse, P, points, rng)
    F = np.concatenate([loads, np.zeros((len(moved), count, 3))])
    U = np.zeros_like(F)
    for i, prescribed in enumerate(moved):
        U[len(loads) + i] = prescribed
    right = F.reshape(len(F), -1) - (K @ U.reshape(len(U), -1).T).T
    U.reshape(len(U), -1)[:, free] = np.stack([factor.solve(b) for b in right[:, free]])
    flat = U.reshape(len(U), -1)
    size = np.sqrt((U**2).sum(axis=2).mean(axis=1))
    F, flat = F / size[:, None, None], flat / size[:, None]
    squares, shapes = _modes(K, mass, free, factor.solve, 6 if foundation else 0)
    at = fine.numbers[tuple((REFINEMENT * coarse.places).T)]
    return Answers(
        coarse.places,
        coarse.cells,
        body.young[body.solid],
        body.density[body.solid],
        body.poisson,
        held,
        np.einsum("fn,lfi->lni", P.toarray(), F, optimize=True),
        flat.reshape(U.shape)[:, at],
        np.einsum("li,li->l", flat, (K @ flat.T).T),
        foundation,
        squares,
        shapes.reshape(len(shapes), -1, 3)[:, at],
        K1,
        M1,
    )


def _refined(grid: NDArray[T]) -> NDArray[T]:
    for axis in range(3):
        grid = np.repeat(grid, REFINEMENT, axis=axis)
    return grid


def _interpolation(coarse: VoxelMesh, fine: VoxelMesh) -> sp.csr_matrix:
    """Trilinear, (fine nodes, coarse nodes)."""
    numbers = np.pad(coarse.numbers, (0, 1), constant_values=-1)
    low, inside = np.divmod(fine.places, REFINEMENT)
    rows, columns, values = [], [], []
    for corner in _CORNERS:
        share = inside / REFINEMENT
        weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
        used = np.flatnonzero(weight > 0.0)
        rows.append(used)
        columns.append(numbers[tuple((low[used] + corner).T)])
        values.append(weight[used])
    shape = (len(fine.places), len(coarse.places))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sp.csr_matrix(sp.coo_matrix(entries, shape=shape))


def _modes(K: sp.csr_matrix, mass: sp.csr_matrix, free, solve, rigid: int) -> tuple[Array, Array]:  # type: ignore[no-untyped-def]
    """Squares and shapes of the lowest modes after so many ``rigid`` ones."""
    inside = sp.csr_matrix(mass[free][:, free])
    stiffness = sp.csr_matrix(K[free][:, free])
    inverse = spla.LinearOperator(stiffness.shape, matvec=solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=len(free))
    count = MODES + rigid
    squares, vectors = spla.eigsh(stiffness, count, inside, sigma=0.0, OPinv=inverse, v0=start)
    order = np.argsort(squares)[rigid:]
    shapes = np.zeros((MODES, K.shape[0]))
    shapes[:, free] = vectors[:, order].T
    return squares[order], shapes


# --- free bodies ---------------------------------------------------------------------------------


def _foundation(K: sp.csr_matrix, mass: sp.csr_matrix, points: Array) -> float:
    """A small share of the square of the lowest elastic frequency."""
    weak = _WEAK / np.ptp(points, axis=0).max() ** 4
    factor = factorise(sp.csr_matrix(K + weak * mass), "cholespy", unknowns=3)
    everything = np.arange(K.shape[0])
    squares, _ = _modes(sp.csr_matrix(K + weak * mass), mass, everything, factor.solve, 6)
    return float(_FOUNDATION * squares[0])


def _balanced(loads: Array, mass: sp.csr_matrix, points: Array) -> Array:
    """Loads less the inertia of the rigid motion that they cause, without those of nothing else."""
    axes = np.eye(3)
    away = points - points.mean(axis=0)
    moves = [np.broadcast_to(axis, away.shape) for axis in axes]
    moves += [np.cross(axis, away) for axis in axes]
    R = np.stack([move.ravel() for move in moves])
    inertia = (mass @ R.T).T
    flat = loads.reshape(len(loads), -1)
    left = flat - np.linalg.solve(R @ inertia.T, R @ flat.T).T @ inertia
    kept = np.linalg.norm(left, axis=1) > 0.05 * np.linalg.norm(flat, axis=1)
    return np.asarray(left[kept].reshape(-1, *loads.shape[1:]))


# --- loads ---------------------------------------------------------------------------------------


def _loads(
    fine: VoxelMesh,
    points: Array,
    masses: Array,
    fixed: NDArray[np.bool_],
    rng: np.random.Generator,
) -> Array:
    """Static loads (L, nodes, 3) on the fine nodes that are not fixed.

    Most lie along one axis: in a sum of several the softest answer would hide the others.
    """
    count = len(points)
    nodal = np.bincount(fine.cells.ravel(), np.repeat(masses, 8) / 8.0, minlength=count)[:, None]
    centre = points.mean(axis=0)
    away: Array = (points - centre) / max(1.0, np.ptp(points, axis=0).max())
    axes = np.eye(3)
    out: list[Array] = [nodal * axis for axis in axes]  # gravity
    out += [nodal * np.cross(axis, away) for axis in axes]  # turning
    out.append(nodal * (rng.normal(size=3) + away @ rng.normal(size=(3, 3))))
    out.append(nodal * np.einsum("ni,nj,ijk->nk", away, away, rng.normal(size=(3, 3, 3))))
    for kind in ("even", "linear", "narrow"):
        axis, side = int(rng.integers(3)), int(rng.integers(2))
        area = np.where(fixed, 0.0, _face_areas(fine, axis, side))[:, None]
        if not area.any():
            continue
        traction: Array = axes[rng.integers(3)]
        if kind == "linear":  # moments, if normal
            traction = traction * (away @ axes[rng.integers(3)])[:, None]
        elif kind == "narrow":
            place = points[rng.choice(np.flatnonzero(area[:, 0] > 0.0))]
            reach = rng.uniform(0.7, 2.0)
            near = np.exp(-((points - place) ** 2).sum(axis=1) / (2.0 * reach**2))[:, None]
            traction = near * (traction + 2.0 * away @ rng.normal(size=(3, 3)))
        load = area * traction
        if np.abs(load).max() > _LEAST * area.max():  # else the side is where the moment is zero
            out.append(load)
    return np.stack(out)


def _face_areas(fine: VoxelMesh, axis: int, side: int) -> Array:
    """Area of each node's share in the outer faces that look along an axis, (nodes,)."""
    corners = np.flatnonzero(_CORNERS[:, axis] == side)
    index = fine.places[fine.cells[:, 0]]
    solid = np.zeros(index.max(axis=0) + 2, dtype=bool)
    solid[tuple(index.T)] = True
    beyond = index.copy()
    beyond[:, axis] += 1 if side else -1
    outer = (beyond[:, axis] < 0) | ~solid[tuple(np.maximum(beyond, 0).T)]
    faces = fine.cells[outer][:, corners]
    share = 1.0 / (4.0 * REFINEMENT**2)
    counts = np.bincount(faces.ravel(), minlength=len(fine.places))
    return np.asarray(share * counts, dtype=np.float64)


def _moved_clamps(
    held: Grid, coarse: VoxelMesh, P: sp.csr_matrix, points: Array, rng: np.random.Generator
) -> list[Array]:
    """A rigid motion of one of several groups of held nodes, as fields (nodes, 3)."""
    groups, count = ndi.label(held, structure=np.ones((3, 3, 3)))
    if count < 2:
        return []
    chosen = groups[tuple(coarse.places.T)] == 1 + rng.integers(count)
    moved = (P @ chosen.astype(float)) > 1.0 - 1e-9
    centre = points[moved].mean(axis=0)
    rigid = rng.normal(size=3) + np.cross(0.5 * rng.normal(size=3), points - centre)
    return [np.asarray(moved[:, None] * rigid)]
