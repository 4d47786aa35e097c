"""Stretches and viscous forces of a batch: `pdcorrect.fem.viscosity` for B scenes, in torch.

Symmetric tensors are (6, B C, Q), 00 11 22 01 02 12; weights (2, B C, Q) are the strain
rate's factor times the viscosity times mu and omega and the points' volumes.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.decomposition import product, signed_svd, transposed
from pdcorrect.batch.points import Components, computed, moved
from pdcorrect.fem.viscosity import KINK

_FULL = (0, 3, 4, 3, 1, 5, 4, 5, 2)
_UPPER = (0, 4, 8, 1, 2, 5)


Frames = tuple[Tensor, Tensor, Tensor]
"""The signed SVD of F at the points: U (9, B C, Q), s (3, B C, Q), V (9, B C, Q)."""


def stretches(cells: CellBatch, y: Tensor) -> tuple[Tensor, Frames]:
    """S (6, B C, Q) and its frames at configurations (B, U, 3)."""
    S, U, s, V = computed(_stretch, [cells.gradients(y - cells.rest)], (6, 9, 3, 9))
    return S, (U, s, V)


def stress(change: Tensor, weights: Tensor) -> Tensor:
    """Weights times the small-strain law of a change of S, (6, B C, Q), J."""
    (out,) = computed(_law, [change, weights], (6,))
    return out


def energies(cells: CellBatch, change: Tensor, stress: Tensor) -> Tensor:
    """1/2 stress : change summed over the points of each scene, (B,), J."""
    (out,) = computed(_energy, [change, stress], (1,))
    return out.reshape(cells.sizes.scenes, -1).sum(dim=1)


def forces(cells: CellBatch, frames: Frames, stress: Tensor) -> Tensor:
    """Derivatives (B, U, 3) of stress : S by the configuration."""
    (P,) = computed(_pull, [*frames, stress], (9,), cell_by_cell=True)
    return cells.gathered(P)


def rates(cells: CellBatch, frames: Frames, x: Tensor) -> Tensor:
    """DS (6, B C, Q) for a change x (B, U, 3) of the configuration."""
    (out,) = computed(_rates, [*frames, cells.gradients(x)], (6,))
    return out


def apply(cells: CellBatch, tangent: Sequence[Tensor], x: Tensor) -> Tensor:
    """The second derivative of the viscous potential times x, both (B, U, 3).

    ``tangent`` has the frames, the stress and the weights.
    """
    (P,) = computed(_change, [*tangent, cells.gradients(x)], (9,), cell_by_cell=True)
    return cells.gathered(P)


def stress_slopes(cells: CellBatch, A: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of A : C : B, summed over points, by each cell's mu and omega, m3, (B, C)."""
    by_mu, by_omega = computed(_slopes, [A, B, cells.volumes], (1, 1))
    n = cells.sizes
    found = (x.reshape(n.scenes, n.cells, n.points).sum(dim=2) for x in (by_mu, by_omega))
    first, second = found
    return first, second


# --- at one point --------------------------------------------------------------------------------


def _stretch(H: Components) -> list[Components]:
    U, s, V = signed_svd(moved(H))
    zero = torch.zeros_like(s[0])
    diagonal = [s[i // 4] if i % 4 == 0 else zero for i in range(9)]
    return [_symmetric(V, diagonal), U, s, V]


def _symmetric(V: Components, A: Components) -> Components:
    """The upper half of V A V^T."""
    full = product(product(V, A), transposed(V))
    return [full[i] for i in _UPPER]


def _law(change: Components, weights: Components) -> list[Components]:
    mean = weights[1] / 3.0 * (change[0] + change[1] + change[2])
    return [[2.0 * weights[0] * a + (mean if i < 3 else 0.0) for i, a in enumerate(change)]]


def _contracted(A: Components, B: Components) -> Tensor:
    return (
        A[0] * B[0] + A[1] * B[1] + A[2] * B[2]
        + 2.0 * (A[3] * B[3] + A[4] * B[4] + A[5] * B[5])
    )  # fmt: skip


def _energy(change: Components, stress: Components) -> list[Components]:
    return [[0.5 * _contracted(change, stress)]]


def _slopes(A: Components, B: Components, volumes: Components) -> list[Components]:
    traces = (A[0] + A[1] + A[2]) * (B[0] + B[1] + B[2])
    return [[2.0 * volumes[0] * _contracted(A, B)], [volumes[1] / 3.0 * traces]]


def _inverse_sums(s: Components) -> Components:
    """1 / (s_i + s_j), 0 at a kink, as nine components."""
    out = []
    for i in range(3):
        for j in range(3):
            total = s[i] + s[j]
            apart = total.abs() > KINK * s[0]
            out.append(torch.where(apart, 1.0 / torch.where(apart, total, 1.0), 0.0))
    return out


def _times(A: Components, B: Components) -> Components:
    return [a * b for a, b in zip(A, B, strict=True)]


def _in_frame(V: Components, A: Components) -> Components:
    return product(product(transposed(V), [A[i] for i in _FULL]), V)


def _pulled(s: Components, Z: Components) -> Components:
    """2 s Z."""
    return [2.0 * s[i // 3] * z for i, z in enumerate(Z)]


def _pull(U: Components, s: Components, V: Components, A: Components) -> list[Components]:
    Z = _times(_in_frame(V, A), _inverse_sums(s))
    return [product(product(U, _pulled(s, Z)), transposed(V))]


def _stretching(s: Components, B: Components, inverse: Components) -> Components:
    """DS in the frame of V for B = U^T dF V."""
    return [
        B[3 * i + j] if i == j
        else (s[i] * B[3 * i + j] + s[j] * B[3 * j + i]) * inverse[3 * i + j]
        for i in range(3) for j in range(3)
    ]  # fmt: skip


def _rates(U: Components, s: Components, V: Components, D: Components) -> list[Components]:
    B = product(product(transposed(U), D), V)
    return [_symmetric(V, _stretching(s, B, _inverse_sums(s)))]


def _change(
    U: Components, s: Components, V: Components, A: Components, weights: Components, D: Components
) -> list[Components]:
    inverse = _inverse_sums(s)
    Z = _times(_in_frame(V, A), inverse)
    B = product(product(transposed(U), D), V)
    dS = _stretching(s, B, inverse)
    mean = weights[1] / 3.0 * (dS[0] + dS[4] + dS[8])
    back, ahead = product(Z, dS), product(dS, Z)
    dA = [
        2.0 * weights[0] * a - b - c + (mean if i in (0, 4, 8) else 0.0)
        for i, (a, b, c) in enumerate(zip(dS, back, ahead, strict=True))
    ]
    more = product(B, Z)
    P = [a + 2.0 * b for a, b in zip(_pulled(s, _times(dA, inverse)), more, strict=True)]
    return [product(product(U, P), transposed(V))]
