"""Loads and equation of a step of a batch: `pdcorrect.solvers.integrators` for B scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.objective import BatchMass, by_scene
from pdcorrect.batch.states import BatchState
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.integrators import (
    Integrator,
    clamp_rates,
    equal_steps,
    nodal_solution,
)
from pdcorrect.solvers.schemes import Linear, Scheme, by_component

Spans = Sequence[tuple[float, float]]
"""The time interval (s) of each scene's loads; a moment where both ends are equal."""


@dataclass(frozen=True, eq=False)
class BatchStepEquation:
    """One step's equation and what it was made of, see `Scheme`.

    ``known`` is what the scheme's sums are of, ``spans`` are the time intervals (s) over which each
    scene's loads act.  The target q (B, U, 3), m, is not changed later; other fields are nodal
    (B, N, 3), start and foreseen with prescribed values where clamped.
    """

    scheme: Scheme
    known: dict[str, Any]
    spans: Spans
    target: Tensor
    origin: Tensor
    start: Tensor
    foreseen: Tensor
    past_forces: Tensor | float
    strains: list[tuple[float, Tensor]]

    def sampled(self, y: Tensor) -> Tensor:
        """Where loads that follow the body are sampled, for nodal y, (B, N, 3)."""
        place: Tensor = self.scheme.sampled({**self.known, "y": y})
        return place


class BatchStaging:
    """From states of B scenes to the equation of a step of so many s, and back to states."""

    def __init__(
        self, cells: CellBatch, problems: Sequence[Problem], integrate: Integrator, time_step: float
    ) -> None:
        self._cells, self._problems = cells, problems
        self._integrate, self._h = integrate, time_step
        distinct, nodes = cells.bodies.distinct, cells.sizes.nodes
        self._moving = any(p.clamps.moving for p in distinct)
        self._clamped = cells.repeated([p.clamped_positions(0.0) for p in distinct], nodes, 3)
        self.free = cells.free[:, :nodes] > 0.5

    def extended(self, nodal: Tensor) -> Tensor:
        """(B, N, 3) as configurations (B, U, 3)."""
        modes = self._cells.sizes.modes
        return torch.nn.functional.pad(nodal, (0, 0, 0, modes)) if modes else nodal

    def __call__(self, state: BatchState) -> BatchStepEquation:
        """The step from a state."""
        scheme, known, h = self._scheme(state), self._known(state), self._h
        first, last = scheme.loads_over
        return BatchStepEquation(
            scheme,
            known,
            [(t + first * h, t + last * h) for t in state.times],
            self.extended(self._split(known, scheme.target, scheme.clamped_target)),
            self._split(known, scheme.origin, scheme.clamped_origin),
            self._split(known, scheme.start, scheme.clamped),
            self._split(known, scheme.foreseen or scheme.start, scheme.clamped),
            scheme.past_forces(known),
            [(a, x(known)) for a, x in scheme.strains],
        )

    def finish(
        self, stage: BatchStepEquation, y: Tensor, state: BatchState, internal: Tensor | None
    ) -> BatchState:
        """The state after the step from ``state`` with solution y (B, U, 3).

        ``internal`` (B, N, 3) are the forces that the equation gives the bodies, see `Scheme`,
        where it needs them.  The state's tensors share no memory with others.
        """
        known = {**stage.known, "y": y[:, : self._cells.sizes.nodes]}
        if internal is not None:
            known["internal_forces_after"] = internal
        scheme = stage.scheme
        return BatchState(
            self._split(known, scheme.positions, None),
            self._split(known, scheme.velocities, scheme.clamped_velocities),
            tuple(t + self._h for t in state.times),
            {name: self._split(known, *rows) for name, rows in scheme.memory.items()},
        )

    def solution(self, before: BatchState, positions: Tensor, modes: Tensor) -> Tensor:
        """The y (B, U, 3) of a step from a state to positions, and modes (B, U - N, 3)."""
        nodal = nodal_solution(self._scheme(before), before.positions, positions)
        return torch.cat([nodal, modes], dim=1)

    def _scheme(self, state: BatchState) -> Scheme:
        usable = self._integrate.usable(state.memory, partial(self._is_a_step, state))
        return self._integrate.scheme_of(self._h, usable)

    def _is_a_step(self, state: BatchState, before: Tensor) -> bool:
        """Whether the times before (B, N, 3) are a step of this length earlier, in all scenes."""
        lengths = [t - e for t, e in zip(state.times, before[:, 0, 0].tolist(), strict=True)]
        rounding = 2.0 * torch.finfo(before.dtype).eps
        started = [
            equal_steps(length, self._h) or abs(length - self._h) <= rounding * abs(t)
            for length, t in zip(lengths, state.times, strict=True)
        ]
        if any(started) and not all(started):
            other = started.index(False)
            raise InputError(
                f"the state of scene {other} came from a step of another length than "
                f"{self._h:g} s, those of others did not: expected all or none."
            )
        return all(started)

    def _known(self, state: BatchState) -> dict[str, Any]:
        like = state.positions
        times = torch.tensor(state.times, dtype=like.dtype).to(like.device, non_blocking=True)
        return {
            "positions": like,
            "velocities": state.velocities,
            "prescribed": self.prescribed([t + self._h for t in state.times]),
            "time": torch.zeros_like(like) + by_scene(times),
            **state.memory,
            **self._clamp_rates(state.times),
        }

    def _clamp_rates(self, times: Sequence[float]) -> dict[str, Any]:
        """See `integrators.clamp_rates`, (B, N, 3) each."""
        pairs = list(zip(self._problems, times, strict=True))
        if not self._moving:
            return clamp_rates(*pairs[0], self._h)
        rates = [clamp_rates(problem, t, self._h) for problem, t in pairs]
        shapes = [problem.positions.shape for problem in self._problems]
        return {
            name: self._cells.nodal(
                [np.broadcast_to(a[name], shape) for a, shape in zip(rates, shapes, strict=True)]
            )
            for name in rates[0]
        }

    def prescribed(self, times: Sequence[float]) -> Tensor:
        """Clamped positions of the scenes at their times (s), (B, N, 3), m."""
        if not self._moving:
            return self._clamped
        pairs = zip(self._problems, times, strict=True)
        return self._cells.nodal([p.clamped_positions(t) for p, t in pairs])

    def _split(self, known: dict[str, Any], on_free: Linear, on_clamped: Linear | None) -> Tensor:
        """A sum (B, N, 3) in memory of its own."""
        values: Tensor = by_component(torch, self.free, known, on_free, on_clamped)
        return values.clone() if any(values is other for other in known.values()) else values


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
