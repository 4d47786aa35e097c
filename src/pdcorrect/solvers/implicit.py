"""What projective dynamics and Newton share: one implicit step, its fallbacks and its report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from numbers import Real
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.clamps import check_held
from pdcorrect.fem.factorisation import Backend, NotPositiveDefinite, check_backend
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.follower import settle
from pdcorrect.solvers.integrators import Integrator, backward_euler
from pdcorrect.solvers.integrators import integrator as make_integrator
from pdcorrect.solvers.minimise import (
    MinimiserOptions,
    Minimum,
    Solve,
    below_saddle,
    newton_cg,
)
from pdcorrect.solvers.reactions import contact_forces
from pdcorrect.solvers.schemes import WHOLE_MEMORY
from pdcorrect.solvers.step import (
    GlobalSolver,
    StepObjective,
    check_input,
    hessian_factors,
)
from pdcorrect.solvers.threads import limited_threads
from pdcorrect.state import State, Status, StepResult, joined_stats

Array = NDArray[np.float64]

_FALLBACK_ITERATIONS = 60
_SUBSTEP_LEVELS = 4
_SADDLES = 5
"""That a step leaves, at most."""
_OF_DISTANCE = 2e-5
"""Of an obstacle's distance: largest tolerance, as contact forces change fast within it."""
_LARGEST = 1e30


_Effort = Counter[str]
"""Iterations and evaluations of one call, over all its attempts."""


@dataclass(eq=False)
class _Outcome:
    """The state after one attempt; ``stats`` are energies (J) then, and what went in or out."""

    state: State
    minimum: Minimum
    modes: Array | None
    stats: dict[str, float]


