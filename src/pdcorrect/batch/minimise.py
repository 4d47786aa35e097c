"""The minimisation loop of `pdcorrect.solvers.minimise` for B scenes, each with its own progress.

One iteration evaluates every scene once: scenes whose trial step is accepted move and take
a new direction, the others try a shorter step.  It has no branches that depend on values,
so a GPU replays it (`Recorder`); between iterations Python looks at the scenes' progress.
A scene stops when its own step is short; then the remaining displacement is estimated with
the true Hessian, by conjugate gradients, for all scenes that wait for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntEnum

import torch
from torch import Tensor

from pdcorrect.batch.first_hessian import FirstHessian
from pdcorrect.batch.gpu import Recorder, one_kernel
from pdcorrect.batch.linear_solver import BatchConjugateGradients
from pdcorrect.batch.objective import BatchObjective, by_scene, dot, largest_displacement, node_dot
from pdcorrect.solvers.follower import MOST, Anderson
from pdcorrect.solvers.minimise import ARMIJO, BACKTRACKS, FIRST_CHECK, NO_MOTION

_CURVATURE = 1e-12


class BatchHistory:
    """S = steps and Z = changes of G^-1 g, (B, m, D), and their small matrices.

    All methods change the tensors in place.
    """

    def __init__(self, scenes: int, length: int, size: int, like: Tensor) -> None:
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=like.dtype, device=like.device)

        self._S, self._Z = zeros(scenes, length, size), zeros(scenes, length, size)
        self._r_inverse, self._yz = zeros(scenes, length, length), zeros(scenes, length, length)
        self._d = zeros(scenes, length)
        self._sg, self._zg = zeros(scenes, length), zeros(scenes, length)
        self._age = torch.full((scenes, length), -1, dtype=torch.int64, device=like.device)
        self._scenes = torch.arange(scenes, device=like.device)

    def clear(self, which: Tensor) -> None:
        """Forget all pairs of the scenes where ``which`` (B,) holds."""
        for small in (self._d, self._sg, self._zg):
            small.masked_fill_(which[:, None], 0.0)
        for matrix in (self._r_inverse, self._yz):
            matrix.masked_fill_(which[:, None, None], 0.0)
        self._age.masked_fill_(which[:, None], -1)

    @property
    def empty(self) -> Tensor:
        """Whether a scene has no pairs, (B,)."""
        return (self._age < 0).all(dim=1)

    def direction(self, x: Tensor) -> Tensor:
        """-H g (B, D) for the gradient that `append` was last given, with x = G^-1 g."""
        return self._product(self._sg, self._zg, x)

    def improved(self, r: Tensor, x: Tensor) -> Tensor:
        """H r (B, D) for any r, with x = G^-1 r: a better preconditioner than G."""
        return -self._product(_times(self._S, r), _times(self._Z, r), x)

    def _product(self, sg: Tensor, zg: Tensor, x: Tensor) -> Tensor:
        w = _times(self._r_inverse, sg)
        mixed = self._d * w + _times(self._yz, w) - zg
        back = _times(self._r_inverse.transpose(1, 2), mixed)
        ahead = torch.bmm(w[:, None], self._Z), torch.bmm(back[:, None], self._S)
        return _combined(*ahead, x)

    def append(
        self, step: Tensor, change: Tensor, gradient: Tensor, new_gradient: Tensor, moved: Tensor
    ) -> None:
        """Add a pair to the scenes that ``moved`` (B,) between two gradients, all else (B, D).

        A pair without positive curvature is not stored.  Numbers that are not finite stay
        out, in whatever scene: what is stored is multiplied by zeros later.
        """
        sg, zg = _times(self._S, new_gradient), _times(self._Z, new_gradient)
        fields = [x.reshape(len(x), -1, 3) for x in (step, change, gradient, new_gradient)]
        by_node = _pair_products(*fields)
        s_new, z_new, s_old, z_old, s_s = by_node.sum(dim=-1)
        y_s, y_z = s_new - s_old, z_new - z_old
        floor = _CURVATURE * torch.sqrt(y_z.abs() * s_s)
        good = moved & (y_s > floor) & (y_z > 0.0) & (y_s < math.inf)
        place = self._age.argmin(dim=1)
        unit = torch.nn.functional.one_hot(place, self._age.shape[1]).to(sg.dtype)
        unit = unit * good.to(sg.dtype)[:, None]
        kept = 1.0 - unit
        sy, zy = (sg - self._sg) * kept, (zg - self._zg) * kept
        both = kept[:, :, None] * kept[:, None, :]
        y_s = torch.where(good, y_s, torch.ones_like(y_s))
        self._r_inverse.mul_(both)
        column = (unit - _times(self._r_inverse, sy)) / y_s[:, None]
        new_pair = good[:, None, None]
        self._r_inverse.add_(torch.where(new_pair, column[:, :, None] * unit[:, None, :], 0.0))
        self._yz.mul_(both)
        cross = zy[:, :, None] * unit[:, None, :]
        corner = y_z[:, None, None] * unit[:, :, None] * unit[:, None, :]
        self._yz.add_(torch.where(new_pair, cross + cross.transpose(1, 2) + corner, 0.0))
        self._d.copy_(self._d * kept + y_s[:, None] * unit)
        seen = moved[:, None]
        new = (sg * kept + s_new[:, None] * unit, zg * kept + z_new[:, None] * unit)
        self._sg.copy_(torch.where(seen, new[0], self._sg))
        self._zg.copy_(torch.where(seen, new[1], self._zg))
        for pairs, value in ((self._S, step), (self._Z, change)):
            old = pairs[self._scenes, place]
            pairs[self._scenes, place] = torch.where(good[:, None], value, old)
        newest = self._age.amax(dim=1) + 1
        age = torch.where(unit > 0.0, newest[:, None], self._age)
        self._age.copy_(age)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.bmm(matrix, vector[:, :, None])[:, :, 0]


@one_kernel
def _combined(plus: Tensor, minus: Tensor, x: Tensor) -> Tensor:
    return (plus - minus)[:, 0] - x


@one_kernel
def _pair_products(s: Tensor, z: Tensor, old: Tensor, new: Tensor) -> Tensor:
    """Of (B, U, 3), what each node has in their inner products, (5, B, U)."""
    pairs = ((s, new), (z, new), (s, old), (z, old), (s, s))
    return torch.stack([node_dot(a, b) for a, b in pairs])


_ROUND_OFF = {torch.float64: 1e-13, torch.float32: 1e-5}
HISTORY = 12
_CG_STEPS = 60


class Phase(IntEnum):
    """Where a scene is."""

    RUNNING = 0
    WAITING = 1
    CONVERGED = 2
    LINE_SEARCH = 3
    NOT_FINITE = 4
    LIMIT = 5


class BatchMinimiser:
    """L-BFGS on a `BatchObjective`.

    The ``tolerance`` (B,), m, is of each scene's estimated largest displacement from its minimum.

    Attributes
    ----------
    start, y, gradient : (B, U, 3)
    phase, iterations, evaluations : (B,)
    estimate : (B,)
        m; infinite where there is none.
    linear_solver : BatchConjugateGradients
    """

    def __init__(
        self,
        objective: BatchObjective,
        inverse: FirstHessian,
        tolerance: Tensor,
        max_iterations: int,
    ) -> None:
        self._objective, self._inverse = objective, inverse
        self._tolerance, self._most = tolerance, max_iterations
        rest, scenes = objective.cells.rest, len(tolerance)
        self.y, self.start, self.gradient, self._x, self._d = (
            torch.zeros_like(rest) for _ in range(5)
        )
        self.start.copy_(rest)
        numbers = torch.zeros(6, scenes, dtype=rest.dtype, device=rest.device)
        self._value, self._scale, self._step, self._slope, self._threshold, self.estimate = numbers
        counters = torch.zeros(4, scenes, dtype=torch.int64, device=rest.device)
        self.phase, self.iterations, self.evaluations, self._tried = counters
        self._alive = torch.ones(scenes, dtype=torch.bool, device=rest.device)
        self._left = torch.zeros(2, dtype=torch.int64, device=rest.device)
        self._unmoved = torch.full((), NO_MOTION, dtype=rest.dtype, device=rest.device)
        self._history = BatchHistory(scenes, HISTORY, rest[0].numel(), rest)
        recorder = Recorder(rest.device)

        def improved(r: Tensor, history: BatchHistory = self._history) -> Tensor:
            return history.improved(r.flatten(1), inverse(r).flatten(1)).reshape(r.shape)

        self.linear_solver = BatchConjugateGradients(objective, improved, recorder)
        self._begin = recorder(self._set_up)
        self._advance = recorder(self._iterate)
        self._judge = recorder(self._conclude)

    def run(self, start: Tensor, alive: Tensor, unmoved: float = NO_MOTION) -> None:
        """Minimise from ``start`` (B, U, 3) the scenes where ``alive`` (B,) holds.

        ``unmoved`` is the share of the tolerance within which a start is accepted as it is.
        """
        self._unmoved.fill_(unmoved)
        self.start.copy_(start)
        self._alive.copy_(alive)
        self._begin()
        while any(left := self._left.tolist()):
            if left[0]:
                self._advance()
            else:
                self._estimate()

    def forget(self, y: Tensor) -> None:
        """Precondition by the first Hessian at y alone, without the last step's pairs."""
        self._inverse.turn(y)
        self._history.clear(torch.ones_like(self._alive))

    # --- one iteration ------------------------------------------------------------------

    def _set_up(self) -> None:
        self._inverse.turn(self.start)
        value, gradient, scale = self._objective(self.start)
        self.y.copy_(self.start)
        self.gradient.copy_(gradient)
        self._value.copy_(value)
        self._scale.copy_(scale)
        self._x.copy_(self._inverse(gradient))
        self._d.copy_(-self._x)
        self._slope.copy_(dot(gradient, self._d))
        self._step.fill_(1.0)
        self._threshold.copy_(self._unmoved.clamp(min=FIRST_CHECK) * self._tolerance)
        self.estimate.fill_(math.inf)
        self.iterations.zero_()
        self._tried.zero_()
        self.evaluations.fill_(1)
        self._history.clear(torch.ones_like(self._alive))
        finite = self._alive & torch.isfinite(value) & torch.isfinite(self._slope)
        short = largest_displacement(self._d) <= self._threshold
        phase = torch.where(short, int(Phase.WAITING), int(Phase.RUNNING))
        phase = torch.where(self._inverse.regular, phase, int(Phase.LINE_SEARCH))
        self.phase.copy_(torch.where(finite, phase, int(Phase.NOT_FINITE)))
        self._look()

    def _look(self) -> None:
        self._left[0] = (self.phase == Phase.RUNNING).sum()
        self._left[1] = (self.phase == Phase.WAITING).sum()

    def _iterate(self) -> None:
        running = self.phase == Phase.RUNNING
        step, trial = _trial(self.y, self._d, self._step, running)
        value, gradient, scale = self._objective(trial)
        fall = value - self._value
        good = fall <= ARMIJO * self._step * self._slope
        noise = _ROUND_OFF[value.dtype] * self._scale
        level = dot(gradient, self._d) <= -0.8 * self._slope
        good = (good | ((fall.abs() <= noise) & level)) & (self._slope < 0.0)
        moved = running & good & torch.isfinite(value)
        x = self._inverse(gradient)
        s, z = step.flatten(1), (x - self._x).flatten(1)
        self._history.append(s, z, self.gradient.flatten(1), gradient.flatten(1), moved)
        _accept(moved, [self.y, self.gradient, self._x], [trial, gradient, x])
        self._value.copy_(torch.where(moved, value, self._value))
        self._scale.copy_(torch.where(moved, scale, self._scale))
        self._backtrack(running & ~moved, fall)
        self._turn(moved)
        self.evaluations.add_(running)
        self.iterations.add_(moved)
        spent = (self.phase == Phase.RUNNING) & (self.iterations >= self._most)
        self.phase.copy_(torch.where(spent, int(Phase.LIMIT), self.phase))
        self._look()

    def _backtrack(self, failed: Tensor, fall: Tensor) -> None:
        """A shorter step; after many, another start along -G^-1 g, and then the end."""
        curvature = 2.0 * (fall - self._step * self._slope) / self._step**2
        usable = (curvature > 0.0) & torch.isfinite(curvature)
        best = torch.where(usable, -self._slope / curvature, 0.0)
        shorter = torch.minimum(torch.maximum(best, 0.1 * self._step), 0.5 * self._step)
        self._tried.copy_(torch.where(failed, self._tried + 1, 0))
        spent = failed & ((self._tried >= BACKTRACKS) | ~(self._slope < 0.0))
        last = spent & self._history.empty
        self._step.copy_(torch.where(failed & ~spent, shorter, 1.0))
        self._tried.copy_(torch.where(spent, 0, self._tried))
        self._history.clear(spent)
        self._d.copy_(torch.where(by_scene(spent), -self._x, self._d))
        self._slope.copy_(torch.where(spent, -dot(self.gradient, self._x), self._slope))
        self.phase.copy_(torch.where(last, int(Phase.LINE_SEARCH), self.phase))

    def _turn(self, moved: Tensor) -> None:
        """New directions for the scenes that moved."""
        d = self._history.direction(self._x.flatten(1)).reshape(self._d.shape)
        _accept(moved, [self._d], [d])
        self._slope.copy_(torch.where(moved, dot(self.gradient, self._d), self._slope))
        short = moved & (largest_displacement(self._d) <= self._threshold)
        self.phase.copy_(torch.where(short, int(Phase.WAITING), self.phase))

    # --- the end of a scene ----------------------------------------------------------------

    def _estimate(self) -> None:
        """Judge the scenes that wait by a Newton step, which is also their next direction."""
        self.linear_solver.solve(
            self.y,
            -self.gradient,
            self._d,
            self.phase == Phase.WAITING,
            tolerance=0.1,
            residual_share=0.03,
            settled=0.1,
            max_steps=_CG_STEPS,
        )
        self._judge()

    def _conclude(self) -> None:
        waiting, sure = self.phase == Phase.WAITING, self.linear_solver.converged
        newton = self.linear_solver.x
        estimate = torch.where(sure, largest_displacement(newton), math.inf)
        limit = torch.where(self.iterations > 0, 1.0, self._unmoved) * self._tolerance
        done = waiting & (estimate <= limit)
        again = waiting & ~done
        ratio = (0.5 * self._tolerance / estimate).clamp(0.05, 0.5)
        lower = again & (estimate > self._tolerance)
        shorter = largest_displacement(self._d) * ratio
        self._threshold.copy_(torch.where(lower, shorter, self._threshold))
        use = again & sure
        self._d.copy_(torch.where(by_scene(use), newton, self._d))
        self._slope.copy_(torch.where(use, dot(self.gradient, self._d), self._slope))
        self.estimate.copy_(torch.where(waiting, estimate, self.estimate))
        phase = torch.where(again, int(Phase.RUNNING), self.phase)
        self.phase.copy_(torch.where(done, int(Phase.CONVERGED), phase))
        self._look()


