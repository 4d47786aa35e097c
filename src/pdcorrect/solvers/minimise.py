"""The loops that minimise a step: L-BFGS and local/global, Newton and Newton-CG.

Quasi-Newton steps d = -H g with H the L-BFGS inverse Hessian built on G^-1
(Liu, Bouaziz and Kavan 2017), in compact form (Byrd, Nocedal and Schnabel
1994): with S = [s_i] and Z = G^-1 Y = [z_i] as rows,

    H g = x + S^T c - Z^T w,   x = G^-1 g,   w = R^-1 S g,
    c = R^-T ((D + Y Z^T) w - Z g),

so one solve with G and four products with tall matrices make an iteration.
Without history this is the plain local/global iteration p <- p - G^-1 grad
gamma (thesis eq. 3-14), which needs no line search.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.multigrid import conjugate_gradients
from pdcorrect.state import Status

Array = NDArray[np.float64]
Solve = Callable[[Array], Array]
ARMIJO = 1e-4
_ROUND_OFF = 1e-13
"""Relative to the terms of gamma: changes below this carry no information."""
BACKTRACKS = 30
_ESTIMATE_STEPS, _INNER_STEPS = 1000, 400
_PROBE = 1e-3
"""Of the residual of a right-hand side with all modes in it: no negative curvature is met later."""
_ASIDE = 1e-8
"""Of the terms of gamma: how far it should fall in the first step from a saddle."""
NEAR_SADDLE = 1e-2 * _ASIDE
"""The same of a step along the gradient that is not worth while beside that."""
NO_MOTION = 1e-6
"""Of the tolerance: above this an unmoved first iterate is improved once before it is accepted.

Otherwise stiff bodies would not move at all where the motion is below the tolerance.
"""
FIRST_CHECK = 0.15
"""Length of the loop's own step, of the tolerance, at which the estimate is first made.

