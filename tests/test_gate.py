"""What a gate refuses: by inputs, volumes, energy, and steps that failed."""

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import box_mesh, disturbed, problem_on
from hybrid_samples import (
    CELL,
    EULER,
    TORSION,
    Prescribed,
    bumped,
    fitted,
    flying,
    folded,
    prescribed,
    problems,
    same,
    seen,
    shaken,
    soft_beam,
    wild,
)
from pdcorrect.corrector.batch_hybrid import BatchBodies, BatchCoarseStep, BatchHybrid
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.gate import Gate, GateMeasures, Reason, Refusal, refusals
from pdcorrect.corrector.hybrid import HybridStepper, SingleCoarseStep
from pdcorrect.errors import InputError

OPEN = Gate(outside=None, crushing=None, energy=None)


def strange(problem):
    """Forces far outside what the network has seen, and so its inputs."""
    return np.random.default_rng(0).normal(size=problem.positions.shape) * 0.5


CASES = {
    Reason.NOT_FINITE: (OPEN, lambda p: np.full(p.positions.shape, np.nan), False),
    Reason.OUTSIDE: (Gate(crushing=None, energy=None), lambda p: 0.01 * bumped(p), True),
    Reason.INVERSION: (Gate(outside=None, energy=None), folded, False),
    Reason.ENERGY: (Gate(outside=None, crushing=None), wild, False),
}


@pytest.mark.parametrize("reason", CASES)
def test_each_reason_refuses_a_correction_and_keeps_the_coarse_step(reason):
    gate, answer, pushed = CASES[reason]
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    correction = answer(problem)
    corrector = prescribed(problem, correction)
    coarse = pc.ProjectiveDynamics(problem)
    stepper = HybridStepper(coarse, corrector, gate=gate)
    push = strange(problem) if pushed else None
    found, plain = stepper(problem.rest_state(), push), coarse(problem.rest_state(), push)
    assert found.stats["gate"] == reason
    assert found.stats["refused"] == 1.0
    assert found.stats["correction"] == 0.0
    assert same(found.state, plain.state)
    if reason is not Reason.NOT_FINITE:
        open_ = HybridStepper(coarse, corrector, gate=OPEN)(problem.rest_state(), push)
        assert open_.stats["refused"] == 0.0
        assert not same(open_.state, plain.state)


@pytest.mark.parametrize("reason", [Reason.NOT_FINITE, Reason.INVERSION, Reason.ENERGY])
def test_a_batch_refuses_one_scene_s_correction_and_not_the_other_s(reason):
    gate, answer, _ = CASES[reason]
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes, kind=Prescribed)
    small = 1e-4 * bumped(scenes[1])
    corrector.answer = np.concatenate([answer(scenes[0]), small])
    stepper = pc.BatchStepper(scenes)
    result = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state())
    plain = stepper(stepper.rest_state())
    assert result.reasons.tolist() == [reason, 0]
    assert result.refused.tolist() == [True, False]
    assert torch.equal(result.state.positions[0], plain.state.positions[0])
    assert torch.equal(result.state.velocities[0], plain.state.velocities[0])
    assert not torch.equal(result.state.positions[1], plain.state.positions[1])
    assert torch.isfinite(result.state.positions).all()
    assert torch.isfinite(result.correction).all()
    first = len(scenes[0].positions)
    assert not result.correction[:first].any()
    assert result.correction[first:].any()


def test_out_of_distribution_inputs_are_refused_in_a_batch():
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes)
    stepper = pc.BatchStepper(scenes)
    states = [pc.State(disturbed(scenes[0], 0.3), shaken(scenes[0], 5.0).velocities)]
    state = stepper.state([*states, scenes[1].rest_state()])
    result = BatchHybrid(stepper, corrector, gate=Gate(crushing=None, energy=None))(state)
    assert result.reasons.tolist() == [Reason.OUTSIDE, 0]
    calm = BatchHybrid(stepper, corrector, gate=Gate())(stepper.rest_state())
    assert calm.reasons.tolist() == [0, 0]
    assert calm.correction.any()
    wide = BatchHybrid(stepper, corrector, gate=Gate(outside=1e9, crushing=None, energy=None))
    assert wide(state).reasons.tolist() == [0, 0]