class ImplicitStepper:
    """One implicit step by minimisation (thesis eq. 3-6); subclasses say how to minimise.

    A step that does not converge is tried again with Newton-CG from where it
    stopped, then by backward Euler in 2, 4, 8, 16 sub-steps.  What happened is the
    result's status; a step that fails after all is returned as failed.

    Parameters
    ----------
    problem : Problem
    tolerance : float or None
        Largest accepted estimate of a node's distance from the step's exact
        solution, as a fraction of the coarse cell size; None for the scene's.
    time_step : float, optional
        s; the scene's by default.
    integrator : str, optional
        Name of the integrator; the scene's by default.
    backend : str
        Factorisation, see `factorise`.
    recover : bool
        Whether to use the fallbacks.

    Raises
    ------
    InputError
        If an argument is wrong, the scene wants what the method does not have, or quasi-static
        bodies can move rigidly.
    """

    name = "implicit"
    _sees_saddles = False
    """Whether convergence means that the Hessian is positive definite."""

    def __init__(
        self,
        problem: Problem,
        tolerance: float | None,
        time_step: float | None = None,
        integrator: str | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        if not isinstance(problem, Problem):
            raise InputError(
                f"problem is a {type(problem).__name__}: expected pc.discretise(scene)."
            )
        self.problem = problem
        self.time_step = problem.time_step if time_step is None else float(time_step)
        check_backend(backend)
        self.tolerance = float(problem.scene.solver.tolerance if tolerance is None else tolerance)
        positive("tolerance", self.tolerance)
        positive("time_step", self.time_step)
        time = problem.scene.time
        self.integrator = time.integrator if integrator is None else integrator
        viscous = problem.scene.damping.viscosity > 0.0
        self.integrate = make_integrator(self.integrator, time.spectral_radius, viscous)
        if self.integrator == "quasi-static" and problem.contact is None:  # which may hold it
            check_held(problem.positions, problem.cells, problem.clamps)
        within = self.tolerance * problem.cell_size
        if problem.contact is not None:
            within = min(within, _OF_DISTANCE * min(problem.contact.distances))
        self._options = MinimiserOptions(within)
        self._backend = backend
        self._recover = recover
        self._solvers: dict[tuple[float, ...], GlobalSolver] = {}
        self._adrift = bool(problem.free.all(axis=0).any())

    def __call__(
        self,
        state: State,
        forces: Array | None = None,
        time_step: float | None = None,
    ) -> StepResult:
        """Advance ``state`` by one step.

        Parameters
        ----------
        state : State
        forces : (N, 3), optional
            Nodal forces besides the scene's loads, N.
        time_step : float, optional
            For this step only, s; a new value is factorised and kept.

        Raises
        ------
        InputError
            If shapes are wrong or a number is not finite.
        """
        state, h = self.accepted(state, forces, time_step)
        with limited_threads():
            return self._step(state, forces, h)

    def accepted(
        self, state: State, forces: Array | None, time_step: float | None
    ) -> tuple[State, float]:
        """The state and the time step (s) that a call with these arguments goes on with.

        The state is without its memory where the step is not the stepper's own, since
        several-step integrators need equal steps.

        Raises
        ------
        InputError
            As by the call itself.
        """
        check_input(self.problem, state, forces)
        h = self.time_step if time_step is None else float(time_step)
        positive("time_step", h)
        return (state if h == self.time_step else replace(state, memory={})), h

    def _step(self, state: State, forces: Array | None, h: float) -> StepResult:
        effort = _Effort(iterations=0, evaluations=0)
        outcome = self._attempt(state, forces, h, effort, self.integrate)
        if not outcome.minimum.status.ok and self._recover:
            outcome = self._substeps(state, forces, h, effort) or outcome
        if h != self.time_step:
            outcome.state = replace(outcome.state, memory={})
        return self._report(outcome, effort)

    def prepare(self) -> Self:
        """Factorise and load the kernels now, so that the first step is like the others."""
        with limited_threads():
            rest = self.problem.rest_state()
            objective = self.objective(rest, None, self.time_step)
            objective.value_and_gradient(objective.start)
            hessian = objective.hessian_operator(objective.start)
            hessian(objective.start)
            if objective.contact is not None:
                hessian.blocks()  # of steps that touch
            self._prepare(objective)
        return self

    def _prepare(self, objective: StepObjective) -> None:
        """Factorise what the first step will use."""
        self.global_solver(objective.factors)

    def __repr__(self) -> str:
        return f"{self.name} of {self.problem!r}, tolerance {self.tolerance:g}"

    def describe(self) -> dict[str, str]:
        """Method, tolerance, integrator, step and factorisation in use."""
        return {
            "solver": self.name,
            "tolerance": f"{self.tolerance:g}",
            "integrator": self.integrator,
            "time_step": f"{self.time_step:g}",
            "factorisation": self._factorisation(),
        }

    def _factorisation(self) -> str:
        rest = self.problem.rest_state()
        stage = self.integrate(self.problem, rest, self.time_step)
        return self.global_solver(hessian_factors(self.problem, stage)).backend

    # --- one attempt ----------------------------------------------------------------

    def _minimise(
        self, objective: StepObjective, start: Array, options: MinimiserOptions
    ) -> Minimum:
        """Minimise the step's objective from a configuration."""
        raise TypeError(f"{type(self).__name__} does not say how to minimise a step")

    def _volume_scale(self) -> float:
        """Factor on the volume weight in G, as used by `global_solver`."""
        return 1.0

    def preconditioner(self, objective: StepObjective, y: Array) -> Solve:
        """A symmetric positive definite approximation of a step's H^-1 at y, for its adjoint."""
        return self.global_solver(objective.factors)

    def global_solver(
        self, factors: tuple[float, float], volume_scale: float | None = None
    ) -> GlobalSolver:
        """G's factor; that of the steps of a run and the last other one are kept.

        ``volume_scale`` multiplies the volume weight in G, by default as in this stepper's
        first Hessian.
        """
        scale = self._volume_scale() if volume_scale is None else volume_scale
        key = (*factors, scale)
        if key not in self._solvers:
            scheme = self.integrate.scheme_of(self.time_step, WHOLE_MEMORY)
            own = hessian_factors(self.problem, scheme)
            self._solvers = {k: s for k, s in self._solvers.items() if k[:2] == own}
            self._solvers[key] = GlobalSolver(self.problem, factors, self._backend, scale)
        return self._solvers[key]

    def objective(
        self,
        state: State,
        forces: Array | None,
        time_step: float,
        integrate: Integrator | None = None,
    ) -> StepObjective:
        """What a step minimises; ``integrate`` is the stepper's own integrator by default."""
        integrate = self.integrate if integrate is None else integrate
        stage = integrate(self.problem, state, time_step)
        return StepObjective(self.problem, state, stage, forces)

    def _attempt(
        self,
        state: State,
        forces: Array | None,
        h: float,
        effort: _Effort,
        integrate: Integrator,
    ) -> _Outcome:
        objective = self.objective(state, forces, h, integrate)
        stage = objective.stage
        minimum = self.minimum(objective, objective.start)
        effort.update(iterations=minimum.iterations, evaluations=minimum.evaluations)
        if minimum.status.ok and self._adrift:
            y, gradient = objective.carried(minimum.positions, minimum.gradient)
            minimum = replace(minimum, positions=y, gradient=gradient)
        minimum.estimate *= stage.gain
        return _outcome(self.problem, state, objective, minimum, h)

    def minimum(self, objective: StepObjective, start: Array) -> Minimum:
        """The minimum of a step's objective that is found from a configuration (N + B, 3)."""
        within = self._options.tolerance / objective.stage.gain
        options = replace(self._options, tolerance=within)
        found = self._settled(objective, start, options)
        return self._past_saddles(objective, found, lambda y: self._settled(objective, y, options))

    def _settled(
        self, objective: StepObjective, start: Array, options: MinimiserOptions
    ) -> Minimum:
        """`_solved`, with friction and loads that follow the body as at the minimum."""
        if not objective.follows:
            return self._solved(objective, start, options)
        options = replace(options, tolerance=0.5 * options.tolerance)
        again = replace(options, unmoved=1.0)
        return settle(
            objective,
            start,
            lambda y: self._solved(objective, y, options if y is start else again),
        )

    def _past_saddles(
        self, objective: StepObjective, minimum: Minimum, minimise: Callable[[Array], Minimum]
    ) -> Minimum:
        """The minimum that ``minimise`` finds below the saddle where the loop ended, if at one."""
        for _ in range(_SADDLES):
            below = self._below_saddle(objective, minimum)
            if below is None:
                break
            minimum = minimise(below).after(minimum)
        return minimum

    def _below_saddle(self, objective: StepObjective, minimum: Minimum) -> Array | None:
        """See `below_saddle`; None too where the loop has looked itself, or contact does not press.

        Symmetric bodies that obstacles squeeze buckle.
        """
        y, status = minimum.positions, minimum.status
        pressed = objective.contact is not None and objective.contact.near(y)
        seen = self._sees_saddles and status is Status.CONVERGED
        if status is Status.LINE_SEARCH or (status.ok and pressed and not seen):
            with suppress(NotPositiveDefinite):
                return below_saddle(objective, y, self.preconditioner(objective, y))
        return None

    def _solved(self, objective: StepObjective, start: Array, options: MinimiserOptions) -> Minimum:
        """The method itself, then Newton-CG from where it stopped."""
        found = self._minimise(objective, start, options)
        if found.status is Status.LINE_SEARCH:
            found = self._past_saddles(
                objective, found, lambda y: self._minimise(objective, y, options)
            )
        if found.status.ok or found.status is Status.NOT_FINITE or not self._recover:
            return found
        options = replace(options, max_iterations=_FALLBACK_ITERATIONS)
        solver = self.global_solver(objective.factors)
        again = newton_cg(objective, found.positions, solver, options)
        if again.status is Status.CONVERGED:
            again.status = Status.RECOVERED
        return again.after(found)

    def _substeps(
        self, state: State, forces: Array | None, h: float, effort: _Effort
    ) -> _Outcome | None:
        """The step in 2, 4, 8, 16 parts; its residual and estimate are the worst part's.

        None without inertia: parts by backward Euler would solve another problem.
        """
        if self.integrate.scheme(state, h).inertia == 0.0:
            return None
        for level in range(1, _SUBSTEP_LEVELS + 1):
            count = 2**level
            parts: list[_Outcome] = []
            current = replace(state, memory={})
            for _ in range(count):
                part = self._attempt(current, forces, h / count, effort, backward_euler)
                if not part.minimum.status.ok:
                    break
                parts.append(part)
                current = part.state
            else:
                memory = self._remembered(state, parts[-2].state, current, forces, h)
                return _joined(parts, replace(current, time=state.time + h, memory=memory))
        return None

    def _remembered(
        self, start: State, before: State, end: State, forces: Array | None, h: float
    ) -> dict[str, Array]:
        """What the integrator needs of a step of h seconds in parts, of which the last is given."""
        part = end.time - before.time
        loads = self.problem.external_forces(before.time, end.time, end.positions)
        accelerations = (end.velocities - before.velocities) / part * self.problem.free
        if self.problem.contact is not None:
            loads = loads + contact_forces(self.problem, end, before).sum(axis=0)
        if self.problem.rollers is not None:
            loads += self.problem.rollers.energy_and_forces(
                end.positions - self.problem.positions, end.time
            )[1]
        internal = self.problem.mass_times(accelerations) - loads
        known = {
            "accelerations": accelerations,
            "internal_forces": (internal if forces is None else internal - forces)
            * self.problem.free,
            "previous_positions": start.positions,
            "previous_velocities": start.velocities,
            "previous_times": np.full_like(start.positions, start.time),
            "strained": 0.5 * (start.positions + end.positions),
            "strained_before": start.memory.get("strained"),
        }
        names = self.integrate.scheme(start, h).memory
        return {n: x for n, x in known.items() if n in names and x is not None}

    def _report(self, outcome: _Outcome, effort: _Effort) -> StepResult:
        state, minimum = outcome.state, outcome.minimum
        ratios = self.problem.volume_ratios(state.positions)
        stats = {
            "evaluations": float(effort["evaluations"]),
            **outcome.stats,
            "smallest_volume_ratio": float(ratios.min()),
        }
        status = minimum.status
        if not status.ok:  # what it remembers would be out of balance
            state = replace(state, memory={})
        if status is Status.CONVERGED and stats["smallest_volume_ratio"] <= 0.0:
            status = Status.INVERTED
        residual = float(np.abs(minimum.gradient).max())
        return StepResult(
            state, status, effort["iterations"], residual, minimum.estimate, stats, outcome.modes,
            ratios,
        )  # fmt: skip


def _outcome(
    problem: Problem, state: State, objective: StepObjective, minimum: Minimum, h: float
) -> _Outcome:
    y, nodes = minimum.positions, len(state.positions)
    stage, forces = objective.stage, objective.given_forces(y)
    reaction, rollers = np.zeros_like(forces), problem.rollers
    if problem.clamps.moving or rollers is not None:
        unbalanced = objective.balance(y)[1][:nodes]
        reaction = unbalanced * ~problem.free
    after = stage.finish(y[:nodes], forces + reaction)
    moved = after.positions - state.positions
    if rollers is not None and objective.attached is not None:
        pushed = unbalanced + objective.attached.end_forces(y)
        reaction = pushed - rollers.along(pushed * problem.free)
    ends_at_y = stage.gain == 1.0  # otherwise the modes at the end are other ones
    end = y if ends_at_y else problem.relaxed(after.positions)
    u = end[:nodes] - problem.positions
    attached = [one.energy_and_forces(u, stage.end)[0] for one in problem.attached]
    momentum = problem.mass_times(after.velocities)
    stats = {
        "elastic_energy": objective.elastic_energy(end) + sum(attached),
        "kinetic_energy": 0.5 * float(np.vdot(after.velocities, momentum)),
        "external_work": float(np.vdot(objective.loads, moved)),
        "clamp_work": float(np.vdot(reaction, moved)) / stage.load_factor,
        "damping_loss": objective.damping_loss(y, moved, h),
    }
    if objective.contact is not None:
        stats |= objective.contact.report(y)
    if objective.attached is not None:
        stats |= objective.attached.work(y)
    return _Outcome(after, minimum, end[nodes:] if problem.space.internal else None, stats)


def _joined(parts: list[_Outcome], end: State) -> _Outcome:
    last = parts[-1]
    minimum = replace(
        last.minimum,
        status=Status.SUBSTEPPED,
        estimate=max(part.minimum.estimate for part in parts),
        gradient=max((part.minimum.gradient for part in parts), key=lambda g: np.abs(g).max()),
    )
    return _Outcome(end, minimum, last.modes, joined_stats([part.stats for part in parts]))


def whole(name: str, value: int, least: int = 0) -> int:
    """``value`` if it is a whole number of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name} = {value!r}: expected a whole number of at least {least}.")
    return int(value)


def positive(name: str, value: float) -> float:
    """``value`` if it is a positive number."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not number or not 0 < value < _LARGEST:
        raise InputError(f"{name} = {value!r}: expected a number between 0 and {_LARGEST:g}.")
    return float(value)
