"""`Gate.pause`: after a refused step corrections count again only after some that would pass."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import pdcorrect as pc
from hybrid_samples import (
    CELL,
    PLACEMENTS,
    TORSION,
    Prescribed,
    fitted,
    folded,
    problems,
    same,
    soft_beam,
    wild,
)
from pdcorrect.corrector.architecture import preset
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.corrected_step import Decision
from pdcorrect.corrector.gate import PAUSE, Gate, Reason
from pdcorrect.corrector.hybrid import MEMORY, HybridStepper
from pdcorrect.evaluation.rollouts import roll_out
from pdcorrect.io.trajectory import TrajectoryWriter
from pdcorrect.solvers.rollout import continue_from

ROOT = Path(__file__).parent.parent
STEP = 0.01
NOTHING = {
    "body": None, "time_step": None, "margin": None, "average": None, "volume": None,
    "crushing": None, "energy": None,
}  # fmt: skip
"""Bounds of a gate that refuses only what is refused without one."""


class Wary(Prescribed):
    """Gives ``bad`` (n, 3), m, for bodies that a load pushes along -y, else ``answer``."""

    bad = None

    def of_view(self, view):
        pushed = view.bodies.some(view.snapshot.forces[:, 1:2] < 0.0)
        bad = torch.as_tensor(self.bad).to(view.bodies.rest)
        bad = torch.where(view.bodies.free, bad, 0.0)
        return torch.where(view.bodies.by_node(pushed)[:, None], bad, super().of_view(view))


def pushed_in(*steps, cells=(3, 1, 1), **changes):
    """A beam under its weight that is pushed along -y in some steps, the first being 1."""
    pushes = [
        {"kind": "gravity", "acceleration": [0.0, -0.1, 0.0],
         "window": [(step - 0.9) * STEP, (step - 0.1) * STEP]} for step in steps
    ]  # fmt: skip
    weight = {"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}
    return pc.discretise(soft_beam(cells, loads=[weight, *pushes], **changes))


def bump(problem, size=1e-4):
    """Some displacement of free nodes."""
    shape = problem.positions.shape
    return size * CELL * np.random.default_rng(0).normal(size=shape) * problem.free


def wary(*scenes, bad=np.nan, **changes):
    """A `Wary` corrector of some scenes, which answers small displacements to all others."""
    corrector = fitted(list(scenes), kind=Wary, **changes)
    corrector.answer = np.concatenate([bump(p) for p in scenes])
    corrector.bad = np.broadcast_to(bad, corrector.answer.shape).copy()
    return corrector


def results_of(stepper, steps, state=None):
    """Results of some steps, and the states before them."""
    state = stepper.problem.rest_state() if state is None else state
    pairs = []
    for _ in range(steps):
        pairs.append((state, stepper(state)))
        state = pairs[-1][1].state
    return pairs


def left_after(result):
    """For how many steps the state after a step says that the gate is shut; 0 without a word."""
    kept = result.state.memory.get(PAUSE)
    if kept is None:
        return 0
    assert kept.shape == result.state.positions.shape
    assert (kept == kept[0, 0]).all()
    return int(kept[0, 0])


# --- the count -------------------------------------------------------------------------------

N, P = Reason.NOT_FINITE, Reason.PAUSE


COUNTS = [
    (3, (2,), [0, N, P, P, P, 0, 0], [0, 3, 2, 1, 0, 0, 0]),
    (3, (1, 3), [N, P, N, P, P, P, 0], [3, 2, 3, 2, 1, 0, 0]),
    (3, (1, 4), [N, P, P, N, P, P, P], [3, 2, 1, 3, 2, 1, 0]),
    (1, (2, 3, 5), [0, N, N, P, N, P, 0], [0, 1, 1, 0, 1, 0, 0]),
    (0, (2, 3), [0, N, N, 0, 0, 0, 0], [0] * 7),
]


@pytest.mark.parametrize(
    ("placement", "count"),
    [*(("state", count) for count in COUNTS), ("force", COUNTS[1]), ("guess", COUNTS[1])],
)
def test_corrections_count_again_after_so_many_steps_that_would_pass(placement, count):
    pause, pushes, reasons, left = count
    problem = pushed_in(*pushes)
    coarse = pc.ProjectiveDynamics(problem)
    gate = Gate(**NOTHING, pause=pause)
    hybrid = HybridStepper(coarse, wary(problem, placement=placement), gate=gate)
    pairs = results_of(hybrid, len(reasons))
    assert [r.stats["gate"] for _, r in pairs] == reasons
    assert [left_after(r) for _, r in pairs] == left
    for before, found in pairs:
        plain = coarse(pc.State(before.positions, before.velocities, before.time))
        assert found.stats["refused"] == (found.stats["gate"] > 0)
        if found.stats["refused"]:
            assert same(found.state, plain.state)
            assert found.stats["correction"] == 0.0
        else:
            assert found.stats["correction"] > 0.0
            assert not same(found.state, plain.state)


@pytest.mark.parametrize("placement", ["state", "force"])
@pytest.mark.parametrize(
    ("reason", "bad", "bounds"),
    [
        (Reason.INVERSION, folded, {"volume": 0.0, "crushing": 0.1}),
        (Reason.ENERGY, wild, {"energy": 8.0}),
    ],
)
def test_a_gate_that_refused_an_answer_still_judges_those_of_the_pause(
    placement, reason, bad, bounds
):
    """The second one is refused by what it would be, in the middle of the pause."""
    problem = pushed_in(2, 4)
    factor = 100.0 if placement == "force" else 1.0  # the body resists
    corrector = wary(problem, bad=factor * bad(problem), placement=placement)
    gate = Gate(**{**NOTHING, **bounds}, pause=2)
    coarse = pc.ProjectiveDynamics(problem)
    pairs = results_of(HybridStepper(coarse, corrector, gate=gate), 8)
    assert [r.stats["gate"] for _, r in pairs] == [0, reason, P, reason, P, P, 0, 0]
    for before, found in pairs:
        plain = coarse(pc.State(before.positions, before.velocities, before.time))
        assert same(found.state, plain.state) == (found.stats["gate"] > 0)


def test_a_limited_correction_is_no_refusal():
    problem = pushed_in(1)
    corrector = wary(problem, bad=0.6 * wild(problem))
    gate = Gate(**{**NOTHING, "energy": 8.0}, limit=True)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
    first, second = (result for _, result in results_of(hybrid, 2))
    assert first.stats["correction_factor"] < 1.0
    assert first.stats["gate"] == second.stats["gate"] == 0.0
    assert not first.state.memory


class FailsThird(pc.ProjectiveDynamics):
    """Says of every step of the scene's own loads from time 2 h that it failed."""

    def __call__(self, state, forces=None, **options):
        result = super().__call__(state, forces, **options)
        if forces is None and np.isclose(state.time, 2 * STEP):
            result = replace(result, status=pc.Status.ITERATION_LIMIT)
        return result


