"""`RefusalWatch`: what a hybrid's gate refuses while it steps, for those who tell of it."""

from __future__ import annotations

from dataclasses import dataclass

from pdcorrect.corrector.foreign import (
    ForeignMeasure,
    ForeignStep,
    foreign_measures,
    foreign_step,
)
from pdcorrect.corrector.gate import Reason
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.unknown_inputs import UnknownInput
from pdcorrect.state import State, StepResult


@dataclass(frozen=True)
class Refused:
    """What lies outside of a model's training in a run, or in several, that its gate refused.

    Attributes
    ----------
    measures : tuple of ForeignMeasure
        Of the body at rest; empty if it is not refused.
    step : ForeignStep or None
        None if the time step is not refused.
    inputs : tuple of UnknownInput
        Of the first step that was refused by them; empty if there is none, or it is not known.
    frame : int
        That step, from 1.
    """

    measures: tuple[ForeignMeasure, ...] = ()
    step: ForeignStep | None = None
    inputs: tuple[UnknownInput, ...] = ()
    frame: int = 0


class RefusalWatch:
    """Sees the steps of one run; of the first that its inputs refuse it asks which these are.

    Parameters
    ----------
    hybrid : HybridStepper
    state : State
        Before the first step that is seen.
    frame : int
        Of that state.
    """

    def __init__(self, hybrid: HybridStepper, state: State, frame: int = 0) -> None:
        self._hybrid, self._state, self._frame = hybrid, state, frame
        bodies, normaliser = hybrid.bodies, hybrid.corrector.normaliser
        h, c = float(bodies.time_step), float(bodies.cell_size)
        self._measures = foreign_measures(hybrid.gate, normaliser, bodies.shapes)
        self._step = foreign_step(hybrid.gate, normaliser, h, c)
        self._inputs: tuple[UnknownInput, ...] = ()
        self._first = 0

    def add(self, result: StepResult) -> None:
        """Take in the next step."""
        self._frame += 1
        if not self._inputs and result.stats["gate"] == Reason.FEATURES:
            self._inputs = tuple(self._hybrid.unknown_inputs(self._state))
            self._first = self._frame
        self._state = result.state

    @property
    def refused(self) -> Refused:
        """What was refused so far."""
        return Refused(self._measures, self._step, self._inputs, self._first)
