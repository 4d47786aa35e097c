"""`Problem`: a scene on a mesh, with everything a stepper needs; `discretise` makes it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import InputError, SceneError
from pdcorrect.fem import kernels
from pdcorrect.fem.clamps import Clamps, resolve_clamps
from pdcorrect.fem.loads import NodalLoad, assemble_loads
from pdcorrect.fem.mesh import HexMesh, voxel_mesh
from pdcorrect.fem.mesh import refine as refine_mesh
from pdcorrect.fem.operators import Quadrature, Space, lumped
from pdcorrect.fem.selection import Selector
from pdcorrect.scene import MeshFile, Scene
from pdcorrect.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Materials:
    """Material of each cell.

    Attributes
    ----------
    mu, volume_weight : (C,)
        Weights of the two energy terms, Pa; zero where a term is left out.
    density : (C,)
        kg/m3.
    """

    mu: Array
    volume_weight: Array
    density: Array

    @classmethod
    def from_moduli(cls, scene: Scene, young: Array, poisson: Array, density: Array) -> Materials:
        """Weights from Young's modulus (C,), Pa, and Poisson's ratio (C,)."""
        mu = young / (2 * (1 + poisson))
        lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        omega = lam if scene.material.volume_weight == "published" else 3 * lam
        energy = scene.material.energy
        return cls(
            mu=np.zeros_like(mu) if energy == "volume-only" else mu,
            volume_weight=np.zeros_like(lam) if energy == "corotated-only" else omega,
            density=density,
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """A discretised scene.  Its arrays are read-only, so a factor made from it stays right.

    Attributes
    ----------
    scene : Scene
    refine : int
        Each coarse cell is cut into ``refine ** 3``.
    element, mass_rule : str
    space : Space
        The scalar finite element space.
    mesh : HexMesh
        Corners, for pictures and refinement.
    quadrature : Quadrature
        Gradients (C, Q, K, 3), 1/m, and weights (C, Q), m3.
    materials : Materials
    clamps : Clamps
    loads : tuple of NodalLoad
    mass_matrix : (N, N) sparse
        kg, for each coordinate.
    cell_size : float
        Coarse cell size (cube root of the mean cell volume), m: the unit of
        tolerances at every refinement.
    """

    scene: Scene
    refine: int
    element: str
    mass_rule: str
    mesh: HexMesh
    space: Space
    quadrature: Quadrature
    materials: Materials
    clamps: Clamps
    loads: tuple[NodalLoad, ...]
    mass_matrix: sp.csr_matrix
    cell_size: float

    def __repr__(self) -> str:
        return (
            f"Problem({self.scene.name!r}, refine={self.refine}: {len(self.positions)} nodes, "
            f"{len(self.cells)} {self.element} cells, {self.mass_rule} mass)"
        )

    # --- names of the contract --------------------------------------------------

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
    def mass(self) -> Array:
        """Nodal masses (N,), kg: the row sums of the mass matrix."""
        return lumped(self.mass_matrix)

    @cached_property
    def mass_is_diagonal(self) -> bool:
        """Whether the mass matrix couples no two nodes."""
        return bool(self.mass_matrix.nnz == len(self.positions))

    def mass_times(self, x: Array) -> Array:
        """The mass matrix times x (N, 3)."""
        if self.mass_is_diagonal:
            return self.mass[:, None] * x
        return np.asarray(self.mass_matrix @ x)

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

    # --- elastic energy and its derivatives ----------------------------------------

    def energy(self, positions: Array) -> float:
        """Elastic energy, J."""
        return self.energy_and_forces(positions)[0]

    def forces(self, positions: Array) -> Array:
        """Elastic nodal forces -dW/dp, (N, 3), N."""
        return self.energy_and_forces(positions)[1]

    def energy_and_forces(self, positions: Array) -> tuple[float, Array]:
        """Elastic energy (J) and forces (N, 3) (N), from one pass over the cells."""
        cells, quadrature, materials = self.cells, self.quadrature, self.materials
        energy = np.empty(len(cells))
        by_cell = np.empty((*cells.shape, 3))
        kernels.cell_energy_and_forces(
            self._displacement(positions), cells, quadrature.lanes, quadrature.weights,
            materials.mu, materials.volume_weight, energy, by_cell,
        )  # fmt: skip
        return float(energy.sum()), self._gather(by_cell)

    def linearise(self, positions: Array, project: bool = False) -> Linearisation:
        """The tangent at ``positions``, ready to be applied or assembled.

        ``project`` raises negative eigenvalues at each quadrature point to zero.
        """
        cells, quadrature, materials = self.cells, self.quadrature, self.materials
        count, lanes = quadrature.weights.shape
        left, right = np.empty((count, 9, lanes)), np.empty((count, 9, lanes))
        tangent = np.empty((count, 12, lanes))
        kernels.linearise_cells(
            self._displacement(positions), cells, quadrature.lanes, quadrature.weights,
            materials.mu, materials.volume_weight, project, left, right, tangent,
        )  # fmt: skip
        return Linearisation(self, left, right, tangent)

    def stiffness(self, positions: Array, project: bool = False) -> sp.csr_matrix:
        """Tangent stiffness d2W/dp2, (3N, 3N), N/m; component i of node n is row 3 n + i."""
        return self.linearise(positions, project).assemble()

    def global_matrix(self, time_step: float, volume_scale: float = 1.0) -> sp.csr_matrix:
        """G of eq. 3-14: M/h^2 + sum (2 mu + omega) w D^T D, (N, N), N/m.

        ``volume_scale`` multiplies omega, for use as a first Hessian only.
        """
        materials = self.materials
        weight = 2 * materials.mu + volume_scale * materials.volume_weight
        return sp.csr_matrix(self.mass_matrix / time_step**2 + self.space.laplacian(weight))

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
        count = len(self.cells)
        values = {"young": young, "poisson": poisson, "density": density}
        arrays = {k: _per_cell(k, v, count) for k, v in values.items() if v is not None}
        if ("young" in arrays) != ("poisson" in arrays):
            raise InputError("with_material: expected young and poisson together.")
        materials = self.materials
        if "young" in arrays:
            materials = Materials.from_moduli(
                self.scene, arrays["young"], arrays["poisson"], materials.density
            )
        if "density" in arrays:
            materials = dataclasses.replace(materials, density=arrays["density"])
        return _build(
            self.scene, self.refine, self.element, self.mass_rule, self.mesh, self.space,
            self.quadrature, materials, self.cell_size,
        )  # fmt: skip

    # --- internals ----------------------------------------------------------------

    def _displacement(self, positions: Array) -> Array:
        """Positions minus rest positions: gradients of it do not depend on the origin."""
        return np.subtract(positions, self.positions)

    @cached_property
    def _slots(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where each node occurs in `cells`, as compressed rows."""
        flat = self.cells.ravel()
        counts = np.bincount(flat, minlength=len(self.positions))
        start = np.concatenate([[0], np.cumsum(counts)])
        return start, np.argsort(flat, kind="stable")

    def _gather(self, by_cell: Array) -> Array:
        """Sum cell-wise nodal values (C, K, 3) into (N, 3)."""
        out = np.empty_like(self.positions)
        start, slots = self._slots
        kernels.gather_nodes(start, slots, by_cell.reshape(-1, 3), out)
        return out

    @cached_property
    def _blocks(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """Pattern of the block tangent and, for each cell's node pair, its place in it."""
        count = len(self.positions)
        rows = np.repeat(self.cells, self.cells.shape[1], axis=1).ravel()
        columns = np.tile(self.cells, self.cells.shape[1]).ravel()
        keys, place = np.unique(rows * count + columns, return_inverse=True)
        indptr = np.searchsorted(keys, np.arange(count + 1) * count)
        return indptr.astype(np.int32), (keys % count).astype(np.int32), place.ravel()


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The tangent of the elastic energy at one state, see `kernels.linearise_cells`."""

    problem: Problem
    left: Array
    right: Array
    tangent: Array

    def apply(self, x: Array) -> Array:
        """Tangent times x, both (N, 3), without assembling."""
        problem = self.problem
        by_cell = np.empty((*problem.cells.shape, 3))
        kernels.apply_linearised(
            x, problem.cells, problem.quadrature.lanes, self.left, self.right, self.tangent, by_cell
        )
        return problem._gather(by_cell)

    def assemble(self) -> sp.csr_matrix:
        """The tangent as a sparse matrix (3N, 3N), N/m."""
        problem = self.problem
        count, nodes = problem.cells.shape
        blocks = np.empty((count, nodes, nodes, 3, 3))
        kernels.cell_stiffness(
            problem.cells, problem.quadrature.lanes, self.left, self.right, self.tangent, blocks
        )
        indptr, indices, place = problem._blocks
        data = np.zeros((len(indices), 3, 3))
        kernels.add_blocks(place, blocks.reshape(-1, 3, 3), data)
        size = 3 * len(problem.positions)
        return sp.bsr_matrix((data, indices, indptr), shape=(size, size)).tocsr()


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
    if not isinstance(refine, int) or refine < 1:
        raise InputError(f"refine = {refine!r}: expected a whole number of at least 1.")
    changes = {k: v for k, v in {"mass": mass, "element": element}.items() if v is not None}
    if changes:
        scene = scene.with_changes(solver=changes)
    coarse = _coarse_mesh(scene)
    mesh = refine_mesh(coarse, refine)
    space = Space(mesh, scene.solver.element)
    cell_size = float(np.cbrt(Space(coarse).volumes().mean()))
    return _build(
        scene, refine, scene.solver.element, scene.solver.mass, mesh, space, space.quadrature(),
        _scene_materials(scene, Selector(mesh, space.positions, cell_size), len(mesh.cells)),
        cell_size,
    )  # fmt: skip


def _build(
    scene: Scene, refine: int, element: str, mass_rule: str, mesh: HexMesh, space: Space,
    quadrature: Quadrature, materials: Materials, cell_size: float,
) -> Problem:  # fmt: skip
    selector = Selector(mesh, space.positions, cell_size)
    mass_matrix = _mass_matrix(mass_rule, space, materials.density)
    clamps = resolve_clamps(scene.clamps, selector, space.positions)
    loads = assemble_loads(scene, space, selector, lumped(mass_matrix), clamps.free)
    _freeze(space.positions, space.cells, clamps.free, quadrature.gradients, quadrature.weights)
    _freeze(materials.mu, materials.volume_weight, materials.density, mass_matrix.data)
    return Problem(
        scene, refine, element, mass_rule, mesh, space, quadrature, materials, clamps, loads,
        mass_matrix, cell_size,
    )  # fmt: skip


def _coarse_mesh(scene: Scene) -> HexMesh:
    body = scene.body
    if isinstance(body, MeshFile):
        from pdcorrect.fem.mesh_files import read_hex_mesh  # meshio only where it is needed

        return read_hex_mesh(scene.resolve(body.path), body.scale)
    return voxel_mesh(*body.occupancy(), body.cell_size, body.origin)


def _scene_materials(scene: Scene, selector: Selector, count: int) -> Materials:
    names = ("young", "poisson", "density")
    values = {name: np.full(count, float(getattr(scene.material, name))) for name in names}
    for i, part in enumerate(scene.materials):
        cells = selector.cells(part.region, f"materials[{i}].region")
        for name in names:
            if getattr(part, name) is not None:
                values[name][cells] = getattr(part, name)
    return Materials.from_moduli(scene, values["young"], values["poisson"], values["density"])


def _mass_matrix(rule: str, space: Space, density: Array) -> sp.csr_matrix:
    if rule == "per-node":
        volumes = density * space.volumes()
        touching = np.bincount(space.cells.ravel(), minlength=len(space.positions))
        total = np.bincount(
            space.cells.ravel(), np.repeat(volumes, space.cells.shape[1]), len(space.positions)
        )
        return sp.diags_array(total / touching).tocsr()
    consistent = space.mass(density)
    if rule == "consistent":
        return consistent
    diagonal = sp.diags_array(lumped(consistent)).tocsr()
    if rule == "averaged":
        return sp.csr_matrix(0.5 * (consistent + diagonal))
    if rule == "lumped":
        return diagonal
    raise SceneError(f"solver.mass = {rule!r}: expected lumped, averaged, consistent or per-node.")


_LIMITS = {"young": (0.0, np.inf), "poisson": (-1e-300, 0.5), "density": (0.0, np.inf)}


def _per_cell(name: str, value: float | Array, count: int) -> Array:
    array = np.broadcast_to(np.asarray(value, dtype=np.float64), (count,)).copy()
    low, high = _LIMITS[name]
    bad = ~(np.isfinite(array) & (array > low) & (array < high))
    if bad.any():
        cell = int(np.argmax(bad))
        raise InputError(
            f"{name} of cell {cell} is {array[cell]}: expected a finite number "
            f"{'in [0, 0.5)' if name == 'poisson' else 'above 0'}."
        )
    return array


def _freeze(*arrays: NDArray[np.generic]) -> None:
    for array in arrays:
        array.flags.writeable = False
