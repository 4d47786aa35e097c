"""Internal modes of a cell: in equilibrium with its nodes, and eliminated from its tangent."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdcorrect.fem.decomposition import OPTIONS, nearest_volume_lanes, signed_svd_lanes
from pdcorrect.fem.energies import (
    corotated_lanes,
    corotated_tangent_lanes,
    finish_tangent_lanes,
    stress_lanes,
)
from pdcorrect.fem.hyperelasticity import (
    COROTATED,
    hyperelastic_lanes,
    hyperelastic_tangent_lanes,
)
from pdcorrect.fem.kernels import PARALLEL, add_stiffness, deformation, nodal_forces, total

Array = NDArray[np.float64]

_CHUNK = 16
_BACKTRACKS = 30


@njit(**PARALLEL)
def relax(  # type: ignore[no-untyped-def]
    model, u, cells, nodes, gradients, shear, volume, first, steps, tolerance
):
    """Bring the internal modes in u (N + B, 3) to equilibrium with the nodes, in place.

    Newton's method with the projected tangent in each cell, at most ``steps``
    times or until no mode changes by more than ``tolerance`` (m).  ``nodes`` is
    the number of nodes a cell; its other local shape functions are modes.
    Other arguments as `kernels.cell_energy_and_forces`.
    """
    count, lanes = cells.shape[0], shear.shape[1]
    width = cells.shape[1] - nodes
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        F, P, B = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((9, lanes))
        U, V, S = np.empty((9, lanes)), np.empty((9, lanes)), np.empty((6, lanes))
        s, v, t = np.empty((3, lanes)), np.empty((3, lanes)), np.empty((3, lanes))
        k, density, T = np.empty(lanes), np.empty(lanes), np.empty((12, lanes))
        forces, old = np.empty((width, 3)), np.empty((width, 3))
        blocks = np.empty((width, width, 3, 3))
        for c in range(chunk * _CHUNK, min(count, (chunk + 1) * _CHUNK)):
            modes, here = cells[c, nodes:], gradients[c, nodes:]
            start = first if volume[c, lanes - 1] > 0.0 else lanes
            energy, scale = np.inf, 1.0
            step, tried = np.zeros((width, 3)), 0
            for _ in range(steps + _BACKTRACKS):
                deformation(u, cells[c], gradients[c], 1.0, F)
                signed_svd_lanes(F, U, s, V, B, S)
                if model == COROTATED:
                    nearest_volume_lanes(s, v, k, start)
                    corotated_lanes(s, v, k, shear[c], volume[c], start, density, t)
                else:
                    hyperelastic_lanes(model, s, shear[c], volume[c], density, t)
                new = total(density)
                if not new <= energy + 1e-13 * abs(energy):
                    scale *= 0.5
                    if scale < 1e-6:
                        for m in range(width):
                            u[modes[m]] = old[m]
                        break
                    for m in range(width):
                        u[modes[m]] = old[m] + scale * step[m]
                    continue
                if tried == steps or (tried > 0 and np.abs(step).max() <= tolerance):
                    break
                tried += 1
                energy, scale = new, 1.0
                stress_lanes(U, t, V, P)
                nodal_forces(P, here, -1.0, forces)
                if model == COROTATED:
                    corotated_tangent_lanes(s, v, k, shear[c], volume[c], start, T)
                else:
                    hyperelastic_tangent_lanes(model, s, shear[c], volume[c], T)
                finish_tangent_lanes(T, True)
                add_stiffness(here, U, V, T, blocks)
                _solve(blocks, forces, step)
                for m in range(width):
                    old[m] = u[modes[m]]
                    u[modes[m]] = old[m] + step[m]


@njit(**OPTIONS)
def _solve(blocks, forces, step):  # type: ignore[no-untyped-def]
    """Step = K^-1 forces for the blocks of a positive semi-definite K, slightly shifted."""
    width = len(forces)
    K, f = np.empty((3 * width, 3 * width)), np.empty(3 * width)
    largest = 0.0
    for m in range(width):
        for i in range(3):
            f[3 * m + i] = forces[m, i]
            largest = max(largest, blocks[m, m, i, i])
            for n in range(width):
                for j in range(3):
                    K[3 * m + i, 3 * n + j] = blocks[m, n, i, j]
    for i in range(3 * width):
        K[i, i] += 1e-12 * largest + 1e-300
    x = np.linalg.solve(K, f)
    for m in range(width):
        for i in range(3):
            step[m, i] = x[3 * m + i]


def condense(blocks: Array, nodes: int) -> Array:
    """Eliminate the modes from tangents (C, L, L, 3, 3): (C, nodes, nodes, 3, 3).

    K_uu - K_ub K_bb^-1 K_bu, the second derivative of the energy with the modes in
    equilibrium.
    """
    count, width = blocks.shape[:2]
    full = blocks.transpose(0, 1, 3, 2, 4).reshape(count, 3 * width, 3 * width)
    n = 3 * nodes
    solved = np.linalg.solve(full[:, n:, n:], full[:, n:, :n])
    small = full[:, :n, :n] - full[:, :n, n:] @ solved
    return small.reshape(count, nodes, 3, nodes, 3).transpose(0, 1, 3, 2, 4)
