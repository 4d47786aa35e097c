"""Shape-function gradients at quadrature points, and what better elements make of them.

*Mean volume* (hex8-mean): the volume term sees the cell's mean deformation
gradient, at one more point that carries no corotated term.  One volume constraint
a cell instead of eight: no volumetric locking, and because it is the true mean,
affine deformations are exact on distorted cells too (a term at the cell's centre
is not).

*Incompatible modes* (hex8-bubble): three more shape functions a cell, B_m =
1 - (2 xi_m - 1)^2 on the unit cell, without mass and without load, which bend with the
cell (Wilson et al. 1973).  Their gradients are (det J0 / det J) J0^-T dB/dxi with J0
the Jacobian at the centre (Taylor, Beresford and Wilson 1976), so that their integral
vanishes and constant stress does no work on them: affine deformations are exact on
distorted cells.  The amplitudes are vectors in space, so the element does not depend
on the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.fem.hexahedron import shape_derivatives

Array = NDArray[np.float64]


_DIGITS = 11
"""To which numbers of different cells count as equal."""


def alike(values: Array) -> bool:
    """Whether the numbers (C, ...) of all cells are the first one's, up to rounding."""
    error = 10.0**-_DIGITS * np.abs(values[0]).max()
    return bool(np.abs(values - values[:1]).max() <= error)


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Shape-function gradients and volumes at the quadrature points.

    Attributes
    ----------
    lanes : (C, L, 3, Q)
        Gradient of each local shape function with respect to rest coordinates,
        1/m; nodes first, then internal modes.  One cell's quadrature points are
        neighbours in memory.
    weights : (C, Q)
        Rest volume of each point in the corotated term, m3.
    volume_weights : (C, Q)
        The same in the volume term.
    first_volume : int
        Points before it have no volume term.
    """

    lanes: Array
    weights: Array
    volume_weights: Array
    first_volume: int = 0

    @property
    def gradients(self) -> Array:
        """The gradients, (C, Q, L, 3), 1/m: a view of ``lanes``."""
        return np.moveaxis(self.lanes, 3, 1)

    @cached_property
    def alike_gradients(self) -> bool:
        """Whether the gradients are the same in all cells, see `alike`."""
        return alike(self.lanes)

    def of_cells(self, cells: slice) -> Quadrature:
        """Of some cells."""
        return replace(
            self,
            lanes=self.lanes[cells],
            weights=self.weights[cells],
            volume_weights=self.volume_weights[cells],
        )

    def with_mean_volume(self) -> Quadrature:
        """The volume term moved to one more point with the cell's mean gradients."""
        volume = self.weights.sum(axis=1)
        mean = np.einsum("cq,clxq->clx", self.weights / volume[:, None], self.lanes)
        nothing = np.zeros_like(self.weights)
        return replace(
            self,
            lanes=np.concatenate([self.lanes, mean[..., None]], axis=3),
            weights=np.pad(self.weights, ((0, 0), (0, 1))),
            volume_weights=np.concatenate([nothing, volume[:, None]], axis=1),
            first_volume=self.weights.shape[1],
        )

    def with_incompatible_modes(self, corners: Array, points: Array) -> Quadrature:
        """Three bubbles a cell more, for corners (C, 8, 3) and points (Q, 3) of the unit cell."""
        jacobian = np.einsum("cki,jqk->cqij", corners, shape_derivatives(points))
        middle = shape_derivatives(np.full((1, 3), 0.5))[:, 0]
        centre = np.einsum("cki,jk->cij", corners, middle)
        ratio = np.linalg.det(centre)[:, None] / np.linalg.det(jacobian)
        slopes = -4.0 * (2.0 * points - 1.0)  # dB_m/dxi_m, (Q, 3)
        inverse = np.linalg.inv(centre)  # (C, m, i): dxi_m/dx_i
        scaled = ratio[:, None, :] * slopes.T  # (C, m, Q)
        modes = np.einsum("cmq,cmi->cmiq", scaled, inverse)
        return replace(self, lanes=np.concatenate([self.lanes, modes], axis=1))

    def laplacian(self, coefficient: Array, local: NDArray[np.int64], size: int) -> sp.csr_matrix:
        """Sum of coefficient grad u . grad v, (size, size), for coefficients (C, Q).

        ``local`` (C, L) numbers the shape functions.
        """
        count, width = local.shape
        rows = self.lanes.reshape(count, width, -1)  # (C, L, 3Q)
        scaled = (self.lanes * coefficient[:, None, None, :]).reshape(count, width, -1)
        blocks = rows @ scaled.transpose(0, 2, 1)
        return sp.csr_matrix(
            sp.coo_matrix(
                (
                    blocks.ravel(),
                    (np.repeat(local, width, axis=1).ravel(), np.tile(local, width).ravel()),
                ),
                shape=(size, size),
            )
        )


@dataclass(frozen=True, eq=False)
class FaceQuadrature:
    """Values and gradients on boundary faces, with what surface loads need.

    Attributes
    ----------
    cells : (n,)
        Owner of each face.
    values : (n, Qf, K), gradients : (n, Qf, K, 3)
        Shape functions of the owner's nodes, 1 and 1/m.
    weights : (n, Qf)
        Rest area, m2.
    normals : (n, Qf, 3)
        Outward unit normals at rest.
    """

    cells: NDArray[np.int64]
    values: Array
    gradients: Array
    weights: Array
    normals: Array
