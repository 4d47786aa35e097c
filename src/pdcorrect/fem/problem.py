"""`Problem`: a scene on a mesh, with everything a stepper needs; `discretise` makes it.

Elements with internal modes (hex8-bubble) have more unknowns than nodes.  A
*configuration* is an array (N + B, 3) of the nodes' positions followed by the
amplitudes of the B modes, m; for other elements B is 0 and it is just the positions.
Solvers work on configurations; users see positions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError, SceneError
from pdcorrect.fem import internal_modes, kernels
from pdcorrect.fem.assembly import Assembly, Linearisation
from pdcorrect.fem.clamps import Clamps, resolve_clamps
from pdcorrect.fem.loads import NodalLoad, assemble_loads
from pdcorrect.fem.materials import Materials
from pdcorrect.fem.mesh import HexMesh, voxel_mesh
from pdcorrect.fem.mesh import refine as refine_mesh
from pdcorrect.fem.operators import Space, lumped, mass_matrix
from pdcorrect.fem.quadrature import Quadrature
from pdcorrect.fem.selection import Selector
from pdcorrect.scene import MeshFile, Scene
from pdcorrect.state import State

Array = NDArray[np.float64]

_RELAXED = 1e-13
"""Of the cell size: change of an internal mode at which its equilibrium is found."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A discretised scene.  Its arrays are read-only, so a factor made from it stays right.

    Attributes
    ----------
    scene : Scene
    refine : int
        Each coarse cell is cut into ``refine ** 3``.
    space : Space
        The scalar finite element space.
    mesh : HexMesh
        Corners, for pictures and refinement.
    quadrature : Quadrature
        Gradients (C, Q, L, 3), 1/m, and weights (C, Q), m3.
    materials : Materials
    clamps : Clamps
    loads : tuple of NodalLoad
    mass_matrix : (N, N) sparse
        kg, for each coordinate.
    cell_size : float
        Coarse cell size (cube root of the mean cell volume), m: the unit of
        tolerances at every refinement.
    material_changed : bool
        Whether the materials are no longer those of ``scene``.
    """

    scene: Scene
    refine: int
    mesh: HexMesh
    space: Space
    quadrature: Quadrature
    materials: Materials
    clamps: Clamps
    loads: tuple[NodalLoad, ...]
    mass_matrix: sp.csr_matrix
    cell_size: float
    material_changed: bool = False

    def __repr__(self) -> str:
        return (
            f"Problem({self.scene.name!r}, refine={self.refine}: {len(self.positions)} nodes, "
            f"{len(self.cells)} {self.element} cells, {self.mass_rule} mass)"
        )

    # --- names of the contract --------------------------------------------------

    @property
    def element(self) -> str:
        """Name of the element."""
        return self.scene.solver.element

    @property
    def mass_rule(self) -> str:
        """Name of the mass rule."""
        return self.scene.solver.mass

    @property
    def positions(self) -> Array:
        """Rest positions (N, 3), m."""
        return self.space.positions

    @property
    def cells(self) -> NDArray[np.int64]:
        """Node numbers (C, K), VTK order."""
        return self.space.cells

    @property
    def free(self) -> NDArray[np.bool_]:
        """Components that may move, (N, 3)."""
        return self.clamps.free

    @cached_property
    def assembly(self) -> Assembly:
        """Sums cell-wise results into configurations."""
        return Assembly(self.space.local, self.unknowns)

    @cached_property
    def mass(self) -> Array:
        """Nodal masses (N,), kg: the row sums of the mass matrix."""
        return lumped(self.mass_matrix)

    @cached_property
    def mass_is_diagonal(self) -> bool:
        """Whether the mass matrix couples no two nodes."""
        return bool(self.mass_matrix.nnz == len(self.positions))

    def mass_times(self, x: Array) -> Array:
        """The mass matrix times x, for nodal vectors and configurations alike."""
        nodal = x[: len(self.positions)]
        out = self.mass[:, None] * nodal if self.mass_is_diagonal else self.mass_matrix @ nodal
        return np.asarray(out) if len(x) == len(nodal) else self.extended(out)

    @property
    def time_step(self) -> float:
        """The scene's step, s."""
        return self.scene.time.step

    def rest_state(self) -> State:
        """Rest positions, no velocity, time zero."""
        return State(self.positions.copy(), np.zeros_like(self.positions), 0.0)

    # --- loads and clamps ---------------------------------------------------------

    def external_forces(
        self, start: float, end: float | None = None, positions: Array | None = None
    ) -> Array:
        """Nodal forces (N, 3), N, of all loads, averaged over the step [start, end] (s).

        ``positions`` (N, 3) are where follower loads are sampled; without them
        they act as on the body at rest.
        """
        total = np.zeros_like(self.positions)
        for load in self.loads:
            total += load.forces(start, start if end is None else end, positions)
        return total

    def clamped_positions(self, time: float) -> Array:
        """Prescribed positions (N, 3), m, at a time (s); meaningful where not `free`."""
        return self.clamps.positions(time)

    # --- configurations ------------------------------------------------------------

    @property
    def unknowns(self) -> int:
        """Nodes and internal modes, N + B."""
        return len(self.positions) + self.space.internal

    @cached_property
    def free_unknowns(self) -> NDArray[np.bool_]:
        """Components that may move of a configuration, (N + B, 3); modes always may."""
        modes = np.ones((self.space.internal, 3), dtype=bool)
        return np.concatenate([self.free, modes])

    def extended(self, nodal: Array) -> Array:
        """A nodal vector (N, 3) followed by zeros for the internal modes, (N + B, 3)."""
        if not self.space.internal:
            return nodal
        return np.concatenate([nodal, np.zeros((self.space.internal, 3))])

    def relaxed(self, positions: Array, steps: int = 50) -> Array:
        """The configuration (N + B, 3) in which the internal modes are in equilibrium.

        ``steps`` Newton steps in each cell at most.
        """
        self._check(positions, len(self.positions))
        if not self.space.internal:
            return positions
        x = self.extended(positions - self.positions)
        internal_modes.relax(
            self.materials.model, x, self.space.local, self.cells.shape[1],
            self.quadrature.lanes, self._point_weights, self.quadrature.first_volume,
            steps, _RELAXED * self.cell_size,
        )  # fmt: skip
        x[: len(positions)] = positions
        return x

    # --- elastic energy and its derivatives ----------------------------------------

    def energy(self, positions: Array) -> float:
        """Elastic energy, J, with internal modes in equilibrium."""
        return self.energy_and_forces(self.relaxed(positions))[0]

    def forces(self, positions: Array) -> Array:
        """Elastic nodal forces -dW/dp, (N, 3), N."""
        return self.energy_and_forces(self.relaxed(positions))[1][: len(self.positions)]

    def stiffness(self, positions: Array, project: bool = False) -> sp.csr_matrix:
        """Tangent stiffness d2W/dp2, (3N, 3N), N/m; component i of node n is row 3 n + i.

        ``project`` raises negative eigenvalues to zero at each quadrature point.
        """
        tangent = self.linearise(self.relaxed(positions), project)
        if not self.space.internal:
            return tangent.assemble()
        try:
            modes = internal_modes.Condensed(
                tangent.blocks(), self.space.local, self.cells.shape[1]
            )
        except np.linalg.LinAlgError:
            raise ConvergenceError(
                "the internal modes of a cell are not in stable equilibrium at these positions: "
                "expected a shape that is strained less. Use project=True."
            ) from None
        return Assembly(self.cells, len(self.positions)).matrix(modes.blocks)

    def energy_and_forces(self, configuration: Array) -> tuple[float, Array]:
        """Elastic energy (J) and forces (N + B, 3) (N), from one pass over the cells."""
        assembly, u = self.assembly, self._displacement(configuration)
        energy, by_cell = np.empty(len(assembly.cells)), np.empty((*assembly.cells.shape, 3))
        forces = np.empty_like(u)
        kernels.energy_and_forces(
            self.materials.model, u, assembly.cells, self.quadrature.lanes,
            self._point_weights, self.quadrature.first_volume, energy, by_cell,
            assembly.start, assembly.slots, forces,
        )  # fmt: skip
        return float(energy.sum()), forces

    def volume_ratios(self, positions: Array) -> Array:
        """Smallest det F over the quadrature points of each cell, (C,).

        Of the nodes' displacements alone: a cell that is turned inside out or folded
        has a value below zero, whatever its internal modes do.
        """
        self._check(positions, len(self.positions))
        out = np.empty(len(self.cells))
        kernels.smallest_determinants(
            positions - self.positions, self.cells, self.quadrature.lanes, out
        )
        return out

    def linearise(self, configuration: Array, project: bool = False) -> Linearisation:
        """The tangent at a configuration, ready to be applied or assembled.

        ``project`` raises negative eigenvalues at each quadrature point to zero.
        """
        count, lanes = self.quadrature.weights.shape
        left, right = np.empty((count, 9, lanes)), np.empty((count, 9, lanes))
        tangent = np.empty((count, 12, lanes))
        kernels.linearise_cells(
            self.materials.model, self._displacement(configuration), self.space.local,
            self.quadrature.lanes, self._point_weights, self.quadrature.first_volume,
            project, left, right, tangent,
        )  # fmt: skip
        return Linearisation(self.assembly, self.quadrature, left, right, tangent)

    @cached_property
    def _point_weights(self) -> Array:
        """Mu w and omega w at the quadrature points, (C, 2, Q), J."""
        return np.stack(
            [
                self.materials.mu[:, None] * self.quadrature.weights,
                self.materials.volume_weight[:, None] * self.quadrature.volume_weights,
            ],
            axis=1,
        )

    def global_matrix(self, time_step: float, volume_scale: float = 1.0) -> sp.csr_matrix:
        """G of eq. 3-14: M/h^2 + sum (2 mu + omega) w D^T D, (N + B, N + B), N/m.

        ``volume_scale`` multiplies omega, for use as a first Hessian only.
        """
        return self.scalar_matrix(1.0 / time_step**2, 1.0, volume_scale)

    def scalar_matrix(
        self, mass_factor: float, stiffness_factor: float, volume_scale: float = 1.0
    ) -> sp.csr_matrix:
        """A M + b sum (2 mu + omega) w D^T D for factors a (1/s2) and b: G of any integrator."""
        shear, volume = self._point_weights[:, 0], self._point_weights[:, 1]
        coefficient = stiffness_factor * (2 * shear + volume_scale * volume)
        matrix = self.quadrature.laplacian(coefficient, self.space.local, self.unknowns)
        mass = self.mass_matrix.copy()
        mass.resize(matrix.shape)
        return sp.csr_matrix(matrix + mass_factor * mass)

    # --- changes ------------------------------------------------------------------

    def with_material(
        self,
        young: float | Array | None = None,
        poisson: float | Array | None = None,
        density: float | Array | None = None,
    ) -> Problem:
        """The same problem with other material values, each a number or one a cell (C,).

        ``young`` and ``poisson`` are given together (Pa; dimensionless).
        """
        materials = self.materials.changed(self.scene.material, young, poisson, density)
        changed = _build(
            self.scene, self.refine, self.mesh, self.space, self.quadrature, materials,
            self.cell_size,
        )  # fmt: skip
        return replace(changed, material_changed=True)

    # --- internals ----------------------------------------------------------------

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


