"""`ElasticBody`: a mesh, an element and materials, and the elastic energy's derivatives.

Elements with internal modes (hex8-bubble) have more unknowns than nodes.  A
*configuration* is an array (N + B, 3) of the nodes' positions followed by the
amplitudes of the B modes, m; for other elements B is 0 and it is just the positions.
Solvers work on configurations; users see positions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem import internal_modes, kernels
from pdcorrect.fem.assembly import Assembly, summed_cells
from pdcorrect.fem.cell_correction import CellCorrection, CorrectionTangent
from pdcorrect.fem.energies import nearest_rotation
from pdcorrect.fem.hexahedron import corner_jacobians
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.fem.materials import Materials
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.operators import Space, freeze
from pdcorrect.fem.quadrature import Quadrature

Array = NDArray[np.float64]

_RELAXED = 1e-13
"""Of the cell size: change of an internal mode at which its equilibrium is found."""
_FLAT = 1e-6
"""The same where only the energy is asked for, from modes that are near."""
_LARGEST = 1e50
"""Deformation gradients are cut off here, so that their squares' squares are finite."""
_NEAR = 1e-4
"""Of the cell size: change below which `internal_modes.relax` uses the exact tangent."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The tangent of the elastic energy at one state, see `kernels.linearise_cells`.

    ``left`` and ``right`` (C, 9, Q) are factors of the signed SVD of F, ``tangent`` (C, 12, Q), J,
    is that in their frame times the volumes, ``correction`` that of a learned element's own energy.
    """

    assembly: Assembly
    quadrature: Quadrature
    left: Array
    right: Array
    tangent: Array
    correction: CorrectionTangent | None = None

    def apply(self, x: Array) -> Array:
        """Tangent times x, both (N, 3), without assembling."""
        self.assembly.check(x)
        cells = self.assembly.cells
        by_cell = np.empty((*cells.shape, 3))
        kernels.apply_linearised(
            len(cells), x, cells, self.quadrature.lanes, self.left, self.right, self.tangent,
            by_cell,
        )  # fmt: skip
        out = self.assembly.gathered(by_cell)
        return out if self.correction is None else out + self.correction.apply(x)

    def blocks(self) -> Array:
        """The tangent of each cell, (C, L, L, 3, 3), N/m."""
        count, width = self.assembly.cells.shape
        blocks = np.empty((count, width, width, 3, 3))
        kernels.cell_stiffness(
            count, self.quadrature.lanes, self.left, self.right, self.tangent, blocks
        )
        if self.correction is not None:
            self.correction.add_to(blocks)
        return blocks