@pytest.mark.parametrize("size", [1.0, 0.0])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_coarse_step_that_fails_in_a_pause_begins_it_anew(placement, size):
    """Also where a network has nothing to correct; forces of a correction would have helped."""
    problem = pushed_in(1)
    corrector = wary(problem, placement=placement)
    corrector.answer = size * corrector.answer
    hybrid = HybridStepper(FailsThird(problem), corrector, gate=Gate(**NOTHING, pause=2))
    pairs = results_of(hybrid, 6)
    assert [r.status.ok for _, r in pairs] == [True, True, False, True, True, True]
    assert [r.stats["gate"] for _, r in pairs] == [N, P, Reason.SOLVER, P, P, 0]


class SomeFail(pc.BatchStepper):
    """Says of the second scene's steps from time h that they failed."""

    def __call__(self, state, *args, **options):
        result = super().__call__(state, *args, **options)
        statuses = list(result.statuses)
        if np.isclose(state.times[1], STEP):
            statuses[1] = pc.Status.ITERATION_LIMIT
        return replace(result, statuses=tuple(statuses))


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_of_a_batch_the_scene_whose_step_fails_in_a_pause_begins_it_anew(placement):
    scenes = [pushed_in(1), pushed_in(1, cells=(2, 2, 1))]
    stepper = SomeFail(scenes)
    hybrid = BatchHybrid(stepper, wary(*scenes, placement=placement), gate=Gate(**NOTHING, pause=2))
    state, reasons = stepper.rest_state(), []
    for _ in range(5):
        result = hybrid(state)
        state = result.state
        reasons.append(result.reasons.tolist())
    assert reasons == [[N, N], [P, Reason.SOLVER], [P, P], [0, P], [0, 0]]


