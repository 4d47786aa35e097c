"""The sentences about what a gate refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch_geometric")

import torch

import pdcorrect as pc
from hybrid_samples import fitted, problems
from pdcorrect.evaluation import refusal_text
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.foreign import (
    ForeignMeasure,
    ForeignStep,
    foreign_measures,
    foreign_step,
)
from pdcorrect.corrector.gate import Gate, Reason, refusals
from pdcorrect.corrector.refusal_watch import Refused
from pdcorrect.corrector.shapes import SHAPE_MEASURES, plain_measures
from pdcorrect.corrector.unknown_inputs import UnknownInput
from pdcorrect.evaluation.refusal_text import by_name, refused_corrections, refused_rollouts

ROOT = Path(__file__).parent.parent
BODY, STEP, FEATURES = int(Reason.BODY), int(Reason.TIME_STEP), int(Reason.FEATURES)
NODES = ForeignMeasure("nodes", 1, 45.0, 45.0, 225.0, 513.0, 1.6, 0.3)
LONG = ForeignMeasure("largest radius", 1, 17.72, 17.72, 2.5, 12.4, 0.4, 0.3)
TWICE = ForeignStep(0.02, 2.0, "0.01 s", 0.1)
LOAD = UnknownInput("load", 0, False, 3.21, 1.0, 0.25, 9.0, -1.0, 1.0)
MEAN = UnknownInput("stiffness", 0, True, np.inf, 4.5, 1.0, 9.0, -1.0, 1.0)


def headings(path):
    """Ends of links to a page's headings."""
    lines = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", line).strip().lower().replace(" ", "-") for line in lines}


def test_the_pages_have_the_sections_that_refusals_lead_to():
    page = headings(ROOT / refusal_text.PAGE)
    assert set(refusal_text.SECTIONS.values()) <= page
    assert len(set(refusal_text.SECTIONS.values())) == 3
    path, section = refusal_text._NAMES.split("#")
    assert section in headings(ROOT / path)


def test_every_reason_of_a_gate_has_a_meaning():
    assert list(refusal_text._MEANINGS) == list(refusals([]))
    assert refusal_text.SECTIONS.keys() == refusal_text._WITHOUT_BOUND.keys()


def test_gates_without_the_bounds_that_are_named_have_none():
    for bounds in refusal_text._WITHOUT_BOUND.values():
        names = [bound.removesuffix("=None") for bound in bounds.split(", ")]
        gate = Gate(**dict.fromkeys(names))
        assert all(getattr(gate, name) is None is not getattr(Gate(), name) for name in names)


def test_of_runs_in_which_nothing_was_refused_nothing_is_told():
    for refused in (None, Refused(step=TWICE)):
        assert refused_corrections([0.0, 0.0], refused) == []
        assert refused_rollouts([(0, [0, 0])], refused) == []
    assert refused_corrections([]) == refused_rollouts([]) == []


def test_a_body_is_told_by_its_measures_with_units_the_farthest_first():
    counted, body, way = refused_corrections([BODY] * 2, Refused(measures=(NODES, LONG)))
    assert counted == "2 of 2 corrections were refused by the gate (2 by body)."
    assert body.endswith(
        "bound (0.3, of most measures a factor of 1.35): nodes 45 (in training 225 to 513), "
        "largest radius 17.7 cells (in training 2.5 to 12.4 cells)."
    )
    assert body.startswith("Measures of the body at rest that lie outside of the training by")
    link = f"{refusal_text.PAGE}#{refusal_text.SECTIONS['body']}"
    assert way.startswith(f"Expected a body like those of the training ({link}); or, at your own")
    assert "a gate without this bound, Gate(body=None), or none (--no-gate)." in way


