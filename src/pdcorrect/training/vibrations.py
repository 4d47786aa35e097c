"""How far an error of the velocities swings a body: what a few steps do not yet show.

An error v of the velocities starts, in the mode phi of frequency w (phi . M phi = 1), a free
vibration of amplitude phi . M v / w.  The mean of its squared distances over a body's N nodes and
over time is

    (phi . M v)^2 |phi|^2 / (2 w^2 N),

undamped, near the shape at rest, and without what modes of like frequency share.  In soft modes
that is seconds away from steps of milliseconds: a rollout of few of them ends before an error has
shown, and single steps of equal length count for very different errors of rollouts.  Where a body
drifts rather than vibrates in the simulation's time T, the distance is that of the drift, T^2 / 3
in place of 1 / (2 w^2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.fem.modes import Modes, modes
from pdcorrect.fem.problem import Problem

MODES = 8
"""Lowest ones that count; fewer where a body has fewer free components."""


class Vibrations:
    """The lowest modes of B bodies on a device.

    Parameters
    ----------
    distinct : sequence of Problem
    owners : sequence of int
        Which of them each body is, (B,).
    durations : (B,)
        T of each body's simulation, s.
    nodes : int
        Of padded tensors, N.
    device : torch.device
    count : int
        Modes, at most.

    Raises
    ------
    ConvergenceError
        As of `pdcorrect.modes`.
    """

    def __init__(
        self,
        distinct: Sequence[Problem],
        owners: Sequence[int],
        durations: NDArray[np.floating],
        nodes: int,
        device: torch.device,
        count: int = MODES,
    ) -> None:
        momenta = np.zeros((len(distinct), count, nodes, 3), dtype=np.float32)
        frequencies = np.full((len(distinct), count), np.inf)
        squares = np.zeros((len(distinct), count))
        for k, problem in enumerate(distinct):
            found = _lowest(problem, count)
            most, here = len(found.frequencies), len(problem.positions)
            for i, shape in enumerate(found.shapes):
                momenta[k, i, :here] = problem.mass_matrix @ shape
            frequencies[k, :most] = 2.0 * np.pi * found.frequencies
            squares[k, :most] = (found.shapes**2).sum(axis=(1, 2)) / here
        time = durations[:, None]
        with np.errstate(divide="ignore"):
            held = np.minimum(0.5 / frequencies[owners] ** 2, time**2 / 3.0)
        self._owners = torch.as_tensor(list(owners), device=device)
        self._momenta = torch.from_numpy(momenta).to(device)
        self._reach = torch.from_numpy(held * squares[owners]).to(device)

    def reach(self, velocities: Tensor) -> Tensor:
        """Mean squared distances (B,), m2, to which velocities' errors (B, N, 3), m/s, lead."""
        momenta = self._momenta.index_select(0, self._owners).to(velocities.dtype)
        speeds = torch.einsum("bmnd,bnd->bm", momenta, velocities)
        return (speeds.square() * self._reach).sum(dim=1)


def _lowest(problem: Problem, count: int) -> Modes:
    return modes(problem, min(count, int(problem.free.sum()) - 1))