def discretise(
    scene: Scene, refine: int = 1, mass: str | None = None, element: str | None = None
) -> Problem:
    """Mesh a scene and assemble its operators.

    Parameters
    ----------
    scene : Scene
    refine : int
        1 coarse, 2 intermediate, 4 fine (64 cells for each coarse one).
    mass, element : str, optional
        Override the scene's solver section.

    Raises
    ------
    SceneError, MeshError
        Naming the key or the cell.
    """
    if not isinstance(scene, Scene):
        raise InputError(f"scene is a {type(scene).__name__}: expected Scene.load(path).")
    if isinstance(refine, bool) or not isinstance(refine, (int, np.integer)) or refine < 1:
        raise InputError(f"refine = {refine!r}: expected a whole number of at least 1.")
    changes = {k: v for k, v in {"mass": mass, "element": element}.items() if v is not None}
    if changes:
        scene = scene.with_changes(solver=changes)
    if scene.material.energy == "volume-only" and scene.solver.element == "hex8-bubble-mean":
        raise SceneError(
            "material.energy = 'volume-only' with solver.element = 'hex8-bubble-mean': nothing "
            "resists the element's modes, for the volume term sees the mean deformation only. "
            "Use hex8-bubble, or an energy with a corotated part."
        )
    coarse = _coarse_mesh(scene)
    mesh = refine_mesh(coarse, refine)
    space = Space(mesh, scene.solver.element)
    cell_size = float(np.cbrt(space.volumes().sum() / len(coarse.cells)))
    selector = Selector(mesh, space.positions, cell_size)
    materials = Materials.from_scene(scene, selector, len(mesh.cells))
    return _build(scene, refine, mesh, space, space.quadrature(), materials, cell_size)


