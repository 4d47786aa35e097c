"""`Gradients`: an adjoint solution, and what each derivative makes of it when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.cell_correction import CellCorrection
from pdcorrect.scene.materials import lame_slopes
from pdcorrect.solvers.adjoint_solve import (
    AdjointOperator,
    AdjointSolution,
    AdjointSolver,
    solve_adjoint,
    spectral_radius,
)
from pdcorrect.solvers.adjoint_terms import (
    DampingTerm,
    RayleighTerm,
    ViscousTerm,
    cell_products,
    follower_slope,
    gravity_slope,
    weight_slopes,
)
from pdcorrect.solvers.contact import ContactTerm
from pdcorrect.solvers.implicit import ImplicitStepper
from pdcorrect.solvers.integrators import Integrator
from pdcorrect.solvers.schemes import Linear
from pdcorrect.solvers.step import GlobalSolver, StepObjective
from pdcorrect.state import State

Array = NDArray[np.float64]

Term = TypeVar("Term", bound=DampingTerm)

_STEP, _SLIDING_STEP = 1e-3, 1e-5
"""Of the time step, for differences of fourth order at fixed y.

The second with friction or moving obstacles: in a small part of a step these may go farther than
points creep, or than a gap is wide.
"""


@dataclass(frozen=True, eq=False)
class TakenStep:
    """One step that was taken, and how to solve for its adjoint.

    ``state`` is as the step used it, ``remembered`` the names in the memory it was given;
    ``integrate`` keeps to the step's scheme.
    """

    stepper: ImplicitStepper
    state: State
    remembered: tuple[str, ...]
    forces: Array | None
    time_step: float
    integrate: Integrator
    solver: AdjointSolver
    tolerance: float

    def objective(self, time_step: float) -> StepObjective:
        return self.stepper.objective(self.state, self.forces, time_step, self.integrate)

    def global_solver(self, objective: StepObjective) -> GlobalSolver:
        """G^-1 for the thesis's G, whatever the stepper's first Hessian is."""
        return self.stepper.global_solver(objective.factors, volume_scale=1.0)

    def solve(
        self, H: AdjointOperator, y: Array, g: Array, solver: AdjointSolver, tolerance: float
    ) -> AdjointSolution:
        """X with H x = g for the operator H at y."""
        objective = H.hessian.objective
        return solve_adjoint(
            H, g, solver, lambda: self.stepper.preconditioner(objective, y),
            lambda: self.global_solver(objective), tolerance,
        )  # fmt: skip


class Gradients:
    """Derivatives of a loss by the inputs of one step; made by `adjoint`.

    Those that take more than the adjoint state are computed when first asked for.

    Attributes
    ----------
    x : (N + B, 3)
        The adjoint state: the loss's derivative by a force on each node (and mode).
    solver, iterations, residual
        Of its linear system, see `AdjointSolution`.
    """

    def __init__(self, step: TakenStep, after: Mapping[str, Array], y: Array) -> None:
        self._problem, free = step.stepper.problem, step.stepper.problem.free
        if "internal_forces" in after:  # where clamped they are for the clamps' work only
            after = {**after, "internal_forces": after["internal_forces"] * free}
        self._step, self._after, self._y = step, after, y
        self._objective = step.objective(step.time_step)
        self._objective.follow(y)
        self._scheme = step.integrate.scheme(step.state, step.time_step)
        self._sums: dict[str, Array] = {}
        self._pull(self._scheme.positions, None, after["positions"])
        by_velocities, rollers = after["velocities"], self._problem.rollers
        if rollers is not None and self._scheme.clamped_velocities is not None:
            by_velocities = rollers.along(by_velocities)
        self._pull(self._scheme.velocities, self._scheme.clamped_velocities, by_velocities)
        for name, rows in self._scheme.memory.items():
            if name in after:
                self._pull(*rows, after[name])
        by_y = self._sums.pop("y")
        kept = self._sums.pop("internal_forces_after", np.zeros_like(by_y))
        if kept.any():
            by_y = by_y + self._scheme.inertia * self._problem.mass_times(kept)
            by_y -= self._by_sampled("y", y, kept)
            by_y -= self._objective.stage.gain * self._by_contact(y, kept)[0]
        loads = (lambda x: self._by_lagged(y, x)) if self._objective.follows else None
        self._H = AdjointOperator(self._objective.hessian_operator(y), loads)
        g = self._problem.extended(by_y) * self._objective.free
        found = step.solve(self._H, y, g, step.solver, step.tolerance)
        self.x, self.solver, self.iterations = found.x, found.solver, found.iterations
        self.residual = found.residual
        self._nodal = self.x[: len(by_y)] - kept
        rayleigh, viscous = self._objective.rayleigh, self._objective.viscous
        self._rayleigh = self._viscous = None
        if rayleigh is not None:
            self._rayleigh = RayleighTerm(self._problem, rayleigh, y, self.x)
        if viscous is not None:
            self._viscous = ViscousTerm(self._problem, viscous, y, self.x)
        self._damping: list[DampingTerm] = [t for t in (self._rayleigh, self._viscous) if t]
        self._pull_stage(by_y)

    def __repr__(self) -> str:
        return (
            f"Gradients(by {self.solver}, {self.iterations} iterations, relative residual "
            f"{self.residual:.1g})"
        )

    # --- by the state and what acts on it ------------------------------------------------

    @cached_property
    def positions(self) -> Array:
        """By the positions at the start of the step, (N, 3), 1/m."""
        return self._sum("positions")

    @cached_property
    def velocities(self) -> Array:
        """By the velocities at the start of the step, (N, 3), s/m."""
        return self._sum("velocities")

    @cached_property
    def forces(self) -> Array:
        """By nodal forces during the step, (N, 3), 1/N."""
        return self._objective.stage.load_factor * self._nodal

    @cached_property
    def clamped_positions(self) -> Array:
        """By the prescribed positions at the end of the step, (N, 3), 1/m; 0 where free.

        The clamps' velocities and accelerations, where an integrator uses them, are held.
        """
        return self._sum("prescribed") * ~self._problem.free

    @property
    def memory(self) -> dict[str, Array]:
        """By the entries of `State.memory` at the start of the step, each (N, 3).

        Zero where the step was not the stepper's own, for it went without them.
        """
        return {name: self._sum(name) for name in self._step.remembered}

    @cached_property
    def time_step(self) -> float:
        """By the time step, 1/s, everything that is given as a function of time included.

        Everything at the start of the step is held, its time and memory too, and so is the
        scheme: for BDF2 the step before gets longer with this one.  With loads and clamps
        that do not change in time the sum over all steps is the derivative by the length
        that they share.  By differences of fourth order of the step's equation at fixed y.
        """
        contact, h = self._objective.contact, self._step.time_step
        e = h * (_SLIDING_STEP if contact and (contact.has_friction or contact.moves) else _STEP)
        f = self._lagrangian
        return (8.0 * (f(h + e) - f(h - e)) - (f(h + 2 * e) - f(h - 2 * e))) / (12.0 * e)

    # --- by the material ----------------------------------------------------------------

    @property
    def mu(self) -> Array:
        """By each cell's mu, (C,), 1/Pa."""
        return self._weights[0]

    @property
    def lam(self) -> Array:
        """By each cell's lambda, (C,), 1/Pa; the volume weight is a multiple of it."""
        published = self._problem.scene.material.volume_weight == "published"
        return self._weights[1] * (1.0 if published else 3.0)

    @property
    def young(self) -> Array:
        """By each cell's Young's modulus at fixed Poisson's ratio, (C,), 1/Pa."""
        (mu, lam), _ = self._moduli_slopes
        return self.mu * mu + self.lam * lam

    @property
    def poisson(self) -> Array:
        """By each cell's Poisson's ratio at fixed Young's modulus, (C,)."""
        _, (mu, lam) = self._moduli_slopes
        return self.mu * mu + self.lam * lam

    @cached_property
    def density(self) -> Array:
        """By each cell's density, (C,), m3/kg; gravity included."""
        stage, problem = self._objective.stage, self._problem
        out = gravity_slope(problem, stage.load_factor * self._nodal, *stage.loads_over)
        for x, offset in self._inertial:
            out -= cell_products(problem.cells, problem.cell_masses, x, offset)
        return out

    @cached_property
    def matrices(self) -> Array:
        """By the matrices K of a learned element, (C, 18, 18), m/N.

        The derivatives by the moduli include what it writes from them.
        """
        correction, problem = self._learned, self._problem
        u = self._y - problem.extended(problem.positions)
        out = correction.matrix_slopes(u, -self.x)
        for term in self._damping:
            out = out + term.matrices
        return out

    @cached_property
    def masses(self) -> Array:
        """By its masses at density 1, (C, 8, 8), 1/m3."""
        cells, out = self._problem.cells, np.zeros_like(self._learned.masses)
        for x, offset in self._inertial:
            out -= np.einsum("cki,cli->ckl", x[cells], offset[cells])
        return self._problem.materials.density[:, None, None] * out

    @property
    def _inertial(self) -> list[tuple[Array, Array]]:
        """Pairs of nodal a and b (N, 3) of which the Lagrangian has - a . M b."""
        stage, x = self._objective.stage, self._nodal
        pairs = [(x, stage.inertia * (self._y[: len(x)] - stage.target))]
        if self._rayleigh:
            pairs.append((self.x[: len(x)], self._rayleigh.mass_offset))
        return pairs

    @property
    def _learned(self) -> CellCorrection:
        if self._problem.correction is None:
            raise InputError(
                f"element {self._problem.element!r}: expected 'hex8-learned', which has matrices."
            )
        return self._problem.correction

    # --- by obstacles ---------------------------------------------------------------------

    @property
    def friction(self) -> Array:
        """By each obstacle's coefficient of friction, (obstacles,); 0 where there is none."""
        return self._contact.friction_slopes(self._y, self._nodal)

    @property
    def obstacle_positions(self) -> Array:
        """By a translation of each obstacle, (obstacles, 3), 1/m."""
        ends, starts = self._contact.slopes(self._y, self._nodal)
        return -(ends + starts).sum(axis=1)

    @property
    def _contact(self) -> ContactTerm:
        if self._objective.contact is None:
            raise InputError("the scene has no obstacles: expected one or more.")
        return self._objective.contact

    # --- by actuators ---------------------------------------------------------------------

    @property
    def activations(self) -> tuple[Array, ...]:
        """By the stretches of each actuator's table ``activation``, (rows,) each."""
        attached = self._objective.attached
        if attached is None or self._problem.fibres is None:
            raise InputError("the scene has no actuators: expected one or more.")
        return attached.activation_slopes(self._y, self.x)

    # --- by damping ---------------------------------------------------------------------

    @property
    def viscosity(self) -> float:
        """By ``damping.viscosity``, 1/s; refused, as the next two, where the scene has none."""
        term = self._damped(self._viscous, "viscosity")
        return self._objective.stage.strain_rate * term.by_rate

    @property
    def rayleigh_mass(self) -> float:
        """By ``damping.mass``, s."""
        return self._objective.stage.rate * self._damped(self._rayleigh, "mass").by_mass

    @property
    def rayleigh_stiffness(self) -> float:
        """By ``damping.stiffness``, 1/s."""
        return self._objective.stage.rate * self._damped(self._rayleigh, "stiffness").by_stiffness

    def _damped(self, term: Term | None, name: str) -> Term:
        if term is None or not getattr(self._problem.scene.damping, name):
            raise InputError(
                f"damping.{name} is 0 in this scene, or its integrator has no velocity: expected "
                "a positive number, however small."
            )
        return term

    # --- how good they are ----------------------------------------------------------------

    @cached_property
    def spectral_radius(self) -> float:
        """Of G^-1 (G - H), the convergence factor of the thesis's fixed point (eq. 3-30)."""
        return spectral_radius(self._H.hessian, self._step.global_solver(self._objective))

    def estimated_errors(self) -> dict[str, float]:
        """How much the gradients change in one Newton step from y, relative.

        An estimate of their error that is due to a forward step that was not solved
        exactly; first order in what it left.
        """
        _, gradient = self._objective.value_and_gradient(self._y)
        symmetric = AdjointOperator(self._H.hessian)
        found = self._step.solve(symmetric, self._y, gradient, "auto", 1e-6)
        better = Gradients(self._step, self._after, self._y - found.x)
        out = {}
        for name in ("positions", "velocities", "forces", "young", "poisson", "density"):
            new = getattr(better, name)
            size = float(np.linalg.norm(new))
            out[name] = float(np.linalg.norm(new - getattr(self, name))) / size if size else 0.0
        return out

    # --- internals --------------------------------------------------------------------------

    def _by_lagged(self, y: Array, x: Array) -> Array:
        """Derivatives of x . (loads and friction) by the y that these are held as at."""
        out, contact = self._by_sampled("y", y, x), self._objective.contact
        if contact is None:
            return out
        return out + self._objective.stage.gain * contact.lagged_slopes(y, x)

    def _by_contact(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Derivatives of x . forces, of obstacles and rollers, by positions after and before."""
        end, start = np.zeros_like(x), np.zeros_like(x)
        contact, attached = self._objective.contact, self._objective.attached
        if contact is not None:
            end, start = (contact.nodal(part.sum(axis=0), len(x)) for part in contact.slopes(y, x))
        if attached is not None:
            end = end + attached.end_slopes(y, x)
        return end, start

    def _by_sampled(self, name: str, y: Array, x: Array) -> Array:
        """Derivatives of x . (loads in the equation) by y or positions that they are sampled at."""
        stage, share = self._objective.stage, self._scheme.sampled.coefficients.get(name, 0.0)
        if not share or not self._problem.has_followers:
            return np.zeros_like(x)
        place = stage.sampled(y[: len(x)])
        slope = follower_slope(self._problem, x, place, *stage.loads_over)
        return share * stage.load_factor * slope

    def _pull(self, on_free: Linear, on_clamped: Linear | None, g: Array) -> None:
        """Add g's share to the derivatives by what a linear combination is made of."""
        if on_clamped is None:
            on_free.transpose(g, self._sums)
            return
        free = self._problem.free
        on_free.transpose(g * free, self._sums)
        on_clamped.transpose(g * ~free, self._sums)

    def _pull_stage(self, by_y: Array) -> None:
        scheme, problem, x = self._scheme, self._problem, self._nodal
        if scheme.inertia:
            by_target = scheme.inertia * problem.mass_times(x)
            self._pull(scheme.target, scheme.clamped_target, by_target)
        scheme.past_forces.transpose(x, self._sums)
        Linear(positions=1.0).transpose(self._by_sampled("positions", self._y, x), self._sums)
        by_end, by_start = self._by_contact(self._y, x)
        share = scheme.positions.coefficients.get("positions", 0.0)
        Linear(positions=1.0).transpose(share * by_end + by_start, self._sums)
        if self._rayleigh:
            origin = scheme.origin, scheme.clamped_origin
            at = scheme.foreseen or scheme.start, scheme.clamped
            for place, slope in zip((origin, at), self._rayleigh.places, strict=False):
                self._pull(*place, slope)
        if self._viscous:
            for (_, strained), slope in zip(scheme.strains, self._viscous.places, strict=True):
                self._pull(strained, None, slope)
        held = ~problem.free
        if held.any():
            back = (by_y - self._H.product(self.x)[: len(x)]) * held
            scheme.clamped.transpose(back, self._sums)

    def _sum(self, name: str) -> Array:
        found = self._sums.get(name)
        return np.zeros_like(self._problem.positions) if found is None else found

    @cached_property
    def _weights(self) -> tuple[Array, Array]:
        """By each cell's mu and omega, 0 for a term that the energy does not have."""
        problem = self._problem
        parts = [weight_slopes(problem, self._y, -self.x)]
        parts += [term.weights for term in self._damping]
        correction, materials = problem.correction, problem.materials
        if correction is not None and correction.writer is not None:
            weights = materials.mu, materials.volume_weight
            parts.append(correction.writer.slopes(*weights, self.matrices, self.masses))
        rule = problem.scene.material
        by_mu = np.sum([part[0] for part in parts], axis=0)
        by_omega = np.sum([part[1] for part in parts], axis=0)
        return by_mu * rule.has_shear_term, by_omega * rule.has_volume_term

    @property
    def _moduli_slopes(self) -> tuple[tuple[Array, Array], ...]:
        materials = self._problem.materials
        return lame_slopes(materials.young, materials.poisson)

    def _lagrangian(self, h: float) -> float:
        """L's linear part less x . r at fixed free y, for a step of h."""
        objective = self._step.objective(h)
        stage, count = objective.stage, len(self._problem.positions)
        y = np.where(objective.free, self._y, self._problem.extended(stage.start))
        objective.follow(y)
        _, residual = objective.balance(y)
        end = stage.finish(y[:count], objective.given_forces(y))
        value = np.vdot(self._after["positions"], end.positions)
        value += np.vdot(self._after["velocities"], end.velocities)
        for name in self._scheme.memory:
            if name in self._after:
                value += np.vdot(self._after[name], end.memory[name])
        return float(value - np.vdot(self.x, residual))