The estimate is usually 3 to 10 times that length.
"""


class Objective(Protocol):
    """What the loop minimises, over arrays (N, 3).

    ``scale`` is the size of the terms that the last value was summed from, ``free`` (N, 3) says
    what is not prescribed.
    """

    scale: float
    free: NDArray[np.bool_]

    def value_and_gradient(self, p: Array) -> tuple[float, Array]:
        """Value and gradient; the gradient is zero where p is prescribed."""

    def hessian_operator(self, p: Array) -> Callable[[Array], Array]:
        """The second derivative at p, as a product."""

    def longest_step(self, p: Array, direction: Array) -> float:
        """Share of a direction, at most 1, along which the function is finite."""

    def trusted(self, p: Array) -> float:
        """Length up to which a Newton step at p tells the distance from the minimum, m."""


@dataclass(frozen=True)
class MinimiserOptions:
    """Policy of the loop.

    ``tolerance`` is the largest accepted estimate of the remaining displacement of a node, m, and
    ``unmoved`` its share within which a start is accepted as it is, and from which it is judged;
    ``history`` are the pairs that L-BFGS keeps, of which plain local/global has 0.
    """

    tolerance: float
    history: int = 16
    max_iterations: int = 1000
    unmoved: float = NO_MOTION


@dataclass(eq=False)
class Minimum:
    """Where the loop ended.

    ``estimate`` is that of the largest distance of a node from the minimum, m; infinite if the
    Hessian there is not positive definite.
    """

    positions: Array
    value: float
    gradient: Array
    status: Status
    iterations: int
    evaluations: int
    estimate: float

    def after(self, earlier: Minimum) -> Minimum:
        """The same with the work of a loop that led to its start."""
        return replace(
            self,
            iterations=earlier.iterations + self.iterations,
            evaluations=earlier.evaluations + self.evaluations,
        )


class History:
    """The pairs (s, z = G^-1 y) and the small matrices of the compact form.

    Only S, Z, R^-1, D and Y Z^T are kept; products with Y follow from those with
    Z, because y_i . x = z_i . g for x = G^-1 g.  A new pair overwrites the oldest
    one's rows; ``_rows`` says where the pairs are, from old to new.
    """

    def __init__(self, size: int, length: int) -> None:
        self._pairs = np.empty((2, size, length))  # S and Z
        self.clear()

    def clear(self) -> None:
        """Forget all pairs."""
        self._rows: list[int] = []
        self._r_inverse = np.empty((0, 0))
        self._yz = np.empty((0, 0))
        self._d: list[float] = []
        self._products = np.empty((2, 0))  # S g and Z g

    def __len__(self) -> int:
        return len(self._rows)

    def direction(self, gradient: Array, x: Array) -> Array:
        """-H g for the gradient (n,) whose products `observe` or `append` took last."""
        m = len(self)
        if m == 0:
            return -x
        sg, zg = self._products
        w = self._r_inverse @ sg
        weights = np.empty((2, m))
        weights[0, self._rows] = self._r_inverse.T @ (self._d * w + self._yz @ w - zg)
        weights[1, self._rows] = w
        out = weights[1] @ self._pairs[1, :m]
        out -= weights[0] @ self._pairs[0, :m]
        out -= x
        return out

    def observe(self, gradient: Array) -> None:
        """Take the products of the stored pairs with a gradient."""
        self._products = (self._pairs[:, : len(self)] @ gradient)[:, self._rows]

    def append(self, step: Array, change: Array, gradient: Array, new_gradient: Array) -> None:
        """Add s = ``step``, z = ``change`` of G^-1 g, for the move between two gradients.

        A pair without positive curvature is not stored.
        """
        new = np.array([step @ new_gradient, change @ new_gradient])
        y_s, y_z = float(new[0] - step @ gradient), float(new[1] - change @ gradient)
        old = self._products
        self.observe(new_gradient)
        if not (y_s > 1e-12 * math.sqrt(abs(y_z) * abs(float(step @ step))) and y_z > 0):
            return
        both = self._products - old  # S y and Z y
        row = len(self)
        if row == self._pairs.shape[1]:
            row = self._rows[0]
            self._drop_oldest()
            both = both[:, 1:]
        self._pairs[0, row], self._pairs[1, row] = step, change
        self._r_inverse = _bordered(self._r_inverse, (self._r_inverse @ both[0]) / -y_s, 1.0 / y_s)
        self._yz = _bordered(self._yz, both[1], y_z)
        self._yz[-1, :-1] = both[1]
        self._rows = [*self._rows, row]
        self._d = [*self._d, y_s]
        self._products = np.column_stack([self._products, new])

    def _drop_oldest(self) -> None:
        """R is upper triangular, so the inverse of its trailing part is the trailing part."""
        self._rows, self._d = self._rows[1:], self._d[1:]
        self._r_inverse, self._yz = self._r_inverse[1:, 1:], self._yz[1:, 1:]
        self._products = self._products[:, 1:]


def _bordered(matrix: Array, column: Array, corner: float) -> Array:
    """[[matrix, column], [0, corner]]."""
    m = len(matrix)
    out = np.zeros((m + 1, m + 1))
    out[:m, :m] = matrix
    out[:m, m] = column
    out[m, m] = corner
    return out


def minimise(
    objective: Objective, start: Array, solve: Solve, options: MinimiserOptions
) -> Minimum:
    """Minimise ``objective`` from ``start`` (N, 3) with G^-1 given by ``solve``.

    The loop watches the length of its own step.  When that is small, the
    remaining displacement is estimated by conjugate gradients on the true
    Hessian.  If that is too large, or nothing has moved yet, the loop goes on,
    with the Newton step just found as its next one (L-BFGS) and having learnt
    how far its own measure was off.
    """
    p = start
    value, gradient = objective.value_and_gradient(p)
    x = solve(gradient)
    history = History(options.history, p.size)
    threshold = max(FIRST_CHECK, options.unmoved) * options.tolerance
    evaluations, estimate = 1, math.inf
    status = Status.ITERATION_LIMIT
    for iteration in range(options.max_iterations + 1):
        if not math.isfinite(value):
            status = Status.NOT_FINITE
            break
        direction = history.direction(gradient.ravel(), x.ravel()).reshape(p.shape)
        length = largest_displacement(direction)
        if length <= threshold:
            exact, estimate = newton_step(objective, p, gradient, solve, direction)
            within = min(options.tolerance, objective.trusted(p))
            if estimate <= within * (1.0 if iteration else options.unmoved):
                status = Status.CONVERGED
                break
            if estimate > within:
                threshold = length * max(0.05, min(0.5, 0.5 * within / estimate))
            if options.history and math.isfinite(estimate):
                direction = exact
        if iteration == options.max_iterations:
            break
        found = line_search(objective, p, value, gradient, direction, bool(options.history))
        evaluations += found.evaluations
        if found.step == 0.0:
            if len(history):
                history.clear()
                continue
            # only of the unmoved start is the estimate within the tolerance, and still its own
            close = iteration == 0 and estimate <= options.tolerance
            status = Status.CONVERGED if close else Status.LINE_SEARCH
            break
        x_new = solve(found.gradient)
        if options.history:
            step = (found.step * direction).ravel()
            change = (x_new - x).ravel()
            history.append(step, change, gradient.ravel(), found.gradient.ravel())
        p, value, gradient, x = found.positions, found.value, found.gradient, x_new
    return Minimum(p, value, gradient, status, iteration, evaluations, estimate)


@dataclass(eq=False)
class LineSearchResult:
    """Outcome of a line search; ``step`` 0 means none was found."""

    step: float
    positions: Array
    value: float
    gradient: Array
    evaluations: int


def line_search(
    objective: Objective, p: Array, value: float, gradient: Array, direction: Array,
    search: bool = True,
) -> LineSearchResult:  # fmt: skip
    """Backtracking until gamma falls (Armijo).

    Where the fall is lost in round-off, the slope decides (approximate Wolfe
    condition, Hager and Zhang 2005).  ``search = False`` takes the full step.
    """
    slope = float(np.vdot(gradient, direction))
    step, tried = 1.0, 0
    if slope < 0.0:
        step = objective.longest_step(p, direction)
        noise = _ROUND_OFF * objective.scale
        while tried < BACKTRACKS:
            tried += 1
            trial = p + step * direction
            new_value, new_gradient = objective.value_and_gradient(trial)
            fall = new_value - value
            if fall <= ARMIJO * step * slope or not search:
                return LineSearchResult(step, trial, new_value, new_gradient, tried)
            if abs(fall) <= noise and float(np.vdot(new_gradient, direction)) <= -0.8 * slope:
                return LineSearchResult(step, trial, new_value, new_gradient, tried)
            curvature = 2.0 * (fall - step * slope) / step**2
            best = -slope / curvature if math.isfinite(curvature) and curvature > 0 else 0.0
            step = min(max(best, 0.1 * step), 0.5 * step)
    return LineSearchResult(0.0, p, value, gradient, tried)


def largest_displacement(x: Array) -> float:
    """Largest node norm of (N, 3)."""
    return float(np.sqrt(np.einsum("ni,ni->n", x, x).max()))


def newton_step(
    objective: Objective, p: Array, gradient: Array, solve: Solve, guess: Array
) -> tuple[Array, float]:
    """-(d2 gamma)^-1 grad gamma (N, 3), m, and its largest node norm: the estimated error.

    By conjugate gradients preconditioned with G, started from ``guess``, until
    the length has settled to a tenth.  The estimate is infinite where that does
    not happen or a direction of negative curvature is met.
    """
    found = conjugate_gradients(
        objective.hessian_operator(p), -gradient, solve, tolerance=0.1, start=guess,
        max_steps=_ESTIMATE_STEPS, residual_share=0.03,
        settled=lambda x, change: largest_displacement(change) <= 0.1 * largest_displacement(x),
    )  # fmt: skip
    exact = found.converged and found.convex
    return found.x, largest_displacement(found.x) if exact else math.inf


def below_saddle(objective: Objective, p: Array, solve: Solve) -> Array | None:
    """A configuration (N, 3) beside a stationary p where the function is less; None at a minimum.

    `newton_step` does not see curvature across a symmetry of body and load, where the gradient is
    zero.  Conjugate gradients on a fixed random right-hand side do.
    """
    b = np.random.default_rng(0).normal(size=p.shape) * objective.free
    hessian = objective.hessian_operator(p)
    way = conjugate_gradients(hessian, b, solve, tolerance=_PROBE, max_steps=_INNER_STEPS).downhill
    if way is None:
        return None
    value, gradient = objective.value_and_gradient(p)
    noise, bend = _ROUND_OFF * objective.scale, -float(np.vdot(way, hessian(way)))
    if not bend > 0.0:
        return None
    way = way * math.copysign(
        math.sqrt(2.0 * _ASIDE * objective.scale / bend), -np.vdot(gradient, way)
    )
    step = objective.longest_step(p, way)
    for _ in range(BACKTRACKS):
        trial = p + step * way
        if objective.value_and_gradient(trial)[0] < value - noise:
            return trial
        step *= 0.5
    return None


Direction = Callable[[Array, Array], tuple[Array, bool]]
"""(p, gradient) -> (minus the Newton step, whether the exact, positive Hessian gave it)."""


def newton_loop(
    objective: Objective, start: Array, direction: Direction, options: MinimiserOptions
) -> Minimum:
    """Minimise ``objective`` from ``start`` (N, 3) along the steps of ``direction``.

    Converged when a Newton step of the exact Hessian is shorter than the
    tolerance; ``options.history`` is not used.
    """
    p = start
    value, gradient = objective.value_and_gradient(p)
    evaluations, estimate, status = 1, math.inf, Status.ITERATION_LIMIT
    for iteration in range(options.max_iterations + 1):
        if not math.isfinite(value):
            status = Status.NOT_FINITE
            break
        step, exact = direction(p, gradient)
        estimate = largest_displacement(step) if exact else math.inf
        if estimate <= options.tolerance and estimate <= objective.trusted(p):
            status = Status.CONVERGED
            break
        if iteration == options.max_iterations:
            break
        found = line_search(objective, p, value, gradient, step)
        evaluations += found.evaluations
        if found.step == 0.0:
            status = Status.LINE_SEARCH
            break
        p, value, gradient = found.positions, found.value, found.gradient
    return Minimum(p, value, gradient, status, iteration, evaluations, estimate)


def newton_cg(
    objective: Objective, start: Array, solve: Solve, options: MinimiserOptions
) -> Minimum:
    """`newton_loop` with conjugate gradients preconditioned by ``solve``.

    Where these meet negative curvature, the direction found so far is used, or
    minus the preconditioned gradient at the first step.
    """

    def direction(p: Array, gradient: Array) -> tuple[Array, bool]:
        found = conjugate_gradients(
            objective.hessian_operator(p), -gradient, solve, tolerance=1e-3, max_steps=_INNER_STEPS
        )
        return found.x, found.converged and found.convex

    return newton_loop(objective, start, direction, options)
