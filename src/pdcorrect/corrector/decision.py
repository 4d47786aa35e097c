"""`corrected_step`: where a network's corrections go, and which of them count.

The same for one scene and for many: what a step is made of is a `CoarseStep`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Answers
from pdcorrect.corrector.features import View
from pdcorrect.corrector.gate import Gate, Measured, Reason

_HALVINGS = 6
"""How often a limited correction is halved before it is refused."""

Answer = TypeVar("Answer")
"""A coarse solver's result of a step of B scenes."""


class CoarseStep(Protocol[Answer]):
    """One step of B scenes, with n nodes in all, from given states."""

    def view(self, answer: Answer | None) -> View:
        """What the network sees, with the coarse answer if it is asked after that."""

    def solved(self, added: Tensor | None = None, guess: Tensor | None = None) -> Answer:
        """The coarse answer, also under the loads of a correction ``added`` (n, 3), m.

        The solver begins at positions ``guess`` (n, 3), m, in scenes where it is finite.
        """

    def ok(self, answer: Answer) -> Tensor:
        """Whether the step of each scene converged, (B,) bool."""

    def moved(self, answer: Answer, correction: Tensor) -> Answer:
        """The answer with a correction (n, 3), m, in its state."""

    def measured(self, answer: Answer) -> Measured:
        """Volumes and energies after the step."""

    def before(self) -> Measured | None:
        """Those before it, without work; None where they are not known."""

    def chosen(self, which: Tensor, one: Answer, other: Answer) -> Answer:
        """Scenes of ``one`` where ``which`` (B,) holds, else of ``other``, bit for bit."""


@dataclass(frozen=True, eq=False)
class Decision:
    """A network's corrections of B bodies with n nodes in all, and what became of them.

    Attributes
    ----------
    bodies : BodyGraph
    asked : (n, 3)
        What the network gave, m; zero where that is not finite, or the body or its inputs are
        unknown.
    reasons : (B,) int64
        Numbers of `Reason`.
    factors : (B,)
        On what it gave, below 1 where a gate limited it.
    """

    bodies: BodyGraph
    asked: Tensor
    reasons: Tensor
    factors: Tensor

    @classmethod
    def of(cls, corrector: Answers, view: View, gate: Gate | None) -> Decision:
        """Ask the network, if a gate lets it see one of the bodies."""
        bodies, factors = view.bodies, torch.ones_like(view.bodies.cell_size)
        reasons = torch.zeros_like(factors, dtype=torch.int64)
        if gate is not None:
            reasons[gate.foreign(corrector, bodies)] = int(Reason.BODY)
            if reasons.all():
                return cls(bodies, torch.zeros_like(bodies.rest), reasons, factors)
        asked = corrector.of_view(view)
        reasons[(reasons == 0) & ~bodies.sound(asked)] = int(Reason.NOT_FINITE)
        if gate is not None:
            reasons[(reasons == 0) & gate.unknown(corrector, view)] = int(Reason.FEATURES)
        asked = torch.where(bodies.by_node(reasons == 0)[:, None], asked, 0.0)
        return cls(bodies, asked, reasons, factors)

    @cached_property
    def counts(self) -> Tensor:
        """Whether a body's correction is applied and not zero, (B,): else nothing changes."""
        there = (self.asked != 0.0).any(dim=1).to(self.asked)
        return (self.reasons == 0) & (self.bodies.node_sums(there) > 0.0)

    @property
    def correction(self) -> Tensor:
        """As applied, (n, 3), m; zero where it was refused."""
        return self.scaled(torch.where(self.reasons == 0, self.factors, 0.0))

    def scaled(self, factors: Tensor) -> Tensor:
        """What the network gave times (B,)."""
        return self.asked * self.bodies.by_node(factors)[:, None]

    def refused(self, reasons: Tensor) -> Decision:
        """With reasons (B,) that were found for corrections that count."""
        return replace(self, reasons=torch.where(self.counts, reasons, self.reasons))

    def judged(
        self, gate: Gate, step: CoarseStep[Answer], coarse: Answer
    ) -> tuple[Decision, Answer]:
        """Refused, or limited, by what corrected answers are beside the coarse one.

        Second: the answer with all corrections that are left, and others that do not count.
        """
        factors, beside = self.factors, step.measured(coarse)
        moved = step.moved(coarse, self.scaled(factors))
        reasons = gate.reasons(step.measured(moved), beside, gate.energy)
        for _ in range(_HALVINGS if gate.limit else 0):
            failed = self.counts & (reasons > 0)
            if not failed.any():
                break
            factors = torch.where(failed, 0.5 * factors, factors)
            moved = step.moved(coarse, self.scaled(factors))
            reasons = gate.reasons(step.measured(moved), beside, gate.energy)
        return replace(self.refused(reasons), factors=factors), moved


