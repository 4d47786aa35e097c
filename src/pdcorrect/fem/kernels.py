"""Loops over cells: elastic energy, forces, and what the tangent needs."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from pdcorrect.fem.blocks import (
    CHUNK,
    PARALLEL,
    block_shape,
    deformation,
    fill,
    first_volume_lane,
    gather_nodes,
    nodal_forces,
    take,
    total,
)
from pdcorrect.fem.decomposition import signed_svd_lanes
from pdcorrect.fem.energies import principal_stress_lanes, principal_tangent_lanes, stress_lanes


@njit(**PARALLEL)
def energy_and_forces(  # type: ignore[no-untyped-def]
    model, u, cells, gradients, weights, first, energy, by_cell, start, slots, out
):
    """Elastic energy (C,), J, of each cell, and forces out (N, 3), N.

    Parameters
    ----------
    model : int
        See `energy_code`.
    u : (N, 3)
        Displacements, m.
    cells : (C, K), gradients : (C, K, 3, Q)
    weights : (C, 2, Q)
        Weights of the two terms, mu and omega, times rest volume, J.
    first : int
        Points below it have no volume term, and no volume projection is computed
        for them.
    by_cell : (C, K, 3)
        Scratch.
    start, slots
        See `gather_nodes`.
    """
    count, points = cells.shape[0], weights.shape[2]
    size, lanes = block_shape(points)
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        F, P, B = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
        U, V, S = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((6, lanes))
        s, v, t = np.empty((3, lanes)), np.empty((3, lanes)), np.empty((3, lanes))
        k, w, one = np.empty(lanes), np.empty((2, lanes)), np.empty((9, points))
        density, part = np.empty((1, lanes)), np.empty((1, points))
        last = min(count, (chunk + 1) * CHUNK)
        for begin in range(chunk * CHUNK, last, size):
            end = min(last, begin + size)
            fill(u, cells, gradients, weights, begin, end, first, one, F, w)
            signed_svd_lanes(F, U, s, V, B, S)
            lane = first_volume_lane(first, points, w)
            principal_stress_lanes(model, s, v, k, w[0], w[1], lane, density[0], t)
            stress_lanes(U, t, V, P)
            for c in range(begin, end):
                take(density, c - begin, size, first, part)
                energy[c] = total(part[0])
                take(P, c - begin, size, first, one)
                nodal_forces(one, gradients[c], -1.0, by_cell[c])
    gather_nodes(start, slots, by_cell.reshape(-1, 3), out)


@njit(**PARALLEL)
def smallest_determinants(u, cells, gradients, out):  # type: ignore[no-untyped-def]
    """Smallest det F of each cell, out (C,), of the nodes' displacements u alone."""
    count, lanes = cells.shape[0], gradients.shape[3]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        F = np.empty((9, lanes))
        for c in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            deformation(u, cells[c], gradients[c], 1.0, F)
            least = np.inf
            for q in range(lanes):
                determinant = (
                    F[0, q] * (F[4, q] * F[8, q] - F[5, q] * F[7, q])
                    + F[1, q] * (F[5, q] * F[6, q] - F[3, q] * F[8, q])
                    + F[2, q] * (F[3, q] * F[7, q] - F[4, q] * F[6, q])
                )
                least = min(least, determinant)
            out[c] = least


@njit(**PARALLEL)
def linearise_cells(  # type: ignore[no-untyped-def]
    model, u, cells, gradients, weights, first, project, left, right, tangent
):
    """Everything the tangent needs at displacements u, for each cell.

    Writes ``left`` and ``right`` (C, 9, Q), the factors U and V of the signed
    SVD, and ``tangent`` (C, 12, Q), see `finish_tangent_lanes`, in J.
    """
    count, points = cells.shape[0], weights.shape[2]
    size, lanes = block_shape(points)
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        F, B, S = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((6, lanes))
        U, V, T = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((12, lanes))
        s, v, k = np.empty((3, lanes)), np.empty((3, lanes)), np.empty(lanes)
        w, one = np.empty((2, lanes)), np.empty((9, points))
        last = min(count, (chunk + 1) * CHUNK)
        for begin in range(chunk * CHUNK, last, size):
            end = min(last, begin + size)
            fill(u, cells, gradients, weights, begin, end, first, one, F, w)
            signed_svd_lanes(F, U, s, V, B, S)
            lane = first_volume_lane(first, points, w)
            principal_tangent_lanes(model, s, v, k, w[0], w[1], lane, project, T)
            for c in range(begin, end):
                take(U, c - begin, size, first, left[c])
                take(V, c - begin, size, first, right[c])
                take(T, c - begin, size, first, tangent[c])
