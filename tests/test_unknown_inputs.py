"""Which of a network's inputs a gate refuses, by name and by how much."""

import itertools

import numpy as np
import pytest

pytest.importorskip("torch_geometric")

import torch

import pdcorrect as pc
from hybrid_samples import PLACEMENTS, PRESSURE, TORSION, fitted, problems, silent, soft_beam
from pdcorrect.corrector.gate import Gate, Reason
from pdcorrect.corrector.hybrid import MEMORY, HybridStepper
from pdcorrect.corrector.refusal_watch import RefusalWatch
from pdcorrect.errors import InputError

INPUTS = Gate(body=None, time_step=None, volume=None, crushing=None, energy=None, pause=0)


def hybrid_of(problem, corrector, gate=INPUTS):
    return HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)


def twisted(strength=1.0, young=5e4):
    """The beam that correctors are fitted to, under more load or of another material."""
    load = {**TORSION, "strength": strength * TORSION["strength"]}
    return pc.discretise(soft_beam((3, 1, 1), loads=[load]).with_changes(material={"young": young}))


def known(**changes):
    return fitted([twisted()], **changes)


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("preset", [{}, {"node_features": ("load", "previous-correction")}])
def test_there_are_some_where_the_gate_refuses_a_step_by_its_inputs_and_only_there(
    placement, preset
):
    corrector = known(placement=placement, size=1e-3, **preset)
    reasons = set()
    for strength, gate in itertools.product((1.0, 30.0), (INPUTS, Gate(body=None, pause=0))):
        hybrid = hybrid_of(twisted(strength), corrector, gate)
        state = hybrid.problem.rest_state()
        for _ in range(4):
            found, result = hybrid.unknown_inputs(state), hybrid(state)
            reason = result.stats["gate"]
            assert bool(found) == (reason == Reason.FEATURES)
            reasons.add(reason)
            state = result.state
    assert {0.0, float(Reason.FEATURES)} <= reasons


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_to_ask_changes_no_step(placement):
    corrector = known(placement=placement, size=1e-3)
    runs = []
    for asked in (False, True):
        hybrid = hybrid_of(twisted(3.0), corrector)
        state, positions = hybrid.problem.rest_state(), []
        for _ in range(4):
            if asked:
                hybrid.unknown_inputs(state)
            state = hybrid(state).state
            positions.append(state.positions)
        runs.append(np.stack(positions))
    np.testing.assert_array_equal(*runs)


def test_a_stiffer_material_is_told_by_its_value_beside_the_range():
    corrector = known()
    hybrid = hybrid_of(twisted(young=5e6), corrector)
    values = [x for x in hybrid.unknown_inputs(hybrid.problem.rest_state()) if not x.mean]
    assert values == sorted(values, key=lambda x: (-x.share, -x.excess))
    (found,) = [x for x in values if x.name == "stiffness"]
    h, c, rho = 0.01, 0.02, 1e3
    assert found.value == pytest.approx(np.log(5e6 * h**2 / (rho * c**2)))
    assert found.low == pytest.approx(np.log(5e4 * h**2 / (rho * c**2)))
    assert found.low == pytest.approx(found.high)
    assert (found.component, found.share, found.bound) == (0, 1.0, 1.0)
    scale = corrector.normaliser.scale("stiffness")
    assert found.excess == pytest.approx((found.value - found.high) / float(scale.above))


def test_of_means_the_component_and_how_far_it_is_from_the_training_s_are_told():
    corrector = known()
    gate = INPUTS.model_copy(update={"margin": None})
    hybrid = hybrid_of(twisted(30.0), corrector, gate)
    found = hybrid.unknown_inputs(hybrid.problem.rest_state())
    assert found
    assert all(x.mean and x.share == 1.0 and x.excess > x.bound == 4.5 for x in found)
    assert all(not x.low <= x.value <= x.high for x in found)
    names = corrector.config.node_features
    assert {x.name for x in found} <= set(names)
    far = [x.excess for x in found]
    assert far == sorted(far, reverse=True)
    step = hybrid._step(hybrid.problem.rest_state())
    view = step.view(step.solved())
    assert far[0] == pytest.approx(float(corrector.unlike(view)))
    only = INPUTS.model_copy(update={"average": None})
    assert not any(
        x.mean
        for x in hybrid_of(twisted(30.0), corrector, only).unknown_inputs(
            hybrid.problem.rest_state()
        )
    )


