"""Rollouts and single steps of correctors, in batches and scene by scene."""

import importlib
import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import pdcorrect as pc  # noqa: E402
from conftest import beam  # noqa: E402
from evaluation_samples import TINY, Fake, as_stored, fake, perfect, untrained  # noqa: E402
from pdcorrect.corrector.gate import Gate, Reason  # noqa: E402
from pdcorrect.data.schema import read_shard, write_shard  # noqa: E402
from pdcorrect.errors import ConvergenceError, InputError  # noqa: E402
from pdcorrect.evaluation.evaluation import (  # noqa: E402
    EvaluatedRun,
    evaluate,
    saved_candidates,
)
from pdcorrect.evaluation.measures import (  # noqa: E402
    measure,
    read_cases,
)
from pdcorrect.evaluation.rollouts import (  # noqa: E402  # noqa: E402
    Outcome,
    roll_out,
    roll_out_alone,
    single_steps,
    single_steps_alone,
)
from pdcorrect.metrics import error_corrected  # noqa: E402
from pdcorrect.state import Status  # noqa: E402
from training_samples import shortened  # noqa: E402


@pytest.fixture(scope="module")
def cases():
    return read_cases(TINY, bases=["best"]).cases


@pytest.fixture(scope="module")
def evaluation(cases):
    candidates = [
        fake(cases, perfect, "perfect", refused=(1, 2)),
        fake(cases, as_stored("plain"), "like plain"),
        fake(cases, as_stored("best"), "like best", "best"),
    ]
    return evaluate(candidates, TINY, batch=3)


# --- Omega -----------------------------------------------------------------------------


def test_a_perfect_model_removes_all_of_the_error(evaluation):
    for one in evaluation.runs["perfect"].trajectories:
        found = one.measures
        assert found.omega == found.omega_base == 100.0
        assert found.step_omega == 100.0
        assert found.rms_error == found.worst_node == found.stress_error == 0.0
        assert found.energy_error == found.linear_momentum_error == 0.0
        assert not one.errors.any()
    values, meshes = evaluation.runs["perfect"].values("gate_rate")
    assert values == [10.0] * 4  # of the steps were refused
    assert sorted(meshes) == [0, 1, 2, 2]
    assert evaluation.runs["like plain"].values("gate_rate")[0] == [0.0] * 4


def test_a_model_without_correction_has_the_omega_of_its_base(evaluation, cases):
    for one in evaluation.runs["like plain"].trajectories:
        assert one.measures.omega == 0.0
        assert one.measures.step_omega == pytest.approx(0.0, abs=1e-2)
    pairs = zip(evaluation.runs["like best"].trajectories, cases, strict=True)
    for one, case in pairs:
        expected = error_corrected(case.runs["best"], case.runs["plain"], case.reference)
        assert one.measures.omega == pytest.approx(expected, rel=1e-12)
        assert one.measures.omega_base == 0.0
        assert (one.measures.mesh, one.measures.simulation) == (case.mesh, case.simulation)


def test_several_processes_measure_what_one_does(shorter):
    done = []
    one_by_one = evaluate([], shorter, batch=3, incomplete=True)
    found = evaluate(
        [], shorter, batch=3, workers=2, incomplete=True, on_cases=lambda *row: done.append(row)
    )
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert found.runs.keys() == one_by_one.runs.keys()
    for name, run in found.runs.items():
        pairs = zip(run.trajectories, one_by_one.runs[name].trajectories, strict=True)
        for one, other in pairs:
            assert one.measures == other.measures, name
            np.testing.assert_array_equal(one.errors, other.errors)


def test_stored_runs_are_measured_as_the_models_are(evaluation):
    stored, same = evaluation.runs["best"], evaluation.runs["like best"]
    for one, other in zip(stored.trajectories, same.trajectories, strict=True):
        for name in ("omega", "rms_error", "energy_loss", "stress_error", "worst_node"):
            pair = getattr(one.measures, name), getattr(other.measures, name)
            assert pair[0] == pytest.approx(pair[1], rel=1e-12), name
    assert "intermediate" in evaluation.runs
    assert evaluation.runs["intermediate"].values("step_omega") == ([], [])


