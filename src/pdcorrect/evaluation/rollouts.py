"""Free rollouts and single steps of corrected scenes, one by one or many at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.states import BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import BatchHybridResult
from pdcorrect.corrector.hybrid import MEMORY, HybridStepper
from pdcorrect.fem.graph import velocities
from pdcorrect.state import State, StepResult

Array = NDArray[np.float64]
LOST = 1e3
"""Of a body's size: a node that is further away from its place at rest has failed."""


class Hybrid(Protocol):
    """A step of many scenes with a correction."""

    def __call__(self, state: BatchState, previous: Tensor | None = None) -> BatchHybridResult:
        """One step; ``previous`` (n, 3) is the correction of the step before, m."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a run makes of a simulation."""

    positions: Array | None = None  # (T+1, N, 3): free rollout from rest, m
    predictions: Array | None = None  # (T, N, 3): single steps from the reference's frames, m
    # coarse model that was stepped, with a corrector or without; None for other models
    base: str | None = None
    # (T,) int64: why steps of the rollout are without correction, numbers of `Reason`; 0 where they
    # have one, and after a failure
    reasons: NDArray[np.int64] | None = None
    # first step of the rollout that did not converge, or gave numbers that are not finite or a node
    # that is `LOST`.  The body is held from there on where it was before
    failed: int | None = None


def roll_out(
    hybrid: Hybrid,
    stepper: BatchStepper,
    steps: Sequence[int],
    worth: Callable[[int, Tensor], Tensor] | None = None,
) -> list[Outcome]:
    """All scenes of a stepper from their initial states, each for its number of steps.

    A failed scene is held at its last state, so its error is that of a simulation that has
    stopped: it is neither left out nor replaced by anything better.  ``worth`` is told each frame
    and the positions (B, N, 3) there, m, and says which scenes (B,) are to go on; others are held
    without having failed.
    """
    rest, state, previous = stepper.rest_state(), stepper.initial_state(), None
    frames, reasons = [rest.positions], []
    last = torch.tensor(steps, device=rest.positions.device)
    failed, going = torch.zeros_like(last), torch.ones_like(last, dtype=torch.bool)
    for number in range(1, max(steps) + 1):
        result = hybrid(state, previous)
        fine = _fine(result) & _near(result.state.positions, rest.positions, stepper.node_mask)
        failed = torch.where(going & ~fine, number, failed)
        going = going & fine
        frames.append(_where(going, result.state.positions, frames[-1]))
        reasons.append(torch.where(going, result.reasons, 0))
        going = going & (last > number)
        if worth is not None:
            going = worth(number, frames[-1]) & going
        state = result.state.where(going, rest)  # at rest scenes cost little
        previous = torch.where(_by_node(stepper, going), result.correction, 0.0)
    positions = torch.stack(frames).to("cpu", torch.float64).numpy()
    told = torch.stack(reasons).cpu().numpy()
    return [
        Outcome(
            positions[: n + 1, i, : stepper.node_counts[i]],
            reasons=told[:n, i],
            failed=first or None,
        )
        for i, (n, first) in enumerate(zip(steps, failed.tolist(), strict=True))
    ]


def single_steps(
    hybrid: Hybrid,
    stepper: BatchStepper,
    references: Sequence[Array],
    coarse: Sequence[Array | None],
) -> list[Array]:
    """One step from each frame of each scene's reference (T+1, N, 3) but the last, (T, N, 3), m.

    The correction of the step before is taken to have been what the coarse model's single steps
    (T, N, 3) lacked; without them zero.  A step that fails leaves the scene where it was.
    """
    h = stepper.time_step
    speeds = [velocities(x, h) for x in references]
    steps = [len(x) - 1 for x in references]
    found: list[Tensor] = []
    for number in range(max(steps)):
        frames = [min(number, last - 1) for last in steps]
        state = stepper.state([
            State(x[t], v[t], t * h) for x, v, t in zip(references, speeds, frames, strict=True)
        ])  # fmt: skip
        before = np.concatenate([
            np.zeros(x.shape[1:]) if y is None or not t else x[t] - y[t - 1]
            for x, y, t in zip(references, coarse, frames, strict=True)
        ])  # fmt: skip
        previous = torch.as_tensor(before, device=stepper.device)
        result = hybrid(state, previous)
        found.append(_where(_fine(result), result.state.positions, state.positions))
    positions = torch.stack(found).to("cpu", torch.float64).numpy()
    return [positions[:n, i, : stepper.node_counts[i]] for i, n in enumerate(steps)]


def _fine(result: BatchHybridResult) -> Tensor:
    """Scenes (B,) whose step converged and gave finite numbers."""
    state = result.state
    finite = torch.isfinite(state.positions) & torch.isfinite(state.velocities)
    converged = torch.tensor([s.ok for s in result.coarse.statuses], device=finite.device)
    return finite.all(dim=2).all(dim=1) & converged


def _near(positions: Tensor, rest: Tensor, mask: Tensor) -> Tensor:
    """Scenes (B,) none of whose nodes is lost."""
    own = mask[..., None]
    low, high = (torch.where(own, rest, x) for x in (torch.inf, -torch.inf))
    size = torch.linalg.vector_norm(high.amax(dim=1) - low.amin(dim=1), dim=1)
    away = torch.linalg.vector_norm(torch.where(own, positions - rest, 0.0), dim=2)
    return away.amax(dim=1) <= LOST * size


def _where(scenes: Tensor, x: Tensor, y: Any) -> Tensor:
    return torch.where(scenes[:, None, None], x, y)


def _by_node(stepper: BatchStepper, scenes: Tensor) -> Tensor:
    """Values (B,) of scenes at all nodes, (n, 1), without padding."""
    mask = stepper.node_mask
    return scenes[:, None].expand_as(mask)[mask][:, None]


def roll_out_alone(hybrid: HybridStepper, steps: int) -> Outcome:
    """From its initial state; a body that fails is held where it was, see `roll_out`."""
    state = hybrid.problem.initial_state()
    rest = state.positions
    size = float(np.linalg.norm(np.ptp(rest, axis=0)))
    frames, reasons = [rest], np.zeros(steps, dtype=np.int64)
    failed: int | None = None
    for number in range(1, steps + 1):
        result = hybrid(state)
        away = np.linalg.norm(result.state.positions - rest, axis=1).max()
        if not (_sound(result) and away <= LOST * size):
            failed = number
            break
        state = result.state
        frames.append(state.positions)
        reasons[number - 1] = int(result.stats["gate"])
    frames += [frames[-1]] * (steps + 1 - len(frames))
    return Outcome(np.stack(frames), reasons=reasons, failed=failed)


def single_steps_alone(hybrid: HybridStepper, reference: Array, coarse: Array | None) -> Array:
    """One step from each frame of a reference but the last, (T, N, 3), m; see `single_steps`."""
    h = hybrid.coarse.time_step
    speeds = velocities(reference, h)
    found = []
    for t in range(len(reference) - 1):
        lacked = np.zeros_like(reference[0])
        if coarse is not None and t:
            lacked = reference[t] - coarse[t - 1]
        memory = {MEMORY: lacked} if hybrid.remembers else {}
        result = hybrid(State(reference[t], speeds[t], t * h, memory))
        found.append(result.state.positions if _sound(result) else reference[t])
    return np.stack(found)


def _sound(result: StepResult) -> bool:
    """Whether the step converged and gave finite numbers."""
    state = result.state
    finite = np.isfinite(state.positions).all() and np.isfinite(state.velocities).all()
    return bool(finite) and result.status.ok
