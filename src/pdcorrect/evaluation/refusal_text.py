"""What a gate refused, and why, in the sentences that all commands tell it by."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pdcorrect.corrector.foreign import ForeignMeasure, ForeignStep
    from pdcorrect.corrector.refusal_watch import Refused
    from pdcorrect.corrector.unknown_inputs import UnknownInput

PAGE = "docs/results.md"
_NAMES = "docs/corrector.md#graph-and-features"
"""Where the names of inputs are explained."""

SECTIONS = {
    "body": "bodies-unlike-those-of-the-training",
    "time step": "other-time-steps",
    "features": "scenes-unlike-those-of-the-training",
}
"""Where `PAGE` tells of what is refused by a reason, as the ends of links."""

_WITHOUT_BOUND = {
    "body": "body=None", "time step": "time_step=None", "features": "margin=None, average=None",
}  # fmt: skip
"""Of a gate without the tests that refuse by a reason."""

_MEANINGS = {
    "not finite": "the network's answer is not a number",
    "features": "the network's inputs are unlike those of its training",
    "inversion": "cells of the corrected state are crushed or turned inside out",
    "energy": "the corrected state has more energy than the loads account for",
    "solver": "the coarse step itself failed",
    "body": "the body at rest is unlike those of its training",
    "pause": "it would have passed, too soon after one that did not",
    "folded": "a cell is folded at a corner",
    "time step": "the time step over the cell size is unlike that of its training",
}
"""Of the reasons that `pdcorrect.corrector.gate.refusals` names."""

_WITHOUT_GATE = {"not finite", "solver"}
"""Reasons that need no gate."""

_IN_CELLS = ("largest radius", "middle radius", "smallest radius", "distance", "spread")
_SHARES = ("supported", "fixity")
"""Measures of bodies in cell sizes, and shares."""


def refused_corrections(reasons: Iterable[float], refused: Refused | None = None) -> list[str]:
    """How many corrections of a run were refused, why, and the way on; empty if none was.

    Parameters
    ----------
    reasons : iterable of numbers of `Reason`
        Of each step, 0 where it was corrected.
    refused : Refused, optional
        What of the run lies outside of the training; without it only reasons are told.
    """
    every = list(reasons)
    counts = _counts(every)
    if not counts:
        return []
    total = sum(counts.values())
    return [
        f"{total} of {len(every)} corrections were refused{_by_gate(counts)} "
        f"({_listed(counts, refused)}).",
        *_explained(counts, refused),
    ]


def refused_rollouts(
    rollouts: Sequence[tuple[int, Iterable[float]]], refused: Refused | None = None
) -> list[str]:
    """The same of many rollouts: those that were refused in all steps, and steps of the others.

    Parameters
    ----------
    rollouts : sequence
        Of each the number of the `Reason` by which all of its steps are refused (see
        `pdcorrect.evaluation.measures.MeasuredRollout.refused_by`), and those of its steps.
    refused : Refused, optional
        As of `refused_corrections`.
    """
    whole = _counts(one for one, _ in rollouts)
    steps = [reason for one, each in rollouts if not one for reason in each]
    others = _counts(steps)
    told = []
    if whole:
        told.append(
            f"{sum(whole.values())} of {len(rollouts)} rollouts were refused in all steps by the "
            f"gate ({_listed(whole, refused)}), and are those of the coarse model."
        )
    if others:
        of = "the other" if whole else "all"
        told.append(
            f"Of the {len(steps)} steps of {of} rollouts {sum(others.values())} were refused"
            f"{_by_gate(others)} ({_listed(others, refused)})."
        )
    return [*told, *_explained(_counts([*(one for one, _ in rollouts), *steps]), refused)]


def by_name(told: Mapping[str, Iterable[str]]) -> list[str]:
    """Sentences with the names of those that they are told of, each sentence once.

    In the order of their places among a name's sentences; of several names the last place counts.
    """
    names: dict[str, list[str]] = {}
    place: dict[str, int] = {}
    for name, sentences in told.items():
        for number, sentence in enumerate(sentences):
            names.setdefault(sentence, []).append(name)
            place[sentence] = max(number, place.get(sentence, 0))
    ordered = sorted(names.items(), key=lambda item: place[item[0]])
    return [f"{', '.join(each)}: {text[0].lower()}{text[1:]}" for text, each in ordered]


def _counts(reasons: Iterable[float]) -> dict[str, int]:
    """How many refusals there are by each reason, without those that there are none by."""
    from pdcorrect.corrector.gate import refusals

    return {reason: n for reason, n in refusals(reasons).items() if n}


def _by_gate(counts: Mapping[str, int]) -> str:
    return "" if _WITHOUT_GATE.issuperset(counts) else " by the gate"


def _listed(counts: Mapping[str, int], refused: Refused | None) -> str:
    """Numbers by reason; steps record the body's where the time step is refused, too."""
    both = refused is not None and refused.step is not None
    names = {"body": "body and time step"} if both else {}
    return ", ".join(f"{n} by {names.get(reason, reason)}" for reason, n in counts.items())