def test_steps_after_a_failure_do_not_count_as_corrected(cases):
    case = cases[0]
    reasons = np.zeros(case.steps, dtype=np.int64)
    reasons[:2] = Reason.OUTSIDE
    outcomes = [Outcome(case.reference, None, "plain", reasons, failed) for failed in (3, 4, None)]
    runs = [EvaluatedRun("run", None, (measure(case, one),)) for one in outcomes]
    assert [all(run.reasons) for run in runs] == [True, False, False]
    assert [len(run.trajectories[0].reasons) for run in runs] == [2, 3, case.steps]


def test_names_bases_splits_and_counts_that_cannot_be_are_refused(cases):
    for names in (("a", "a"), ("best",), ("reference",)):
        with pytest.raises(InputError, match=names[0]):
            evaluate([fake(cases, perfect, name) for name in names], TINY)
    for base in ("intermediate", "total-mass"):
        with pytest.raises(InputError, match=f"'{base}'"):
            evaluate([fake(cases, perfect, base=base)], TINY)
    for options, words in (
        ({"split": "test"}, "'test'"), ({"batch": 0}, "batch = 0"), ({"workers": 0}, "workers = 0")
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            evaluate([], TINY, **options)


# --- rollouts --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair(cases):
    """A stepper of two scenes of unlike sizes."""
    chosen = (cases[0], cases[1])
    assert chosen[0].reference.shape != chosen[1].reference.shape
    return chosen, pc.BatchStepper([case.problems["plain"] for case in chosen])


def test_a_scene_that_fails_is_held_and_the_others_reach_the_frames_asked_for(pair):
    chosen, stepper = pair
    runs = roll_out(Fake(stepper, chosen, perfect), stepper, [3, 7])
    for run, case, count in zip(runs, chosen, (3, 7), strict=True):
        np.testing.assert_allclose(run.positions[1:], case.reference[1 : count + 1], atol=1e-15)
        assert run.reasons.shape == (count,)
        assert run.failed is None

    chosen, stepper = pair

    def breaking(case, t, x):
        return np.full_like(x, np.nan) if case is chosen[1] and t == 4 else perfect(case, t, x)

    one, other = roll_out(Fake(stepper, chosen, breaking, refused=range(9)), stepper, [8, 8])
    assert (one.failed, other.failed) == (None, 5)
    np.testing.assert_array_equal(other.positions[5:], np.stack([other.positions[4]] * 4))
    np.testing.assert_allclose(other.positions[4], chosen[1].reference[4], atol=1e-15)
    np.testing.assert_allclose(one.positions[8], chosen[0].reference[8], atol=1e-15)
    assert (other.reasons > 0).tolist() == [True] * 4 + [False] * 4
    found = measure(chosen[1], Outcome(_cut(other, chosen[1]), failed=other.failed)).measures
    assert found.failed == 5
    assert found.omega < 100.0


def _cut(run, case):
    """The rollout held until the case's last frame."""
    more = case.steps + 1 - len(run.positions)
    return np.concatenate([run.positions, np.stack([run.positions[-1]] * more)])


@pytest.mark.parametrize("away", [1e5, 1e160])
def test_a_scene_that_flies_away_has_failed(pair, away):
    chosen, stepper = pair

    def leaving(case, t, x):
        gone = case is chosen[0] and t >= 2
        return perfect(case, t, x) + (away if gone else 0.0)

    one, other = roll_out(Fake(stepper, chosen, leaving), stepper, [5, 5])
    assert (one.failed, other.failed) == (3, None)
    np.testing.assert_array_equal(one.positions[3:], np.stack([one.positions[2]] * 3))


def test_a_run_that_cannot_be_measured_is_not_left_out(cases):
    gone = cases[0].reference.copy()
    gone[5:] *= 1e160
    with np.errstate(over="ignore"), pytest.raises(ConvergenceError, match="omega"):
        measure(cases[0], Outcome(gone))


def test_a_step_that_does_not_converge_is_a_failure(pair):
    chosen, stepper = pair
    hybrid = Fake(stepper, chosen, perfect)

    def stopped(state, previous=None):
        result = hybrid(state)
        result.coarse.statuses = [Status.CONVERGED, Status.ITERATION_LIMIT]
        return result

    runs = roll_out(stopped, stepper, [2, 2])
    assert [run.failed for run in runs] == [None, 1]
    steps = single_steps(stopped, stepper, [c.reference[:3] for c in chosen], [None, None])
    np.testing.assert_allclose(steps[0], chosen[0].reference[1:3], atol=1e-15)
    np.testing.assert_allclose(steps[1], chosen[1].reference[:2], atol=1e-15)


def test_the_correction_before_a_single_step_is_what_the_coarse_step_lacked(pair):
    chosen, stepper = pair
    hybrid, seen = Fake(stepper, chosen, perfect), []

    def watched(state, previous=None):
        seen.append(previous.numpy().copy())
        return hybrid(state)

    references = [case.reference[:4] for case in chosen]
    predictions = [case.predictions["plain"] for case in chosen]
    single_steps(watched, stepper, references, [predictions[0], None])
    n = len(references[0][0])
    assert not seen[0].any()
    np.testing.assert_allclose(seen[2][:n], references[0][2] - predictions[0][1], atol=1e-15)
    assert not seen[2][n:].any()


# --- saved models ----------------------------------------------------------------------


def test_the_gate_refuses_what_the_network_has_not_seen_unless_it_is_off(tmp_path, pair):
    """A fitted range of nothing: every body, and every input, lies outside."""
    _, stepper = pair
    path = untrained(tmp_path / "model")
    for gate, rate in ((Gate(), 1.0), (None, 0.0)):
        (saved,) = saved_candidates([path], gate=gate)
        runs = roll_out(saved.hybrid(stepper), stepper, [2, 2])
        assert [(run.reasons > 0).mean() for run in runs] == [rate, rate]


@pytest.fixture(scope="module")
def shorter(tmp_path_factory):
    """Two meshes of tiny's evaluation split, of which three simulations, up to frame 8."""
    folder = tmp_path_factory.mktemp("shorter")
    for name in ("evaluation/mesh-0000.h5", "evaluation/mesh-0002.h5"):
        shard = shortened(read_shard(TINY / name), 8)
        (folder / name).parent.mkdir(exist_ok=True)
        write_shard(folder / name, shard, "float32")
    return folder


@pytest.mark.parametrize("gate", [pytest.param(None, marks=pytest.mark.slow), pc.Gate()])
def test_scenes_alone_are_evaluated_as_in_a_batch(shorter, gate):
    """Which a CPU does, since it is quicker: to the tolerance of the coarse solver."""
    (saved,) = saved_candidates(["tiny"], gate=gate)
    batch = replace(saved, name="batch", alone=None)
    found = evaluate([saved, batch], shorter, device="cpu", incomplete=True)
    alone = found.runs[saved.name].trajectories
    for one, other in zip(alone, found.runs["batch"].trajectories, strict=True):
        assert one.measures.failed == other.measures.failed
        assert one.measures.gate_rate == other.measures.gate_rate
        assert one.measures.omega == pytest.approx(other.measures.omega, abs=0.05)
        assert one.measures.step_omega == pytest.approx(other.measures.step_omega, abs=0.05)


def test_a_gate_refuses_alone_as_in_a_batch(cases):
    """Of the first scene; in others two gates may part where energy is at its bound."""
    (saved,) = saved_candidates(["tiny"], gate=Gate(energy=0.01))
    problem = cases[0].problems[saved.base]
    stepper = pc.BatchStepper([problem])
    (expected,) = roll_out(saved.hybrid(stepper), stepper, [20])
    found = roll_out_alone(saved.alone(problem), 20)
    assert {0, Reason.ENERGY} == set(found.reasons.tolist())
    np.testing.assert_array_equal(found.reasons, expected.reasons)


@pytest.mark.parametrize("lost", [np.nan, 1e9])
def test_a_scene_alone_that_is_lost_has_failed(cases, lost):
    (saved,) = saved_candidates(["tiny"], gate=None)
    hybrid = saved.alone(cases[0].problems[saved.base])
    step = type(hybrid).__call__

    class Lost:
        problem, coarse, remembers = hybrid.problem, hybrid.coarse, hybrid.remembers

        def __call__(self, state):
            result, after = step(hybrid, state), SimpleNamespace()
            after.positions = result.state.positions + lost
            after.velocities = result.state.velocities
            return replace(result, state=after)

    run = roll_out_alone(Lost(), 3)
    assert run.failed == 1
    np.testing.assert_array_equal(run.positions, np.stack([hybrid.problem.positions] * 4))
    if np.isnan(lost):
        reference = cases[0].reference[:3]
        np.testing.assert_array_equal(single_steps_alone(Lost(), reference, None), reference[:2])


def test_single_steps_alone_are_given_what_the_coarse_step_lacked(cases):
    given = []
    problem, case = cases[0].problems["plain"], cases[0]

    def hybrid(state):
        given.append(state.memory)
        return SimpleNamespace(state=state, status=Status.CONVERGED)

    hybrid.coarse, hybrid.remembers = pc.ProjectiveDynamics(problem), True
    steps = single_steps_alone(hybrid, case.reference[:3], case.predictions["plain"])
    np.testing.assert_array_equal(steps, case.reference[:2])
    first, second = (memory["previous_correction"] for memory in given)
    assert not first.any()
    np.testing.assert_allclose(second, case.reference[1] - case.predictions["plain"][0])
    hybrid.remembers = False
    single_steps_alone(hybrid, case.reference[:2], None)
    assert given[-1] == {}


def test_a_scene_alone_that_fails_is_held(cases):
    (saved,) = saved_candidates(["tiny"], gate=None)
    hybrid = saved.alone(cases[0].problems[saved.base])
    step, count = type(hybrid).__call__, itertools.count(1)

    class Failing:
        problem, coarse, remembers = hybrid.problem, hybrid.coarse, hybrid.remembers

        def __call__(self, state):
            result = step(hybrid, state)
            result = replace(result, stats={**result.stats, "gate": 1.0})
            return replace(result, status=Status.LINE_SEARCH) if next(count) == 3 else result

    run = roll_out_alone(Failing(), 6)
    assert run.failed == 3
    assert run.reasons.tolist() == [1, 1, 0, 0, 0, 0]
    assert run.positions.shape == (7, *hybrid.problem.positions.shape)
    assert not np.array_equal(run.positions[2], run.positions[1])
    for frame in run.positions[3:]:
        np.testing.assert_array_equal(frame, run.positions[2])


# --- speed -----------------------------------------------------------------------------


@dataclass
class Uncorrected:
    """A stepper as a hybrid; counts its steps."""

    stepper: object
    steps: int = 0

    def __call__(self, state, previous=None):
        self.steps += 1
        result = self.stepper(state)
        n, count = sum(self.stepper.node_counts), len(result.statuses)
        return SimpleNamespace(
            state=result.state, correction=torch.zeros(n, 3), coarse=result,
            reasons=torch.zeros(count, dtype=torch.int64),
        )  # fmt: skip


@pytest.fixture
def speed(monkeypatch):
    """The benchmark's module that times steps."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    return importlib.import_module("speed")


def test_solvers_are_compared_at_equal_accuracy(speed):
    pulled = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]
    loaded = beam((2, 1, 1), cell_size=0.1, loads=pulled)
    made = []

    def hybrid(stepper):
        made.append(Uncorrected(stepper))
        return made[0]

    coarse, fine = ([pc.discretise(loaded, refine=k)] * 2 for k in (1, 2))
    found = speed.measure_speed(coarse, fine, hybrid, accuracy=1e-3, steps=2)
    solvers = (found.coarse, found.hybrid, found.fine, found.fine_one_by_one)
    assert all(0 < s.solver_error <= 1e-3 for s in solvers)
    assert all(s.seconds > 0 for s in solvers)
    assert made[0].steps == 4  # two of them to warm up
    assert made[0].stepper.tolerances == (found.coarse.tolerance,) * 2
    assert found.scenes == 2
    assert found.coarse.nodes == 2 * len(coarse[0].positions)
    quickest = min(found.fine.seconds, found.fine_one_by_one.seconds)
    assert found.speed_up == quickest / found.hybrid.seconds
    with pytest.raises(InputError, match="2 .* 1 |1 .* 2 |as many"):
        speed.measure_speed(coarse, fine[:1], hybrid)

    assert speed._loosest(lambda tolerance: 2 * tolerance, 1e-3) == (3e-4, 6e-4)
    assert speed._loosest(lambda tolerance: 0.5 * tolerance, 1e-3) == (1e-3, 5e-4)
    with pytest.raises(ConvergenceError, match="tolerance"):
        speed._loosest(lambda tolerance: 1.0, 1e-3)
