"""Projective dynamics: a constant global matrix, factorised once (thesis section 3.1)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.factorisation import Backend, NotPositiveDefinite
from pdcorrect.fem.hyperelasticity import COROTATED
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.first_hessian import INSIDE, TrueHessian
from pdcorrect.solvers.implicit import ImplicitStepper, whole
from pdcorrect.solvers.minimise import MinimiserOptions, Minimum, Solve, minimise
from pdcorrect.solvers.step import StepObjective
from pdcorrect.solvers.tangent_solver import TangentFactory
from pdcorrect.state import State, Status, StepResult
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
Method = Literal["lbfgs", "local-global"]
FirstHessian = Literal["auto", "G", "G-scaled", "rest", "lagged"]

_PATIENCE = 40
"""Iterations with one true Hessian before it is renewed within the step."""
_CONTACT_PATIENCE = 5
"""The same in scenes with obstacles, whose barriers no earlier Hessian knows."""
VOLUME_SCALE = 0.25
"""Factor on the volume weight inside the first Hessian "G-scaled".

G overestimates the stiffness of the volume term where it acts.  In twist,
bending and free flight at Poisson's ratio 0.3 and 0.45 a quarter took 21 to 46
per cent fewer iterations than 1, and was the best or within a tenth of it
(``benchmarks``, case volume_scale).
"""


class ProjectiveDynamics(ImplicitStepper):
    """Steps a problem by projective dynamics.

    Minimises gamma of eq. 3-6 with quasi-Newton steps on the factor of G
    (eq. 3-14), which is built at the first step and kept.

    Parameters
    ----------
    problem : Problem
    tolerance : float, optional
        Of the coarse cell size; the scene's by default.
    method : {"lbfgs", "local-global"}
        L-BFGS with a line search, or the plain alternation of the thesis.
    first_hessian : {"auto", "G", "G-scaled", "rest", "lagged"}
        L-BFGS's first approximation: G as in the thesis; G with its volume
        weight scaled by `VOLUME_SCALE`; the true Hessian of the rest shape, turned
        with the body (`TrueHessian`), like G factorised once; or that of an earlier
        frame, factorised again when the iteration counts say that it pays.  "auto"
        is "rest", or "G-scaled" where ``backend`` asks for a general factorisation.
        The energy, and so the answer, is the same.
    max_iterations : int, optional
        1000 for L-BFGS and 20000 for local/global by default.
    time_step, integrator, backend, recover
        See `ImplicitStepper`.

    Examples
    --------
    >>> stepper = ProjectiveDynamics(problem)          # doctest: +SKIP
    >>> result = stepper(problem.rest_state())         # doctest: +SKIP
    """

    def __init__(
        self,
        problem: Problem,
        tolerance: float | None = None,
        *,
        method: Method = "lbfgs",
        first_hessian: FirstHessian = "auto",
        max_iterations: int | None = None,
        time_step: float | None = None,
        integrator: str | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        super().__init__(problem, tolerance, time_step, integrator, backend, recover)
        general = backend in ("cholespy", "splu")
        _check_method(problem, method, first_hessian, general)
        self.method = method
        self.name = f"projective dynamics ({method})"
        plain = method == "local-global"
        self.first_hessian = first_hessian
        if first_hessian == "auto":
            self.first_hessian = "G" if plain else "G-scaled" if general else "rest"
        self._true: TrueHessian | None = None
        if self.first_hessian == "lagged" and problem.scene.time.substeps > 1:
            raise InputError(
                f"first_hessian = 'lagged' with time.substeps = {problem.scene.time.substeps}: "
                "expected 1, for it is resumed from the states of all its steps."
            )
        if self.first_hessian in ("rest", "lagged"):
            tangents = TangentFactory(problem, backend)
            self._true = TrueHessian(tangents, lagged=self.first_hessian == "lagged")
        limit = (20000 if plain else 1000) if max_iterations is None else max_iterations
        self._options = replace(
            self._options,
            history=0 if plain else self._options.history,
            max_iterations=whole("max_iterations", limit),
        )

    def describe(self) -> dict[str, str]:
        """Method, first Hessian, tolerance, step and factorisation in use."""
        return {**super().describe(), "first_hessian": _NAMES[self.first_hessian]}

    def restore(self, run: Trajectory) -> None:
        """Go on as if this stepper had made ``run``, bit by bit."""
        if self._true is None or not self._true.lagged or not len(run):
            return
        age = int(run.stats["hessian_age"][-1])
        made = len(run) - 1 - max(age, 0)
        state = run.state(made)
        objective = self.objective(state, None, self.time_step)
        counts = [int(n) for n in run.stats["iterations"][made:]]
        self._true.restore(age, counts, objective, run.state(-1).time)

    def _factorisation(self) -> str:
        if self._true is not None:
            return self._true.tangents.backend
        return super()._factorisation()

    def preconditioner(self, objective: StepObjective, y: Array) -> Solve:
        """The first Hessian's solver, turned to y; G's where there is no true one."""
        if self._true is None:
            return super().preconditioner(objective, y)
        return self._true.at(objective, y)

    def _volume_scale(self) -> float:
        return 1.0 if self.first_hessian == "G" else VOLUME_SCALE

    def _prepare(self, objective: StepObjective) -> None:
        if self._true is None:
            super()._prepare(objective)
        else:
            with suppress(NotPositiveDefinite):
                self._true.solver(objective)(objective.start)
            if self._true.lagged:
                self._true.forget()

    def _step(self, state: State, forces: Array | None, h: float) -> StepResult:
        result = super()._step(state, forces, h)
        if self._true is None or not self._true.lagged:
            return result
        self._true.note(result.iterations, result.state.time)
        return replace(result, stats={**result.stats, "hessian_age": float(self._true.age)})

    def _minimise(
        self, objective: StepObjective, start: Array, options: MinimiserOptions
    ) -> Minimum:
        if self._true is not None:
            try:
                return self._minimise_true(self._true, objective, start, options)
            except NotPositiveDefinite:  # G always is, if the step has a minimum
                self._true.forget()
        return minimise(objective, start, self.global_solver(objective.factors), options)

    def _minimise_true(
        self,
        hessian: TrueHessian,
        objective: StepObjective,
        start: Array,
        options: MinimiserOptions,
    ) -> Minimum:
        """L-BFGS; a Hessian that has not led to the minimum after a while is renewed on the way."""
        most = options.max_iterations
        first = start is objective.start
        touching = objective.contact is not None and objective.contact.near(start)
        patience = _PATIENCE if objective.contact is None else _CONTACT_PATIENCE
        if touching and (first or hessian.age != INSIDE):
            solver = hessian.renew(objective, start)
        else:
            solver = hessian.solver(objective) if first else hessian.at(objective, start)
        limit = min(patience, most)
        found = minimise(objective, start, solver, replace(options, max_iterations=limit))
        while found.status is Status.ITERATION_LIMIT and found.iterations < most:
            solver = hessian.renew(objective, found.positions)
            limit = min(patience, most - found.iterations)
            again = replace(options, max_iterations=limit)
            found = minimise(objective, found.positions, solver, again).after(found)
        return found


def _check_method(problem: Problem, method: str, first_hessian: str, general: bool) -> None:
    if method not in get_args(Method):
        raise InputError(f"method = {method!r}: expected 'lbfgs' or 'local-global'.")
    names = get_args(FirstHessian)
    if first_hessian not in names:
        raise InputError(f"first_hessian = {first_hessian!r}: expected {', '.join(names)}.")
    if method == "local-global" and first_hessian not in ("auto", "G"):
        raise InputError("method = 'local-global' iterates with G itself: leave first_hessian.")
    if method == "local-global" and problem.contact is not None:
        raise InputError("method = 'local-global' with obstacles: expected method = 'lbfgs'.")
    if problem.rollers is not None and (
        method == "local-global" or first_hessian in ("G", "G-scaled") or general
    ):
        raise InputError(
            "oblique rollers with the global matrix G, which knows no directions: expected method "
            "= 'lbfgs' with first_hessian = 'rest' or 'lagged', and a backend for those."
        )
    if method == "local-global" and problem.materials.model != COROTATED:
        raise InputError(
            f"method = 'local-global' with energy = {problem.scene.material.energy!r}: "
            "expected the corotated energy, whose terms are projections, or method = 'lbfgs'."
        )


_NAMES = {
    "G": "G",
    "G-scaled": f"G, volume weight x {VOLUME_SCALE:g}",
    "rest": "true Hessian of the rest shape, turned with the body",
    "lagged": "true Hessian of an earlier frame, turned with the body",
}
