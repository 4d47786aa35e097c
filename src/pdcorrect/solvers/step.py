"""The minimisation that one implicit step is (thesis eq. 3-6), and its preconditioner G.

    gamma(y) = c/2 (y - q)^T M (y - q) + D(y) + W(y) - f . (y - X)

with the constants of a `StepEquation`; for backward Euler c = 1/h^2 and q = p_t + h v_t, and the
stationary point satisfies eq. 3-4.  D is what `damping` adds.  M is never inverted.  Clamped
components of y are prescribed; gradients are zero there.  Loads that follow the body have no
potential: f is theirs at a y that `StepObjective.follow` is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.clamps import rigid_freedom
from pdcorrect.fem.elastic_body import Linearisation
from pdcorrect.fem.factorisation import (
    Backend,
    Factor,
    NotPositiveDefinite,
    choose_backend,
    factorise,
)
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.attached import AttachedTerm, Tangent
from pdcorrect.solvers.contact import ContactTerm
from pdcorrect.solvers.damping import Rayleigh, Viscous, ViscousTangent
from pdcorrect.solvers.integrators import StepEquation
from pdcorrect.solvers.schemes import Scheme
from pdcorrect.state import State

Array = NDArray[np.float64]


class StepObjective:
    """gamma for one step from ``state``, over configurations y (N + B, 3).

    ``stage`` is the integrator's equation, ``extra`` (N, 3) forces besides the scene's loads, N.

    Attributes
    ----------
    start : (N + B, 3)
        First iterate, prescribed where clamped.
    loads : (N, 3)
        All external forces, N.
    forces : (N + B, 3)
        Those of the step's equation, N.
    scale : float
        Size of the terms of gamma where it was last evaluated, J: round-off in
        gamma is relative to this.
    factors : tuple of float
        On mass and on stiffness in the Hessian: 1/s2 and 1.
    """

    def __init__(
        self, problem: Problem, state: State, stage: StepEquation, extra: Array | None = None
    ) -> None:
        self.problem = problem
        self.state = state
        self.stage = stage
        self.free = problem.free_unknowns
        self.scale = 0.0
        self._evaluated: tuple[Array | None, float] = (None, 0.0)
        self.start = problem.following(stage.start)
        self._extra = extra
        self.forces = self._forces(stage.start)
        self.factors = hessian_factors(problem, stage)
        self._rest = problem.extended(problem.positions)
        self._target = problem.extended(stage.target)
        damping = problem.scene.damping
        has_rayleigh = stage.rate and (damping.mass or damping.stiffness)
        self.rayleigh = Rayleigh(problem, stage) if has_rayleigh else None
        self.viscous = Viscous(problem, stage) if stage.strains else None
        self.attached = AttachedTerm(problem, stage, state) if problem.attached else None
        self.contact = None
        if problem.contact is not None:
            self.contact = ContactTerm(problem.contact, stage, state)
            start = self.contact.feasible(stage.start, problem.free)
            self.start = problem.following(start)

    @property
    def follows(self) -> bool:
        """Whether forces without a potential are held as at one configuration."""
        sliding = self.contact is not None and self.contact.has_friction
        return self.problem.has_followers or sliding

    def follow(self, y: Array) -> bool:
        """Sample the loads that follow the body, and friction, at a configuration.

        Whether there are any.
        """
        slides = self.contact is not None and self.contact.follow(y)
        if self.problem.has_followers:
            self.forces = self._forces(y[: len(self.problem.positions)])
        return self.problem.has_followers or slides

    def given_forces(self, y: Array) -> Array:
        """All forces (N, 3) of the equation at y but the body's own, N."""
        nodes = len(self.problem.positions)
        out = self.forces[:nodes]
        if self.attached is not None:
            out = out + self.attached.end_forces(y)
        if self.contact is not None:
            out = out - self.contact.value_and_gradient(y)[1][:nodes]
        return out

    def _forces(self, y: Array) -> Array:
        stage = self.stage
        self.loads = self.problem.external_forces(*stage.loads_over, stage.sampled(y))
        if self._extra is not None:
            self.loads = self.loads + self._extra
        return self.problem.extended(stage.load_factor * self.loads + stage.past_forces)

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """Gamma (J) and its gradient (N + B, 3), N, zero where clamped."""
        energy, gradient = self.balance(y)
        gradient *= self.free
        return energy, gradient

    def balance(self, y: Array) -> tuple[float, Array]:
        """Gamma (J) and its gradient on all components: where clamped, the clamps' forces.

        y must not change afterwards, see `elastic_energy`.
        """
        energy, elastic = self.problem.energy_and_forces(y)
        self._evaluated = y, energy
        offset = y - self._target
        gradient = self.problem.mass_times(offset)
        gradient *= self.stage.inertia
        kinetic = 0.5 * np.vdot(offset, gradient)
        work = np.vdot(self.forces, y - self._rest)
        self.scale = float(energy + kinetic + abs(work))
        value = energy + kinetic - work
        gradient -= elastic
        gradient -= self.forces
        for term in (self.rayleigh, self.viscous, self.attached, self.contact):
            if term is not None:
                loss, force = term.value_and_gradient(y)
                value, self.scale = value + loss, self.scale + loss
                gradient += force
        return float(value), gradient

    def elastic_energy(self, y: Array) -> float:
        """The body's own energy at y, J; known where gamma was evaluated last."""
        last, energy = self._evaluated
        return energy if last is y else self.problem.energy_and_forces(y)[0]

    def carried(self, y: Array, gradient: Array) -> tuple[Array, Array]:
        """Y moved as a whole to where the forces on the body add up to its inertia.

        And the gradient there.  Only along axes without a clamp: a translation changes
        nothing but inertia, so this minimises gamma along it exactly, and linear momentum
        does not depend on the accuracy of the rest.
        """
        nodes, factor = len(self.problem.positions), self.factors[0]
        held = self.contact is not None or self.problem.rollers is not None
        if not factor or held:
            return y, gradient
        mass = self.problem.mass
        shift = -gradient[:nodes].sum(axis=0) / (factor * mass.sum())
        shift *= self.problem.free.all(axis=0)
        y, gradient = y.copy(), gradient.copy()
        y[:nodes] += shift
        gradient[:nodes] += factor * mass[:, None] * shift
        return y, gradient

    def damping_loss(self, y: Array, way: Array, h: float) -> float:
        """Energy that the damping takes out in a step of h seconds, J, by mean velocities.

        ``way`` (N, 3) is how far nodes move in it, m.
        """
        out = 0.0
        if self.rayleigh is not None:
            out += self.rayleigh.loss(way, h) / self.stage.rate
        if self.viscous is not None:
            out += self.viscous.loss(y, h)
        return out

    def cell_hessians(self, y: Array, project: bool = False, at_rest: bool = False) -> Array:
        """Second derivative by cell, (C, L, L, 3, 3), N/m.

        ``project`` raises negative eigenvalues to zero at each quadrature point.
        ``at_rest``: damping in proportion to the stiffness at y itself, so that the
        result does not depend on the state at the step's start.
        """
        if not at_rest:
            return self.hessian_operator(y, project).blocks()
        blocks = self.problem.linearise(y, project).blocks() * self.factors[1]
        for one in self.problem.attached:
            one.rest_tangent().add_to(blocks)
        return self.with_inertia(blocks)

    def with_inertia(self, blocks: Array) -> Array:
        """Matrices (C, L, L, 3, 3) of the cells, to which that of their masses is added."""
        nodes, factor = self.problem.cells.shape[1], self.factors[0]
        if factor:
            masses = self.problem.materials.density[:, None, None] * self.problem.cell_masses
            for i in range(3):
                blocks[:, :nodes, :nodes, i, i] += factor * masses
        return blocks

    def hessian_operator(self, y: Array, project: bool = False) -> HessianOperator:
        """The second derivative without assembling; ``project`` as in `cell_hessians`."""
        viscous = None if self.viscous is None else self.viscous.tangent(y, project)
        local = [] if self.attached is None else self.attached.tangents(y, project)
        if self.contact is not None:
            local.append(self.contact.tangent(y, project))
        return HessianOperator(self, self.problem.linearise(y, project), viscous, local)

    def longest_step(self, y: Array, direction: Array) -> float:
        """See `ContactTerm.longest_step`."""
        return 1.0 if self.contact is None else self.contact.longest_step(y, direction)

    def trusted(self, y: Array) -> float:
        """See `ContactTerm.trusted`."""
        return math.inf if self.contact is None else self.contact.trusted(y)


