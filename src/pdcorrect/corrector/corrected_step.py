"""`corrected_step`: where a network's corrections go, and which of them count.

The same for one scene, in arrays, and for many, in tensors: what a step is made of is a
`CoarseStep`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeVar

from pdcorrect.corrector.corrector import Answers
from pdcorrect.corrector.features import FeatureView
from pdcorrect.corrector.gate import Gate, GateMeasures, Reason
from pdcorrect.corrector.placements import Values, filled, where

_HALVINGS = 6
"""How often a limited correction is halved before it is refused."""

Answer = TypeVar("Answer")
"""A coarse solver's result of a step of B scenes."""


class Bodies(Protocol):
    """What a decision asks about B bodies with n nodes in all."""

    @property
    def cell_size(self) -> Values:
        """(B,), m."""

    def by_node(self, values: Values) -> Values:
        """Values (B,) of bodies at their nodes: (n,), or (1,) of one body."""

    def some(self, flags: Values) -> Values:
        """Whether any of the flags (n, ...) of each body is set, (B,)."""

    def sound(self, values: Values) -> Values:
        """Whether all values (n, ...) of each body are finite, (B,)."""


class CoarseStep(Protocol[Answer]):
    """One step of B scenes, with n nodes in all, from given states."""

    @property
    def bodies(self) -> Bodies:
        """Those of the scenes."""

    def own(self, values: Values) -> Values:
        """Values of a network or gate as what the step computes with."""

    def view(self, answer: Answer | None) -> FeatureView:
        """What the network sees, with the coarse answer if it is asked after that."""

    def solved(self, added: Values | None = None, guess: Values | None = None) -> Answer:
        """The coarse answer, also under the loads of a correction ``added`` (n, 3), m.

        The solver begins at positions ``guess`` (n, 3), m, in scenes where it is finite.
        """

    def ok(self, answer: Answer) -> Values:
        """Whether the step of each scene converged, (B,) bool."""

    def moved(self, answer: Answer, correction: Values) -> Answer:
        """The answer with a correction (n, 3), m, in its state."""

    def measured(self, answer: Answer) -> GateMeasures:
        """Volumes and energies after the step."""

    def before(self) -> GateMeasures | None:
        """Those before it, without work; None where they are not known."""

    def chosen(self, which: Values, one: Answer, other: Answer) -> Answer:
        """Scenes of ``one`` where ``which`` (B,) holds, else of ``other``, bit for bit."""


@dataclass(frozen=True, eq=False)
class Decision:
    """A network's corrections of B bodies with n nodes in all, and what became of them.

    Attributes
    ----------
    bodies : Bodies
    asked : (n, 3)
        What the network gave, m; zero where that is not finite, or the body, its time step or
        its inputs are unknown.
    reasons : (B,) int64
        Numbers of `Reason`.
    factors : (B,)
        On what it gave, below 1 where a gate limited it.
    """

    bodies: Bodies
    asked: Values
    reasons: Values
    factors: Values

    @classmethod
    def of(
        cls, step: CoarseStep[Answer], view: FeatureView, corrector: Answers, gate: Gate | None
    ) -> Decision:
        """Ask the network, if a gate lets it see one of the scenes."""
        bodies, factors = step.bodies, filled(step.bodies.cell_size, 1.0)
        foreign: Values = int(Reason.NONE)
        if gate is not None:
            foreign = step.own(gate.foreign(corrector, view.bodies))
            if foreign.all():
                nothing = filled(step.own(view.snapshot.proposed), 0.0)
                return cls(bodies, nothing, foreign, factors)
        asked = step.own(corrector.of_view(view))
        reasons = where(bodies.sound(asked), int(Reason.NONE), int(Reason.NOT_FINITE))
        if gate is not None:
            unknown = step.own(gate.unknown(corrector, view)) & (reasons == 0)
            reasons = where(unknown, int(Reason.FEATURES), reasons)
            folded = step.own(gate.folded(corrector, view)) & (reasons == 0)
            reasons = where(folded, int(Reason.FOLDED), reasons)
            reasons = where(foreign > 0, foreign, reasons)
        asked = where(bodies.by_node(reasons == 0)[:, None], asked, 0.0)
        return cls(bodies, asked, reasons, factors)

    @cached_property
    def counts(self) -> Values:
        """Whether a body's correction is applied and not zero, (B,): else nothing changes."""
        return (self.reasons == 0) & self.bodies.some(self.asked != 0.0)

    @property
    def correction(self) -> Values:
        """As applied, (n, 3), m; zero where it was refused."""
        return self.scaled(where(self.reasons == 0, self.factors, 0.0))

    def scaled(self, factors: Values) -> Values:
        """What the network gave times (B,)."""
        return self.asked * self.bodies.by_node(factors)[:, None]

    def refused(self, reasons: Values) -> Decision:
        """With reasons (B,) that were found for corrections that count."""
        return replace(self, reasons=where(self.counts, reasons, self.reasons))

    def paused(self, left: Values | None) -> Decision:
        """With those refused that would pass while the gate is shut, for (B,) steps more."""
        if left is None:
            return self
        shut = (left > 0) & (self.reasons == 0)
        return replace(self, reasons=where(shut, int(Reason.PAUSE), self.reasons))

    def failed_in_pause(self, ok: Values) -> Decision:
        """With the solver's reason where a step (B,) failed while the gate was shut."""
        failed = (self.reasons == Reason.PAUSE) & ~ok
        return replace(self, reasons=where(failed, int(Reason.SOLVER), self.reasons))

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
            factors = where(failed, 0.5 * factors, factors)
            moved = step.moved(coarse, self.scaled(factors))
            reasons = gate.reasons(step.measured(moved), beside, gate.energy)
        return replace(self.refused(reasons), factors=factors), moved


