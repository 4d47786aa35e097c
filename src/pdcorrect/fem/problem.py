"""`Problem`: a scene on a mesh, with all that a stepper needs; `discretise`, `coarse_model`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from typing import Any, Literal, get_args

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import InputError, PdcorrectWarning, SceneError
from pdcorrect.fem.assembly import summed_cells
from pdcorrect.fem.banded import BandOrder
from pdcorrect.fem.cell_correction import CellCorrection
from pdcorrect.fem.clamps import Clamps, Selector, resolve_clamps
from pdcorrect.fem.contact import Contact, surface_points
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.fibres import Fibres
from pdcorrect.fem.initial import motion_from
from pdcorrect.fem.loads import NodalLoad, assemble_loads
from pdcorrect.fem.materials import Materials
from pdcorrect.fem.mesh import HexMesh, warn_of_thin_cells
from pdcorrect.fem.mesh import refine as refine_mesh
from pdcorrect.fem.operators import Space, freeze, lumped, mass_matrix
from pdcorrect.fem.plausibility import warn_of_units
from pdcorrect.fem.probes import probe_weights
from pdcorrect.fem.rollers import Rollers
from pdcorrect.fem.scene_mesh import check_size, scene_mesh
from pdcorrect.scene import Load, Region, Scene, check_scene, trained_coarse
from pdcorrect.state import State

Array = NDArray[np.float64]
_JUMP = 1e-3
"""Of the coarse cell size: how far clamps may be from where a run starts."""


@dataclass(frozen=True, eq=False)
class Problem(ElasticBody):
    """A discretised scene: an `ElasticBody` with mass, clamps and loads.

    Its arrays are read-only, so a factor made from it stays right.

    Attributes
    ----------
    scene : Scene
    refine : int
        Each coarse cell is cut into ``refine ** 3``.
    mass_matrix : (N, N) sparse
        kg, for each coordinate.
    clamps : Clamps
    loads : tuple of NodalLoad
    contact : Contact or None
        Of the surface with the scene's obstacles.
    fibres : Fibres or None
        Of the scene's actuators.
    rollers : Rollers or None
        Of clamps along directions that are no axes.
    material_changed, density_changed : bool
        Whether the moduli, or the density, are no longer those of ``scene``.
    """

    scene: Scene
    refine: int
    mass_matrix: sp.csr_matrix
    clamps: Clamps
    loads: tuple[NodalLoad, ...]
    contact: Contact | None = None
    fibres: Fibres | None = None
    rollers: Rollers | None = None
    material_changed: bool = False
    density_changed: bool = False

    def __repr__(self) -> str:
        return (
            f"Problem({self.scene.name!r}, refine={self.refine}: {len(self.positions)} nodes, "
            f"{len(self.cells)} {self.element} cells, {self.mass_rule} mass)"
        )

    def _freeze(self) -> None:
        super()._freeze()
        materials, mass = self.materials, self.mass_matrix
        freeze(materials.mu, materials.volume_weight, materials.density)
        freeze(self.clamps.free, mass.data, mass.indices, mass.indptr)

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
        """The mass matrix times x, for nodal vectors and configurations alike."""
        nodal = x[: len(self.positions)]
        out = self.mass[:, None] * nodal if self.mass_is_diagonal else self.mass_matrix @ nodal
        return np.asarray(out) if len(x) == len(nodal) else self.extended(out)

    @property
    def cell_masses(self) -> Array:
        """Each cell's share of the mass matrix at density 1, (C, K, K), m3."""
        shares = self.space.cell_masses(self.mass_rule)
        return shares if self.correction is None else shares + self.correction.masses

    @property
    def attached(self) -> tuple[Fibres | Rollers, ...]:
        """Energies besides the body's own."""
        return tuple(one for one in (self.fibres, self.rollers) if one is not None)

    @property
    def time_step(self) -> float:
        """Of an integrator, s: the scene's step over its substeps."""
        return self.scene.time.step / self.scene.time.substeps

    def rest_state(self) -> State:
        """Rest positions, no velocity, time zero."""
        return State(self.positions.copy(), np.zeros_like(self.positions), 0.0)

    def initial_state(self) -> State:
        """Where runs start, at time zero: the scene's initial velocities, from rest positions.

        Or a frame of the run that ``initial.run`` names, its velocities added.  Clamped
        components have none; where the scene gives them some, a `PdcorrectWarning` says so.
        """
        positions, velocities = self._initial_motion
        return State(positions.copy(), velocities.copy(), 0.0)

    @cached_property
    def _initial_motion(self) -> tuple[Array, Array]:
        initial = self.scene.initial
        if initial is None:
            return self.positions, np.zeros_like(self.positions)
        mass = self.mass
        if self.mass_rule == "per-node":  # whose centre depends on the mesh
            mass = lumped(mass_matrix("lumped", self.space, self.materials.density))
        region = initial.region or Region(everywhere=True)
        moved = Selector(self.mesh, self.space, self.cell_size).nodes(region, "initial.region")
        centre = mass[moved] @ self.positions[moved] / mass[moved].sum()
        wanted = np.zeros_like(self.positions)
        wanted[moved] = initial.velocities(self.positions[moved], centre)
        if initial.run is not None:
            frame = -1 if initial.frame is None else initial.frame
            start, speed = motion_from(
                initial.run, frame, self.positions, self.cell_size, self.scene.clamps
            )
            jump = np.abs(start - self.clamped_positions(0.0))[~self.free].max(initial=0.0)
            if jump > _JUMP * self.cell_size:
                warnings.warn(
                    f"initial.run: clamps are up to {jump:.3g} m from where that run's frame has "
                    "the nodes, which jump there in the first step.",
                    PdcorrectWarning,
                    stacklevel=3,
                )
            return start, self._led(speed + wanted)
        if wanted[~self.free].any():
            warnings.warn(
                "initial: some of the nodes that it sets in motion are clamped; their clamped "
                "components follow the clamps.",
                PdcorrectWarning,
                stacklevel=3,
            )
        return self.positions, self._led(wanted)

    def _led(self, velocities: Array) -> Array:
        """Those of the clamps in the first step where components are clamped."""
        h = self.time_step
        led = (self.clamped_positions(h) - self.clamped_positions(0.0)) / h
        velocities = np.where(self.free, velocities, led)
        return velocities if self.rollers is None else self.rollers.led(velocities, 0.0, h)

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

    @cached_property
    def has_followers(self) -> bool:
        """Whether a load depends on the positions."""
        return any(load.sample is not None for load in self.loads)

    def clamped_positions(self, time: float) -> Array:
        """Prescribed positions (N, 3), m, at a time (s); meaningful where not `free`."""
        return self.clamps.positions(time)

    @cached_property
    def free_unknowns(self) -> NDArray[np.bool_]:
        """Components that may move of a configuration, (N + B, 3); modes always may."""
        modes = np.ones((self.space.internal, 3), dtype=bool)
        return np.concatenate([self.free, modes])

    @cached_property
    def band_order(self) -> BandOrder:
        """An order of the nodes' free components in which cells couple near neighbours."""
        return BandOrder(self.positions, self.cells, self.free)

    def global_matrix(self, time_step: float, volume_scale: float = 1.0) -> sp.csr_matrix:
        """G of eq. 3-14: M/h^2 + sum (2 mu + omega) w D^T D, (N + B, N + B), N/m.

        ``volume_scale`` multiplies omega, for use as a first Hessian only.
        """
        return self.scalar_matrix(1.0 / time_step**2, 1.0, volume_scale)

    def scalar_matrix(
        self, mass_factor: float, stiffness_factor: float, volume_scale: float = 1.0
    ) -> sp.csr_matrix:
        """A M + b sum (2 mu + omega) w D^T D for factors a (1/s2) and b: G of any integrator."""
        nodal = mass_factor * self.mass_matrix
        if self.fibres is not None:
            nodal = nodal + self.fibres.laplacian()
        nodal.resize((self.unknowns, self.unknowns))
        return sp.csr_matrix(stiffness_factor * self.laplacian(volume_scale) + nodal)

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
        changed = ElasticBody(self.mesh, self.space, self.quadrature, materials, self.cell_size)
        return replace(
            problem_from_body(self.scene, self.refine, changed),
            material_changed=self.material_changed or young is not None,
            density_changed=self.density_changed or density is not None,
        )

    def with_total_mass(self, mass: float) -> Problem:
        """The same problem, its density scaled so that its nodes have this mass together, kg."""
        if isinstance(mass, bool) or not isinstance(mass, Real) or not 0.0 < mass < np.inf:
            raise InputError(f"total mass {mass} kg: expected a positive number.")
        return self.with_material(density=mass / self.mass.sum() * self.materials.density)

    def with_loads(self, loads: Sequence[Load | Mapping[str, Any]]) -> Problem:
        """The same problem under other loads, each as in a scene's ``loads``.

        Mesh, operators and masses are shared, and factors made from them stay right.
        """
        scene = self.scene.with_changes(loads=list(loads))
        selector = Selector(self.mesh, self.space, self.cell_size)
        found = assemble_loads(scene, self.space, selector, self.mass, self.free)
        return replace(self, scene=scene, loads=found)