def hessian_factors(problem: Problem, stage: StepEquation | Scheme) -> tuple[float, float]:
    """What multiplies mass (1/s2) and stiffness in a step's Hessian."""
    damping = problem.scene.damping
    slowed = stage.rate * damping.stiffness + stage.strain_rate * damping.viscosity
    return stage.inertia + stage.rate * damping.mass, 1.0 + slowed


@dataclass(frozen=True, eq=False)
class HessianOperator:
    """x -> (d2 gamma/dy2) x, with x and the result on the free components."""

    objective: StepObjective
    tangent: Linearisation
    viscous: ViscousTangent | None
    local: Sequence[Tangent]

    def __call__(self, x: Array) -> Array:
        out = self.product(x)
        out *= self.objective.free
        return out

    def product(self, x: Array) -> Array:
        """The same on all components."""
        out = self.tangent.apply(x)
        objective = self.objective
        if objective.factors[0]:
            out += objective.factors[0] * objective.problem.mass_times(x)
        if objective.rayleigh is not None and objective.rayleigh.stiffness:
            out += objective.rayleigh.stiffness * objective.rayleigh.tangent.apply(x)
        if self.viscous is not None:
            out += self.viscous.apply(x)
        for term in self.local:
            out += term.apply(x)
        return out

    def blocks(self) -> Array:
        """By cell, (C, L, L, 3, 3)."""
        out = self.objective.with_inertia(self.tangent.blocks())
        rayleigh = self.objective.rayleigh
        if rayleigh is not None and rayleigh.stiffness:
            out += rayleigh.stiffness * rayleigh.tangent.blocks()
        if self.viscous is not None:
            out += self.viscous.blocks()
        for term in self.local:
            term.add_to(out)
        return out


