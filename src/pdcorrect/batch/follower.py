"""Loads that follow the body in a batch: `pdcorrect.solvers.follower` for B scenes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pdcorrect.batch.minimise import BatchMinimiser, Phase
from pdcorrect.solvers.follower import MOST, Anderson


def settle(
    minimiser: BatchMinimiser, alive: Tensor, follow: Callable[[Tensor], None]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Go on from a minimum with the loads as they are there, scene by scene, until both agree.

    Parameters
    ----------
    minimiser : BatchMinimiser
        After a run from the first iterate.
    alive : (B,) bool
        Scenes that take part.
    follow : callable
        Samples the loads at configurations (B, U, 3).

    Returns
    -------
    y, phase, iterations, evaluations, estimate
        As the minimiser's, of all runs together.
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