def discretise(
    scene: Scene,
    refine: int = 1,
    mass: str | None = None,
    element: str | None = None,
    *,
    mesh: HexMesh | None = None,
) -> Problem:
    """Mesh a scene and assemble its operators.

    Parameters
    ----------
    scene : Scene
    refine : int
        1 coarse, 2 intermediate, 4 fine (64 cells for each coarse one).
    mass, element : str, optional
        Override the scene's solver section.
    mesh : HexMesh, optional
        Coarse mesh in place of the one that the scene's bodies make or name.

    Raises
    ------
    SceneError, MeshError
        Naming the key or the cell.
    """
    check_scene(scene)
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
    if mesh is not None:
        check_size(scene, len(mesh.cells), refine)
    coarse = scene_mesh(scene, refine) if mesh is None else mesh
    refined = refine_mesh(coarse, refine)
    space = Space(refined, scene.solver.element)
    cell_size = float(np.cbrt(space.volumes().sum() / len(coarse.cells)))
    selector = Selector(refined, space, cell_size)
    materials = Materials.from_scene(scene, selector, len(refined.cells))
    body = ElasticBody(refined, space, space.quadrature(), materials, cell_size)
    problem = problem_from_body(scene, refine, body)
    if scene.probes:
        probe_weights(body, scene.probes)  # what is wrong is told before a run
    warn_of_thin_cells(scene.solver.element, refined, problem.free)
    warn_of_units(scene, body)
    return problem


