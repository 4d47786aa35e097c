"""A coarse-mesh correction of G^-1: bending and twisting as the true Hessian sees them.

G takes every rotation of a part of the body for strain, so it is far too stiff where the
body bends or twists, in smooth motions that the scene's own coarse mesh resolves too.
With P the interpolation from it, R the nodes' rotations since rest, G_c = P^T G P and
H_c the true rest Hessian on the coarse mesh,

    B = G^-1 + R P (H_c^-1 - G_c^-1) P^T R^T

is symmetric and positive definite, since G^-1 - P G_c^-1 P^T never is negative, and
takes less than half of G's iterations for two small products more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.sharing import Sharing
from pdcorrect.fem.mesh import interpolation
from pdcorrect.fem.problem import Problem, discretise

Array = NDArray[np.float64]


class CoarseCorrection:
    """R -> P (H_c^-1 - G_c^-1) P^T r on nodal fields (B, N, 3), in the frame of rest.

    Parameters
    ----------
    cells : CellBatch
    problems : sequence of Problem
        The distinct ones of the batch, refined.
    matrices : sequence of (N, N) sparse or None
        Their G; None where it is singular, and there is no correction.
    factors : (float, float)
        On mass (1/s2) and stiffness.
    sharing : Sharing
    """

    def __init__(
        self,
        cells: CellBatch,
        problems: Sequence[Problem],
        matrices: Sequence[sp.csr_matrix | None],
        factors: tuple[float, float],
        sharing: Sharing,
    ) -> None:
        parts = [_parts(p, G, factors) for p, G in zip(problems, matrices, strict=True)]
        nodes = cells.sizes.nodes
        most = max(P.shape[1] for P, _ in parts)
        device = cells.device
        self._sharing = sharing
        P = padded([P for P, _ in parts], (nodes, most))
        self._P = torch.as_tensor(P, dtype=torch.float32, device=device)
        difference = padded([D for _, D in parts], (3 * most, 3 * most))
        self._difference = torch.as_tensor(difference, dtype=torch.float32, device=device)
        self.bytes = 4 * (self._P.numel() + self._difference.numel())

    def narrowed(self, sharing: Sharing, kept: list[int]) -> CoarseCorrection:
        """With some of the matrices."""
        rows = torch.tensor(kept, device=self._P.device)
        return with_rows(self, rows, "_P", "_difference", _sharing=sharing)

    def __call__(self, r: Tensor) -> Tensor:
        shared = self._sharing.gathered(r.to(torch.float32))  # (K, m, N, 3)
        count, most, nodes, _ = shared.shape
        columns = shared.permute(0, 2, 3, 1).reshape(count, nodes, 3 * most)
        coarse = self._P.transpose(1, 2) @ columns
        size = coarse.shape[1]
        flat = coarse.reshape(count, 3 * size, most)
        moved = (self._difference @ flat).reshape(count, size, 3 * most)
        x = (self._P @ moved).reshape(count, nodes, 3, most).permute(0, 3, 1, 2)
        return self._sharing.scattered(x).to(r.dtype)


def _parts(
    problem: Problem, G: sp.csr_matrix | None, factors: tuple[float, float]
) -> tuple[Array, Array]:
    """P (N, N_c) and H_c^-1 - G_c^-1, (3 N_c, 3 N_c), zero where clamped."""
    coarse = discretise(problem.scene, element="hex8")
    P = interpolation(coarse.mesh, problem.refine)
    if G is None:
        return P.toarray(), np.zeros((coarse.free.size, coarse.free.size))
    identity = sp.eye_array(3)
    free = sp.diags_array(problem.free.ravel().astype(np.float64))
    held = sp.diags_array(coarse.free.ravel().astype(np.float64))
    Q = sp.csr_matrix(free @ sp.kron(P, identity) @ held)
    G_c = (Q.T @ sp.kron(G, identity) @ Q).toarray()
    mass = Q.T @ sp.kron(problem.mass_matrix, identity) @ Q
    K = held @ coarse.stiffness(coarse.positions, project=True) @ held
    H_c = (factors[0] * mass + factors[1] * K).toarray()
    keep = coarse.free.ravel()
    out = np.zeros_like(G_c)
    place = np.ix_(keep, keep)
    out[place] = np.linalg.inv(H_c[place]) - np.linalg.inv(G_c[place])
    return P.toarray(), out