def test_an_edge_s_input_counts_at_the_node_that_receives_it():
    corrector = known()
    normaliser = corrector.normaliser
    hybrid = hybrid_of(twisted(), corrector, INPUTS.model_copy(update={"average": None}))
    with torch.no_grad():  # edges along x alone become unknown
        low, high = (getattr(normaliser, f"rest_edge__{part}") for part in ("low", "high"))
        low[:], high[:] = -1e3, 1e3
        high[0] = 0.5
        normaliser.rest_edge__mean[:], normaliser.rest_edge__deviation[:] = 0.0, 0.1
    (found,) = hybrid.unknown_inputs(hybrid.problem.rest_state())
    assert (found.name, found.component, found.mean) == ("rest-edge", 0, False)
    assert found.value == pytest.approx(1.0)
    assert found.share == pytest.approx(12 / 16)  # all but the last four have a sender beyond


def test_a_body_or_step_that_is_refused_anyway_hides_no_inputs():
    corrector = known()
    gate = Gate()
    scene = soft_beam((12, 1, 1), loads=[PRESSURE]).with_changes(material={"young": 5e6})
    hybrid = hybrid_of(pc.discretise(scene), corrector, gate)
    state = hybrid.problem.rest_state()
    assert hybrid(state).stats["gate"] == Reason.BODY
    assert "stiffness" in {x.name for x in hybrid.unknown_inputs(state)}


def test_without_a_gate_or_its_tests_of_inputs_none_is_unknown():
    corrector = known()
    for gate in (None, INPUTS.model_copy(update={"margin": None, "average": None})):
        hybrid = hybrid_of(twisted(30.0), corrector, gate)
        assert hybrid.unknown_inputs(hybrid.problem.rest_state()) == []


def test_forces_of_the_caller_count_and_wrong_ones_are_refused():
    hybrid = hybrid_of(twisted(), known())
    state = hybrid.problem.rest_state()
    assert hybrid.unknown_inputs(state) == []
    forces = np.zeros_like(state.positions)
    forces[:, 2] = 50.0
    assert "load" in {x.name for x in hybrid.unknown_inputs(state, forces)}
    with pytest.raises(InputError):
        hybrid.unknown_inputs(state, forces[:-1])
    with pytest.raises(InputError):
        hybrid.unknown_inputs("rest")


def test_inputs_that_are_not_numbers_are_infinitely_far():
    corrector = known(node_features=("load", "previous-correction"))
    hybrid = hybrid_of(twisted(), corrector)
    state = hybrid.problem.rest_state()
    memory = {MEMORY: np.full_like(state.positions, np.nan)}
    found = hybrid.unknown_inputs(pc.State(state.positions, state.velocities, 0.0, memory))
    assert {(x.name, x.excess) for x in found} == {("previous-correction", np.inf)}


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_run_is_watched_for_its_first_step_that_is_refused_by_inputs(placement):
    corrector = silent(known(placement=placement))
    late = {**TORSION, "strength": 30.0 * TORSION["strength"]}
    late["table"] = [[0.0, 1.0 / 30.0], [0.02, 1.0 / 30.0], [0.021, 1.0]]
    hybrid = hybrid_of(pc.discretise(soft_beam((3, 1, 1), loads=[late])), corrector)
    state = hybrid.problem.rest_state()
    watch, states = RefusalWatch(hybrid, state), [state]
    for _ in range(4):
        result = hybrid(states[-1])
        watch.add(result)
        states.append(result.state)
    found = watch.refused
    assert found.frame == 3
    assert list(found.inputs) == hybrid.unknown_inputs(states[2]) != []
    assert (found.measures, found.step) == ((), None)


def test_a_run_of_known_inputs_has_none():
    hybrid = hybrid_of(problems((3, 1, 1))[0], fitted(problems((3, 1, 1))))
    watch = RefusalWatch(hybrid, hybrid.problem.rest_state())
    watch.add(hybrid(hybrid.problem.rest_state()))
    assert (watch.refused.inputs, watch.refused.frame) == ((), 0)
