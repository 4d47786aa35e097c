"""`corrected_step`: a coarse step and a network's correction of it, if a `Gate` lets it pass.

A refused correction counts as zero: the step is the plain coarse one.  Corrections that are
not finite, and those of steps that the coarse solver failed, are refused without a gate too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, ClassVar, Generic, Literal, Protocol, TypeVar, get_args

import torch
from pydantic import Field
from torch import Tensor

from pdcorrect._config import Checked, NonNegative
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Answers
from pdcorrect.corrector.features import FeatureView
from pdcorrect.errors import InputError
from pdcorrect.solvers.schemes import Scheme


class Reason(IntEnum):
    """Why a correction was refused; 0 where it was not."""

    NONE = 0
    NOT_FINITE = 1
    OUTSIDE = 2
    INVERSION = 3
    ENERGY = 4
    SOLVER = 5

    @property
    def meaning(self) -> str:
        """The end of a sentence: a correction is refused because ..."""
        return _MEANINGS[self]


_MEANINGS = {
    Reason.NONE: "it was not",
    Reason.NOT_FINITE: "the network's answer is not a number",
    Reason.OUTSIDE: "the body, its time step or its motion is outside of the training",
    Reason.INVERSION: "cells of the corrected state are crushed or inverted",
    Reason.ENERGY: "the corrected state has more energy than the loads account for",
    Reason.SOLVER: "the coarse step failed",
}


@dataclass(frozen=True)
class Refusal:
    """Steps whose corrections were refused for one reason."""

    reason: Reason
    steps: int


def refusals(reasons: Iterable[float]) -> tuple[Refusal, ...]:
    """What was refused in a run, most frequent first, for numbers ``run.stats["gate"]``."""
    counts = Counter(Reason(int(number)) for number in reasons if number > 0)
    return tuple(Refusal(reason, steps) for reason, steps in counts.most_common())


@dataclass(frozen=True, eq=False)
class GateMeasures:
    """What a gate looks at in the states of B scenes after a step.

    Smallest det F (B, C) of each cell, of the nodes' displacements, infinite in padding; kinetic
    and elastic energy (B,), J; work (B,) of the scene's loads since the step began, J.
    """

    ratios: Tensor
    stored: Tensor
    work: Tensor


class Gate(Checked):
    """When a correction is refused; None switches a test off.  Each step is judged by itself.

    The body at rest and the time step are tested first: a scene that is refused by them is so in
    every step, and where all are the network is not asked.  Cells and energy are tested on the
    corrected answers, against the plain coarse ones of the same step.

    Attributes
    ----------
    outside
        Refused if the out-of-distribution score of body, time step and inputs is more than this,
        see `pdcorrect.corrector.normaliser.Envelope`.
    crushing
        Refused if in any cell the smallest det F at the quadrature points, of the nodes'
        displacements, is not positive, or below this multiple of the coarse answer's, where that
        is positive; unless it is no smaller than in the same cell of the coarse answer.  Zero is
        a test of inversion alone.
    energy
        Refused if kinetic and elastic energy less the work of the scene's loads in the step is
        higher than after the coarse step by more than this multiple of the step's energy:
        kinetic and elastic energy after the coarse step and the magnitude of the loads' work
        in it.  Nothing in the bound depends on the correction.  A bound against single jumps, and
        a wide one: where the coarse mass rule makes nodes r times too heavy, the right answer to
        a kick rises by (r - 1)²/3, if all are, and single nodes may move farther still: with the
        published rule 6.4 was measured beside a 4x4x4 reference (r = 4.1 at corners).

    Raises
    ------
    InputError
        If a value is not what is expected, or there is no such test.
    """

    outside: NonNegative | None = 1.0
    crushing: Annotated[float, Field(strict=True, ge=0, lt=1)] | None = 0.1
    energy: NonNegative | None = 8.0

    source: ClassVar[str] = "gate"

    def reasons(self, answer: GateMeasures, coarse: GateMeasures) -> Tensor:
        """Reasons (B,) to refuse corrected answers beside the coarse ones.

        What is not a number does not pass.
        """
        reasons = torch.zeros_like(answer.work, dtype=torch.int64)
        if self.energy is not None:
            cap = coarse.stored - coarse.work + self.energy * (coarse.stored + coarse.work.abs())
            reasons = torch.where(answer.stored - answer.work <= cap, reasons, Reason.ENERGY)
        if self.crushing is not None:
            bound = self.crushing * torch.where(coarse.ratios < 0.0, 0.0, coarse.ratios)
            good = (answer.ratios > 0.0) & (answer.ratios >= bound)
            worse = ~good & ~(answer.ratios >= coarse.ratios)
            reasons = torch.where(worse.any(dim=1), Reason.INVERSION, reasons)
        return reasons


def check_gate(gate: object) -> None:
    """Refuse what is no gate with an `InputError`."""
    if gate is not None and not isinstance(gate, Gate):
        raise InputError(f"gate is a {type(gate).__name__}: expected a Gate(...) or None.")


# --- a corrected step --------------------------------------------------------------------


class HasState(Protocol):
    """A coarse solver's result of a step of B scenes."""

    @property
    def state(self) -> Any:
        """After the step."""


Answer = TypeVar("Answer", bound=HasState)