def _explained(counts: Mapping[str, int], refused: Refused | None) -> list[str]:
    """What was refused by the reasons of some refusals, and the way on."""
    if not counts:
        return []
    known: dict[str, list[str]] = {}
    if refused is not None:
        if "body" in counts and refused.measures:
            known["body"] = [_of_the_body(refused.measures)]
        if refused.step is not None and ("time step" in counts or "body" in counts):
            known["time step"] = [_of_the_step(refused.step)]
        if "features" in counts and refused.inputs:
            known["features"] = _of_the_inputs(refused.inputs, refused.frame)
    rest = [f"'{reason}': {_MEANINGS[reason]}" for reason in counts if reason not in known]
    meanings = [f"Of the refusals, {'; '.join(rest)}."] if rest else []
    return [*(x for each in known.values() for x in each), *meanings, *_way_on(counts, refused)]


def _of_the_body(measures: Sequence[ForeignMeasure]) -> str:
    """Its measures and their ranges in training, the farthest out first."""
    if math.isnan(measures[0].low):
        return "The bodies of the training are not known: the gate refuses any body at rest."
    named = ", ".join(
        f"{x.name} {_span(x.name, x.least, x.most)} (in training {_span(x.name, x.low, x.high)})"
        for x in measures
    )
    bodies = max(x.bodies for x in measures)
    what = "the body" if bodies == 1 else "bodies"
    bound = measures[0].bound
    return (
        f"Measures of {what} at rest that lie outside of the training by more than the gate's "
        f"bound ({bound:g}, of most measures a factor of {math.exp(bound):.3g}): {named}."
    )


def _span(name: str, low: float, high: float) -> str:
    """A measure's values with their unit."""
    factor, unit = 1.0, ""
    if name in _SHARES:
        factor, unit = 100.0, " %"
    elif name in _IN_CELLS:
        unit = " cells"
    whole = name == "nodes"
    ends = dict.fromkeys(f"{factor * x:.0f}" if whole else f"{factor * x:.3g}" for x in (low, high))
    return " to ".join(ends) + unit


def _of_the_step(step: ForeignStep) -> str:
    if math.isnan(step.factor):
        return (
            f"The time step is {step.step:g} s, and that of the training is not known: the gate "
            "refuses any."
        )
    return (
        f"The time step per cell size is {_factor(step.factor)} times that of the training: "
        f"{step.step:g} s, where the training has {step.trained} for cells of this size; the "
        f"gate's bound is a factor of {math.exp(step.bound):.2g}."
    )


def _factor(x: float) -> str:
    """With a digit after the point where it is not far from one."""
    return f"{x:.1f}" if 0.95 <= x < 99.5 else f"{x:.2g}"


def _of_the_inputs(inputs: Sequence[UnknownInput], frame: int) -> list[str]:
    """Of values at nodes and edges and of means one sentence each."""
    values, means = [x for x in inputs if not x.mean], [x for x in inputs if x.mean]
    told = []
    if values:
        named = ", ".join(
            f"{x.name} by {_deviations(x.excess)} at {100.0 * x.share:.0f} % of the nodes"
            for x in values
        )
        told.append(
            f"Inputs ({_NAMES}) outside of the training's range in frame {frame}, in deviations of "
            f"which the gate allows {values[0].bound:g}: {named}."
        )
    if means:
        named = ", ".join(f"{x.name} by {_deviations(x.excess)}" for x in means)
        told.append(
            f"Inputs ({_NAMES}) whose mean over the body is off the training's in frame {frame}, "
            f"in deviations of which the gate allows {means[0].bound:g}: {named}."
        )
    return told


def _deviations(excess: float) -> str:
    """Also where it is not a number."""
    from pdcorrect.evaluation.run_text import three_digits

    return "no number" if math.isinf(excess) else three_digits(excess)


def _way_on(counts: Mapping[str, int], refused: Refused | None) -> list[str]:
    """What a gate would let pass, and how to do without it."""
    step = None if refused is None else refused.step
    expected: dict[str, str] = {}
    if "body" in counts:
        expected["body"] = "a body like those of the training"
    if "time step" in counts or ("body" in counts and step is not None):
        known = step is not None and not math.isnan(step.factor)
        expected["time step"] = (
            f"a time step of {step.trained}" if step is not None and known
            else "the time step of the training"
        )  # fmt: skip
    if "features" in counts:
        expected["features"] = "materials, loads and motions like those of the training"
    if not expected:
        return []
    wanted = " and ".join(f"{x} ({PAGE}#{SECTIONS[name]})" for name, x in expected.items())
    without = ", ".join(_WITHOUT_BOUND[name] for name in expected)
    these = "these bounds" if "," in without else "this bound"
    return [
        f"Expected {wanted}; or, at your own risk, a gate without {these}, Gate({without}), or "
        "none (--no-gate)."
    ]
