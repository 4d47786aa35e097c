"""Internal modes of a cell: in equilibrium with its nodes, and eliminated from its tangent."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdcorrect.fem.cell_loops import CellLoop
from pdcorrect.fem.decomposition import OPTIONS, scratch, signed_svd_lanes
from pdcorrect.fem.energies import principal_stress_lanes, principal_tangent_lanes, stress_lanes
from pdcorrect.fem.kernels import (
    REDUCE,
    deformation,
    nodal_forces,
    stiffness,
    stiffness_room,
    total,
)

Array = NDArray[np.float64]

_BACKTRACKS = 30
_STRAINED = 0.5
"""Of a cell's size: change of shape beyond which its modes do not follow as at rest."""
_CHORD = 100.0
"""Times ``near``: length of a step after which the next one tries the same tangent first."""


@CellLoop
def relax(  # type: ignore[no-untyped-def]
    begin, end, model, u, cells, nodes, gradients, weights, first, steps, tolerance, near
):
    """Bring the internal modes in u (N + B, 3) to equilibrium with the nodes, in place.

    Newton's method in each cell, with the projected tangent far from equilibrium and where the
    exact one is not positive definite, at most ``steps`` times or until no
    mode changes by more than ``tolerance`` (m).  Farther than a last step of ``near`` (m) the
    exact tangent can lead to another equilibrium, and magnifies rounding where modes have hardly
    any stiffness.  A tangent costs several times a stress, so near equilibrium the last one is
    used again as long as steps become shorter by a factor of ten (chord method).

    ``nodes`` is the number of nodes a cell; its other local shape functions are modes.
    Other arguments as `kernels.energy_and_forces`.
    """
    lanes, width = weights.shape[2], cells.shape[1] - nodes
    F, U, V, B, S, s, v, k = scratch(lanes)
    P, T, room = np.empty((9, lanes)), np.empty((12, lanes)), stiffness_room(width, lanes)
    t, density = np.empty((3, lanes)), np.empty(lanes)
    forces, old, step = np.empty((width, 3)), np.empty((width, 3)), np.empty((width, 3))
    K, flat = np.empty((width, 3, width, 3)), step.reshape(3 * width, 1)
    M = K.reshape(3 * width, 3 * width)
    for c in range(begin, end):
        modes, here = cells[c, nodes:], gradients[c, nodes:]
        shear, volume = weights[c, 0], weights[c, 1]
        start = first if volume[lanes - 1] > 0.0 else lanes
        energy, scale, tried, cut = np.inf, 1.0, 0, False
        for _ in range(steps + _BACKTRACKS):
            deformation(u, cells[c], gradients[c], 1.0, F)
            signed_svd_lanes(F, U, s, V, B, S)
            principal_stress_lanes(model, s, v, k, shear, volume, start, density, t)
            new = total(density)
            if not new <= energy + 1e-13 * abs(energy):
                scale *= 0.5
                cut = True
                if scale < 1e-6:
                    for m in range(width):
                        u[modes[m]] = old[m]
                    break
                for m in range(width):
                    u[modes[m]] = old[m] + scale * step[m]
                continue
            if tried == steps or (tried > 0 and _largest(step) <= tolerance):
                break
            tried += 1
            energy, scale = new, 1.0
            stress_lanes(U, t, V, P)
            nodal_forces(P, here, -1.0, forces)
            last = np.inf if tried == 1 or cut else _largest(step)
            cut = False
            if last <= _CHORD * near:
                step[:] = forces
                _substitute(M, flat)
            if not (last <= _CHORD * near and _largest(step) <= 0.1 * last):
                for cautious in (last > near, True):
                    principal_tangent_lanes(model, s, v, k, shear, volume, start, cautious, T)
                    stiffness(here, U, V, T, room, K)
                    if _factorise(M, 1e-12) or cautious:
                        break
                step[:] = forces
                _substitute(M, flat)
            for m in range(width):
                old[m] = u[modes[m]]
                u[modes[m]] = old[m] + step[m]


@njit(**OPTIONS)
def _largest(step):  # type: ignore[no-untyped-def]
    """Largest size of an entry of ``step`` (L, 3)."""
    out = 0.0
    for m in range(step.shape[0]):
        for i in range(3):
            out = max(out, abs(step[m, i]))
    return out