def test_out_of_distribution_inputs_shut_the_gate():
    """Without the test of them the same steps are corrected."""
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector, coarse = fitted([problem]), pc.ProjectiveDynamics(problem)
    push = np.random.default_rng(0).normal(size=problem.positions.shape) * 0.5
    for margin, first in ((1.0, Reason.FEATURES), (None, 0)):
        gate = Gate(**{**NOTHING, "margin": margin}, pause=1)
        result = HybridStepper(coarse, corrector, gate=gate)(problem.rest_state(), push)
        assert result.stats["gate"] == first
        assert left_after(result) == (first > 0)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_an_out_of_distribution_body_leaves_nothing_to_remember(placement):
    known, strange = problems((3, 1, 1)), pc.discretise(soft_beam((6, 1, 1), loads=[TORSION]))
    corrector = fitted(known, placement=placement)
    hybrid = HybridStepper(pc.ProjectiveDynamics(strange), corrector, gate=Gate())
    for _, result in results_of(hybrid, 2):
        assert result.stats["gate"] == Reason.BODY
        assert not result.state.memory
    stepper = pc.BatchStepper([known[0], strange])
    gate = Gate(**{**NOTHING, "body": 0.3})
    result = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state())
    assert result.reasons.tolist() == [0, Reason.BODY]
    assert not result.state.memory


def test_a_count_is_ignored_without_a_gate_and_counts_for_its_own_pause_at_most():
    problem = pushed_in()
    rest, shape = problem.rest_state(), problem.positions.shape
    stale = replace(rest, memory={PAUSE: np.full(shape, 4.0)})
    stepper = pc.BatchStepper([problem])
    for gate in (None, Gate(**NOTHING, pause=0)):
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), wary(problem), gate=gate)
        found, expected = hybrid(stale), hybrid(rest)
        assert found.stats["gate"] == 0.0 < found.stats["correction"]
        assert same(found.state, expected.state)
        assert not found.state.memory
        many = BatchHybrid(stepper, hybrid.corrector, gate=gate)
        one, other = many(stepper.state([stale])), many(stepper.state([rest]))
        assert one.reasons.tolist() == [0]
        assert torch.equal(one.state.positions, other.state.positions)
        assert not one.state.memory
    hybrid = HybridStepper(
        pc.ProjectiveDynamics(problem), wary(problem), gate=Gate(**NOTHING, pause=2)
    )
    reasons = [result.stats["gate"] for _, result in results_of(hybrid, 3, stale)]
    assert reasons == [P, P, 0]  # no gate is shut for longer than its own pause


# --- its definition --------------------------------------------------------------------------

SHUTTING = set(Reason) - {Reason.NONE, Reason.BODY, Reason.TIME_STEP, Reason.PAUSE}


