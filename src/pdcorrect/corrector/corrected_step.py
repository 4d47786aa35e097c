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

Answer = TypeVar("Answer")
"""A coarse solver's result of a step of B scenes."""


class Bodies(Protocol):
    """What a decision asks about B bodies with n nodes in all."""

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
    """A network's corrections of B bodies with n nodes in all, and which of them count.

    Attributes
    ----------
    bodies : Bodies
    correction : (n, 3)
        As applied, m; zero where it was refused.
    reasons : (B,) int64
        Numbers of `Reason`.
    """

    bodies: Bodies
    correction: Values
    reasons: Values

    @classmethod
    def of(
        cls, step: CoarseStep[Answer], view: FeatureView, corrector: Answers, gate: Gate | None
    ) -> Decision:
        """Ask the network, if a gate lets it see one of the scenes."""
        bound = None if gate is None else gate.outside
        if bound is not None:
            outside = step.own(corrector.rest_score(view.bodies) > bound)
            if outside.all():
                nothing = filled(step.own(view.snapshot.proposed), 0.0)
                return cls(step.bodies, nothing, where(outside, int(Reason.OUTSIDE), 0))
        asked = step.own(corrector.of_view(view))
        reasons = where(step.bodies.sound(asked), int(Reason.NONE), int(Reason.NOT_FINITE))
        if bound is not None:
            outside = step.own(corrector.score(view) > bound)
            reasons = where(outside, int(Reason.OUTSIDE), reasons)
        return cls(step.bodies, asked, reasons)._without_refused()

    @cached_property
    def counts(self) -> Values:
        """Whether a body's correction is applied and not zero, (B,): else nothing changes."""
        return self.bodies.some(self.correction != 0.0)

    def refused(self, reasons: Values) -> Decision:
        """With reasons (B,) that were found for corrections that count."""
        found = where(self.counts, reasons, self.reasons)
        return replace(self, reasons=found)._without_refused()

    def _without_refused(self) -> Decision:
        passed = self.bodies.by_node(self.reasons == Reason.NONE)[:, None]
        return replace(self, correction=where(passed, self.correction, 0.0))


def corrected_step(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None
) -> tuple[Answer, Answer, Decision]:
    """The answer of a corrected step, the coarse solver's, and the decision.

    Scenes whose correction is zero or refused have the plain coarse answer bit for bit.  With
    placement "state" the coarse solver's is always that; else it is the answer itself.
    """
    placement = corrector.config.placement
    if placement == "state":
        return _state(step, corrector, gate)
    view = step.view(None)
    decision = Decision.of(step, view, corrector, gate)
    if not decision.counts.any():
        answer = step.solved()
    elif placement == "force":
        answer, decision = _force(step, decision, gate)
    else:
        answer, decision = _guess(step, decision, step.own(view.snapshot.proposed))
    return answer, answer, decision


def _state(
    step: CoarseStep[Answer], corrector: Answers, gate: Gate | None
) -> tuple[Answer, Answer, Decision]:
    coarse = step.solved()
    decision = Decision.of(step, step.view(coarse), corrector, gate)
    failed = where(step.ok(coarse), decision.reasons, int(Reason.SOLVER))
    decision = replace(decision, reasons=failed)._without_refused()
    if not decision.counts.any():
        return coarse, coarse, decision
    moved = step.moved(coarse, decision.correction)
    if gate is not None and gate.judges:
        found = gate.reasons(step.measured(moved), step.measured(coarse), gate.energy)
        decision = decision.refused(found)
    return step.chosen(decision.counts, moved, coarse), coarse, decision


def _force(
    step: CoarseStep[Answer], decision: Decision, gate: Gate | None
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
    if not (decision.counts & (reasons > 0)).any():
        return forced, decision
    plain = step.solved()
    if gate is not None and measured is not None:
        found = gate.reasons(measured, step.measured(plain), gate.energy)
        found = where(step.ok(plain), found, int(Reason.SOLVER))
        reasons = where(ok & (reasons > 0), found, reasons)
    decision = decision.refused(reasons)
    return step.chosen(decision.counts, forced, plain), decision


def _guess(
    step: CoarseStep[Answer], decision: Decision, proposed: Values
) -> tuple[Answer, Decision]:
    at_nodes = decision.bodies.by_node(decision.counts)[:, None]
    guessed = step.solved(guess=where(at_nodes, proposed + decision.correction, math.nan))
    ok = step.ok(guessed)
    if not (decision.counts & ~ok).any():
        return guessed, decision
    decision = decision.refused(where(ok, int(Reason.NONE), int(Reason.SOLVER)))
    return step.chosen(decision.counts, guessed, step.solved()), decision