@njit(**OPTIONS)
def _factorise(M, share):  # type: ignore[no-untyped-def]
    """Cholesky's factor of M (n, n), in its lower triangle; whether M is positive definite.

    Pivots below ``share`` of the largest diagonal entry are not positive and are raised to it.
    """
    least = 1e-300
    for i in range(len(M)):
        least = max(least, share * M[i, i])
    positive = True
    for i in range(len(M)):
        for j in range(i):
            entry = M[i, j]
            for n in range(j):
                entry -= M[i, n] * M[j, n]
            M[i, j] = entry / M[j, j]
        pivot = M[i, i]
        for n in range(i):
            pivot -= M[i, n] * M[i, n]
        positive &= pivot > least
        M[i, i] = np.sqrt(max(pivot, least))
    return positive


@njit(**OPTIONS)
def _substitute(M, x):  # type: ignore[no-untyped-def]
    """Overwrite x (n, m) by M^-1 x, for the factor of M that `_factorise` left."""
    size, columns = x.shape
    for i in range(size):
        for n in range(i):
            for b in range(columns):
                x[i, b] -= M[i, n] * x[n, b]
        for b in range(columns):
            x[i, b] /= M[i, i]
    for i in range(size - 1, -1, -1):
        for n in range(i + 1, size):
            for b in range(columns):
                x[i, b] -= M[n, i] * x[n, b]
        for b in range(columns):
            x[i, b] /= M[i, i]


