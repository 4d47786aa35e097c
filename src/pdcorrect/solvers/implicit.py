"""What projective dynamics and Newton share: one implicit step, its fallbacks and its report."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from pdcorrect.errors import InputError
from pdcorrect.fem.factorisation import Backend, check_backend
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.lbfgs import MinimiserOptions, Minimum
from pdcorrect.solvers.newton_loop import newton_cg
from pdcorrect.solvers.step import GlobalSolver, StepObjective, check_input
from pdcorrect.state import State, Status, StepResult

Array = NDArray[np.float64]

_FALLBACK_ITERATIONS = 60
_SUBSTEP_LEVELS = 4
_LARGEST = 1e30


@dataclass
class _Effort:
    """Work done in one call, over all its attempts."""

    iterations: int = 0
    evaluations: int = 0

    def add(self, minimum: Minimum) -> None:
        self.iterations += minimum.iterations
        self.evaluations += minimum.evaluations


class ImplicitStepper:
    """Backward Euler by minimisation (thesis eq. 3-6); subclasses say how to minimise.

    A step that does not converge is tried again with Newton-CG from where it
    stopped, then in 2, 4, 8, 16 sub-steps.  What happened is the result's
    status; a step that fails after all is returned as failed.

    Parameters
    ----------
    problem : Problem
    tolerance : float
        Largest accepted estimate of a node's distance from the step's exact
        solution, as a fraction of the coarse cell size.
    time_step : float, optional
        s; the scene's by default.
    backend : str
        Factorisation, see `factorise`.
    recover : bool
        Whether to use the fallbacks.
    """

    name = "implicit"

    def __init__(
        self,
        problem: Problem,
        tolerance: float,
        time_step: float | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        self.problem = problem
        self.time_step = problem.time_step if time_step is None else float(time_step)
        check_backend(backend)
        _positive("tolerance", tolerance)
        _positive("time_step", self.time_step)
        self.tolerance = float(tolerance)
        self._options = MinimiserOptions(self.tolerance * problem.cell_size)
        self._backend = backend
        self._recover = recover
        self._solvers: dict[float, GlobalSolver] = {}

    def __call__(
        self, state: State, forces: Array | None = None, time_step: float | None = None
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
        check_input(self.problem, state, forces)
        h = self.time_step if time_step is None else float(time_step)
        _positive("time_step", h)
        with _quiet_blas():
            return self._step(state, forces, h)

    def _step(self, state: State, forces: Array | None, h: float) -> StepResult:
        effort = _Effort()
        minimum, loads = self._attempt(state, forces, h, effort)
        after = _advance(state, minimum.positions, h)
        work = float(np.vdot(loads, minimum.positions - state.positions))
        if not minimum.status.ok and self._recover:
            found = self._substeps(state, forces, h, effort)
            if found is not None:
                after, minimum, work = found
        return self._report(after, minimum, effort, work)

    def prepare(self) -> Self:
        """Factorise and load the kernels now, so that the first step is like the others."""
        with _quiet_blas():
            self._global_solver(self.time_step)
            rest = self.problem.positions
            self.problem.energy_and_forces(rest)
            self.problem.linearise(rest).apply(rest)
        return self

    def __repr__(self) -> str:
        return f"{self.name} of {self.problem!r}, tolerance {self.tolerance:g}"

    def describe(self) -> dict[str, str]:
        """Method, tolerance, step and factorisation in use."""
        return {
            "solver": self.name,
            "tolerance": f"{self.tolerance:g}",
            "time_step": f"{self.time_step:g}",
            "factorisation": self._factorisation(),
        }

    def _factorisation(self) -> str:
        return self._global_solver(self.time_step).backend

    # --- one attempt ----------------------------------------------------------------

    def _minimise(self, objective: StepObjective) -> Minimum:
        """Minimise the step's objective from its starting point."""
        raise TypeError(f"{type(self).__name__} does not say how to minimise a step")

    def _volume_scale(self) -> float:
        """Factor on the volume weight in G, as used by `_global_solver`."""
        return 1.0

    def _global_solver(self, h: float) -> GlobalSolver:
        """G's factor for a step size; the stepper's own and the last other one are kept."""
        if h not in self._solvers:
            kept = {k: v for k, v in self._solvers.items() if k == self.time_step}
            kept[h] = GlobalSolver(self.problem, h, self._backend, self._volume_scale())
            self._solvers = kept
        return self._solvers[h]

    def _attempt(
        self, state: State, forces: Array | None, h: float, effort: _Effort
    ) -> tuple[Minimum, Array]:
        """The method itself, then Newton-CG from where it stopped; and the forces used."""
        loads = self.problem.external_forces(state.time, state.time + h, state.positions)
        if forces is not None:
            loads = loads + forces
        objective = StepObjective(self.problem, state, h, loads)
        minimum = self._minimise(objective)
        effort.add(minimum)
        if minimum.status.ok or not self._recover or minimum.status is Status.NOT_FINITE:
            return minimum, loads
        options = replace(self._options, max_iterations=_FALLBACK_ITERATIONS)
        again = newton_cg(objective, minimum.positions, self._global_solver(h), options)
        effort.add(again)
        if again.status is Status.CONVERGED:
            again.status = Status.RECOVERED
        return again, loads

    def _substeps(
        self, state: State, forces: Array | None, h: float, effort: _Effort
    ) -> tuple[State, Minimum, float] | None:
        """The step in 2, 4, 8, 16 parts; its residual and estimate are the worst part's."""
        for level in range(1, _SUBSTEP_LEVELS + 1):
            count = 2**level
            current, work, estimate, gradient = state, 0.0, 0.0, np.zeros(1)
            for _ in range(count):
                minimum, loads = self._attempt(current, forces, h / count, effort)
                if not minimum.status.ok:
                    break
                work += float(np.vdot(loads, minimum.positions - current.positions))
                current = _advance(current, minimum.positions, h / count)
                estimate = max(estimate, minimum.estimate)
                gradient = max(gradient, minimum.gradient, key=lambda g: np.abs(g).max())
            else:
                worst = replace(
                    minimum, status=Status.SUBSTEPPED, estimate=estimate, gradient=gradient
                )
                return replace(current, time=state.time + h), worst, work
        return None

    def _report(self, state: State, minimum: Minimum, effort: _Effort, work: float) -> StepResult:
        kinetic = 0.5 * np.vdot(state.velocities, self.problem.mass_times(state.velocities))
        stats = {
            "evaluations": float(effort.evaluations),
            "elastic_energy": self.problem.energy(state.positions),
            "kinetic_energy": float(kinetic),
            "external_work": work,
        }
        residual = float(np.abs(minimum.gradient).max())
        return StepResult(
            state, minimum.status, effort.iterations, residual, minimum.estimate, stats
        )


@cache
def _threadpools() -> ThreadpoolController:
    return ThreadpoolController()


def _quiet_blas() -> AbstractContextManager[Any]:
    """BLAS on one thread: idle BLAS threads spin and take the kernels' cores.

    The products here are too small to gain from threads (``benchmarks``, case
    threads).
    """
    return _threadpools().limit(limits=1, user_api="blas")


def _advance(state: State, positions: Array, h: float) -> State:
    """Backward Euler's velocity, eq. 3-1."""
    return State(positions, (positions - state.positions) / h, state.time + h)


def whole(name: str, value: int) -> int:
    """``value`` if it is a whole number of at least 0."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise InputError(f"{name} = {value!r}: expected a whole number of at least 0.")
    return int(value)


def _positive(name: str, value: float) -> None:
    if not 0 < value < _LARGEST:
        raise InputError(f"{name} = {value!r}: expected a number between 0 and {_LARGEST:g}.")
