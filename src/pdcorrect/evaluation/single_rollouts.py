"""Free rollouts and single steps of one corrected scene on a CPU.

What `pdcorrect.evaluation.rollouts` does for many scenes at once.  On a CPU one scene after the
other is quicker, since its network runs in compiled loops (see `HybridStepper`).  Results are the
same to the solver's tolerance; with internal modes a gate may let a correction pass that it refuses
in a batch, since a scene alone relaxes its modes before its energy is judged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.corrector.hybrid import MEMORY, HybridStepper
from pdcorrect.evaluation.rollouts import LOST, Rollout
from pdcorrect.fem.graph import velocities
from pdcorrect.state import State, StepResult

Array = NDArray[np.float64]


def roll_out_alone(hybrid: HybridStepper, steps: int) -> Rollout:
    """From rest; a body that fails is held where it was before, see `roll_out`."""
    state = hybrid.problem.rest_state()
    rest = state.positions
    size = float(np.linalg.norm(np.ptp(rest, axis=0)))
    frames, reasons = [rest], np.zeros(steps, dtype=np.int64)
    failed: int | None = None
    for number in range(1, steps + 1):
        result = hybrid(state)
        away = np.linalg.norm(result.state.positions - rest, axis=1).max()
        if not (_fine(result) and away <= LOST * size):
            failed = number
            break
        state = result.state
        frames.append(state.positions)
        reasons[number - 1] = int(result.stats["gate"])
    frames += [frames[-1]] * (steps + 1 - len(frames))
    return Rollout(np.stack(frames), reasons, failed)


def single_steps_alone(hybrid: HybridStepper, reference: Array, coarse: Array | None) -> Array:
    """One step from each frame of a reference but the last, (T, N, 3), m; see `single_steps`.

    Parameters
    ----------
    hybrid : HybridStepper
    reference : (T+1, N, 3)
        m.
    coarse : (T, N, 3), optional
        Single steps of the coarse model, m.
    """
    h = hybrid.coarse.time_step
    speeds = velocities(reference, h)
    found = []
    for t in range(len(reference) - 1):
        lacked = np.zeros_like(reference[0])
        if coarse is not None and t:
            lacked = reference[t] - coarse[t - 1]
        memory = {MEMORY: lacked} if hybrid.remembers else {}
        result = hybrid(State(reference[t], speeds[t], t * h, memory))
        found.append(result.state.positions if _fine(result) else reference[t])
    return np.stack(found)


def _fine(result: StepResult) -> bool:
    """Whether the step converged and gave finite numbers."""
    state = result.state
    finite = np.isfinite(state.positions).all() and np.isfinite(state.velocities).all()
    return bool(finite) and result.status.ok
