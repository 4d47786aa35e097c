"""Oblique rollers: clamps of one direction that is no axis, by stiff springs along it.

    W = sum_a k_a/2 (n_a . (x_a - x'_a(t)))^2

with x' where the clamp would have the node.  k is so much larger than the body's own stiffness at
the node that the springs give by a millionth of what the body does.  Components along an axis are
held exactly instead, see `clamps`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.clamps import Clamps, ObliqueClamp
from pdcorrect.fem.elastic_body import ElasticBody

Array = NDArray[np.float64]

_STIFFER = 1e6
"""Than the body at a node."""
_ALIKE = 1e-9
"""Relative size of what is new in a direction that others hold already."""


@dataclass(frozen=True, eq=False)
class Rollers:
    """Springs of all oblique clamps; their second derivative is constant.

    Attributes
    ----------
    clamps : tuple of ObliqueClamp
    rest, free : (N, 3)
        Rest positions of all nodes, m, and the components that no other clamp holds.
    nodes, normals : (m,), (m, 3)
        Of the springs.
    stiffness : (m,)
        N/m.
    cells, corners : (m,)
        A cell of each node, and which of its nodes that is.
    """

    clamps: tuple[ObliqueClamp, ...]
    rest: Array
    free: NDArray[np.bool_]
    nodes: NDArray[np.int64]
    normals: Array
    stiffness: Array
    cells: NDArray[np.int64]
    corners: NDArray[np.int64]
    at_end: ClassVar[bool] = True

    @classmethod
    def of(cls, clamps: Clamps, body: ElasticBody) -> Rollers:
        """Those of a body's clamps."""
        oblique = clamps.oblique
        nodes = np.concatenate([clamp.nodes for clamp in oblique])
        normals = np.concatenate([np.tile(c.normal, (len(c.nodes), 1)) for c in oblique])
        own = body.laplacian().diagonal()[nodes]
        assembly = body.assembly
        cells, corners = np.divmod(assembly.slots[assembly.start[nodes]], assembly.cells.shape[1])
        return cls(
            oblique, clamps.rest, clamps.free, nodes, normals, _STIFFER * own, cells, corners
        )

    def energy_and_forces(self, u: Array, time: float) -> tuple[float, Array]:
        """J, and of the springs on the nodes, (N, 3), N, for displacements u (N, 3), m."""
        out, gaps = np.zeros_like(self.rest), self._gaps(u, time)
        pull = -self.stiffness * gaps
        np.add.at(out, self.nodes, pull[:, None] * self.normals)
        return -0.5 * float(pull @ gaps), out

    def tangent(self, u: Array, time: float, project: bool = False, factor: float = 1.0) -> Rollers:
        """The second derivative times a factor."""
        return self if factor == 1.0 else replace(self, stiffness=factor * self.stiffness)

    def rest_tangent(self) -> Rollers:
        """The same."""
        return self

    def led(self, velocities: Array, start: float, end: float) -> Array:
        """Velocities (N, 3), m/s, that along all clamps are their means from start to end."""
        places, _, inverse = self._constraints
        rates = np.zeros((len(places), inverse.shape[2]))
        rates[:, -3:] = velocities[places] * ~self.free[places]
        for k, clamp in enumerate(self.clamps):
            way = clamp.displacements(self.rest, end) - clamp.displacements(self.rest, start)
            rates[np.searchsorted(places, clamp.nodes), k] = way @ clamp.normal / (end - start)
        out = self.along(velocities)
        out[places] += np.einsum("rik,rk->ri", inverse, rates)
        return out

    def along(self, x: Array) -> Array:
        """X (N, 3) without what clamps hold at the rollers' nodes, of other clamps too."""
        places, ways, _ = self._constraints
        out = x.copy()
        out[places] = np.einsum("rki,rkj,rj->ri", ways, ways, x[places])
        return out

    @cached_property
    def _constraints(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Nodes (r,), unit vectors in which they may move (r, 3, 3), zero for those in which they
        may not, and the pseudo-inverse (r, 3, clamps + 3) of what holds them.

        A node may be on several rollers, whose normals need not be orthogonal.
        """
        places = np.unique(self.nodes)
        rows = np.zeros((len(places), len(self.clamps) + 3, 3))
        for k, clamp in enumerate(self.clamps):
            rows[np.searchsorted(places, clamp.nodes), k] = clamp.normal
        rows[:, -3:] = np.eye(3) * ~self.free[places][:, None]
        _, sizes, ways = np.linalg.svd(rows)
        ways = np.asarray(ways * (sizes <= _ALIKE * sizes[:, :1])[:, :, None], dtype=np.float64)
        return places, ways, np.asarray(np.linalg.pinv(rows, rcond=_ALIKE), dtype=np.float64)

    def apply(self, x: Array) -> Array:
        """The second derivative times x (N + B, 3)."""
        out = np.zeros_like(x)
        along = self.stiffness * np.einsum("mi,mi->m", self.normals, x[self.nodes])
        np.add.at(out, self.nodes, along[:, None] * self.normals)
        return out

    def add_to(self, blocks: Array) -> None:
        """Add the second derivative to the cells' matrices (C, L, L, 3, 3)."""
        n = self.normals
        more = self.stiffness[:, None, None] * n[:, :, None] * n[:, None, :]
        np.add.at(blocks, (self.cells, self.corners, self.corners), more)

    def _targets(self, time: float) -> Array:
        """X' less the rest positions, (m, 3), m."""
        return np.concatenate([clamp.displacements(self.rest, time) for clamp in self.clamps])

    def _gaps(self, u: Array, time: float) -> Array:
        """How far each spring is stretched, (m,), m."""
        return np.einsum("mi,mi->m", self.normals, u[self.nodes] - self._targets(time))