def _build(
    scene: Scene,
    refine: int,
    mesh: HexMesh,
    space: Space,
    quadrature: Quadrature,
    materials: Materials,
    cell_size: float,
) -> Problem:
    selector = Selector(mesh, space.positions, cell_size)
    matrix = mass_matrix(scene.solver.mass, space, materials.density)
    clamps = resolve_clamps(scene.clamps, selector, space.positions)
    loads = assemble_loads(scene, space, selector, lumped(matrix), clamps.free)
    _freeze(space.positions, space.cells, clamps.free, quadrature.lanes, quadrature.weights)
    _freeze(quadrature.volume_weights, matrix.indices, matrix.indptr)
    _freeze(materials.mu, materials.volume_weight, materials.density, matrix.data)
    return Problem(
        scene, refine, mesh, space, quadrature, materials, clamps, loads, matrix, cell_size
    )


def _coarse_mesh(scene: Scene) -> HexMesh:
    body = scene.body
    if isinstance(body, MeshFile):
        from pdcorrect.fem.mesh_files import read_hex_mesh  # meshio only where it is needed

        return read_hex_mesh(body.path, body.scale)
    return voxel_mesh(*body.occupancy(), body.cell_size, body.origin)


def _freeze(*arrays: NDArray[np.generic]) -> None:
    for array in arrays:
        array.flags.writeable = False