def test_a_body_with_out_of_distribution_means_is_refused_though_each_node_is_within():
    """Fitted to two beams, of which one moves as it did, and one all of whose means are new."""
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes)
    stepper = pc.BatchStepper(scenes)
    state = stepper.rest_state()
    open_ = Gate(crushing=None, energy=None)
    assert BatchHybrid(stepper, corrector, gate=open_)(state).reasons.tolist() == [0, 0]
    views = []
    answer, corrector.of_view = corrector.of_view, lambda view: views.append(view) or answer(view)
    BatchHybrid(stepper, corrector)(state)
    corrector.of_view = answer
    familiar = views[0].bodies.body_means(corrector.inputs(views[0])[0])[:1]
    corrector.envelope.fit({"average": seen(familiar.detach())})
    away = corrector.score(views[0]).tolist()
    assert away[0] < 0.1 < 1.0 / 4.5 < away[1]
    for outside, reason in ((0.9 * away[1], Reason.OUTSIDE), (1.1 * away[1], 0), (None, 0)):
        gate = open_.model_copy(update={"outside": outside})
        assert BatchHybrid(stepper, corrector, gate=gate)(state).reasons.tolist() == [0, reason]
    for scene, (problem, reason) in enumerate(zip(scenes, (0, Reason.OUTSIDE), strict=True)):
        gate = open_.model_copy(update={"outside": 0.9 * away[1]})
        one = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
        assert one(problem.rest_state()).stats["gate"] == reason, scene


def test_a_correction_may_improve_what_the_coarse_step_inverted():
    problem = pc.discretise(soft_beam(loads=[], time={"step": 1e-6, "frames": 1}))
    bad = pc.State(problem.positions + folded(problem), np.zeros_like(problem.positions))
    coarse = pc.ProjectiveDynamics(problem)
    answer = coarse(bad).state.positions
    assert problem.volume_ratios(answer).min() < 0.0
    corrector = prescribed(problem, 0.1 * (problem.positions - answer))
    gate = Gate(outside=None, energy=None, crushing=0.5)
    assert HybridStepper(coarse, corrector, gate=gate)(bad).stats["refused"] == 0.0
    corrector.answer = -corrector.answer
    assert HybridStepper(coarse, corrector, gate=gate)(bad).stats["gate"] == Reason.INVERSION


def test_a_failed_coarse_step_is_not_corrected():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = prescribed(problem, bumped(problem))
    coarse = pc.ProjectiveDynamics(problem, 1e-13, max_iterations=1, recover=False)
    result, plain = (s(shaken(problem)) for s in (HybridStepper(coarse, corrector), coarse))
    assert not plain.status.ok
    assert result.status is plain.status
    assert same(result.state, plain.state)
    assert result.stats["gate"] == Reason.SOLVER
    assert result.stats["correction"] == 0.0
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes)
    stepper = pc.BatchStepper(scenes, 1e-13, max_iterations=1, recover=False)
    state = stepper.state([shaken(p) for p in scenes])
    result, plain = BatchHybrid(stepper, corrector)(state), stepper(state)
    assert result.reasons.tolist() == [Reason.SOLVER] * 2
    assert torch.equal(result.state.positions, plain.state.positions)
    assert not result.correction.any()


def measured(ratios, stored=1.0, work=0.0):
    """Of scenes with some smallest det F in their cells."""
    ratios = torch.tensor(ratios, dtype=torch.float64)
    one = torch.ones(len(ratios), dtype=torch.float64)
    return GateMeasures(ratios, stored * one, work * one)