def counted(reasons, pause):
    """For how many steps it stays shut after each of some: by the last that was refused."""
    shut, last = [], None
    for step, reason in enumerate(reasons):
        last = step if reason in SHUTTING else last
        shut.append(0 if last is None else max(0, pause - (step - last)))
    return shut


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.integers(0, 6),
    st.lists(st.lists(st.sampled_from(list(Reason)), min_size=3, max_size=3), max_size=20),
)
def test_the_count_goes_by_the_last_refusal_in_arrays_and_tensors(pause, rows):
    """Three scenes, whose reasons are any."""
    gate = Gate(pause=pause)
    scenes = [counted([row[scene] for row in rows], pause) for scene in range(3)]
    expected = list(zip(*scenes, strict=True))
    for kind in (np.array, torch.tensor):
        left, found = None, []
        for row in rows:
            left = gate.steps_shut(kind([int(r) for r in row]), left)
            found.append(tuple(left.tolist()))
        assert found == expected


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.integers(0, 4), st.lists(st.tuples(st.booleans(), st.booleans()), max_size=20))
def test_what_counts_has_passed_and_so_have_all_steps_of_the_pause_before(pause, passes):
    gate = Gate(pause=pause)
    for kind in (np.array, torch.tensor):
        left = None
        for step, row in enumerate(passes):
            verdicts = kind([0 if good else int(Reason.FEATURES) for good in row])
            found = Decision(None, None, verdicts, None).paused(left).reasons
            for scene, reason in enumerate(found.tolist()):
                before = [good[scene] for good in passes[max(0, step - pause) : step]]
                if not row[scene]:
                    assert reason == Reason.FEATURES
                else:
                    assert reason == (0 if all(before) else Reason.PAUSE)
            left = gate.steps_shut(found, left)


# --- many scenes -----------------------------------------------------------------------------


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_one_scene_of_a_batch_pauses_as_a_single_one_does_and_the_other_does_not(placement):
    scenes = [pushed_in(2), pushed_in(cells=(2, 2, 1))]
    corrector, gate = wary(*scenes, placement=placement), Gate(**NOTHING, pause=2)
    stepper = pc.BatchStepper(scenes, 1e-12)
    many = BatchHybrid(stepper, corrector, gate=gate)
    alone = [
        HybridStepper(pc.ProjectiveDynamics(p, 1e-12), wary(p, placement=placement), gate=gate)
        for p in scenes
    ]
    state, states, shut = stepper.rest_state(), [p.rest_state() for p in scenes], []
    for step in range(6):
        plain, result = stepper(replace(state, memory={})), many(state)
        state = result.state
        for i, hybrid in enumerate(alone):
            one = hybrid(states[i])
            states[i], found = one.state, stepper.states(state)[i]
            assert result.reasons[i] == one.stats["gate"]
            assert np.abs(found.positions - one.state.positions).max() < 1e-8 * CELL
            assert found.memory.get(PAUSE, np.zeros(1)).max() == left_after(one)
            if result.reasons[i]:
                assert torch.equal(state.positions[i], plain.state.positions[i])
                assert torch.equal(state.velocities[i], plain.state.velocities[i])
            else:
                assert not torch.equal(state.positions[i], plain.state.positions[i])
        shut.append(set(state.memory))
        if PAUSE in state.memory:
            kept = state.memory[PAUSE]
            assert not kept[~stepper.node_mask].any()
            assert not kept[1].any()
        assert result.reasons[1] == 0, step
    assert shut == [set(), {PAUSE}, {PAUSE}, set(), set(), set()]


def test_scenes_of_a_batch_go_on_as_single_ones_in_the_middle_of_a_pause():
    scenes = [pushed_in(1), pushed_in(cells=(2, 2, 1))]
    corrector, gate = wary(*scenes), Gate(**NOTHING, pause=2)
    stepper = pc.BatchStepper(scenes)
    state = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state()).state
    reasons = []
    for problem, own in zip(scenes, stepper.states(state), strict=True):
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), wary(problem), gate=gate)
        reasons.append([r.stats["gate"] for _, r in results_of(hybrid, 3, own)])
    assert reasons == [[P, P, 0], [0, 0, 0]]


