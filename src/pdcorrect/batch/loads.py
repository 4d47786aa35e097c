"""External forces of the scenes of a batch, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.objective import BatchMass
from pdcorrect.fem.problem import Problem

Spans = Sequence[tuple[float, float]]
"""The time interval (s) of each scene's loads; a moment where both ends are equal."""


class BatchLoads:
    """All loads of B scenes, averaged over time intervals.

    Patterns of loads that do not follow the body stay on the device; those that do are
    sampled on the CPU, one scene at a time.
    """

    def __init__(self, cells: CellBatch, problems: Sequence[Problem], mass: BatchMass) -> None:
        self._cells, self._mass = cells, mass
        self._gravity = [[k for k in p.loads if k.acceleration is not None] for p in problems]
        self._following = [[k for k in p.loads if k.sample is not None] for p in problems]
        self._fixed = [
            [k for k in p.loads if k.sample is None and k.acceleration is None] for p in problems
        ]
        most, n = max(map(len, self._fixed)), cells.sizes
        patterns = np.zeros((n.scenes, most, n.unknowns, 3))
        for scene, loads in zip(patterns, self._fixed, strict=True):
            for row, load in zip(scene, loads, strict=False):
                row[: len(load.pattern)] = load.pattern
        self._patterns = cells.tensor(patterns)
        self._known: tuple[tuple[float, ...], ...] | None = None
        self._sum, self._acceleration = torch.zeros_like(cells.rest), cells.rest[:, :1] * 0.0

    @property
    def follow(self) -> bool:
        """Whether any load depends on the positions."""
        return any(self._following)

    def __call__(self, spans: Spans, positions: Tensor) -> Tensor:
        """Nodal forces (B, U, 3), N; follower loads are sampled at positions (B, N, 3)."""
        fall = self._mass.nodal[..., None] * self.acceleration(spans)
        total = self._sum + fall
        if not self.follow:
            return total
        sampled = []
        for at, loads, span in zip(self._host(positions), self._following, spans, strict=True):
            out = np.zeros_like(at)
            if np.isfinite(at).all():
                for load in loads:
                    out += load.forces(*span, at)
            sampled.append(out)
        return total + self._cells.configurations(sampled)

    def acceleration(self, spans: Spans) -> Tensor:
        """Of gravity, (B, 1, 3), m/s2."""
        amplitudes = tuple(
            tuple(load.amplitude.mean(*span) for load in (*fixed, *gravity))
            for fixed, gravity, span in zip(self._fixed, self._gravity, spans, strict=True)
        )
        if amplitudes != self._known:
            self._update(amplitudes)
        return self._acceleration

    def pulled(self, spans: Spans, positions: Tensor, x: Tensor) -> Tensor:
        """Derivatives (B, N, 3) of x . forces by the positions, N/m, for x (B, N, 3)."""
        out = []
        every = zip(self._host(positions), self._host(x), self._following, spans, strict=True)
        for at, along, loads, span in every:
            slope = np.zeros_like(at)
            for load in loads:
                slope += load.pulled(*span, at, along)
            out.append(slope)
        return self._cells.nodal(out)

    def _update(self, amplitudes: tuple[tuple[float, ...], ...]) -> None:
        factors = np.zeros(self._patterns.shape[:2])
        fall = np.zeros((len(amplitudes), 1, 3))
        for i, (row, gravity) in enumerate(zip(amplitudes, self._gravity, strict=True)):
            fixed = len(row) - len(gravity)
            factors[i, :fixed] = row[:fixed]
            for factor, load in zip(row[fixed:], gravity, strict=True):
                fall[i, 0] += factor * np.asarray(load.acceleration)
        self._sum = torch.einsum("bk,bkui->bui", self._cells.tensor(factors), self._patterns)
        self._acceleration = self._cells.tensor(fall)
        self._known = amplitudes

    def _host(self, x: Tensor) -> list[np.ndarray]:
        host = x.detach().to("cpu", torch.float64).numpy()
        return [host[i, :count] for i, count in enumerate(self._cells.node_counts)]
