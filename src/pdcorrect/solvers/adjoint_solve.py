"""Linear systems of the adjoint: H x = g with the second derivative H of a step's gamma.

Thesis eq. 3-30 iterates x <- G^-1 (g + (G - H) x), which needs nothing but G's factor
and converges where the spectral radius of G^-1 (G - H) is below 1 (eq. 3-38, the
quasi-Newton form of the same, has the same iterates).  Conjugate gradients with the
same preconditioner take the square root of its iterations, and converge wherever H is
positive definite; a factor of H itself needs not even that.  Loads that follow the body add
a part that is not symmetric, for which GMRES takes the place of both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.multigrid import conjugate_gradients
from pdcorrect.solvers.step import GlobalSolver, HessianOperator

Array = NDArray[np.float64]
Solve = Callable[[Array], Array]
AdjointSolver = Literal["auto", "cg", "direct", "fixed-point"]

_CG_STEPS = 300
_GMRES_STEPS = 400
_FIXED_POINT_STEPS = 20000
_DIRECT_STEPS = 4
"""The first solution and refinements: LU pivots little, GMRES looks at another norm."""
_HOPELESS = 1e3
"""Growth of the residual at which iterations are given up."""


@dataclass(frozen=True, eq=False)
class AdjointOperator:
    """x -> (dr/dy)^T x for the residual r of a step's equation.

    ``loads`` gives, for nodal x (N, 3), derivatives of x . (loads that follow the body).
    """

    hessian: HessianOperator
    loads: Callable[[Array], Array] | None = None

    def __call__(self, x: Array) -> Array:
        return self.product(x) * self.hessian.objective.free

    def product(self, x: Array) -> Array:
        """The same on all components."""
        out, problem = self.hessian.product(x), self.hessian.objective.problem
        if self.loads is None:
            return out
        return out - problem.extended(self.loads(x[: len(problem.positions)]))


@dataclass(frozen=True, eq=False)
class AdjointSolution:
    """X (N + B, 3) with H x = g on the free components, zero where clamped.

    ``solver`` is what found it, ``residual`` |g - H x| / |g|.
    """

    x: Array
    solver: str
    iterations: int
    residual: float


def solve_adjoint(
    H: AdjointOperator,
    g: Array,
    solver: AdjointSolver,
    precondition: Callable[[], Solve],
    global_solver: Callable[[], Solve],
    tolerance: float,
) -> AdjointSolution:
    """Solve H x = g for g (N + B, 3) that is zero where clamped.

    "auto" is conjugate gradients, and a direct solution where they fail; with loads that follow
    the body GMRES, as is "direct" with a factor of the symmetric part.  ``precondition`` and
    ``global_solver`` make the preconditioner of conjugate gradients and G^-1.  Where the method
    asked for does not reach the relative tolerance, as where H is singular, `ConvergenceError` is
    raised.
    """
    if not g.any():
        return AdjointSolution(np.zeros_like(g), "none needed", 0, 0.0)
    if solver == "fixed-point":
        return _iterated(H, g, global_solver(), tolerance, solver, _FIXED_POINT_STEPS)
    if H.loads is not None:
        if solver == "cg":
            raise InputError(
                "solver = 'cg' with loads that follow the body, whose matrix is not symmetric: "
                "expected 'auto', 'direct' or 'fixed-point'."
            )
        return _gmres(H, g, precondition() if solver == "auto" else _factor(H), tolerance)
    if solver != "direct":
        found = conjugate_gradients(
            H, g, precondition(), tolerance=0.1, max_steps=_CG_STEPS, residual_share=tolerance
        )
        if found.converged:
            return AdjointSolution(found.x, "cg", found.steps, _residual(H, g, found.x)[1])
        if solver == "cg":
            why = "did not converge" if found.convex else "met negative curvature"
            raise ConvergenceError(
                f"adjoint by conjugate gradients: {why} in {found.steps} steps, expected a state "
                "that a step converged to. Use solver='direct'."
            )
    return _iterated(H, g, _factor(H), tolerance, "direct", _DIRECT_STEPS)


def _residual(H: AdjointOperator, g: Array, x: Array) -> tuple[Array, float]:
    """G - H x, and its size relative to g's."""
    r = g - H(x)
    return r, float(np.linalg.norm(r) / np.linalg.norm(g))


