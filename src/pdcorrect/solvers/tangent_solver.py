"""The step's second derivative, factorised: for Newton, and as L-BFGS's first Hessian.

Internal modes are eliminated cell by cell, so the matrix has the nodes' unknowns only.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect._environment import total_memory
from pdcorrect.fem.factorisation import (
    MEMORY_SHARE,
    Backend,
    Factor,
    NotPositiveDefinite,
    factorise,
)
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.fem.multigrid import rigid_motions
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.step import StepObjective

Array = NDArray[np.float64]

_CG_SECONDS = 7e-8
"""Of a Newton step by conjugate gradients, for each entry of the cells' tangents (case newton)."""
_USUAL_VOLUME = 27.0
"""Volume weight by shear modulus at Poisson's ratio 0.45, up to which that holds.

Beyond, conjugate gradients take steps about as the root of it: on Cook's membrane of 32 x 32
hex27 cells at 0.4999 a band took 4 s, they had not ended after 280 s.
"""
_NO_SHEAR = 1e-300
"""Pa, in place of the shear modulus of an energy that has none."""
_CYCLE_SECONDS = 1.7e-8
"""Worth of a band's solve against a multigrid cycle, for each such entry (case growth).

The cycle is cheaper on large meshes, but takes three to four times the iterations.
"""
_TANGENT_SECONDS = 3.3e-8
"""Of the cells' tangents, for each number of their gradients, of which only ratios matter."""
_LARGEST_BAND = 2e9
"""Bytes; fixed, so that machines of usual size make the same choice."""
_SOLVES = 50
"""Solves over which a factorisation should have paid."""
_SHIFTS = (1e-10, 1e-6, 1e-2)
"""Of the largest diagonal entry, tried in turn where even the projected tangent is singular."""


class TangentFactory:
    """Factorises the Hessians of one problem's steps.

    ``backend``, see `factorise`, is one of a kind for all; "auto" is a band where that pays and
    fits into memory, else multigrid.
    """

    def __init__(self, problem: Problem, backend: Backend = "auto") -> None:
        self.problem = problem
        self.order = problem.band_order
        best: Backend = "band" if self._band_pays else "amg"
        self.backend = best if backend == "auto" else backend
        self._free = np.flatnonzero(problem.free.ravel())

    @property
    def factor_cost(self) -> float:
        """Cost of a band factorisation in iterations of L-BFGS with it."""
        iteration = 1e-4 + 1.6e-7 * self.problem.quadrature.weights.size + self._solve_seconds
        assembly = _TANGENT_SECONDS * self.problem.quadrature.lanes.size
        return (assembly + self._factor_seconds) / iteration

    @property
    def direct_pays(self) -> bool:
        """Whether a band factor in each iteration beats conjugate gradients with multigrid."""
        materials = self.problem.materials
        hardest = float((materials.volume_weight / np.maximum(materials.mu, _NO_SHEAR)).max())
        steps = max(1.0, hardest / _USUAL_VOLUME) ** 0.5
        return self.backend == "band" and (
            self._factor_seconds + self._solve_seconds < _CG_SECONDS * steps * self._entries
        )

    @property
    def _solve_seconds(self) -> float:
        """Estimates by size, of which only ratios matter (``benchmarks``, tangent_factors)."""
        return 1.1e-9 * self.order.rows * self.order.bandwidth

    @property
    def _factor_seconds(self) -> float:
        return 3.5e-11 * self.order.factor_flops + 2e-9 * self.order.rows * self.order.bandwidth

    @property
    def _entries(self) -> int:
        """Of all cells' tangents: a measure of a sparse matrix product."""
        return len(self.problem.cells) * (3 * self.problem.cells.shape[1]) ** 2

    @property
    def _band_pays(self) -> bool:
        """Whether a band factor, kept for a run, beats multigrid as a first Hessian."""
        seconds = self._solve_seconds + self._factor_seconds / _SOLVES
        fits = self.order.factor_bytes < min(_LARGEST_BAND, MEMORY_SHARE * total_memory())
        return fits and seconds < _CYCLE_SECONDS * self._entries

    def factorise(
        self, objective: StepObjective, y: Array, at_rest: bool = False
    ) -> tuple[TangentSolver, bool]:
        """A factor of the Hessian at a configuration, and whether it is the exact one.

        Where the exact Hessian is not positive definite, negative eigenvalues are
        raised to zero at each quadrature point (Teran et al. 2005), with a growing
        shift where that is singular.  `NotPositiveDefinite` is raised if all of that fails.
        ``at_rest``: damping too is taken at y, not at the step's start.
        """
        try:
            return self._solver(objective, y, at_rest=at_rest), True
        except (NotPositiveDefinite, np.linalg.LinAlgError):
            return self._projected(objective, y, at_rest=at_rest), False

    def first_hessian(
        self, objective: StepObjective, y: Array, at_rest: bool = False
    ) -> TangentSolver:
        """A fixed symmetric positive solver for L-BFGS: a factor, or a cycle of multigrid."""
        if self.backend == "amg":
            return self.approximate(objective, y, at_rest)
        return self.factorise(objective, y, at_rest)[0]

    def approximate(
        self, objective: StepObjective, y: Array, at_rest: bool = False
    ) -> TangentSolver:
        """One cycle of multigrid for the projected Hessian: symmetric, positive, cheap."""
        return self._projected(objective, y, at_rest=at_rest, approximate=True)

    def _projected(self, objective: StepObjective, y: Array, **how: bool) -> TangentSolver:
        for shift in (0.0, *_SHIFTS):
            with suppress(NotPositiveDefinite, np.linalg.LinAlgError):
                return self._solver(objective, y, shift, project=True, **how)
        raise NotPositiveDefinite("no shift made the projected tangent positive definite")

    def _solver(
        self,
        objective: StepObjective,
        y: Array,
        shift: float = 0.0,
        *,
        project: bool = False,
        approximate: bool = False,
        at_rest: bool = False,
    ) -> TangentSolver:
        backend: Backend = "amg" if approximate else self.backend
        problem = self.problem
        blocks = objective.cell_hessians(y, project, at_rest)
        modes = Condensed(blocks, problem.space.local, problem.cells.shape[1], shift)
        if backend == "band":
            band = self.order.assemble(modes.blocks)
            band[:, 0] += shift * band[:, 0].max()
            return TangentSolver(self.order.factorise(band), None, modes)
        matrix = problem.nodal_assembly.matrix(modes.blocks)
        if shift:
            matrix = matrix + shift * matrix.diagonal().max() * sp.eye_array(matrix.shape[0])
        matrix = sp.csr_matrix(matrix)[self._free][:, self._free]
        motions = rigid_motions(y[: len(problem.positions)])[self._free]
        factor = factorise(matrix, backend, 3, motions, approximate)
        return TangentSolver(factor, self._free, modes)


class TangentSolver:
    """r -> H^-1 r on configurations (N + B, 3), zero where clamped."""

    def __init__(self, factor: Factor, free: NDArray[np.int64] | None, modes: Condensed) -> None:
        self._factor, self._free, self._modes = factor, free, modes

    def __call__(self, r: Array) -> Array:
        return self._modes.recovered(self._solve(self._modes.reduced(r)), r)

    def _solve(self, r: Array) -> Array:
        if self._free is None:
            return self._factor.solve(r)
        out = np.zeros(r.size)
        out[self._free] = self._factor.solve(r.ravel()[self._free])
        return out.reshape(r.shape)