@dataclass(frozen=True, eq=False)
class ElasticBody:
    """A body that stores elastic energy; it knows neither mass nor time.

    Attributes
    ----------
    mesh : HexMesh
        Corners, for pictures and refinement.
    space : Space
    quadrature : Quadrature
    materials : Materials
    cell_size : float
        Coarse cell size (cube root of the mean cell volume), m: the unit of
        tolerances at every refinement.
    correction : CellCorrection, optional
        What a learned element adds.
    """

    mesh: HexMesh
    space: Space
    quadrature: Quadrature
    materials: Materials
    cell_size: float
    correction: CellCorrection | None = field(default=None, kw_only=True)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._freeze()

    def _freeze(self) -> None:
        """Make arrays read-only, which those of copies and of unpickled bodies are not."""
        space, quadrature = self.space, self.quadrature
        freeze(space.positions, space.cells, space.local)
        freeze(quadrature.lanes, quadrature.weights, quadrature.volume_weights)
        if self.correction is not None:
            freeze(self.correction.cells)

    @property
    def positions(self) -> Array:
        """Rest positions (N, 3), m."""
        return self.space.positions

    @property
    def cells(self) -> NDArray[np.int64]:
        """Node numbers (C, K), VTK order."""
        return self.space.cells

    @property
    def unknowns(self) -> int:
        """Nodes and internal modes, N + B."""
        return len(self.positions) + self.space.internal

    def extended(self, nodal: Array) -> Array:
        """A nodal vector (N, 3) followed by zeros for the internal modes, (N + B, 3)."""
        if not self.space.internal:
            return nodal
        return np.concatenate([nodal, np.zeros((self.space.internal, 3))])

    def relaxed(
        self,
        positions: Array,
        steps: int = 50,
        modes: Array | None = None,
        tolerance: float | None = None,
    ) -> Array:
        """The configuration (N + B, 3) in which the internal modes are in equilibrium.

        ``steps`` Newton steps in each cell at most, from ``modes`` (B, 3), m, by default from 0,
        until the last one is below ``tolerance`` cell sizes, by default far below rounding in
        nodal positions.
        """
        self._check(positions, len(self.positions))
        if not self.space.internal:
            return positions
        x = self.extended(positions - self.positions)
        if modes is not None:
            x[len(positions) :] = modes
        internal_modes.relax(
            len(self.cells), self.materials.model, x, self.space.local, self.cells.shape[1],
            self.quadrature.lanes, self.point_weights, self.quadrature.first_volume,
            steps, (_RELAXED if tolerance is None else tolerance) * self.cell_size,
            _NEAR * self.cell_size,
        )  # fmt: skip
        x[: len(positions)] = positions
        return x

    def following(self, positions: Array) -> Array:
        """The configuration (N + B, 3) whose modes follow as at rest, turned with their cells.

        Near equilibrium, for the price of a rotation of each cell: where solvers begin.  Where a
        cell is strongly strained, or modes have no stiffness at rest, by one step of `relaxed`.
        """
        self._check(positions, len(self.positions))
        if not self.space.internal or self._at_rest is None:
            return self.relaxed(positions, steps=1)
        out = self.extended(positions)
        turns = self.cell_rotations(positions)
        near = self._at_rest.follow(np.ascontiguousarray(turns), self.positions, out)
        return out if near else self.relaxed(positions, steps=1)

    def cell_rotations(self, positions: Array) -> Array:
        """Nearest rotation of each cell's mean deformation gradient, (C, 3, 3).

        Those of absurd or infinite deformations mean nothing: such a step fails by name.
        """
        u = positions[: len(self.positions)] - self.positions
        mean = np.swapaxes(u[self.cells], 1, 2) @ self._mean_gradients
        return nearest_rotation(np.eye(3) + np.clip(np.nan_to_num(mean), -_LARGEST, _LARGEST))

    @cached_property
    def _mean_gradients(self) -> Array:
        """Means of the nodal shape functions' gradients over the cells, (C, K, 3), 1/m."""
        shares = self.quadrature.weights / self.space.volumes()[:, None]
        lanes = self.quadrature.lanes[:, : self.cells.shape[1]]
        return np.einsum("cq,clxq->clx", shares, lanes, optimize=True)

    @cached_property
    def _at_rest(self) -> Condensed | None:
        """The tangent at rest, if modes have stiffness there."""
        blocks = self.linearise(self.extended(self.positions)).blocks()
        try:
            return Condensed(blocks, self.space.local, self.cells.shape[1])
        except np.linalg.LinAlgError:
            return None

    def energy(self, positions: Array, modes: Array | None = None) -> float:
        """Elastic energy, J, with internal modes in equilibrium.

        From near ``modes`` (B, 3), m, that is quicker and a little less exact.
        """
        tolerance = None if modes is None else _FLAT
        return self.energy_and_forces(self.relaxed(positions, modes=modes, tolerance=tolerance))[0]

    def forces(self, positions: Array) -> Array:
        """Elastic nodal forces -dW/dp, (N, 3), N."""
        return self.energy_and_forces(self.relaxed(positions))[1][: len(self.positions)]

    def stiffness(self, positions: Array, project: bool = False) -> sp.csr_matrix:
        """Tangent stiffness d2W/dp2, (3N, 3N), N/m; component i of node n is row 3 n + i.

        ``project`` raises negative eigenvalues to zero at each quadrature point.
        """
        return self.nodal_assembly.matrix(self.condensed(self.relaxed(positions), project).blocks)

    def condensed(self, configuration: Array, project: bool = False) -> Condensed:
        """The tangent with internal modes that follow the nodes, in equilibrium.

        `ConvergenceError` is raised where that is not stable.
        """
        blocks = self.linearise(configuration, project).blocks()
        try:
            return Condensed(blocks, self.space.local, self.cells.shape[1])
        except np.linalg.LinAlgError:
            raise ConvergenceError(
                "the internal modes of a cell are not in stable equilibrium: expected a state "
                "that a step converged to, or a shape that is strained less. Use project=True."
            ) from None

    def lifted(self, configuration: Array, nodal: Array) -> Array:
        """A change of the nodes (N, 3) with that of the modes, in equilibrium, (N + B, 3)."""
        return self.condensed(configuration).lifted(nodal) if self.space.internal else nodal

    def energy_and_forces(self, configuration: Array) -> tuple[float, Array]:
        """Elastic energy (J) and forces (N + B, 3) (N), from one pass over the cells."""
        u = self._displacement(configuration)
        energy, _, forces = self.element_forces(u, self.point_weights)
        total = float(energy.sum())
        if self.correction is not None:
            more, added = self.correction.energy_and_forces(u)
            total, forces = total + more, forces + added
        return total, forces

    def element_forces(self, u: Array, weights: Array) -> tuple[Array, Array, Array]:
        """Energy (C,), forces by cell (C, L, 3) and forces (N + B, 3) of the element alone.

        For displacements u (N + B, 3), m, and ``weights`` like `point_weights`.
        """
        cells, quadrature = self.space.local, self.quadrature
        energy, by_cell = np.empty(len(cells)), np.empty((*cells.shape, 3))
        kernels.energy_and_forces(
            len(cells), self.materials.model, u, cells, quadrature.lanes, weights,
            quadrature.first_volume, energy, by_cell,
        )  # fmt: skip
        return energy, by_cell, self.assembly.gathered(by_cell)

    def volume_ratios(self, positions: Array) -> Array:
        """Smallest det F over the quadrature points of each cell, (C,).

        Of the nodes' displacements alone: a cell that is turned inside out or folded
        has a value below zero, whatever its internal modes do.
        """
        self._check(positions, len(self.positions))
        out = np.empty(len(self.cells))
        kernels.smallest_determinants(
            len(out), positions - self.positions, self.cells, self.quadrature.lanes, out
        )
        return out

    def corner_volume_ratios(self, positions: Array) -> Array:
        """Volume ratios, det F, at the corners of each cell, (C, 8), of the trilinear map of them.

        Folded layers of cells show here first: det F may be positive at all quadrature points
        (`volume_ratios`) and negative at corners, which neither the energy nor steppers see.
        """
        self._check(positions, len(self.positions))
        corners = self.cells[:, :8]  # VTK order: also of cells with 27 nodes
        return corner_jacobians(positions, corners) / corner_jacobians(self.positions, corners)

    def linearise(
        self, configuration: Array, project: bool = False, cells: slice = slice(None)
    ) -> Linearisation:
        """The tangent at a configuration, ready to be applied or assembled.

        ``project`` raises negative eigenvalues at each quadrature point to zero; ``cells``
        are those that it is of.
        """
        if cells == slice(None):
            assembly, quadrature = self.assembly, self.quadrature
        else:
            assembly = Assembly(self.space.local[cells], self.unknowns)
            quadrature = self.quadrature.of_cells(cells)
        count, lanes = quadrature.weights.shape
        left, right = np.empty((count, 9, lanes)), np.empty((count, 9, lanes))
        tangent = np.empty((count, 12, lanes))
        u = self._displacement(configuration)
        kernels.linearise_cells(
            count, self.materials.model, u, assembly.cells, quadrature.lanes,
            self.point_weights[cells], quadrature.first_volume, project, left, right, tangent,
        )  # fmt: skip
        correction = None
        if self.correction is not None:
            correction = self.correction.tangent(u, project, cells=cells)
        return Linearisation(assembly, quadrature, left, right, tangent, correction)

    def laplacian(self, volume_scale: float = 1.0) -> sp.csr_matrix:
        """Sum (2 mu + s omega) w D^T D, (N + B, N + B), N/m: the stiffness in G (eq. 3-14).

        ``volume_scale`` is s.
        """
        shear, volume = self.point_weights[:, 0], self.point_weights[:, 1]
        lanes, shape = self.quadrature.lanes, (*self.space.local.shape, -1)
        scaled = lanes * (2 * shear + volume_scale * volume)[:, None, None, :]
        blocks = lanes.reshape(shape) @ scaled.reshape(shape).transpose(0, 2, 1)
        return summed_cells(self.space.local, blocks, self.unknowns)

    @cached_property
    def assembly(self) -> Assembly:
        """Sums cell-wise results into configurations."""
        return Assembly(self.space.local, self.unknowns)

    @cached_property
    def nodal_assembly(self) -> Assembly:
        """Sums cell-wise results at the nodes."""
        if not self.space.internal:
            return self.assembly
        return Assembly(self.cells, len(self.positions))

    @cached_property
    def point_weights(self) -> Array:
        """Mu w and omega w at the quadrature points, (C, 2, Q), J."""
        return np.stack(
            [
                self.materials.mu[:, None] * self.quadrature.weights,
                self.materials.volume_weight[:, None] * self.quadrature.volume_weights,
            ],
            axis=1,
        )

    def _displacement(self, configuration: Array) -> Array:
        """The nodes' positions less those at rest: gradients of it do not depend on the origin."""
        self._check(configuration, self.unknowns)
        if not self.space.internal:
            return np.subtract(configuration, self.positions)
        out = np.array(configuration)
        out[: len(self.positions)] -= self.positions
        return out

    def _check(self, x: Array, count: int) -> None:
        if np.shape(x) != (count, 3):
            raise InputError(f"positions {np.shape(x)}: expected ({count}, 3), one row a node.")