def global_backend(problem: Problem) -> Backend:
    """The back end for a problem's G, chosen without factorising.

    By the bandwidth for cells with eight nodes: a slender body's factor stays sparse where
    a compact body's of the same size does not.  By the size alone for `hex27` and for
    elements with internal modes, where a multigrid cycle takes more steps.
    """
    size = int(problem.free_unknowns.any(axis=1).sum())
    if problem.space.internal or problem.cells.shape[1] != 8:
        return choose_backend(size)
    return choose_backend(size, bandwidth=problem.band_order.bandwidth)


class GlobalSolver:
    """G^-1 on the free components: one factor for each distinct column of ``free``.

    ``factors`` are those of `hessian_factors`; ``volume_scale`` multiplies the volume weight
    inside G, without a change of the energy.
    """

    def __init__(
        self,
        problem: Problem,
        factors: tuple[float, float],
        backend: Backend = "auto",
        volume_scale: float = 1.0,
    ) -> None:
        backend = global_backend(problem) if backend in ("auto", "band") else backend
        matrix = problem.scalar_matrix(*factors, volume_scale)
        free = problem.free_unknowns
        columns, group = np.unique(free, axis=1, return_inverse=True)
        self._parts: list[tuple[Factor, NDArray[np.int64], NDArray[np.int64]]] = []
        for i, nodes in enumerate(map(np.flatnonzero, columns.T)):
            if not len(nodes):
                continue
            try:
                factor = factorise(matrix[nodes][:, nodes], backend, approximate=True)
            except NotPositiveDefinite as error:
                loose = rigid_freedom(problem.positions, problem.cells, problem.clamps)
                raise ConvergenceError(
                    "the global matrix of the step is singular to working precision "
                    f"({loose or error}): expected clamps, or inertia that matters beside the "
                    "stiffness. Use clamps (a quasi-static problem needs them), a smaller time "
                    "step or more density."
                ) from None
            self._parts.append((factor, nodes, np.flatnonzero(group.ravel() == i)))
        self._all_free = bool(free.all())

    @property
    def backend(self) -> str:
        """Name of the factorisation in use."""
        return self._parts[0][0].backend

    def __call__(self, r: Array) -> Array:
        """X (N + B, 3) with G x = r on the free components, zero elsewhere."""
        if self._all_free:
            return self._parts[0][0].solve(r)
        out = np.zeros_like(r)
        for factor, nodes, axes in self._parts:
            if len(axes) == 3:
                out[nodes] = factor.solve(r[nodes])
            else:
                out[np.ix_(nodes, axes)] = factor.solve(r[np.ix_(nodes, axes)])
        return out


def check_input(problem: Problem, state: State, forces: Array | None) -> None:
    """Refuse states and forces of the wrong shape or with NaN, see `nodal_array`."""
    if not isinstance(state, State):
        raise InputError(f"state is a {type(state).__name__}: expected problem.initial_state().")
    nodal_array(problem, "positions", state.positions)
    nodal_array(problem, "velocities", state.velocities)
    if forces is not None:
        nodal_array(problem, "forces", forces)


def nodal_array(problem: Problem, name: str, values: Array) -> Array:
    """``values`` as an array; `InputError` names the node if it is not (N, 3) and finite."""
    if isinstance(values, str) or not isinstance(values, (np.ndarray, Sequence)):
        raise InputError(
            f"{name} is a {type(values).__name__}: expected an array of shape "
            f"{problem.positions.shape}."
        )
    array = np.asarray(values, dtype=np.float64)
    if array.shape != problem.positions.shape:
        raise InputError(
            f"{name} has shape {array.shape}: expected {problem.positions.shape}, one row "
            "for each node of the problem."
        )
    if not np.isfinite(array).all():
        node = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise InputError(
            f"{name} of node {node} (at rest at {problem.positions[node].tolist()} m) is "
            f"{array[node].tolist()}: expected finite numbers."
        )
    return array
