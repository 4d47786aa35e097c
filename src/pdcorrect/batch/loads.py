"""External forces of the scenes of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.fem.problem import Problem


class BatchLoads:
    """All loads of B scenes, averaged over a step.

    Patterns of loads that do not follow the body stay on the device; those that do are
    sampled on the CPU, one scene at a time.
    """

    def __init__(self, cells: CellBatch, problems: Sequence[Problem]) -> None:
        self._cells = cells
        fixed = [[load for load in p.loads if load.sample is None] for p in problems]
        self._following = [[load for load in p.loads if load.sample is not None] for p in problems]
        self._any_following = any(self._following)
        most = max(map(len, fixed))
        self._patterns = torch.stack(
            [
                cells.nodal(
                    [
                        loads[k].pattern if k < len(loads) else np.zeros_like(p.positions)
                        for loads, p in zip(fixed, problems, strict=True)
                    ]
                )
                for k in range(most)
            ]
        ) if most else None  # fmt: skip
        self._fixed = fixed
        self._last: tuple[tuple[tuple[float, ...], ...], Tensor] | None = None

    def __call__(
        self, times: Sequence[float], over: tuple[float, float], h: float, positions: Tensor
    ) -> Tensor:
        """Nodal forces (B, U, 3), N, over a step of h seconds from ``times``.

        ``over`` as in `Scheme.loads_over`; ``positions`` (B, N, 3) are where follower
        loads are sampled.
        """
        spans = [(t + over[0] * h, t + over[1] * h) for t in times]
        amplitudes = tuple(
            tuple(load.amplitude.mean(*span) for load in loads)
            for loads, span in zip(self._fixed, spans, strict=True)
        )
        if self._last is None or self._last[0] != amplitudes:
            self._last = amplitudes, self._sum(amplitudes)
        total = self._last[1]
        if self._any_following:
            total = total + self._sampled(spans, positions)
        return total

    def _sum(self, amplitudes: tuple[tuple[float, ...], ...]) -> Tensor:
        if self._patterns is None:
            return torch.zeros_like(self._cells.rest)
        most = len(self._patterns)
        table = [list(row) + [0.0] * (most - len(row)) for row in amplitudes]
        factors = self._cells.tensor(np.array(table).T)
        return (factors[:, :, None, None] * self._patterns).sum(dim=0)

    def _sampled(self, spans: Sequence[tuple[float, float]], positions: Tensor) -> Tensor:
        arrays = []
        host = positions.detach().to("cpu", torch.float64).numpy()
        for i, (loads, span) in enumerate(zip(self._following, spans, strict=True)):
            at = host[i, : self._cells.node_counts[i]]
            total = np.zeros_like(at)
            for load in loads:
                if np.isfinite(at).all():
                    total += load.forces(*span, at)
            arrays.append(total)
        return self._cells.nodal(arrays)