def corrected_step(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None
) -> tuple[Answer, Answer, Decision]:
    """The answer of a corrected step, the coarse solver's, and the decision.

    Scenes whose correction is zero or refused have the plain coarse answer bit for bit.  With
    placement "state" the coarse solver's is always that; else it is the answer itself.
    """
    if corrector.config.placement == "state":
        return _state(step, corrector, gate)
    view = step.view(None)
    decision = Decision.of(corrector, view, gate)
    if not decision.counts.any():
        answer = step.solved()
    elif corrector.config.placement == "force":
        answer, decision = _force(step, decision, gate)
    else:
        answer, decision = _guess(step, decision, view)
    return answer, answer, decision


def _state(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None
) -> tuple[Answer, Answer, Decision]:
    coarse = step.solved()
    decision = Decision.of(corrector, step.view(coarse), gate)
    reasons = torch.where(step.ok(coarse), decision.reasons, int(Reason.SOLVER))
    decision = replace(decision, reasons=reasons)
    if not decision.counts.any():
        return coarse, coarse, decision
    if gate is not None and gate.judges:
        decision, moved = decision.judged(gate, step, coarse)
    else:
        moved = step.moved(coarse, decision.correction)
    return step.chosen(decision.counts, moved, coarse), coarse, decision


def _force(
    step: CoarseStep[Answer], decision: Decision, gate: Gate | None
) -> tuple[Answer, Decision]:
    forced = step.solved(added=decision.correction)
    ok, measured = step.ok(forced), None
    reasons = torch.where(ok, int(Reason.NONE), int(Reason.SOLVER))
    if gate is not None and gate.judges:
        measured, before = step.measured(forced), step.before()
        rise = None if gate.energy is None else 0.0
        found = torch.full_like(reasons, int(Reason.ENERGY))
        found = found if before is None else gate.reasons(measured, before, rise)
        reasons = torch.where(ok, found, reasons)
    if not (decision.counts & (reasons > 0)).any():
        return forced, decision
    plain = step.solved()
    if gate is not None and measured is not None:
        found = gate.reasons(measured, step.measured(plain), gate.energy)
        found = torch.where(step.ok(plain), found, int(Reason.SOLVER))
        reasons = torch.where(ok & (reasons > 0), found, reasons)
    decision = decision.refused(reasons)
    return step.chosen(decision.counts, forced, plain), decision


def _guess(step: CoarseStep[Answer], decision: Decision, view: View) -> tuple[Answer, Decision]:
    at_nodes = decision.bodies.by_node(decision.counts)[:, None]
    guess = torch.where(at_nodes, view.snapshot.proposed + decision.correction, torch.nan)
    guessed = step.solved(guess=guess)
    failed = decision.counts & ~step.ok(guessed)
    if not failed.any():
        return guessed, decision
    decision = decision.refused(torch.where(failed, int(Reason.SOLVER), int(Reason.NONE)))
    return step.chosen(decision.counts, guessed, step.solved()), decision
