"""Shape-function gradients at quadrature points, and what better elements make of them.

*Mean volume* (hex8-mean): the volume term sees the cell's mean deformation
gradient, at one more point that carries no corotated term.  One volume constraint
a cell instead of eight: no volumetric locking, and because it is the true mean,
affine deformations are exact on distorted cells too (a term at the cell's centre
is not).

*Linear volume* (hex8-enhanced): the volume term sees the part of the deformation gradient that
is linear in the cell's own coordinates xi, incompatible modes included: its L2 projection on
1, xi_1, xi_2, xi_3, as in B-bar methods (Simo, Taylor and Pister 1985 project it on constants).
Bending changes volume linearly in the cell, so it keeps its stiffness; the products xi_1 xi_2
etc., which no mode could relieve near nu = 0.5, are left out.  Nine points stand for the linear
part: the mean, without which a folded cell could look right, and eight like the Gauss points
about it: in large bending six on the axes are too stiff.

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
from numpy.typing import NDArray

from pdcorrect.fem.hexahedron import VTK_CORNERS, shape_derivatives

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

    def with_volume_points(self, shares: Array) -> Quadrature:
        """The volume term moved to P more points, averages of the others.

        ``shares`` (C, Q, P) say how much a stress at the new points counts at the others, see
        `mean_shares` and `linear_shares`: the gradients there are sum_q w_q shares_qp G_q / v_p
        with v_p = sum_q w_q shares_qp, the point's weight.
        """
        volumes = np.einsum("cq,cqp->cp", self.weights, shares)
        averages = self.weights[:, :, None] * shares / volumes[:, None, :]
        count, width, _, points = self.lanes.shape
        more = (self.lanes.reshape(count, 3 * width, points) @ averages).reshape(
            count, width, 3, -1
        )
        nothing = np.zeros_like(self.weights)
        return replace(
            self,
            lanes=np.concatenate([self.lanes, more], axis=3),
            weights=np.pad(self.weights, ((0, 0), (0, volumes.shape[1]))),
            volume_weights=np.concatenate([nothing, volumes], axis=1),
            first_volume=points,
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


_MEAN_SHARE = 0.1
"""Of the volume weight, at the mean of the linear part.  From 0.1 on folded cells come back
(`tests/test_recovery.py`)."""
_CORNERS = 2.0 * VTK_CORNERS - 1.0


def mean_shares(weights: Array) -> Array:
    """Of the cell's mean, (C, Q, 1), see `Quadrature.with_volume_points`."""
    return np.ones((*weights.shape, 1))


def linear_shares(weights: Array, points: Array) -> Array:
    """Of the nine points that stand for the linear part, (C, Q, 9).

    With phi_i the cell's coordinates xi_i less their mean and made orthonormal over the cell, the
    projection of G is mean G + sum_i phi_i C_i, C_i = mean of phi_i G.  Its points are
    mean G + a (+- C_1 +- C_2 +- C_3), a^2 = 1 / (1 - share of the mean), and mean G.
    ``weights`` (C, Q) are rest volumes, m3; ``points`` (Q, 3) lie on the unit cell.
    """
    parts = weights / weights.sum(axis=1, keepdims=True)
    centred = points - np.einsum("cq,qi->ci", parts, points)[:, None]
    moments = np.einsum("cq,cqi,cqj->cij", parts, centred, centred)
    values, axes = np.linalg.eigh(moments)
    root = (axes / np.sqrt(values)[:, None, :]) @ axes.transpose(0, 2, 1)  # moments^-1/2
    outer = 1.0 - _MEAN_SHARE
    corners = (1.0 + (centred @ root) @ _CORNERS.T / np.sqrt(outer)) * (outer / len(_CORNERS))
    return np.concatenate([corners, np.full((*weights.shape, 1), _MEAN_SHARE)], axis=2)


@dataclass(frozen=True, eq=False)
class FaceQuadrature:
    """Values (n, Qf, K) and gradients (n, Qf, K, 3), 1/m, on boundary faces of these cells (n,).

    Of the cells' shape functions; ``weights`` (n, Qf) are rest areas, m2, ``normals`` (n, Qf, 3)
    outward unit normals at rest.
    """

    cells: NDArray[np.int64]
    values: Array
    gradients: Array
    weights: Array
    normals: Array
