"""What training minimises, and how large the base model's own errors are.

With the base model's error d1 = mean over steps and nodes of the squared distance between
its single steps from the reference and the reference, and D that of its free rollout (both
m2, of one trajectory), the "relative" loss of a frame that is j steps away from the
reference is the mean over the body's nodes of the squared distance over

    d(j) = min((j (j + 1) / 2)^2 d1, D),        d(1) = d1.

The factor is how far j equal one-step errors carry: each of them is an error e of the
positions and so e / h of the velocities, and j of them in the same direction add up to
e (1 + 2 + ... + j) where nothing holds the body back.  The base model itself has a loss of
about one, whether a trajectory moves by metres or trembles by micrometres.  With a weight
``ahead`` what the error will come to in the frames ahead (`Vibrations`) is added, over D, times
that weight.  With a bend b a loss x counts as b log(1 + x / b).

The "absolute" loss (thesis, eq. 5-3) sums over a body's nodes distances, or their squares,
of positions in units of 1 / 1000 m.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.fem.modes import modes
from pdcorrect.fem.problem import Problem
from pdcorrect.training.recipe import Loss

LEAST_ERROR = 1e-30
"""d1 and D count as at least this, m2."""
MODES = 8
"""Lowest ones that count in what is ahead; fewer where a body has no more free components."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BaseErrors:
    """d1 and D of the base model, m2, one a trajectory, (B,)."""

    one_step: Tensor
    rollout: Tensor

    def after(self, steps: Tensor | int) -> Tensor:
        """d(j) for j steps, one number or (B,)."""
        factor = (steps * (steps + 1) / 2) ** 2
        return torch.minimum(factor * self.one_step, self.largest)

    def of(self, trajectories: Tensor) -> BaseErrors:
        """Those of some, by their numbers."""
        return BaseErrors(self.one_step[trajectories], self.rollout[trajectories])

    @property
    def largest(self) -> Tensor:
        """D, at least d1, (B,)."""
        return torch.maximum(self.rollout, self.one_step)


def body_losses(
    loss: Loss,
    errors: Tensor,
    total: Callable[[Tensor], Tensor],
    counts: Tensor,
    scale: Tensor,
    added: Tensor | float = 0.0,
) -> Tensor:
    """The loss of each body, (B,).

    ``errors`` (..., 3) are distances at nodes, m; ``total`` sums values (...) over the nodes of
    each body, of which it has ``counts`` (B,); ``scale`` (B,) is d(j), m2.  ``added`` (B,) comes to
    relative losses before they are bent.
    """
    if loss.kind == "relative":
        ratios = total(errors.square().sum(dim=-1)) / (counts * scale) + added
        return ratios if loss.bend is None else loss.bend * torch.log1p(ratios / loss.bend)
    errors = loss.scale * errors
    if loss.power == 1:
        return total(torch.linalg.vector_norm(errors, dim=-1))
    return total(errors.square().sum(dim=-1))


def mean_of(values: Tensor, chosen: Tensor) -> Tensor:
    """Mean of the chosen values; NaN where none is chosen, so that the batch does not count."""
    kept = torch.where(chosen, values, 0.0)
    return kept.sum() / chosen.sum()


@contextlib.contextmanager
def network_precision(corrector: Corrector, amp: Literal["none", "bf16"]) -> Iterator[None]:
    """Let the network, and nothing else, take its matrix products in bfloat16.

    The coarse solver, which may run between, keeps its own precision.
    """
    if amp == "none":
        yield
        return
    network = corrector.network
    plain, kind = network.forward, next(network.parameters()).device.type

    def forward(*arguments: Any) -> Any:
        with torch.autocast(kind, torch.bfloat16):
            return plain(*arguments)

    vars(network)["forward"] = forward
    try:
        yield
    finally:
        del vars(network)["forward"]


# --- what is ahead -----------------------------------------------------------------------


class BodyModes(NamedTuple):
    """Angular frequencies (m,), rad/s; M phi (m, N, 3), kg^1/2; |phi|^2 / N (m,), 1/kg."""

    frequencies: Array
    weighted: Array
    squares: Array


def body_modes(problem: Problem, count: int = MODES) -> BodyModes:
    """The lowest modes of a body at rest, of the problem's own mass and stiffness."""
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

    An error of positions e and velocities v, small and near the shape at rest, goes on by itself:
    in the mode phi of angular frequency w (phi . M phi = 1) backward Euler takes its coordinates
    (x, y) = (phi . M e, phi . M v) in a step h to

        y' = (y - h w^2 x) / (1 + (h w)^2),        x' = x + h y',

    which is linear in x and y, so that x_n = a_n x + b_n y after n steps.  Meant over a body's N
    nodes and the next T frames, as many as its simulation has, the squared distances are

        sum_{n = 1..T} (a_n x + b_n y)^2 |phi|^2 / (N T),

    without what unlike modes have in common, and wherever in the simulation it is, for users let
    theirs go on.  A soft mode takes a second to show an error of its velocity, where derivatives of
    training reach back over some hundredths of one.

    ``owners`` (B,) says which of the unlike ``bodies`` each is, ``steps`` (B,) are T, ``time_step``
    is h, s, and ``nodes`` the number of padded tensors.
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