_ADVICE = {
    "fixed-point": "Use solver='auto': the spectral radius of G^-1 (G - H) is not well under 1.",
    "direct": "If it is large, the Hessian at this state is singular and the step has no slope "
    "there; if it is small, use a larger tolerance.",
}


def _iterated(
    H: AdjointOperator, g: Array, solve: Solve, tolerance: float, solver: str, most: int
) -> AdjointSolution:
    """By x <- x + solve(g - H x): the fixed point with G^-1, refinement with factors of H."""
    x, r = np.zeros_like(g), g
    for step in range(1, most + 1):
        x = x + solve(r)
        r, left = _residual(H, g, x)
        if left <= tolerance:
            return AdjointSolution(x, solver, step, left)
        if not left < _HOPELESS:
            break
    raise ConvergenceError(
        f"adjoint, solver {solver!r}: relative residual {left:.1e} after {step} steps, expected "
        f"{tolerance:g} or less. {_ADVICE[solver]}"
    )


def _factor(H: AdjointOperator) -> Solve:
    """The inverse of the Hessian, without loads, by a sparse LU factorisation."""
    matrix, free = assembled(H.hessian)
    try:
        factor = spla.splu(matrix.tocsc())
    except RuntimeError as error:
        raise ConvergenceError(
            f"adjoint: the Hessian at this state is singular ({error}); the step has no "
            "derivative there."
        ) from None

    def solve(r: Array) -> Array:
        out = np.zeros(r.size)
        out[free] = factor.solve(r.ravel()[free])
        return out.reshape(r.shape)

    return solve


def _gmres(H: AdjointOperator, g: Array, solve: Solve, tolerance: float) -> AdjointSolution:
    def flat(function: Callable[[Array], Array]) -> spla.LinearOperator:
        return spla.LinearOperator(
            (g.size, g.size), matvec=lambda x: function(x.reshape(g.shape)).ravel(), dtype=g.dtype
        )

    steps: list[float] = []
    x, r, left = np.zeros_like(g), g, 1.0
    for _ in range(_DIRECT_STEPS):
        change, _ = spla.gmres(
            flat(H), r.ravel(), rtol=0.5 * tolerance / left, atol=0.0, restart=_GMRES_STEPS,
            maxiter=1, M=flat(solve), callback=steps.append, callback_type="pr_norm",
        )  # fmt: skip
        x = x + change.reshape(g.shape)
        r, left = _residual(H, g, x)
        if left <= tolerance:
            return AdjointSolution(x, "gmres", len(steps), left)
    raise ConvergenceError(
        f"adjoint by GMRES: relative residual {left:.1e} after {len(steps)} steps, expected "
        f"{tolerance:g} or less. Use solver='direct', or a larger tolerance."
    )


def assembled(H: HessianOperator) -> tuple[sp.csr_matrix, NDArray[np.int64]]:
    """H as a sparse matrix on the free components of configurations, and their numbers."""
    objective, problem = H.objective, H.objective.problem
    free = np.flatnonzero(objective.free.ravel())
    return problem.assembly.matrix(H.blocks())[free][:, free], free


def spectral_radius(H: HessianOperator, solve: GlobalSolver) -> float:
    """Of G^-1 (G - H): the factor by which the fixed point's error falls in a step."""
    objective = H.objective
    shape, free = objective.free.shape, np.flatnonzero(objective.free.ravel())
    G = sp.kron(objective.problem.scalar_matrix(*objective.factors), sp.eye_array(3))
    G = sp.csr_matrix(G)[free][:, free]

    def on_free(function: Solve) -> spla.LinearOperator:
        def product(x: Array) -> Array:
            full = np.zeros(objective.free.size)
            full[free] = x.ravel()
            return function(full.reshape(shape)).ravel()[free]

        return spla.LinearOperator(G.shape, matvec=product, dtype=np.float64)

    start = np.random.default_rng(0).normal(size=len(free))
    ratios = spla.eigsh(
        on_free(H), 2, G, which="BE", Minv=on_free(solve), v0=start, return_eigenvectors=False
    )
    return float(np.abs(1.0 - ratios).max())
