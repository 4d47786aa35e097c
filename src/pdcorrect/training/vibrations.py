"""What the error of a state will come to in the frames ahead, in a body's soft modes.

An error of positions e and velocities v, small and near the shape at rest, goes on by itself: in
the mode phi of angular frequency w (phi . M phi = 1) backward Euler takes its coordinates
(x, y) = (phi . M e, phi . M v) in a step h to

    y' = (y - h w^2 x) / (1 + (h w)^2),        x' = x + h y',

which is linear in x and y, so that x_n = a_n x + b_n y after n steps.  Meant over a body's N nodes
and the next T frames, as many as its simulation has, the squared distances are

    sum_{n = 1..T} (a_n x + b_n y)^2 |phi|^2 / (N T),

without what unlike modes have in common, and wherever in the simulation it is, for users let
theirs go on.  A soft mode takes a second to show an error of its velocity, where derivatives of
training reach back over some hundredths of one; and single steps of equal errors differ in how
much of them is in such modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.fem.modes import modes
from pdcorrect.fem.problem import Problem

MODES = 8
"""Lowest ones that count; fewer where a body has no more free components."""

Array = NDArray[np.float64]


class BodyModes(NamedTuple):
    """Angular frequencies (m,), rad/s; M phi (m, N, 3), kg^1/2; |phi|^2 / N (m,), 1/kg."""

    frequencies: Array
    weighted: Array
    squares: Array


def body_modes(problem: Problem, count: int = MODES) -> BodyModes:
    """The lowest modes of a body at rest, of the problem's own mass and stiffness.

    Raises
    ------
    ConvergenceError
        As of `pdcorrect.modes`.
    """
    nodes = len(problem.positions)
    count = min(count, int(problem.free.sum()) - 1)
    if count < 1:
        return BodyModes(np.zeros(0), np.zeros((0, nodes, 3)), np.zeros(0))
    found = modes(problem, count)
    weighted = np.stack([problem.mass_matrix @ shape for shape in found.shapes])
    squares = (found.shapes**2).sum(axis=(1, 2)) / nodes
    return BodyModes(2.0 * np.pi * found.frequencies, weighted, squares)


class Vibrations:
    """The lowest modes of B bodies on a device, stepped by backward Euler.

    Parameters
    ----------
    bodies : sequence of BodyModes
        Unlike ones; ``owners`` says which of them each body is, (B,).
    steps : (B,) int
        T of each body's simulation.
    time_step : float
        h, s.
    nodes : int
        Of padded tensors.
    """

    def __init__(
        self,
        bodies: Sequence[BodyModes],
        owners: Sequence[int],
        steps: NDArray[np.int64],
        time_step: float,
        nodes: int,
        device: torch.device,
    ) -> None:
        count = max(len(body.frequencies) for body in bodies)
        weighted = np.zeros((len(bodies), count, nodes, 3), dtype=np.float32)
        frequencies, squares = np.zeros((2, len(bodies), count))
        for k, body in enumerate(bodies):
            here, its_nodes, _ = body.weighted.shape
            weighted[k, :here, :its_nodes] = body.weighted
            frequencies[k, :here] = body.frequencies
            squares[k, :here] = body.squares
        which = np.asarray(owners)
        responses = _responses(frequencies[which], steps, time_step) * squares[which]
        self._owners = torch.from_numpy(which).to(device)
        self._weighted = torch.from_numpy(weighted).to(device)
        self._responses = torch.from_numpy(responses).to(device)

    def ahead(self, positions: Tensor, velocities: Tensor) -> Tensor:
        """Mean squared distances (B,), m2, that errors (B, N, 3) come to in the next T frames."""
        weighted = self._weighted.index_select(0, self._owners).to(positions.dtype)
        x, y = (torch.einsum("bmnd,bnd->bm", weighted, z) for z in (positions, velocities))
        xx, xy, yy = self._responses.to(positions.dtype)
        return (xx * x.square() + 2.0 * xy * x * y + yy * y.square()).sum(dim=1)


def _responses(frequencies: Array, steps: NDArray[np.int64], h: float) -> Array:
    """Means of a^2, a b and b^2 over each body's steps (B,), (3, B, m)."""
    out = np.zeros((3, *frequencies.shape))
    x = np.stack([np.ones_like(frequencies), np.zeros_like(frequencies)])
    y = x[::-1].copy()
    for n in range(1, int(steps.max()) + 1):
        y = (y - h * frequencies**2 * x) / (1.0 + (h * frequencies) ** 2)
        x = x + h * y
        counts = (n <= steps)[:, None]
        out += np.where(counts, np.stack([x[0] ** 2, x[0] * x[1], x[1] ** 2]), 0.0)
    return out / steps[:, None]