@CellLoop
def _eliminate(  # type: ignore[no-untyped-def]
    begin, end, blocks, nodes, shift, condensed, inverse, solved, positive
):
    """Fill K_uu - K_ub K_bb^-1 K_bu, K_bb^-1, K_bb^-1 K_bu and whether K_bb is positive."""
    m, n = 3 * (blocks.shape[1] - nodes), 3 * nodes
    K, right = np.empty((m, m)), np.empty((m, m + n))
    coupling, row = np.empty((m, n)), np.empty(n)
    for c in range(begin, end):
        for i in range(m):
            k, a = nodes + i // 3, i % 3
            for j in range(m):
                K[i, j] = blocks[c, k, nodes + j // 3, a, j % 3]
                right[i, j] = 1.0 if i == j else 0.0
            _copy_row(blocks[c, k, :nodes, a], coupling[i])
            right[i, m:] = coupling[i]
        largest = 0.0
        for i in range(m):
            largest = max(largest, K[i, i])
        for i in range(m):
            K[i, i] += shift * largest
        positive[c] = _factorise(K, 0.0)
        _substitute(K, right)
        inverse[c] = right[:, :m]
        solved[c] = right[:, m:]
        for i in range(n):
            _copy_row(blocks[c, i // 3, :nodes, i % 3], row)
            for b in range(0, m, 3):
                x, y, z = coupling[b, i], coupling[b + 1, i], coupling[b + 2, i]
                for j in range(n):
                    row[j] -= (
                        x * solved[c, b, j] + y * solved[c, b + 1, j] + z * solved[c, b + 2, j]
                    )
            for j in range(nodes):
                for a in range(3):
                    condensed[c, i // 3, j, i % 3, a] = row[3 * j + a]


@njit(**OPTIONS)
def _copy_row(blocks, row):  # type: ignore[no-untyped-def]
    for k in range(len(blocks)):
        for a in range(3):
            row[3 * k + a] = blocks[k, a]


@njit(**OPTIONS)
def _reduce(solved, nodes, modes, r, out):  # type: ignore[no-untyped-def]
    """Subtract (K_bb^-1 K_bu)^T times the modes' part of r (N + B, 3) from out (N, 3)."""
    row = np.empty(solved.shape[2])
    for c in range(len(nodes)):
        row[:] = 0.0
        for b in range(solved.shape[1]):
            value = r[modes[c, b // 3], b % 3]
            for j in range(len(row)):
                row[j] += solved[c, b, j] * value
        for k in range(nodes.shape[1]):
            for j in range(3):
                out[nodes[c, k], j] -= row[3 * k + j]


@njit(**REDUCE)
def _recover(inverse, solved, nodes, modes, r, out):  # type: ignore[no-untyped-def]
    """Modes of out (N + B, 3): K_bb^-1 times those of r less K_bb^-1 K_bu times its nodes."""
    row, force = np.empty(solved.shape[2]), np.empty(solved.shape[1])
    for c in range(len(nodes)):
        for k in range(nodes.shape[1]):
            for j in range(3):
                row[3 * k + j] = out[nodes[c, k], j]
        for b in range(len(force)):
            force[b] = r[modes[c, b // 3], b % 3]
        for b in range(len(force)):
            held, moved = 0.0, 0.0
            for a in range(len(force)):
                held += inverse[c, b, a] * force[a]
            for j in range(len(row)):
                moved += solved[c, b, j] * row[j]
            out[modes[c, b // 3], b % 3] = held - moved


@njit(**OPTIONS)
def _follow(solved, turns, rest, nodes, modes, out):  # type: ignore[no-untyped-def]
    """Modes of out (N + B, 3): R times -K_bb^-1 K_bu times R^T times its nodes less the rest's.

    False where a cell is too strained for that.
    """
    width = nodes.shape[1]
    moved, amplitude = np.empty(3 * width), np.empty(3)
    for c in range(len(nodes)):
        R, first = turns[c], nodes[c, 0]
        size, most = 0.0, 0.0
        for k in range(width):
            for j in range(3):
                turned = 0.0
                for i in range(3):
                    turned += R[i, j] * (out[nodes[c, k], i] - out[first, i])
                length = rest[nodes[c, k], j] - rest[first, j]
                moved[3 * k + j] = turned - length
                size, most = max(size, abs(length)), max(most, abs(turned - length))
        if most > _STRAINED * size:
            return False
        for m in range(modes.shape[1]):
            for i in range(3):
                total = 0.0
                for n in range(3 * width):
                    total -= solved[c, 3 * m + i, n] * moved[n]
                amplitude[i] = total
            for i in range(3):
                value = R[i, 0] * amplitude[0] + R[i, 1] * amplitude[1] + R[i, 2] * amplitude[2]
                out[modes[c, m], i] = value
    return True


class Condensed:
    """Tangents (C, L, L, 3, 3) of nodes and modes, with the modes eliminated.

    ``local`` (C, L) numbers both in a configuration, ``nodes`` is how many are nodes, and
    ``shift`` is added to the diagonal of the modes' tangents, of its largest entry.

    Its ``blocks`` (C, nodes, nodes, 3, 3), K_uu - K_ub K_bb^-1 K_bu, are the second derivative of
    the energy with the modes in equilibrium; ``size`` is the number of modes of all cells.

    Raises
    ------
    numpy.linalg.LinAlgError
        If K_bb of a cell is not positive definite.
    """

    def __init__(
        self, blocks: Array, local: NDArray[np.int64], nodes: int, shift: float = 0.0
    ) -> None:
        count, width = blocks.shape[:2]
        m = 3 * (width - nodes)
        self._nodes, self._modes = local[:, :nodes], local[:, nodes:]
        self.size, self.blocks = self._modes.size, blocks
        if not self.size:
            return
        self.blocks = np.empty((count, nodes, nodes, 3, 3))
        self._inverse = np.empty((count, m, m))
        self._solved = np.empty((count, m, 3 * nodes))
        positive = np.empty(count, dtype=np.bool_)
        _eliminate(count, blocks, nodes, shift, self.blocks, self._inverse, self._solved, positive)
        if not positive.all():
            raise np.linalg.LinAlgError("the modes of a cell have an indefinite tangent")

    def reduced(self, r: Array) -> Array:
        """Right-hand side (N, 3) of the nodes for that of a configuration, (N + B, 3)."""
        if not self.size:
            return r
        out = r[: len(r) - self.size].copy()
        _reduce(self._solved, self._nodes, self._modes, r, out)
        return out

    def recovered(self, nodal: Array, r: Array) -> Array:
        """The whole solution (N + B, 3) for that of the nodes (N, 3) and right-hand side r."""
        if not self.size:
            return nodal
        out = np.empty_like(r)
        out[: len(nodal)] = nodal
        _recover(self._inverse, self._solved, self._nodes, self._modes, r, out)
        return out

    def lifted(self, nodal: Array) -> Array:
        """The configuration's change (N + B, 3) for a change of the nodes (N, 3)."""
        return self.recovered(nodal, np.zeros((len(nodal) + self.size, 3)))

    def follow(self, turns: Array, rest: Array, out: Array) -> bool:
        """Set the modes of ``out`` (N + B, 3) by its nodes, in cells turned by ``turns`` (C, 3, 3).

        ``rest`` (N, 3) are positions at which they are zero.  False where a cell is too strained.
        """
        return bool(_follow(self._solved, turns, rest, self._nodes, self._modes, out))

    def response(self, r: Array) -> Array:
        """The modes' change (N + B, 3) with nodes held, by forces r (N + B, 3)."""
        return self.recovered(np.zeros((len(r) - self.size, 3)), r)
