"""Newton's method on the exact tangent: the trusted reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.factorisation import Backend, NotPositiveDefinite
from pdcorrect.fem.multigrid import Solution, conjugate_gradients
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.implicit import ImplicitStepper, whole
from pdcorrect.solvers.minimise import (
    NEAR_SADDLE,
    Direction,
    MinimiserOptions,
    Minimum,
    Solve,
    largest_displacement,
    newton_loop,
)
from pdcorrect.solvers.step import StepObjective
from pdcorrect.solvers.tangent_solver import TangentFactory, TangentSolver

Array = NDArray[np.float64]
LinearSolver = Literal["auto", "direct", "cg"]

_CG_TOLERANCE = 1e-3
"""Of the residual of a Newton step."""
_CG_LENGTH = 1e-2
"""Of a Newton step's length: the last change at which it has settled."""
_CG_STEPS = 500


class Newton(ImplicitStepper):
    """Steps a problem by Newton's method with a line search.

    The exact tangent is factorised in each iteration, or, for large meshes, the
    Newton step is found by conjugate gradients with the exact tangent,
    preconditioned by multigrid.  Where the tangent is not positive definite, the
    one with negative eigenvalues raised to zero at each quadrature point (Teran et
    al. 2005) takes its place for that iteration, with a shift if it is singular.

    Parameters
    ----------
    problem : Problem
    tolerance : float
        Of the coarse cell size: the length of the Newton step at which the
        iteration stops.
    max_iterations : int
    linear_solver : {"auto", "direct", "cg"}
        "auto" factorises where a band factor is expected to be quicker
        (`TangentFactory.direct_pays`) and where a direct ``backend`` is asked for by
        name.  Conjugate gradients may miss a direction of negative curvature that
        neither the force nor a fixed random vector excites.
    time_step, integrator, backend, recover
        See `ImplicitStepper`.
    """

    name = "Newton"
    _sees_saddles = True

    def __init__(
        self,
        problem: Problem,
        tolerance: float = 1e-10,
        *,
        max_iterations: int = 100,
        linear_solver: LinearSolver = "auto",
        time_step: float | None = None,
        integrator: str | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        if linear_solver not in ("auto", "direct", "cg"):
            raise InputError(
                f"linear_solver = {linear_solver!r}: expected 'auto', 'direct' or 'cg'."
            )
        super().__init__(problem, tolerance, time_step, integrator, backend, recover)
        self._options = replace(
            self._options, max_iterations=whole("max_iterations", max_iterations)
        )
        self._tangents = TangentFactory(problem, backend)
        direct = backend not in ("auto", "amg") or self._tangents.direct_pays
        self.linear_solver = linear_solver
        if linear_solver == "auto":
            self.linear_solver = "direct" if direct and backend != "amg" else "cg"

    def _prepare(self, objective: StepObjective) -> None:
        _, gradient = objective.value_and_gradient(objective.start)
        self._steps(objective, self._options)(objective.start, gradient)

    def preconditioner(self, objective: StepObjective, y: Array) -> Solve:
        """A factor of the Hessian at y, or a multigrid cycle where steps go without one."""
        if self.linear_solver == "cg":
            return self._tangents.approximate(objective, y)
        return self._tangents.factorise(objective, y)[0]

    def _factorisation(self) -> str:
        return "amg" if self.linear_solver == "cg" else self._tangents.backend

    def _minimise(
        self, objective: StepObjective, start: Array, options: MinimiserOptions
    ) -> Minimum:
        return newton_loop(objective, start, self._steps(objective, options), options)

    def _steps(self, objective: StepObjective, options: MinimiserOptions) -> Direction:
        """What gives the Newton steps of one time step."""
        if self.linear_solver == "cg":
            return _IterativeSteps(objective, self._tangents, options.tolerance)

        def direct(p: Array, gradient: Array) -> tuple[Array, bool]:
            try:
                solver, exact = self._tangents.factorise(objective, p)
                step = -solver(gradient)
                if not exact and -np.vdot(gradient, step) <= NEAR_SADDLE * objective.scale:
                    return np.zeros_like(p), False  # curvature leads down, not the gradient
                return step, exact
            except NotPositiveDefinite:  # multigrid may notice only when it solves
                return np.zeros_like(p), False  # no descent: the line search says so

        return direct


class _IterativeSteps:
    """Newton steps of one time step by multigrid-preconditioned conjugate gradients.

    The preconditioner is made from the projected tangent, which is never indefinite,
    and kept until the steps it needs have doubled.
    """

    def __init__(
        self, objective: StepObjective, tangents: TangentFactory, tolerance: float
    ) -> None:
        self._objective, self._tangents, self._tolerance = objective, tangents, tolerance
        self._cycle: TangentSolver | None = None
        self._first = self._last = 0

    def __call__(self, p: Array, gradient: Array) -> tuple[Array, bool]:
        """The Newton step, and whether the exact tangent gave it and is positive definite."""
        if self._cycle is None or self._last > 2 * self._first:
            self._renew(p)
        found = self._solve(p, -gradient)
        if found.convex and not found.converged:
            self._renew(p)
            found = self._solve(p, -gradient)
        if found.converged and (
            largest_displacement(found.x) > self._tolerance or self._positive(p)
        ):
            return found.x, True
        return self._solve(p, -gradient, project=True).x, False

    def _renew(self, p: Array) -> None:
        """Make the preconditioner at p."""
        self._first = self._last = 0
        try:
            self._cycle = self._tangents.approximate(self._objective, p)
        except NotPositiveDefinite:
            self._cycle = None  # no preconditioner

    def _solve(self, p: Array, b: Array, project: bool = False) -> Solution:
        objective = self._objective

        def settled(x: Array, change: Array) -> bool:
            return largest_displacement(change) <= _CG_LENGTH * largest_displacement(x)

        found = conjugate_gradients(
            objective.hessian_operator(p, project), b, self._cycle or (lambda r: r),
            tolerance=_CG_TOLERANCE, max_steps=_CG_STEPS, settled=settled,
        )  # fmt: skip
        self._last = found.steps
        self._first = self._first or found.steps
        return found

    def _positive(self, p: Array) -> bool:
        """Whether no negative curvature is met with a right-hand side that has all modes in it."""
        b = np.random.default_rng(0).normal(size=p.shape) * self._objective.free
        return self._solve(p, b).convex