@pytest.mark.parametrize(
    ("factor", "told"),
    [(2.0, "2.0 times"), (0.5, "0.5 times"), (1.111, "1.1 times"), (0.001, "0.001 times"),
     (123.4, "1.2e+02 times")],
)  # fmt: skip
def test_a_time_step_is_told_by_its_factor(factor, told):
    step = ForeignStep(0.02, factor, "0.005 to 0.01 s", 0.1)
    _, text, way = refused_corrections([STEP], Refused(step=step))
    assert f"The time step per cell size is {told} that of the training: 0.02 s, where the" in text
    assert "the training has 0.005 to 0.01 s for cells of this size; the gate's bound is a" in text
    assert "Expected a time step of 0.005 to 0.01 s (" in way


def test_a_time_step_of_which_the_training_s_is_not_known_is_told_so():
    _, text, way = refused_corrections(
        [STEP], Refused(step=ForeignStep(0.02, np.nan, "not known", 0.1))
    )
    assert text.startswith("The time step is 0.02 s, and that of the training is not known")
    assert "Expected the time step of the training (" in way


def test_a_body_where_those_of_the_training_are_not_known_is_told_without_measures():
    unknown = [replace(x, low=np.nan, high=np.nan) for x in (NODES, LONG)]
    _, text, way = refused_corrections([BODY], Refused(measures=tuple(unknown)))
    assert text == "The bodies of the training are not known: the gate refuses any body at rest."
    assert way.startswith("Expected a body like those of the training (")


def test_body_and_time_step_are_told_together_where_both_are_refused():
    both = Refused(measures=(NODES,), step=TWICE)
    reasons = [BODY, BODY, int(Reason.SOLVER)]
    counted, body, step, meaning, way = refused_corrections(reasons, both)
    assert "3 of 3 corrections were refused by the gate" in counted
    assert "2 by body and time step" in counted
    assert "1 by solver" in counted
    assert body.startswith("Measures")
    assert step.startswith("The time step")
    assert meaning == "Of the refusals, 'solver': the coarse step itself failed."
    assert way.count(f"{refusal_text.PAGE}#") == 2
    assert "without these bounds, Gate(body=None, time_step=None), or none" in way


def test_inputs_are_told_by_name_and_share_and_means_apart():
    pause = int(Reason.PAUSE)
    told = refused_corrections([0, FEATURES, pause], Refused(inputs=(LOAD, MEAN), frame=2))
    counted, values, means, rest, way = told
    assert counted == "2 of 3 corrections were refused by the gate (1 by features, 1 by pause)."
    assert "range in frame 2, in deviations of which the gate allows 1: load by 3.21 at" in values
    assert values.endswith("at 25 % of the nodes.")
    assert means.endswith("in deviations of which the gate allows 4.5: stiffness by no number.")
    assert rest == (
        "Of the refusals, 'pause': it would have passed, too soon after one that did not."
    )
    assert refusal_text.SECTIONS["features"] in way
    assert "Gate(margin=None, average=None)" in way


def test_reasons_of_which_no_more_is_known_have_their_meaning():
    (_, meaning, way) = refused_corrections([FEATURES])
    assert meaning == (
        "Of the refusals, 'features': the network's inputs are unlike those of its training."
    )
    assert way.startswith("Expected materials, loads and motions like those of the training (")
    assert len(refused_corrections([int(Reason.ENERGY), 0])) == 2  # no way on


def test_what_is_refused_without_a_gate_is_not_said_to_be_by_one():
    counted, _ = refused_corrections([int(Reason.NOT_FINITE), 0])
    assert counted == "1 of 2 corrections were refused (1 by not finite)."


def test_of_rollouts_those_refused_as_a_whole_and_steps_of_the_others_are_counted():
    refused = Refused(measures=(ForeignMeasure("supported", 2, 0.08, 0.09, 0.02, 0.04, 0.8, 0.3),))
    whole, others, body, meaning, way = refused_rollouts(
        [(BODY, [BODY] * 3), (BODY, [BODY] * 3), (0, [0, FEATURES, 7]), (0, [0, 0])], refused
    )
    assert whole.startswith("2 of 4 rollouts were refused in all steps by the gate (2 by body),")
    assert others == (
        "Of the 5 steps of the other rollouts 2 were refused by the gate (1 by features, 1 by "
        "pause)."
    )
    assert body.startswith("Measures of bodies at rest")
    assert body.endswith("supported 8 to 9 % (in training 2 to 4 %).")
    assert meaning.startswith("Of the refusals, 'features': ")
    assert "'pause': " in meaning
    assert way.count("docs/results.md#") == 2
    (alone, *_) = refused_rollouts([(0, [FEATURES, 0])])
    assert alone.startswith("Of the 2 steps of all rollouts 1 were refused by the gate")


