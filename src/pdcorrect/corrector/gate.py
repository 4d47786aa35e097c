"""`Gate`: corrections that are better not applied.

A refused correction counts as zero: the step is the plain coarse one.  Corrections that are
not finite, and those of steps that the coarse solver failed, are refused without a gate too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, ClassVar

from pydantic import Field

from pdcorrect._config import Checked, NonNegative
from pdcorrect.corrector.placements import Values, where
from pdcorrect.errors import InputError


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
    """When a correction is refused; None switches a test off.  Each step is judged by itself.

    The body at rest and the time step are tested first: a scene that is refused by them is so in
    every step, and where all are the network is not asked.  Cells and energy are tested on
    corrected answers (placement "state") and on those under corrected loads ("force"), against
    the plain coarse answer of the same step; where only the first iterate is corrected ("guess"),
    the answer is the coarse solver's anyway.

    To save the plain step, an answer under corrected loads is first held against the state
    before the step: if no cell fails beside what it was, and the loads have done at least the
    work by which the energy rose, it stands.  In batches of elements with internal modes the
    plain step is always solved.

    Attributes
    ----------
    outside
        Refused if the out-of-distribution score of body, time step and inputs is more than this,
        see `pdcorrect.corrector.envelope.Envelope`.
    crushing
        Refused if in any cell the smallest det F at the quadrature points, of the nodes'
        displacements, is not positive, or below this multiple of the coarse answer's, where that
        is positive; unless it is no smaller than in the same cell of the coarse answer.  Zero is
        a test of inversion alone.
    energy
        Refused if kinetic and elastic energy less the work of the scene's loads in the step is
        higher than after the coarse step by more than this multiple of the step's energy:
        kinetic and elastic energy after the coarse step and the magnitude of the loads' work
        in it.  Nothing in the bound depends on the correction, and the forces of corrections
        are no loads.  A bound against single jumps, and a wide one: where the coarse mass rule
        makes nodes r times too heavy, the right answer to a kick rises by (r - 1)²/3, if all are,
        and single nodes may move farther still: with the published rule 6.4 was measured beside a
        4x4x4 reference (r = 4.1 at corners).

    Raises
    ------
    InputError
        If a value is not what is expected, or there is no such test.
    """

    outside: NonNegative | None = 1.0
    crushing: Annotated[float, Field(strict=True, ge=0, lt=1)] | None = 0.1
    energy: NonNegative | None = 8.0

    source: ClassVar[str] = "gate"

    def reasons(self, answer: GateMeasures, coarse: GateMeasures, rise: float | None) -> Values:
        """Reasons (B,) to refuse an answer beside another one, which is the coarse one.

        ``rise`` takes the place of ``energy``.  What is not a number does not pass.
        """
        reasons: Values = int(Reason.NONE)
        if rise is not None:
            cap = coarse.stored - coarse.work + rise * (coarse.stored + abs(coarse.work))
            reasons = where(answer.stored - answer.work <= cap, reasons, int(Reason.ENERGY))
        if self.crushing is not None:
            bound = self.crushing * where(coarse.ratios < 0.0, 0.0, coarse.ratios)
            good = (answer.ratios > 0.0) & (answer.ratios >= bound)
            worse = ~good & ~(answer.ratios >= coarse.ratios)
            reasons = where(worse.any(axis=1), int(Reason.INVERSION), reasons)
        return reasons

    @property
    def judges(self) -> bool:
        """Whether it looks at the answers."""
        return self.crushing is not None or self.energy is not None


def check_gate(gate: object) -> None:
    """Refuse what is no gate.

    Raises
    ------
    InputError
    """
    if gate is not None and not isinstance(gate, Gate):
        raise InputError(f"gate is a {type(gate).__name__}: expected a Gate(...) or None.")