def corrected_step(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None, left: Values | None = None
) -> tuple[Answer, Answer, Decision]:
    """The answer of a corrected step, the coarse solver's, and the decision.

    ``left`` (B,) is for how many steps more the gate is shut; None where it is open.

    Scenes whose correction is zero or refused have the plain coarse answer bit for bit.  With
    placement "state" the coarse solver's is always that; else it is the answer itself.
    """
    if corrector.config.placement == "state":
        return _state(step, corrector, gate, left)
    view = step.view(None)
    decision = Decision.of(step, view, corrector, gate)
    if corrector.config.placement == "guess":
        decision = decision.paused(left)
    if not decision.counts.any():
        answer, decision = step.solved(), decision.paused(left)
    elif corrector.config.placement == "force":
        answer, decision = _force(step, decision, gate, left)
    else:
        answer, decision = _guess(step, decision, step.own(view.snapshot.proposed))
    if left is not None:
        decision = decision.failed_in_pause(step.ok(answer))
    return answer, answer, decision


def _state(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None, left: Values | None
) -> tuple[Answer, Answer, Decision]:
    coarse = step.solved()
    decision = Decision.of(step, step.view(coarse), corrector, gate)
    reasons = where(step.ok(coarse), decision.reasons, int(Reason.SOLVER))
    decision = replace(decision, reasons=reasons)
    if not decision.counts.any():
        return coarse, coarse, decision.paused(left)
    if gate is not None and gate.judges:
        decision, moved = decision.judged(gate, step, coarse)
    else:
        moved = step.moved(coarse, decision.correction)
    decision = decision.paused(left)
    return step.chosen(decision.counts, moved, coarse), coarse, decision


def _force(
    step: CoarseStep[Answer], decision: Decision, gate: Gate | None, left: Values | None
) -> tuple[Answer, Decision]:
    forced = step.solved(added=decision.correction)
    ok, measured = step.ok(forced), None
    reasons = where(ok, int(Reason.NONE), int(Reason.SOLVER))
    if gate is not None and gate.judges:
        measured, before = step.measured(forced), step.before()
        rise = None if gate.energy is None else 0.0
        found = filled(reasons, int(Reason.ENERGY))
        found = found if before is None else gate.reasons(measured, before, rise)
        reasons = where(ok, found, reasons)
    unused = reasons > 0 if left is None else (reasons > 0) | (left > 0)
    if not (decision.counts & unused).any():
        return forced, decision.paused(left)
    plain = step.solved()
    if gate is not None and measured is not None:
        found = gate.reasons(measured, step.measured(plain), gate.energy)
        found = where(step.ok(plain), found, int(Reason.SOLVER))
        reasons = where(ok & (reasons > 0), found, reasons)
    decision = decision.refused(reasons).paused(left)
    return step.chosen(decision.counts, forced, plain), decision


def _guess(
    step: CoarseStep[Answer], decision: Decision, proposed: Values
) -> tuple[Answer, Decision]:
    at_nodes = decision.bodies.by_node(decision.counts)[:, None]
    guess = where(at_nodes, proposed + decision.correction, math.nan)
    guessed = step.solved(guess=guess)
    failed = decision.counts & ~step.ok(guessed)
    if not failed.any():
        return guessed, decision
    decision = decision.refused(where(failed, int(Reason.SOLVER), int(Reason.NONE)))
    return step.chosen(decision.counts, guessed, step.solved()), decision