def problem_from_body(scene: Scene, refine: int, body: ElasticBody) -> Problem:
    """A body with the scene's mass rule, clamps and loads."""
    space, quadrature, materials = body.space, body.quadrature, body.materials
    selector = Selector(body.mesh, space, body.cell_size)
    clamps = resolve_clamps(scene.clamps, selector, space.positions)
    correction = _learned(scene, body, clamps) if scene.solver.element == "hex8-learned" else None
    matrix = mass_matrix(scene.solver.mass, space, materials.density)
    if correction is not None:
        matrix = matrix + summed_cells(
            space.cells, materials.density[:, None, None] * correction.masses, matrix.shape[0]
        )
    loads = assemble_loads(scene, space, selector, lumped(matrix), clamps.free)
    contact = None
    if scene.obstacles:
        points = surface_points(body.mesh, space, clamps.free)
        young = max([scene.material.young, *(part.young or 0.0 for part in scene.materials)])
        contact = Contact(scene.obstacles, points, space.positions, body.cell_size, young)
    fibres = Fibres.of(scene.actuators, body, selector) if scene.actuators else None
    rollers = Rollers.of(clamps, body) if clamps.oblique else None
    problem = Problem(
        body.mesh, space, quadrature, materials, body.cell_size, scene, refine, matrix, clamps,
        loads, contact, fibres, rollers, correction=correction,
    )  # fmt: skip
    problem._freeze()
    return problem


def _learned(scene: Scene, body: ElasticBody, clamps: Clamps) -> CellCorrection:
    from pdcorrect.fem import element_network  # the network only where it is needed
    from pdcorrect.fem.learned import ElementWriter

    materials = body.materials
    path = scene.solver.weights
    network = element_network.released() if path is None else element_network.read_network(path)
    writer = ElementWriter(network, body, clamps)
    found = writer.correction(materials.mu, materials.volume_weight)
    count = int((~found.learned).sum())
    if count:
        unlike = writer.unlike(materials.mu, materials.volume_weight)
        told = "; ".join(f"{cells} {what}" for what, cells in unlike.items())
        warnings.warn(
            f"element 'hex8-learned': {count} of {len(body.cells)} cells are unlike those it was "
            f"trained on ({told}) and keep the element 'hex8-enhanced'",
            PdcorrectWarning,
            stacklevel=4,
        )
    return found


Base = Literal["plain", "best", "total-mass"]
BASES: tuple[str, ...] = get_args(Base)


def coarse_model(scene: Scene, base: str = "plain", refine: int = 4) -> Problem:
    """A scene on its coarse mesh, by the name that a corrector's training has for it.

    Parameters
    ----------
    scene : Scene
    base : {"plain", "best", "total-mass"}
        As the scene says; with element and masses of `pdcorrect.scene.trained_coarse`; or with
        its density scaled so that it has the total mass of the scene refined, for
        ``mass = "per-node"``, by which a mesh is the heavier the coarser it is.
    refine : int
        Of the mesh with that mass: 4 is what correctors were trained beside.
    """
    if base not in BASES:
        raise InputError(f"base {base!r}: expected one of {', '.join(BASES)}.")
    if base == "best":
        return discretise(trained_coarse(scene))
    plain = discretise(scene)
    if base == "plain":
        return plain
    return plain.with_total_mass(float(discretise(scene, refine).mass.sum()))