class CoarseStep(Protocol[Answer]):
    """One step of B scenes, with n nodes in all, from given states: of one scene, or of many."""

    def solved(self) -> Answer:
        """The coarse answer."""

    def view(self, answer: Answer) -> FeatureView:
        """What the network sees."""

    def ok(self, answer: Answer) -> Tensor:
        """Whether the step of each scene converged, (B,) bool."""

    def moved(self, answer: Answer, correction: Tensor) -> Answer:
        """The answer with a correction (n, 3), m, in its state."""

    def measured(self, answer: Answer) -> GateMeasures:
        """Volumes and energies after the step."""

    def chosen(self, which: Tensor, one: Answer, other: Answer) -> Answer:
        """Scenes of ``one`` where ``which`` (B,) holds, else of ``other``, bit for bit."""


@dataclass(frozen=True, eq=False)
class CorrectedStep(Generic[Answer]):
    """A step of B scenes with n nodes in all, those corrections in it that count.

    ``coarse`` is the coarse solver's answer: ``answer`` bit for bit in scenes whose correction is
    zero or refused.  The correction (n, 3), m, is as applied, zero where refused; ``reasons`` (B,)
    are numbers of `Reason`, int64: 0 where the correction was not refused.
    """

    answer: Answer
    coarse: Answer
    correction: Tensor
    reasons: Tensor

    @property
    def state(self) -> Any:
        """Of the answer."""
        return self.answer.state

    @property
    def refused(self) -> Tensor:
        """Whether the plain coarse answer was kept, (B,) bool."""
        return self.reasons > 0


def corrected_step(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None
) -> CorrectedStep[Answer]:
    """The coarse step, and what becomes of it with a network's corrections."""
    coarse = step.solved()
    view = step.view(coarse)
    bodies = view.bodies
    correction, reasons = asked(view, corrector, gate)
    reasons = torch.where(step.ok(coarse), reasons, Reason.SOLVER)
    correction = _passed(bodies, correction, reasons)
    counts = bodies.some(correction != 0.0)
    if not counts.any():
        return CorrectedStep(coarse, coarse, correction, reasons)
    moved = step.moved(coarse, correction)
    if gate is not None and (gate.crushing is not None or gate.energy is not None):
        found = gate.reasons(step.measured(moved), step.measured(coarse))
        reasons = torch.where(counts, found, reasons)
        correction = _passed(bodies, correction, reasons)
        counts = counts & (reasons == Reason.NONE)
    return CorrectedStep(step.chosen(counts, moved, coarse), coarse, correction, reasons)


def asked(view: FeatureView, corrector: Answers, gate: Gate | None) -> tuple[Tensor, Tensor]:
    """A network's corrections (n, 3), m, and reasons (B,) to refuse them before they are applied.

    It is not asked where a gate refuses all bodies as they are at rest.
    """
    bodies, bound = view.bodies, None if gate is None else gate.outside
    if bound is not None:
        outside = corrector.rest_score(bodies) > bound
        if outside.all():
            return torch.zeros_like(view.snapshot.proposed), outside * int(Reason.OUTSIDE)
    correction = corrector.of_view(view)
    reasons = torch.where(bodies.sound(correction), Reason.NONE, Reason.NOT_FINITE)
    if bound is not None:
        reasons = torch.where(corrector.score(view) > bound, Reason.OUTSIDE, reasons)
    return correction, reasons


def _passed(bodies: BodyGraph, correction: Tensor, reasons: Tensor) -> Tensor:
    """Corrections without the refused ones."""
    return torch.where(bodies.by_node(reasons == Reason.NONE)[:, None], correction, 0.0)


Velocity = Literal["recomputed", "kept"]
"""Of corrected states: what the integrator makes of the corrected positions, or the coarse
solver's own."""


def check_velocity(velocity: str, integrator: str) -> None:
    """Refuse velocities that have no meaning with an integrator with an `InputError`."""
    if velocity not in get_args(Velocity):
        raise InputError(f"velocity = {velocity!r}: expected 'recomputed' or 'kept'.")
    if velocity == "kept" and integrator in ("bdf2", "generalised-alpha"):
        raise InputError(
            f"velocity = 'kept' with {integrator}: what it remembers would not belong to the "
            "corrected positions. Expected velocity = 'recomputed', or backward-euler, midpoint "
            "or quasi-static."
        )


def moved(
    scheme: Scheme,
    state: Any,
    correction: Any,
    velocity: Velocity,
    mass_times: Callable[[Any], Any],
) -> tuple[Any, Any, Mapping[str, Any]]:
    """Positions, velocities and memory of a state after a step, corrected.

    Recomputed velocities, and memory, are those that the integrator would have given had the
    corrected positions been its solution; by backward Euler v = (p - p_before)/h.  They are
    linear in the solution, so each takes its own multiple of the correction.

    Arrays or tensors: ``state`` has positions and velocities (..., 3) and a memory; the correction
    (..., 3), m, is zero where clamped, as ``mass_times``, the mass matrix times one, makes it.
    """
    positions = state.positions + correction
    if velocity == "kept":
        return positions, state.velocities, state.memory
    by_y = correction / scheme.positions.coefficients["y"]
    change = {"y": by_y}
    if "internal_forces" in state.memory:
        change["internal_forces_after"] = scheme.inertia * mass_times(by_y)
    memory = {}
    for name, array in state.memory.items():
        row = scheme.memory[name][0].coefficients
        memory[name] = sum((row.get(key, 0.0) * x for key, x in change.items()), array)
    velocities = state.velocities + scheme.velocities.coefficients.get("y", 0.0) * by_y
    return positions, velocities, memory
