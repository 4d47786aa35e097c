"""Who computes the runs of a data set: `OneByOne` on the CPU, `Batched` (a module of its own)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.implicit import ImplicitStepper
from pdcorrect.solvers.newton import Newton
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State, Status, StepResult

MOST_ITERATIONS = 300
"""Of projective dynamics in a step, without fallbacks; a load that takes more is rejected.

In `impulse-as-published` a step takes 3 to 6 on average and 91 at most.  A body that folds takes
far more, for which all others in its batch would wait.
"""

Array = NDArray[np.float64]
SolverName = Literal["pd", "newton"]


@dataclass(frozen=True, eq=False)
class Steps:
    """What came of T steps, on the N coarse nodes of a problem."""

    # (T, N, 3): after each step, m and m/s.  Steps after a failure are missing
    positions: Array
    velocities: Array
    # (T,): error estimates in m; det F at quadrature points
    iterations: NDArray[np.int64]
    error_estimates: Array
    smallest_volume_ratios: Array
    failure: str  # why the run is of no use, with its first bad step; empty if it is fine
    seconds: float  # the share of the wall-clock time


def failure_of(status: Status, ratio: float) -> str:
    """Why a step with this smallest volume ratio is of no use; empty if it is fine."""
    if not status.ok:
        return status.value
    return "" if ratio > 0.0 else "a cell is inverted"


class Engine(Protocol):
    """Computes runs of problems that may share meshes and materials."""

    def rollouts(self, problems: Sequence[Problem], steps: int, divisor: int = 1) -> list[Steps]:
        """Each problem from rest, ``steps`` time steps, each cut into ``divisor`` ones."""

    def predictions(
        self, problems: Sequence[Problem], states: Sequence[Sequence[State]]
    ) -> list[Steps]:
        """One step from each state of each problem, as long as they all succeed."""

    def describe(self) -> dict[str, str]:
        """The solver and what it runs on."""


class OneByOne:
    """One problem after the other, on the CPU.

    Projective dynamics has no fallbacks and at most `MOST_ITERATIONS`.  The tolerance is of the
    coarse cell size; if errors add up it falls with the square of a rollout's ``divisor``.
    """

    def __init__(self, solver: SolverName, tolerance: float, adds_up: bool = False) -> None:
        self._solver, self._tolerance, self._adds_up = solver, tolerance, adds_up

    def rollouts(self, problems: Sequence[Problem], steps: int, divisor: int = 1) -> list[Steps]:
        return self._run(problems, [[None] * steps for _ in problems], divisor)

    def predictions(
        self, problems: Sequence[Problem], states: Sequence[Sequence[State]]
    ) -> list[Steps]:
        return self._run(problems, states, 1)

    def describe(self) -> dict[str, str]:
        return {"solver": self._solver, "engine": "one by one on the CPU"}

    def _run(
        self, problems: Sequence[Problem], starts: Sequence[Sequence[State | None]], divisor: int
    ) -> list[Steps]:
        """Frames of each problem, from given states or, where None, from the one before."""
        steppers: dict[int, Any] = {}
        out = []
        for problem, states in zip(problems, starts, strict=True):
            began = time.perf_counter()
            stepper = self._stepper(steppers, problem, divisor)
            out.append(_steps(stepper, problem, states, divisor, began))
        return out

    def _stepper(self, known: dict[int, Any], problem: Problem, divisor: int) -> Any:
        """One stepper, without loads, for all problems on the same mesh.

        Follower loads depend on where a step ends: it takes their own problem's stepper.
        """
        own = problem.has_followers
        key = id(problem if own else problem.space)
        if key not in known:
            stepped = problem if own else problem.with_loads([])
            step = problem.time_step / divisor
            tolerance = self._tolerance / (divisor**2 if self._adds_up else 1)
            if self._solver == "newton":
                known[key] = Newton(stepped, tolerance, time_step=step)
            else:
                known[key] = ProjectiveDynamics(
                    stepped, tolerance, time_step=step, max_iterations=MOST_ITERATIONS,
                    recover=False,
                )  # fmt: skip
        return known[key]


def step_forces(stepper: ImplicitStepper, problem: Problem, state: State) -> Array:
    """A problem's loads over the time that its integrator averages them, (N, 3), N."""
    shares = stepper.integrate.scheme(state, stepper.time_step).loads_over
    first, last = (state.time + share * stepper.time_step for share in shares)
    return problem.external_forces(first, last, state.positions)


def _steps(
    stepper: ImplicitStepper,
    problem: Problem,
    starts: Sequence[State | None],
    divisor: int,
    began: float,
) -> Steps:
    """Frames up to the first failure, of ``divisor`` steps each."""
    frames: list[tuple[Any, ...]] = []
    nodes, state, failure = problem.mesh.coarse_nodes, problem.initial_state(), ""
    for start in starts:
        state = state if start is None else start
        iterations, error, ratio = 0, 0.0, np.inf
        for _ in range(divisor):
            loaded = stepper.problem is problem
            forces = None if loaded else step_forces(stepper, problem, state)
            result: StepResult = stepper(state, forces)
            state = result.state
            iterations += result.iterations
            error = max(error, result.error_estimate)
            ratio = min(ratio, result.stats["smallest_volume_ratio"])
            failure = failure or failure_of(result.status, ratio)
        frames.append((state.positions[nodes], state.velocities[nodes], iterations, error, ratio))
        if failure:
            failure = f"step {len(frames)}: {failure}"
            break
    x, v, counts, errors, ratios = (np.stack(column) for column in zip(*frames, strict=True))
    return Steps(x, v, counts, errors, ratios, failure, time.perf_counter() - began)
