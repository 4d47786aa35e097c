"""Gates that know the time step over the cell size of the training."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import pdcorrect as pc
from hybrid_samples import TORSION, Watched, fitted, problems, seen, soft_beam
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector, preset
from pdcorrect.corrector.gate import Gate, Reason, Refusal, refusals
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.normaliser import RunningMoments

H, C = 0.01, 0.02
"""Time step and cell size of the training, s and m."""
ONLY_OUTSIDE = Gate(crushing=None, energy=None)


def logarithms(*steps):
    """Of time steps, s, over the cell size, as a normaliser takes them."""
    found = RunningMoments()
    found.add((torch.tensor(steps, dtype=torch.float64) / C).log()[:, None])
    return found


def ranged(*steps):
    """A corrector that knows some time steps, s, otherwise without values."""
    corrector = Corrector(preset("compact", layers=1, width=8))
    corrector.envelope.fit({"time_step": logarithms(*steps)})
    return corrector


def graph(*steps, dtype=torch.float64):
    """A beam for each time step."""
    bodies = BodyGraph.of([pc.discretise(soft_beam()) for _ in steps], H, dtype=dtype)
    return replace(bodies, time_step=torch.tensor(steps, dtype=dtype))


def stepped(factor, cells=(3, 1, 1)):
    """The twisted beam with another time step."""
    return pc.discretise(soft_beam(cells, loads=[TORSION], time={"step": factor * H, "frames": 4}))


# --- the range ---------------------------------------------------------------------------------


def test_time_steps_lie_outside_their_range_by_the_logarithm_of_a_factor():
    corrector = ranged(0.02, 0.005, 0.01)
    assert corrector.envelope.trained_step(C) == "0.005 to 0.02 s"
    found = corrector.envelope.time_step_excess(graph(0.004, 0.005, 0.013, 0.02, 0.03).time_steps)
    expected = [np.log(5 / 4), 0.0, 0.0, 0.0, np.log(3 / 2)]
    assert found.tolist() == pytest.approx(expected, abs=1e-12)


def test_no_time_step_is_known_before_data_were_seen_nor_is_what_is_no_number():
    corrector = Corrector(preset("compact", layers=1, width=8))
    assert corrector.envelope.time_step_excess(graph(H).time_steps).tolist() == [np.inf]
    assert corrector.rest_score(graph(H)).tolist() == [np.inf]
    known = ranged(H)
    assert (
        known.envelope.time_step_excess(graph(np.nan, np.inf, -H, 0.0).time_steps).tolist()
        == [np.inf] * 4
    )
    assert np.isnan(corrector.envelope.time_steps).all()
    strange = fitted(problems((3, 1, 1)))
    strange.envelope.time_step_low.fill_(np.nan)
    hybrid = HybridStepper(pc.ProjectiveDynamics(stepped(1.0)), strange, gate=Gate(outside=1e6))
    assert hybrid.trained_step == "not known"
    assert hybrid(hybrid.problem.rest_state()).stats["gate"] == Reason.OUTSIDE


def test_time_steps_of_further_data_are_as_known_as_those_of_the_first():
    corrector = ranged(0.1 * H, 10.0 * H)
    corrector.envelope.fit({"time_step": logarithms(H)})  # takes the place of what was known
    state = corrector.state_dict()
    for name in ("envelope.time_step_low", "envelope.time_step_high"):
        assert state[name].tolist() == pytest.approx([np.log(H / C)])
    corrector.envelope.widen({"time_step": logarithms(0.5 * H)})
    assert corrector.envelope.time_steps == pytest.approx((0.5 * H / C, H / C))
    corrector.envelope.widen({"time_step": logarithms(0.7 * H, 3.0 * H)})
    assert corrector.envelope.time_steps == pytest.approx((0.5 * H / C, 3.0 * H / C))
    found = corrector.envelope.time_step_excess(
        graph(0.25 * H, 0.5 * H, 3.0 * H, 6.0 * H).time_steps
    )
    assert found.tolist() == pytest.approx([np.log(2), 0.0, 0.0, np.log(2)], abs=1e-12)


# --- the gate ----------------------------------------------------------------------------------


def test_the_default_bound_is_a_factor_of_1_1_both_ways():
    bodies = graph(*(np.array([0.5, 1 / 1.11, 1 / 1.1, 1.0, 1.1, 1.11, 2.0]) * H))
    corrector = ranged(H)
    corrector.envelope.fit({"shape": seen(bodies.shapes)})
    found = corrector.rest_score(bodies) > Gate().outside
    assert found.tolist() == [True, True, False, False, False, True, True]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("step", [0.01, 0.003, 1 / 60, 0.007])
def test_the_very_time_step_of_the_training_passes_the_narrowest_bound(step, dtype):
    corrector, bodies = ranged(step), graph(*[step] * 9, 1.0001 * step, dtype=dtype)
    corrector.envelope.fit({"shape": seen(bodies.shapes)})
    assert (corrector.rest_score(bodies) > 0.0).tolist() == [*[False] * 9, True]


def test_the_larger_score_of_body_and_time_step_counts():
    known, strange = problems((3, 1, 1), (6, 2, 2))
    bodies = BodyGraph.of([known, known, strange, strange], H, dtype=torch.float64)
    bodies = replace(bodies, time_step=bodies.time_step * torch.tensor([1.0, 2.0, 1.0, 2.0]))
    corrector = fitted([known])
    body = float(corrector.envelope.shape_excess(bodies.shapes).max() / 0.3)
    step = np.log(2.0) / 0.1
    expected = [0.0, step, body, max(body, step)]
    assert corrector.rest_score(bodies).tolist() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_half_and_double_steps_are_the_coarse_ones_and_the_network_is_not_asked(factor):
    problem = stepped(factor)
    corrector = fitted(problems((3, 1, 1)), kind=Watched)
    coarse = pc.ProjectiveDynamics(problem)
    hybrid = HybridStepper(coarse, corrector, gate=Gate()).prepare()
    run, plain = pc.rollout(hybrid, 4), pc.rollout(coarse, 4)
    assert np.array_equal(run.positions, plain.positions)
    assert np.array_equal(run.velocities, plain.velocities)
    assert run.stats["gate"].tolist() == [Reason.OUTSIDE] * 4
    assert run.stats["refused"].tolist() == [1.0] * 4
    assert not run.stats["correction"].any()
    assert corrector.calls == 0
    assert not hybrid(problem.rest_state()).state.memory
    assert refusals(run.stats["gate"]) == (Refusal(Reason.OUTSIDE, 4),)
    open_ = HybridStepper(coarse, corrector, gate=ONLY_OUTSIDE.model_copy(update={"outside": None}))
    found = open_(problem.rest_state())
    assert corrector.calls == 1
    assert found.stats["gate"] == 0.0 < found.stats["correction"]


def test_it_is_the_stepper_s_time_step_that_counts_and_not_the_scene_s():
    problem = stepped(1.0)
    corrector = fitted(problems((3, 1, 1)))
    for step, reason in ((H, 0), (2.0 * H, Reason.OUTSIDE)):
        coarse = pc.ProjectiveDynamics(problem, time_step=step)
        hybrid = HybridStepper(coarse, corrector, gate=ONLY_OUTSIDE)
        assert hybrid(problem.rest_state()).stats["gate"] == reason
        stepper = pc.BatchStepper([problem], time_step=step)
        many = BatchHybrid(stepper, corrector, gate=ONLY_OUTSIDE)
        assert many(stepper.rest_state()).reasons.tolist() == [reason]


def test_a_stiffer_body_with_a_shorter_step_is_refused_though_the_network_sees_a_known_one():
    known = soft_beam(loads=[TORSION])
    half = known.with_changes(
        time={"step": 0.5 * H},
        material={"young": 4.0 * known.material.young},
        loads=[{**TORSION, "strength": 4.0 * TORSION["strength"]}],
    )
    corrector, found = fitted(problems((3, 1, 1))), []
    for scene, reason in ((known, 0), (half, Reason.OUTSIDE)):
        problem = pc.discretise(scene)
        for gate in (None, ONLY_OUTSIDE):
            hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
            result = hybrid(problem.rest_state())
            found += [result] if gate is None else []
        assert result.stats["gate"] == reason
    one, two = (result.state.positions for result in found)
    np.testing.assert_allclose(one, two, atol=1e-9)
    assert found[0].stats["correction"] == pytest.approx(found[1].stats["correction"], rel=1e-4)
    assert found[0].stats["correction"] > 0.0


def test_of_a_refined_body_its_own_cells_count():
    corrector = fitted(problems((3, 1, 1)))
    for refine, step, reason in ((2, H, Reason.OUTSIDE), (2, 0.5 * H, 0)):
        scene = soft_beam(loads=[TORSION], time={"step": step, "frames": 4})
        problem = pc.discretise(scene, refine=refine)
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector)
        excess = corrector.envelope.time_step_excess(hybrid.bodies.time_steps)
        assert (excess > 0.1).tolist() == [reason > 0]
        assert hybrid.trained_step == f"{0.5 * H:g} s"


SCALED = [(0.5, 1.0, Reason.OUTSIDE), (1.0, 2.0, Reason.OUTSIDE), (0.5, 0.5, 0), (3.0, 3.0, 0)]
"""Factors on all lengths and on the time step, and what a gate says."""


@pytest.mark.parametrize(("lengths", "times", "reason"), SCALED)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_half_the_lengths_are_refused_as_twice_the_step_is_and_both_alike_pass(
    lengths, times, reason, dtype
):
    """Of one material, waves cross as many cells in a step wherever h/c is the same."""
    body = {"shape": "beam", "cells": [3, 1, 1], "cell_size": lengths * C}
    scene = soft_beam().with_changes(body=body, time={"step": times * H})
    problem = pc.discretise(scene)
    corrector = fitted(problems((3, 1, 1)))
    bodies = BodyGraph.of([problem], dtype=dtype)
    score = np.log(2.0) / 0.1 if reason else 0.0
    assert corrector.rest_score(bodies).tolist() == pytest.approx([score], rel=1e-4, abs=1e-4)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=ONLY_OUTSIDE)
    assert hybrid.trained_step == f"{lengths * H:g} s"
    assert reason == 0 or hybrid(problem.rest_state()).stats["gate"] == Reason.OUTSIDE


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_batch_of_another_time_step_is_refused_as_a_whole_each_scene_by_its_reason(
    factor, recorded
):
    known, strange = stepped(factor), stepped(factor, (6, 1, 1))
    kind = Corrector if recorded else Watched
    corrector = fitted(problems((3, 1, 1)), kind=kind)
    stepper = pc.BatchStepper([known, strange])
    state = stepper.rest_state()
    hybrid = BatchHybrid(stepper, corrector, gate=Gate(), recorded=recorded)
    result, plain = hybrid(state), stepper(state)
    assert result.reasons.tolist() == [Reason.OUTSIDE, Reason.OUTSIDE]
    assert torch.equal(result.state.positions, plain.state.positions)
    assert not result.state.memory
    assert not result.correction.any()
    assert recorded or corrector.calls == 0


def test_of_several_time_steps_only_the_out_of_distribution_one_is_refused():
    """Steppers have one for all scenes; graphs of bodies have one each."""
    scenes = problems((3, 1, 1), (3, 1, 1))
    corrector = fitted(scenes, kind=Watched)
    stepper = pc.BatchStepper(scenes)
    hybrid = BatchHybrid(stepper, corrector, gate=ONLY_OUTSIDE)
    nodes = hybrid.nodes
    nodes._graph = replace(nodes.graph, time_step=torch.tensor([2.0 * H, H], dtype=torch.float64))
    result, plain = hybrid(stepper.rest_state()), stepper(stepper.rest_state())
    assert result.reasons.tolist() == [Reason.OUTSIDE, 0]
    assert corrector.calls == 1
    assert torch.equal(result.state.positions[0], plain.state.positions[0])
    assert not torch.equal(result.state.positions[1], plain.state.positions[1])


# --- released models ---------------------------------------------------------------------------


MODELS = Path(__file__).parents[1] / "models"
RELEASED = sorted(path.parent.name for path in MODELS.glob("*/model.json"))
MEASURED = ("impulse-as-published", "stretch-as-published")
"""Whose ranges a training widened to data sets' corners, of single precision; others are exact."""


@pytest.mark.parametrize("name", RELEASED)
def test_released_models_know_the_time_step_and_cell_size_of_their_data(name):
    model = pc.load_model(name)
    rel = 1e-6 if name in MEASURED else 1e-12
    assert model.corrector.envelope.time_steps == pytest.approx((0.2, 0.2), rel=rel)