@one_kernel
def _trial(y: Tensor, d: Tensor, length: Tensor, running: Tensor) -> tuple[Tensor, Tensor]:
    step = torch.where(by_scene(running), by_scene(length) * d, 0.0)
    return step, y + step


@one_kernel
def _accept(moved: Tensor, known: Sequence[Tensor], found: Sequence[Tensor]) -> None:
    """Put what was found, (B, U, 3) each, in the place of what was known, where moved (B,)."""
    for old, new in zip(known, found, strict=True):
        old.copy_(torch.where(by_scene(moved), new, old))


# --- loads that follow the body ------------------------------------------------------------------


def settle(
    minimiser: BatchMinimiser, alive: Tensor, follow: Callable[[Tensor], None]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Go on from a minimum with the loads as they are there, scene by scene, until both agree.

    ``follow`` samples the loads at configurations (B, U, 3), ``alive`` (B,) are the scenes that
    take part.  Returns the minimiser's y, phase, iterations, evaluations and estimate, of all runs
    together.
    """
    m = minimiser
    start = m.start
    y, phase, estimate = m.y.clone(), m.phase.clone(), m.estimate.clone()
    iterations, evaluations = m.iterations.clone(), m.evaluations.clone()
    mixed = Mixing(len(y))
    for _ in range(MOST):
        going = alive & (phase == Phase.CONVERGED)
        if not bool(going.any()):
            break
        start = mixed(start, y, going)
        follow(start)
        m.run(start, going, unmoved=1.0)
        here = going[:, None, None]
        y = torch.where(here, m.y, y)
        phase = torch.where(going, m.phase, phase)
        estimate = torch.where(going, m.estimate, estimate)
        iterations, evaluations = iterations + m.iterations * going, evaluations + m.evaluations
        settled = going & (m.phase == Phase.CONVERGED) & (m.iterations == 0)
        alive = alive & ~settled
    else:
        phase = torch.where(alive & (phase == Phase.CONVERGED), int(Phase.LIMIT), phase)
    return y, phase, iterations, evaluations, estimate


class Mixing:
    """`Anderson`'s acceleration of each scene, on the CPU as the loads are."""

    def __init__(self, scenes: int) -> None:
        self._scenes = [Anderson() for _ in range(scenes)]

    def __call__(self, y: Tensor, image: Tensor, which: Tensor) -> Tensor:
        """The next iterates of the scenes where ``which`` (B,) holds; others stay at ``y``."""
        before, after = (x.detach().to("cpu", torch.float64).numpy() for x in (y, image))
        out = before.copy()
        for i in which.nonzero()[:, 0].tolist():
            out[i] = self._scenes[i](before[i].ravel(), after[i].ravel()).reshape(out[i].shape)
        return torch.as_tensor(out, dtype=y.dtype, device=y.device)