def test_the_same_sentence_of_several_is_told_once_after_what_is_of_each():
    told = by_name({"a": ["Count.", "Own of a.", "Way."], "b": ["Count.", "Own of b.", "Way."]})
    assert told == ["a, b: count.", "a: own of a.", "b: own of b.", "a, b: way."]
    assert by_name({"a": []}) == by_name({}) == []


# --- where they come from ----------------------------------------------------------------------


def test_measures_are_told_without_their_logarithms():
    body = BodyGraph.of(problems((4, 2, 2)), dtype=torch.float64)
    found = dict(zip(SHAPE_MEASURES, plain_measures(body.shapes.numpy())[0], strict=True))
    assert found["nodes"] == pytest.approx(45)
    assert found["supported"] == pytest.approx(9 / 45)
    assert found["fixity"] == pytest.approx(1.0)
    assert found["volume to surface"] == pytest.approx(16 / 40)
    assert found["distance"] == pytest.approx(2.0)  # of nodes at 0 to 4 cells
    assert found["spread"] == pytest.approx(np.sqrt(4 / 3))
    assert found["overhang"] == pytest.approx(2.0 / np.sqrt(2.0 + 2 * 2 / 3))
    assert found["largest radius"] == pytest.approx(np.sqrt(2.0))


def test_measures_of_several_bodies_are_those_of_the_refused_ones():
    known, long, longer = problems((3, 1, 1), (9, 1, 1), (12, 1, 1))
    corrector, gate = fitted([known]), Gate()
    shapes = BodyGraph.of([known, long, longer], dtype=torch.float64).shapes
    found = {x.name: x for x in foreign_measures(gate, corrector.normaliser, shapes)}
    far = [x.excess for x in found.values()]
    assert far == sorted(far, reverse=True)
    nodes = found["nodes"]
    assert (nodes.bodies, round(nodes.least), round(nodes.most)) == (2, 40, 52)
    assert nodes.low == nodes.high == pytest.approx(16)
    assert nodes.excess == pytest.approx(np.log(52 / 16))
    assert foreign_measures(gate, corrector.normaliser, shapes[:1]) == ()
    assert foreign_measures(gate, corrector.normaliser, shapes[:0]) == ()
    for other in (None, Gate(body=None), Gate(body=10.0)):
        assert foreign_measures(other, corrector.normaliser, shapes) == ()
    alone = pc.HybridStepper(pc.ProjectiveDynamics(longer), corrector).body_excess()
    assert found.keys() == {name for name, x in alone.items() if x > 0.3}


def test_a_time_step_is_compared_with_the_nearest_end_of_the_range():
    normaliser = fitted(problems((3, 1, 1))).normaliser  # 0.01 s on cells of 2 cm
    normaliser.time_step_high += np.log(2.0)
    for step, factor in ((0.04, 2.0), (0.005, 0.5), (0.0221, None), (0.015, None)):
        found = foreign_step(Gate(), normaliser, step, 0.02)
        assert (None if found is None else pytest.approx(found.factor)) == factor
        assert found is None or found.trained == "0.01 to 0.02 s"
    assert foreign_step(Gate(), normaliser, 0.04, 0.04) is None
    for gate in (None, Gate(time_step=None)):
        assert foreign_step(gate, normaliser, 0.04, 0.02) is None
    normaliser.time_step_low[:] = torch.nan
    assert np.isnan(foreign_step(Gate(), normaliser, 0.01, 0.02).factor)
