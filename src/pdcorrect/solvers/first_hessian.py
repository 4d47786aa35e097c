"""First Hessians of L-BFGS from the true second derivative, turned with the body.

The Hessian H of an earlier shape is a poor model of the present one mostly because the
body has turned since, each part by its own rotation.  With R the block diagonal of the
nodes' rotations since then, R H R^T is again symmetric and positive definite, and needs
no new factor (the idea of stiffness warping, Mueller et al. 2002, used for a first
Hessian, so the answer does not depend on it).  Turned in this way even the Hessian of the
rest shape serves a whole run: like G, it is factorised once.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.fem.energies import nearest_rotation
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.step import StepObjective
from pdcorrect.solvers.tangent_solver import TangentFactory, TangentSolver

Array = NDArray[np.float64]

INSIDE = -1
"""Age of a Hessian that was factorised within a step, at no frame."""
_LARGEST = 1e50
"""Deformation gradients are cut off here, so that their squares' squares are finite."""
_MODE_STEPS = 2
"""Newton steps of each cell's internal modes before its Hessian is taken."""


class Rotations:
    """How the parts of a body have turned: rotations of cells and nodes."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        cells, count = problem.cells, len(problem.positions)
        weights = problem.space.volumes()[:, None]
        quadrature = problem.quadrature
        shares = quadrature.weights / weights
        lanes = quadrature.lanes[:, : cells.shape[1]]
        self._mean = np.einsum("cq,clxq->clx", shares, lanes, optimize=True)
        owners = np.repeat(np.arange(len(cells)), cells.shape[1])
        ones = np.ones(cells.size)
        self._gather = sp.csr_matrix((ones, (cells.ravel(), owners)), shape=(count, len(cells)))
        self._held = np.array(~problem.free.all(axis=1))
        if problem.rollers is not None:
            self._held[problem.rollers.nodes] = True

    def of_cells(self, y: Array) -> Array:
        """Nearest rotation of each cell's mean deformation gradient, (C, 3, 3).

        Those of absurd or infinite deformations mean nothing: such a step fails by name.
        """
        u = y[: len(self._problem.positions)] - self._problem.positions
        mean = np.swapaxes(u[self._problem.cells], 1, 2) @ self._mean
        return nearest_rotation(np.eye(3) + np.clip(np.nan_to_num(mean), -_LARGEST, _LARGEST))

    def since(self, before: Array, y: Array) -> Array:
        """Rotations (N + B, 3, 3) of nodes and modes from cells' ``before`` (C, 3, 3) to y.

        A node turns as its cells do on average; one with a clamped component does not.
        """
        turns = self.of_cells(y) @ np.swapaxes(before, -1, -2)
        total = (self._gather @ turns.reshape(-1, 9)).reshape(-1, 3, 3)
        nodes = nearest_rotation(total)
        nodes[self._held] = np.eye(3)
        modes = self._problem.space.internal // len(turns)
        return np.concatenate([nodes, np.repeat(turns, modes, axis=0)]) if modes else nodes


class TurnedSolver:
    """r -> R H^-1 R^T r on configurations (N + B, 3)."""

    def __init__(self, solver: TangentSolver, rotations: Array) -> None:
        self._solver = solver
        self._rotations = np.ascontiguousarray(rotations)
        self._back = np.ascontiguousarray(np.swapaxes(rotations, 1, 2))

    def __call__(self, r: Array) -> Array:
        back = np.empty_like(r)
        _turn(self._back, r, back)
        out = self._solver(back)
        _turn(self._rotations, out, out)
        return out


@njit(**OPTIONS)
def _turn(rotations, x, out):  # type: ignore[no-untyped-def]
    """Each row of x (n, 3) times its rotation; ``out`` may be x."""
    for n in range(len(x)):
        a, b, c = x[n, 0], x[n, 1], x[n, 2]
        for i in range(3):
            out[n, i] = rotations[n, i, 0] * a + rotations[n, i, 1] * b + rotations[n, i, 2] * c


class TrueHessian:
    """A factor of the Hessian at some shape, turned to each step's first iterate.

    ``lagged``: a new factor is taken when that pays; otherwise the rest shape's is kept, and steps
    do not depend on those before.  ``age`` counts the steps since the factor was made, `INSIDE` if
    that was not at the start of a step.

    A factor's first step needs the fewest iterations; what later steps need more is
    its loss.  When the losses since the last factorisation add up to the cost of one,
    it is time for the next: this keeps the total within twice the best possible.  The
    rule counts iterations, not seconds, and a state that does not continue the run at
    hand gets a new factor, so runs can be repeated exactly.
    """

    def __init__(self, tangents: TangentFactory, lagged: bool) -> None:
        self.tangents = tangents
        self.lagged = lagged
        self.age = INSIDE
        self._problem = tangents.problem
        self._rotations = Rotations(tangents.problem)
        self._cost = tangents.factor_cost
        self._solver: TangentSolver | None = None  # none has been made
        self._factors = (0.0, 0.0)
        self._shape = np.empty(0)  # rotations of the cells where the factor was made
        self._counts: list[int] = []
        self._time = 0.0

    def solver(self, objective: StepObjective) -> TurnedSolver:
        """H^-1 for the step that ``objective`` belongs to."""
        if self._solver is None or self._stale(objective):
            y = self._at_start(objective) if self.lagged else self._at_rest()
            return self._turned(self._renew(objective, y, 0), objective.start)
        self.age += 1
        return self._turned(self._solver, objective.start)

    def at(self, objective: StepObjective, y: Array) -> TurnedSolver:
        """H^-1 for the same step at a configuration y, by the factor in use if it fits."""
        if self._solver is None or objective.factors != self._factors:
            self._renew(objective, self._at_rest(), INSIDE if self.lagged else 0)
        assert self._solver is not None
        return self._turned(self._solver, y)

    def renew(self, objective: StepObjective, y: Array) -> TurnedSolver:
        """H^-1 at a configuration within the step, which the next step will not keep."""
        return self._turned(self._renew(objective, y, INSIDE), y)

    def forget(self) -> None:
        """Take a new factor at the next step."""
        self.age = INSIDE

    def note(self, iterations: int, time: float) -> None:
        """What the step took, and the time that it led to (s)."""
        self._counts.append(iterations)
        self._time = time

    def restore(self, age: int, counts: list[int], objective: StepObjective, time: float) -> None:
        """Take up a factor made ``age`` steps before the last one, in the step of ``objective``.

        ``counts`` are the iterations since, ``time`` (s) is where the run goes on.
        """
        if self.lagged and age != INSIDE:
            self._renew(objective, self._at_start(objective), age)
            self._counts, self._time = counts, time

    def _at_start(self, objective: StepObjective) -> Array:
        return self._problem.relaxed(objective.state.positions, steps=_MODE_STEPS)

    def _at_rest(self) -> Array:
        return self._problem.extended(self._problem.positions)

    def _stale(self, objective: StepObjective) -> bool:
        if self.age == INSIDE or objective.factors != self._factors:
            return True
        return self.lagged and (objective.state.time != self._time or self._spent())

    def _renew(self, objective: StepObjective, y: Array, age: int) -> TangentSolver:
        at_rest = age != INSIDE and not self.lagged
        self._solver = None  # two factors at a time would be the peak of memory
        self._solver = self.tangents.first_hessian(objective, y, at_rest)
        self._shape = self._rotations.of_cells(y)
        self._factors, self.age, self._counts = objective.factors, age, []
        return self._solver

    def _turned(self, solver: TangentSolver, y: Array) -> TurnedSolver:
        return TurnedSolver(solver, self._rotations.since(self._shape, y))

    def _spent(self) -> bool:
        fewest = min(self._counts, default=0)
        return sum(n - fewest for n in self._counts) >= self._cost
