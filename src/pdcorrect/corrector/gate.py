"""`Gate`: corrections that are better not applied.

A refused correction counts as zero: the step is the plain coarse one.  Corrections that are
not finite, and those of steps that the coarse solver failed, are refused without a gate too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, ClassVar

import torch
from pydantic import Field

from pdcorrect._config import Checked, NonNegative, Number
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Answers, Corrector
from pdcorrect.corrector.features import FeatureView
from pdcorrect.corrector.placements import Values, where
from pdcorrect.errors import InputError


class Reason(IntEnum):
    """Why a correction was refused; 0 where it was not."""

    NONE = 0
    NOT_FINITE = 1
    FEATURES = 2
    INVERSION = 3
    ENERGY = 4
    SOLVER = 5
    BODY = 6
    PAUSE = 7
    FOLDED = 8
    TIME_STEP = 9

    @property
    def meaning(self) -> str:
        """The end of a sentence: a correction is refused because ..."""
        return _MEANINGS[self]


_MEANINGS = {
    Reason.NONE: "it was not",
    Reason.NOT_FINITE: "the network's answer is not a number",
    Reason.FEATURES: "the network's inputs are outside of its training",
    Reason.INVERSION: "cells of the corrected state are crushed or inverted",
    Reason.ENERGY: "the corrected state has more energy than the loads account for",
    Reason.SOLVER: "the coarse step failed",
    Reason.BODY: "the body is outside of the training",
    Reason.PAUSE: "a step shortly before was refused",
    Reason.FOLDED: "a cell is folded at a corner",
    Reason.TIME_STEP: "the time step over the cell size is outside of the training",
}


@dataclass(frozen=True)
class Refusal:
    """Steps whose corrections were refused for one reason."""

    reason: Reason
    steps: int


def refusals(reasons: Iterable[float]) -> tuple[Refusal, ...]:
    """What was refused in the steps of a run, most frequent first.

    Parameters
    ----------
    reasons : iterable of numbers of `Reason`
        Of each step, such as ``run.stats["gate"]``.
    """
    counts = Counter(Reason(int(number)) for number in reasons if number > 0)
    return tuple(Refusal(reason, steps) for reason, steps in counts.most_common())


@dataclass(frozen=True, eq=False)
class GateMeasures:
    """What a gate looks at in the states of B scenes after a step, or before it.

    Arrays or tensors.

    Attributes
    ----------
    ratios : (B, C)
        Smallest det F of each cell, of the nodes' displacements; infinite in padding.
    stored : (B,)
        Kinetic and elastic energy, J.
    work : (B,)
        Of the scene's loads since the step began, J, without the forces of corrections.
    """

    ratios: Values
    stored: Values
    work: Values


class Gate(Checked):
    """When a correction is refused; None switches a test off.

    The body at rest is tested first, and the time step: a scene that is refused by them is so in
    every step, and where all are the network is not asked.  Its inputs are tested before any
    placement.  Volumes and energy are tested on corrected answers (placement "state") and on those
    under corrected loads ("force"), against the plain coarse answer of the same step; where only
    the first iterate is corrected ("guess"), the answer is the coarse solver's anyway.

    To save the plain step, an answer under corrected loads is first held against the state
    before the step: if no cell fails by ``volume`` and ``crushing`` beside what it was, and
    the loads have done at least the work by which the energy rose, it stands.  In batches
    of elements with internal modes the plain step is always solved.

    Attributes
    ----------
    body
        Refused in all steps if a measure of the body's size, slenderness, ratio of volume to
        surface or supports at rest (`pdcorrect.corrector.shapes.shape_measures`) lies farther than
        this outside its range in training.  Most are logarithms: 0.3 is a factor of 1.35.  Ranges
        are separate: what is unlike by a combination of them, or by where a body branches, passes.
    time_step
        Refused in all steps if the logarithm of the time step over the cell size, h/c in s/m, lies
        farther than this outside its range in training: 0.1 is a factor of 1.1.  Networks of frame
        features see stiffness as E h²/(rho c²) and loads as f h²/(m c), so that of one material a
        body of half the cell size is to them one of twice the time step, and scaled alike in both
        the same body.  A stiffer material with a shorter step may be a known body to them and is
        refused here all the same.  Quasi-static steps, which are increments of loads, are held to
        those of the training, too.
    margin, share
        Refused if more than this share of a body's nodes has inputs, or an edge with inputs,
        that lie more than ``margin`` deviations outside the range of the training data, of which
        the farthest value on that side counts as 3.5 at most: where one is farther from the mean,
        as of inputs that are large in few steps, a margin of 1 is 2/7 of its distance.
    average
        Refused if the mean of an input over a body's nodes is farther than this from its mean in
        training, in deviations of such means there, of which the farthest of them counts as 3.5
        at most: a body whose every node is somewhere in what was seen may yet move as none did.
        For inputs that are large in few steps, as in kicks, that is a test of their range.
    corners
        Refused if det F at a corner of a cell is not above this bound in what the network sees as
        the positions after the step: the coarse answer, or, before it is solved ("force",
        "guess"), where inertia and loads alone would lead.  What a correction makes of them is not
        tested.  A cell may be folded at a corner while det F is positive at all its quadrature
        points; corrections may pass all other tests there, and those that do may hold the body
        out of balance.  Others are right: bodies fold and unfold.
    volume
        Refused if in any cell the smallest det F at the quadrature points, of the nodes'
        displacements, is not above this bound, unless it is no smaller than in the same cell
        of the coarse answer.
    crushing
        Refused if in any cell it is below this multiple of the coarse answer's, where that is
        positive.
    energy
        Refused if kinetic and elastic energy less the work of the scene's loads in the step is
        higher than after the coarse step by more than this multiple of the step's energy:
        kinetic and elastic energy after the coarse step and the magnitude of the loads' work
        in it.  Nothing in the bound depends on the correction, and the forces of corrections
        are no loads.  A bound against single jumps, and a wide one: where the coarse mass rule
        makes nodes r times too heavy, the right answer to a kick rises by (r - 1)²/3, if all are,
        and single nodes may move farther still: with the published rule 6.4 was measured beside a
        4x4x4 reference (r = 4.1 at corners).
    limit
        Whether a correction that fails by volume or energy is halved, up to six times, until it
        passes, and refused only then; for placement "state".
    pause
        After a step that is refused, corrections count again after so many steps in a row that
        would have passed: what was applied before is one half of a motion of which the gate does
        not know the other.  The count is kept in `State.memory` while it lasts.  Zero: each step
        is judged for itself.

    Raises
    ------
    InputError
        If a value is not what is expected, or there is no such test.
    """

    body: NonNegative | None = 0.3
    time_step: NonNegative | None = 0.1
    margin: NonNegative | None = 1.0
    share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.05
    average: NonNegative | None = 4.5
    corners: Number | None = None
    volume: Number | None = 0.0
    crushing: Annotated[float, Field(strict=True, ge=0, lt=1)] | None = 0.1
    energy: NonNegative | None = 8.0
    limit: bool = False
    pause: Annotated[int, Field(strict=True, ge=0)] = 5

    source: ClassVar[str] = "gate"

    def foreign(self, corrector: Answers, bodies: BodyGraph) -> Values:
        """Why scenes are refused in all steps, by their bodies at rest or time steps.

        Numbers (B,) of `Reason`, 0 where they are not; that of the body where both are unlike those
        of the training.

        Parameters
        ----------
        corrector : Answers
            Which knows the ranges of its training.
        bodies : BodyGraph
            B, one for each scene.
        """
        reasons: Values = torch.zeros_like(bodies.cell_size, dtype=torch.int64)
        if self.time_step is not None:
            beyond = corrector.time_step_excess(bodies) > self.time_step
            reasons = where(beyond, int(Reason.TIME_STEP), reasons)
        if self.body is not None:
            beyond = corrector.shape_excess(bodies) > self.body
            reasons = where(beyond, int(Reason.BODY), reasons)
        return reasons

    def unknown(self, corrector: Answers, view: FeatureView) -> Values:
        """Whether the network's inputs are too far from its training data, (B,) bool, or False."""
        found: Values = False
        if self.margin is not None:
            found = found | (corrector.outside(view, self.margin) > self.share)
        if self.average is not None:
            found = found | (corrector.unlike(view) > self.average)
        return found

    def folded(self, corrector: Answers, view: FeatureView) -> Values:
        """Whether bodies are folded at a corner in what the network sees, (B,) bool, or False.

        What is not a number counts as folded.
        """
        if self.corners is None:
            return False
        return ~(corrector.least_corners(view) > self.corners)

    def reasons(self, answer: GateMeasures, coarse: GateMeasures, rise: float | None) -> Values:
        """Reasons (B,) to refuse an answer beside another one, which is the coarse one.

        ``rise`` takes the place of ``energy``.  What is not a number does not pass.
        """
        reasons: Values = int(Reason.NONE)
        if rise is not None:
            cap = coarse.stored - coarse.work + rise * (coarse.stored + abs(coarse.work))
            reasons = where(answer.stored - answer.work <= cap, reasons, int(Reason.ENERGY))
        below: Values = False
        if self.volume is not None:
            below = ~(answer.ratios > self.volume)
        if self.crushing is not None:
            bound = self.crushing * where(coarse.ratios < 0.0, 0.0, coarse.ratios)
            below = below | ~(answer.ratios >= bound)
        worse = below & ~(answer.ratios >= coarse.ratios)
        return where(worse.any(axis=1), int(Reason.INVERSION), reasons)

    def steps_shut(self, reasons: Values, left: Values | None) -> Values:
        """For how many steps it stays shut after one, (B,).

        Parameters
        ----------
        reasons : (B,)
            Of the step.
        left : (B,), optional
            For how many it was to stay shut before the step; by default it was open.
        """
        again = reasons != Reason.NONE
        for lasting in (Reason.PAUSE, Reason.BODY, Reason.TIME_STEP):
            again = again & (reasons != lasting)
        return where(again, self.pause, 0 if left is None else (left - 1).clip(min=0))

    @property
    def judges(self) -> bool:
        """Whether it looks at the answers."""
        return any(bound is not None for bound in (self.volume, self.crushing, self.energy))


def check_gate(gate: object, corrector: Corrector) -> None:
    """Refuse what is no gate, and limits where there is nothing to scale.

    Raises
    ------
    InputError
    """
    if gate is None:
        return
    if not isinstance(gate, Gate):
        raise InputError(f"gate is a {type(gate).__name__}: expected a Gate(...) or None.")
    placement = corrector.config.placement
    if gate.limit and placement != "state":
        raise InputError(
            f"gate.limit with placement {placement!r}: expected placement 'state', whose answers "
            "can be scaled back without solving again."
        )


PAUSE = "gate_pause"
"""For how many steps more a gate is shut, in the memory of states; absent where it is open."""


def steps_left(gate: Gate | None, memory: Mapping[str, Values]) -> Values | None:
    """For how many steps the gate of each scene is shut, (1,) or (B,); None where none is.

    Never for more than its own pause, whichever gate counted before.
    """
    if gate is None or PAUSE not in memory:
        return None
    kept = memory[PAUSE]
    return kept[..., 0, 0].reshape(-1).clip(max=gate.pause)