def test_rollouts_of_an_evaluation_carry_the_pause_on():
    scenes = [pushed_in(1, 2, 6), pushed_in(3, cells=(2, 2, 1))]
    stepper = pc.BatchStepper(scenes)
    hybrid = BatchHybrid(stepper, wary(*scenes), gate=Gate(**NOTHING, pause=2))
    one, other = roll_out(hybrid, stepper, [8, 7])
    assert (one.reasons > 0).tolist() == [True, True, True, True, False, True, True, True]
    assert (other.reasons > 0).tolist() == [False, False, True, True, True, False, False]
    assert (one.failed, other.failed) == (None, None)


# --- what states remember --------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["backward-euler", "generalised-alpha"])
def test_a_run_goes_on_from_its_file_in_the_middle_of_a_pause(tmp_path, integrator):
    problem = pushed_in(2, time={"integrator": integrator})
    corrector = wary(pushed_in())
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=Gate(**NOTHING, pause=3))
    whole = pc.rollout(hybrid, 7)
    assert whole.stats["gate"].tolist() == [0, N, P, P, P, 0, 0]
    for frames in range(1, 7):
        path = tmp_path / f"{frames}.h5"
        pc.save_trajectory(path, pc.rollout(hybrid, frames))
        read = pc.load_trajectory(path)
        assert (PAUSE in read.memory) == (frames > 1)
        rest = pc.rollout(hybrid, 7 - frames, state=continue_from(hybrid, read))
        assert np.array_equal(rest.positions, whole.positions[frames:])
        assert np.array_equal(rest.velocities, whole.velocities[frames:])
        assert np.array_equal(rest.stats["gate"], whole.stats["gate"][frames:])
    middle = pc.load_trajectory(tmp_path / "3.h5").state(-1)
    forgetful = {name: x for name, x in middle.memory.items() if name != PAUSE}
    other = pc.rollout(hybrid, 4, state=replace(middle, memory=forgetful))
    assert not np.array_equal(other.positions[-1], whole.positions[-1])


def test_a_file_that_is_written_frame_by_frame_holds_the_counts(tmp_path):
    """They come after the first frames, and end before the last; it is stopped between."""
    problem, path = pushed_in(2), tmp_path / "run.h5"
    hybrid = HybridStepper(
        pc.ProjectiveDynamics(problem), wary(problem), gate=Gate(**NOTHING, pause=2)
    )
    run, results = pc.rollout(hybrid, 6), [r for _, r in results_of(hybrid, 6)]
    about = {"scene_toml": run.scene_toml, "attributes": run.attributes}
    with TrajectoryWriter(path, run.points, run.cells, run.state(0), **about) as writer:
        for result in results[:3]:
            writer.append(result, 0.0)
    assert pc.load_trajectory(path).state(-1).memory[PAUSE][0, 0] == 1.0
    with TrajectoryWriter.resume(path) as writer:
        for result in results[3:]:
            writer.append(result, 0.0)
    read = pc.load_trajectory(path)
    none = np.nan
    np.testing.assert_array_equal(
        read.memory[PAUSE][:, 0, 0], [none, none, 2.0, 1.0, none, none, none]
    )
    assert np.array_equal(read.memory[PAUSE], run.memory[PAUSE], equal_nan=True)
    assert np.array_equal(read.positions, run.positions)


def test_the_count_stands_beside_the_correction_before_and_the_integrator_s_memory():
    names = (*preset("compact").node_features, "previous-correction")
    problem = pushed_in(1, time={"integrator": "generalised-alpha"})
    corrector = wary(pushed_in(), node_features=names)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=Gate(**NOTHING, pause=1))
    after = [r.state.memory for _, r in results_of(hybrid, 3)]
    own = {"accelerations", "internal_forces", MEMORY}
    assert [set(memory) for memory in after] == [own | {PAUSE}, own, own]
    assert not after[1][MEMORY].any()
    assert after[2][MEMORY].any()


MOVING = {
    "times": [0.0, 0.02, 0.1], "rotation": [0.0, 10.0, 0.0], "centre": [0, 0.01, 0.01], "axis": "x",
}  # fmt: skip