@pytest.mark.parametrize(
    ("ratios", "passes"),
    [
        ([-1.0, 0.9], True),  # as it was
        ([-0.5, 0.9], True),  # better, though not good
        ([-1.0, -0.5], False),  # inverts a cell that was not the worst one
        ([0.5, -1e-9], False),
        ([-1.1, 0.9], False),  # worse than inverted
        ([-1.0, 0.091], True),
        ([-1.0, 0.089], False),  # below a tenth of the coarse answer's
        ([np.nan, 0.9], False),
        ([-1.0, np.nan], False),
    ],
)
def test_a_gate_looks_at_each_cell(ratios, passes):
    coarse = measured([[-1.0, 0.9, np.inf], [1.0, 1.0, 1.0]])
    answer = measured([[*ratios, np.inf], [1.0, 1.0, 1.0]])
    found = Gate(energy=None).reasons(answer, coarse)
    assert found.tolist() == [0 if passes else Reason.INVERSION, 0]
    found = Gate(energy=None).reasons(
        measured([[1.0, 1.0, 1.0], [*ratios, 1.0]]), measured([[1.0] * 3, [-1.0, 0.9, 1.0]])
    )
    assert found.tolist() == [0, 0 if passes else Reason.INVERSION]


def test_the_test_of_cells_is_switched_off_or_is_one_of_inversion_alone():
    coarse = measured([[1.0, 1.0]])
    crushed, inverted = measured([[1.0, 0.05]]), measured([[1.0, -0.5]])
    for gate, expected in (
        (Gate(crushing=0.0), (0, Reason.INVERSION)),
        (Gate(), (Reason.INVERSION, Reason.INVERSION)),
        (Gate(crushing=None), (0, 0)),
        (Gate(crushing=0.05), (0, Reason.INVERSION)),
    ):
        found = [int(gate.reasons(x, coarse)) for x in (crushed, inverted)]
        assert found == list(expected)


def test_a_crushed_cell_refuses_a_correction():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    flat = -(problem.positions - problem.positions[0]) * [0.0, 0.0, 1.0]
    held_at = problem.positions[:, :1] / (3 * CELL)  # the held end stays
    corrector = prescribed(problem, flat * held_at)
    stepper = pc.BatchStepper([problem])
    for gate, reason in (
        (Gate(outside=None, energy=None), Reason.INVERSION),
        (Gate(outside=None, energy=None, crushing=0.0), Reason.NONE),
    ):
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
        assert hybrid(problem.rest_state()).stats["gate"] == reason
        many = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state())
        assert many.reasons.tolist() == [reason]


@pytest.mark.parametrize(
    ("push", "refused"), [(0.999, False), (1.001, True), (100.0, True), (-1.5, False), (-3.1, True)]
)
def test_the_bound_on_energy_does_not_grow_with_the_correction(push, refused):
    """A push of x times the way makes the energy (1 + x)^2 times as large; 4 is allowed."""
    problem, before = flying()
    way = np.zeros_like(problem.positions)
    way[:, 0] = push * problem.time_step * before.velocities[:, 0]
    corrector = prescribed(problem, way)
    gate = Gate(outside=None, energy=3.0)
    result = HybridStepper(pc.ProjectiveDynamics(problem, 1e-10), corrector, gate=gate)(before)
    assert result.stats["gate"] == (Reason.ENERGY if refused else 0)
    stepper = pc.BatchStepper([problem], 1e-10)
    many = BatchHybrid(stepper, corrector, gate=gate)(stepper.state([before]))
    assert many.reasons.tolist() == [Reason.ENERGY if refused else 0]