@pytest.mark.parametrize(
    "integrator", ["backward-euler", "bdf2", "midpoint", "generalised-alpha", "quasi-static"]
)
def test_plain_steppers_know_nothing_of_a_pause(integrator):
    """Neither from rest nor from a later state of their own, under clamps that move."""
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": MOVING}]
    scene = soft_beam(loads=[TORSION], clamps=clamps, solver={"mass": "consistent"})
    problem = pc.discretise(scene)
    plain = pc.ProjectiveDynamics(problem, integrator=integrator)
    kept, bare = {PAUSE: np.full(problem.positions.shape, 3.0)}, problem.rest_state()
    for step in range(3):
        paused = replace(bare, memory={**bare.memory, **kept})
        found, expected = plain(paused), plain(bare)
        assert same(found.state, expected.state), step
        assert set(found.state.memory) == set(expected.state.memory)
        bare = expected.state


@pytest.mark.parametrize(
    "integrator", ["backward-euler", "bdf2", "midpoint", "generalised-alpha", "quasi-static"]
)
def test_plain_batches_know_nothing_of_a_pause(integrator):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    stepper = pc.BatchStepper([problem], integrator=integrator)
    bare = stepper.rest_state()
    for step in range(3):
        kept = {PAUSE: torch.full_like(bare.positions, 3.0)}
        paused = replace(bare, memory={**bare.memory, **kept})
        found, expected = stepper(paused).state, stepper(bare).state
        assert torch.equal(found.positions, expected.positions), step
        assert torch.equal(found.velocities, expected.velocities)
        assert set(found.memory) == set(expected.memory)
        bare = expected


# --- loads that turn round -------------------------------------------------------------------


def turning_round(hybrid, load, steps):
    """Reasons of steps under a load (N, 3), N, that turns round at each, and all corrections, m."""
    state, reasons, corrections = hybrid.problem.rest_state(), [], []
    for step in range(steps):
        result = hybrid(state, (-1.0) ** step * load)
        reasons.append(int(result.stats["gate"]))
        corrections.append(result.stats["correction"])
        state = result.state
    return reasons, corrections


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_of_a_load_that_turns_round_the_first_step_alone_is_corrected(placement):
    """The network is refused where the load points along -y, as unlike its training."""
    problem = pushed_in()
    corrector, coarse = wary(problem, placement=placement), pc.ProjectiveDynamics(problem)
    load = problem.mass[:, None] * [0.0, 1.0, 0.0]
    reasons, corrections = turning_round(
        HybridStepper(coarse, corrector, gate=Gate(**NOTHING)), load, 12
    )
    assert reasons == [0, N] + [P, N] * 5
    assert corrections[0] > 0.0
    assert not any(corrections[1:])
    reasons, corrections = turning_round(
        HybridStepper(coarse, corrector, gate=Gate(**NOTHING, pause=0)), load, 12
    )
    assert reasons == [0, N] * 6
    assert corrections == corrections[:2] * 6


def test_a_released_model_corrects_the_first_step_alone_under_a_torsion_that_turns_round():
    """Its gate knows the steps under the torsion, and none of those between."""
    scene = pc.Scene.load(ROOT / "examples" / "unseen_cross.toml")
    hybrid = pc.hybrid_of(scene.with_changes(loads=[]), "torsion-exact")
    load = pc.hybrid_of(scene, "torsion-exact").problem.external_forces(0.0, STEP)
    found = {}
    for pause in (0, Gate().pause):
        other = HybridStepper(
            hybrid.coarse, hybrid.corrector, velocity=hybrid.velocity, gate=Gate(pause=pause)
        )
        found[pause] = turning_round(other, load, 8)
    reasons, corrections = found[5]
    assert reasons == [0, Reason.FEATURES] + [P, Reason.FEATURES] * 3
    assert sum(corrections) == corrections[0] > 0.0
    reasons, corrections = found[0]
    assert reasons == [0, Reason.FEATURES] * 4
    assert sum(corrections) > 3.0 * corrections[0]