@pytest.mark.parametrize(
    ("gate", "heavier", "refused"),
    [
        (Gate(outside=None), 4.0, False),
        (Gate(outside=None), 5.89, False),
        (Gate(outside=None), 5.90, True),
        (Gate(outside=None, energy=1.0), 2.73, False),
        (Gate(outside=None, energy=1.0), 2.74, True),
    ],
)
def test_a_kick_s_right_answer_passes_where_the_coarse_mass_is_four_times_too_heavy(
    gate, heavier, refused
):
    """From rest energy less work rises by (r - 1)^2/3 of the coarse step's energy and work."""
    problem = problem_on(box_mesh((2, 1, 1), (0.04, 0.02, 0.02), 0.2), time=EULER)
    kick = np.zeros_like(problem.positions)
    kick[:, 0] = 10.0 * problem.mass
    result = pc.ProjectiveDynamics(problem, 1e-10)(problem.rest_state(), kick)
    way = result.state.positions - problem.positions
    corrector = prescribed(problem, (heavier - 1.0) * way)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem, 1e-10), corrector, gate=gate)
    assert hybrid(problem.rest_state(), kick).stats["refused"] == refused


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize("integrator", ["backward-euler", "midpoint"])
def test_a_batch_s_gate_measures_what_a_single_scene_s_does(integrator, element):
    scenes = [pc.discretise(p.scene, element=element) for p in problems((3, 1, 1), (2, 2, 1))]
    shifts = [bumped(p) for p in scenes]
    stepper = pc.BatchStepper(scenes, 1e-12, integrator=integrator)
    states = [pc.State(disturbed(p, 0.1), shaken(p).velocities) for p in scenes]
    many = BatchCoarseStep(BatchBodies(stepper), stepper.state(states), None)
    answer = many.solved()
    many.view(answer)
    moved = many.moved(answer, torch.tensor(np.concatenate(shifts)))
    for i, (problem, state, shift) in enumerate(zip(scenes, states, shifts, strict=True)):
        coarse = pc.ProjectiveDynamics(problem, 1e-12, integrator=integrator)
        bodies = BodyGraph.of([problem], dtype=torch.float64)
        one = SingleCoarseStep(coarse, bodies, "recomputed", state)
        alone = one.solved()
        pairs = (
            (many.measured(answer), one.measured(alone), True),
            (many.measured(moved), one.measured(one.moved(alone, torch.tensor(shift))), False),
        )
        for found, expected, same_modes in pairs:
            count = len(problem.cells)
            ratios = found.ratios[i, :count].numpy()
            assert ratios == pytest.approx(expected.ratios[0].numpy(), rel=1e-8)
            assert torch.isinf(found.ratios[i, count:]).all()
            assert float(found.work[i]) == pytest.approx(float(expected.work[0]), rel=1e-8)
            stored, least = float(found.stored[i]), float(expected.stored[0])
            if same_modes or element == "hex8" or integrator == "midpoint":
                assert stored == pytest.approx(least, rel=1e-8)
            else:
                assert stored > least


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"outside": -1.0}, "outside = -1.0"),
        ({"crushing": 1.0}, "crushing = 1.0"),
        ({"energy": float("nan")}, "energy = nan"),
        ({"outside": "0.1"}, 'outside = "0.1"'),
        ({"outside": float("nan")}, "outside = nan"),
        ({"outside": True}, "outside = true"),
        ({"pause": 5}, "pause: unknown key"),
        ({"step": 0.1}, "step: unknown key"),
    ],
)
def test_bounds_without_meaning_are_refused_by_key_and_value(changes, told):
    with pytest.raises(InputError, match=f"^gate: {told}"):
        Gate(**changes)


def test_refusals_are_counted_by_reason_the_most_frequent_first():
    assert refusals([0.0, 0.0]) == refusals([]) == ()
    first, *others = refusals(np.array([0.0, 1.0, 3.0, 3.0, 2.0]))
    assert first == Refusal(Reason.INVERSION, 2)
    assert set(others) == {Refusal(Reason.NOT_FINITE, 1), Refusal(Reason.OUTSIDE, 1)}
    assert len({reason.meaning for reason in Reason}) == len(Reason)
