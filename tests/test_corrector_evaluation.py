"""Evaluation of correctors: measures, rollouts, resampling, tables, files, commands."""

import csv
import io
import itertools
import json
import shutil
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from typer.testing import CliRunner  # noqa: E402

import pdcorrect as pc  # noqa: E402
from pdcorrect.batch.states import BatchState  # noqa: E402
from pdcorrect.cli.main import app  # noqa: E402
from pdcorrect.corrector.bodies import BodyGraph  # noqa: E402
from pdcorrect.corrector.config import preset  # noqa: E402
from pdcorrect.corrector.corrector import Corrector  # noqa: E402
from pdcorrect.corrector.gate import Gate, Reason  # noqa: E402
from pdcorrect.corrector.model_io import ModelRecord, save_model  # noqa: E402
from pdcorrect.corrector.normaliser import Moments  # noqa: E402
from pdcorrect.data.simulate import rebuilt_problems  # noqa: E402
from pdcorrect.data.shard_reader import read_shard  # noqa: E402
from pdcorrect.errors import ConvergenceError, FileFormatError, InputError  # noqa: E402
from pdcorrect.evaluation import tables  # noqa: E402
from pdcorrect.evaluation.alone import roll_out_alone, single_steps_alone  # noqa: E402
from pdcorrect.evaluation.candidates import saved_candidates  # noqa: E402
from pdcorrect.evaluation.measures import Case, read_cases  # noqa: E402
from pdcorrect.evaluation.evaluation import Candidate, EvaluatedRun, evaluate  # noqa: E402
from pdcorrect.evaluation.measures import (  # noqa: E402
    Measured,
    Outcome,
    TrajectoryMeasures,
    measure,
    time_within,
)
from pdcorrect.evaluation.resampling import mean_interval, over_seeds, summarise  # noqa: E402
from pdcorrect.evaluation.rollouts import roll_out, single_steps  # noqa: E402
from pdcorrect.evaluation.speed import _loosest, measure_speed  # noqa: E402
from pdcorrect.figures.curves import plot_omega, plot_validations  # noqa: E402
from pdcorrect.metrics import error_corrected, mean_squared_error  # noqa: E402
from pdcorrect.state import State, Status  # noqa: E402

TINY = Path(__file__).parent.parent / "datasets" / "tiny"
FRAMES, STEP = 5, 0.01


# --- hybrids that need no network -------------------------------------------------------


class Fake:
    """A hybrid whose next positions of a scene are `answer(case, frame, positions)`."""

    def __init__(self, stepper, cases, answer, refused=(), reason=Reason.FEATURES):
        self.stepper, self.answer = stepper, answer
        self.reasons = dict.fromkeys(refused, int(reason))
        known = {case.problems["plain"].scene.name: case for case in cases}
        self.cases = [known[p.scene.name] for p in stepper.problems]

    def __call__(self, state, previous=None):
        h, found = self.stepper.time_step, []
        for i, one in enumerate(self.stepper.states(state)):
            t = round(one.time / h)
            x = self.answer(self.cases[i], t, one.positions)
            found.append((x, (x - one.positions) / h, one.time + h))
        after = self.state(found)
        n, count = sum(self.stepper.node_counts), len(found)
        return SimpleNamespace(
            state=after,
            correction=torch.zeros(n, 3, dtype=torch.float64),
            coarse=SimpleNamespace(statuses=[Status.CONVERGED] * count),
            reasons=torch.tensor([self.reasons.get(round(s[2] / h), 0) for s in found]),
        )

    def state(self, found):
        finite = self.stepper.state(
            [State(np.nan_to_num(x), np.nan_to_num(v), t) for x, v, t in found]
        )
        positions = finite.positions.clone()
        for i, (x, _, _) in enumerate(found):
            positions[i, : len(x)] = torch.as_tensor(x)
        return BatchState(positions, finite.velocities, finite.times, finite.memory)


def fake(cases, answer, name="fake", base="plain", group=None, **options):
    return Candidate(name, base, lambda stepper: Fake(stepper, cases, answer, **options), group)


def perfect(case, t, x):
    return case.reference[min(t + 1, case.steps)]


def as_stored(name):
    """What a stored run does, from the reference's frames and from its own."""

    def answer(case, t, x):
        if t and np.allclose(x, case.reference[t], rtol=0, atol=1e-12):
            return case.predictions[name][t]
        return case.runs[name][t + 1]

    return answer


@pytest.fixture(scope="module")
def cases():
    return read_cases(TINY, bases=["best"], skip_damaged=False).cases


@pytest.fixture(scope="module")
def evaluation(cases):
    candidates = [
        fake(cases, perfect, "perfect", group="fakes", refused=(1, 2)),
        fake(cases, as_stored("plain"), "like plain", group="fakes"),
        fake(cases, as_stored("best"), "like best", "best"),
    ]
    return evaluate(candidates, TINY, batch=3)


# --- Omega -----------------------------------------------------------------------------


def test_a_perfect_model_removes_all_of_the_error(evaluation):
    for one in evaluation.runs["perfect"].trajectories:
        found = one.measures
        assert found.omega == found.omega_base == found.rms_reduction == 100.0
        assert found.step_omega == 100.0
        assert found.rms_error == found.worst_node == found.stress_error == 0.0
        assert found.energy_error == found.linear_momentum_error == 0.0
        assert not one.errors.any()
        assert found.within_1 == pytest.approx(20 * STEP)


def test_a_model_without_correction_has_the_omega_of_its_base(evaluation, cases):
    for one in evaluation.runs["like plain"].trajectories:
        assert one.measures.omega == one.measures.rms_reduction == 0.0
        assert one.measures.step_omega == pytest.approx(0.0, abs=1e-2)
    pairs = zip(evaluation.runs["like best"].trajectories, cases, strict=True)
    for one, case in pairs:
        expected = error_corrected(case.runs["best"], case.runs["plain"], case.reference)
        assert one.measures.omega == pytest.approx(expected, rel=1e-12)
        assert one.measures.omega_base == 0.0
        assert (one.measures.mesh, one.measures.simulation) == (case.mesh, case.simulation)


def test_several_processes_measure_what_one_does(evaluation):
    done = []
    found = evaluate([], TINY, batch=3, workers=2, on_cases=lambda *row: done.append(row))
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert found.runs.keys() < evaluation.runs.keys()
    for name, run in found.runs.items():
        pairs = zip(run.trajectories, evaluation.runs[name].trajectories, strict=True)
        for one, other in pairs:
            assert one.measures == other.measures, name
            np.testing.assert_array_equal(one.errors, other.errors)


def test_stored_runs_are_measured_as_the_models_are(evaluation):
    stored, same = evaluation.runs["best"], evaluation.runs["like best"]
    for one, other in zip(stored.trajectories, same.trajectories, strict=True):
        for name in ("omega", "rms_error", "energy_loss", "stress_error", "within_2"):
            pair = getattr(one.measures, name), getattr(other.measures, name)
            assert pair[0] == pytest.approx(pair[1], rel=1e-12), name
    assert "intermediate" in evaluation.runs
    assert evaluation.runs["intermediate"].values("step_omega") == ([], [])


def test_the_gates_rate_is_the_share_of_refused_steps(evaluation):
    values, meshes = evaluation.runs["perfect"].values("gate_rate")
    assert values == [10.0] * 4
    assert sorted(meshes) == [0, 1, 2, 2]
    assert evaluation.runs["like plain"].values("gate_rate")[0] == [0.0] * 4


def test_of_rollouts_that_a_gate_refuses_as_a_whole_the_reason_is_kept(cases):
    options = {"refused": range(1, 21)}
    candidates = [
        fake(cases, perfect, reason.name, reason=reason, **options)
        for reason in (Reason.BODY, Reason.TIME_STEP, Reason.FEATURES)
    ]
    found = evaluate([*candidates, fake(cases, perfect, "open")], TINY, batch=3).runs
    for name, reason in (("BODY", 6), ("TIME_STEP", 9), ("FEATURES", 0), ("open", 0)):
        assert found[name].refused_by() == [reason] * 4
        assert found[name].all_refused == (name != "open")
        assert found[name].shapes().shape == (4 if name == "BODY" else 0, 10)
        assert found[name].values("gate_rate")[0] == [0.0 if name == "open" else 100.0] * 4
    assert found["plain"].refused_by() == [0] * 4
    assert not found["plain"].all_refused
    bodies = BodyGraph.of([case.problems["plain"] for case in cases], dtype=torch.float64)
    np.testing.assert_allclose(found["BODY"].shapes(), bodies.shapes.numpy(), atol=1e-12)


def test_steps_after_a_failure_do_not_count_as_corrected(cases):
    case = cases[0]
    reasons = np.zeros(case.steps, dtype=np.int64)
    reasons[:2] = Reason.FEATURES
    outcomes = [Outcome(case.reference, None, "plain", reasons, failed) for failed in (3, 4, None)]
    runs = [EvaluatedRun("run", None, None, (measure(case, one),)) for one in outcomes]
    assert [run.all_refused for run in runs] == [True, False, False]
    assert [len(run.trajectories[0].reasons) for run in runs] == [2, 3, case.steps]
    assert not EvaluatedRun("run", None, None, ()).all_refused


def test_names_of_models_must_be_unlike(cases):
    for names in (("a", "a"), ("best",), ("reference",)):
        with pytest.raises(InputError, match="expected each one once"):
            evaluate([fake(cases, perfect, name) for name in names], TINY)


def test_unknown_bases_and_splits_are_refused(cases):
    with pytest.raises(InputError, match="base 'intermediate': expected one of plain, best"):
        evaluate([fake(cases, perfect, base="intermediate")], TINY)
    with pytest.raises(InputError, match="no run 'total-mass'"):
        evaluate([fake(cases, perfect, base="total-mass")], TINY)
    with pytest.raises(InputError, match="no split 'test'"):
        evaluate([], TINY, "test")
    with pytest.raises(InputError, match="batch = 0"):
        evaluate([], TINY, batch=0)
    with pytest.raises(InputError, match="workers = 0"):
        evaluate([], TINY, workers=0)


# --- rollouts --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair(cases):
    """A stepper of two scenes of unlike sizes."""
    chosen = (cases[0], cases[1])
    assert chosen[0].reference.shape != chosen[1].reference.shape
    return chosen, pc.BatchStepper([case.problems["plain"] for case in chosen])


def test_rollouts_reach_the_frames_asked_for(pair):
    chosen, stepper = pair
    runs = roll_out(Fake(stepper, chosen, perfect), stepper, [3, 7])
    for run, case, count in zip(runs, chosen, (3, 7), strict=True):
        np.testing.assert_allclose(run.positions[1:], case.reference[1 : count + 1], atol=1e-15)
        assert run.refused.shape == (count,)
        assert run.failed is None


def test_a_scene_that_fails_is_held_and_the_others_go_on(pair):
    chosen, stepper = pair

    def breaking(case, t, x):
        return np.full_like(x, np.nan) if case is chosen[1] and t == 4 else perfect(case, t, x)

    one, other = roll_out(Fake(stepper, chosen, breaking, refused=range(9)), stepper, [8, 8])
    assert (one.failed, other.failed) == (None, 5)
    np.testing.assert_array_equal(other.positions[5:], np.stack([other.positions[4]] * 4))
    np.testing.assert_allclose(other.positions[4], chosen[1].reference[4], atol=1e-15)
    np.testing.assert_allclose(one.positions[8], chosen[0].reference[8], atol=1e-15)
    assert other.refused.tolist() == [True] * 4 + [False] * 4
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
    with np.errstate(over="ignore"), pytest.raises(ConvergenceError, match="omega is -inf"):
        measure(cases[0], Outcome(gone))


def test_measures_that_some_trajectories_lack_are_counted():
    measured = [Measured(TrajectoryMeasures(0, k, omega=1.0)) for k in range(3)]
    measured.append(Measured(TrajectoryMeasures(0, 3, omega=2.0, stress_error=0.1)))
    run = EvaluatedRun("run", None, None, tuple(measured))
    assert run.gaps() == {"stress_error": 3}


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


# --- measures by hand ------------------------------------------------------------------


def scene(**changes):
    values = {
        "body": {"shape": "beam", "cells": [2, 1, 1], "cell_size": 0.1},
        "material": {"young": 1e5, "poisson": 0.3, "density": 1e3},
        "time": {"step": STEP, "frames": FRAMES},
        "clamps": [{"region": {"plane": "x", "at": 0.0}}],
        **changes,
    }
    return pc.Scene(**values)


def case_of(problem, reference, **runs):
    return Case(0, 0, {"plain": problem}, reference, runs, {})


def translated(problem, way):
    """All nodes at distances ``way`` (T+1,) along x."""
    return problem.positions + np.multiply.outer(way, np.array([[1.0, 0.0, 0.0]]))


@pytest.fixture(scope="module")
def beam():
    return pc.discretise(scene())


def test_shares_errors_and_times_are_those_computed_by_hand(beam):
    way = 0.01 * np.arange(FRAMES + 1.0)  # to 0.05 m
    errors = 1e-4 * np.array([0, 4, 6, 20, 30, 10])
    reference = translated(beam, way)
    plain, model = translated(beam, way + 2 * errors), translated(beam, way - errors)
    model[2, 3] += [0.0, 0.01, 0.0]
    case = case_of(beam, reference, plain=plain, **{"time-converged": translated(beam, way + 1e-3)})
    found = measure(case, Outcome(model, base="plain")).measures
    n = len(beam.positions)
    total = n * (errors**2).sum() + 0.01**2
    assert found.omega == pytest.approx(100 * (1 - total / (4 * n * (errors**2).sum())))
    assert found.omega_base == found.omega
    assert found.rms_error == pytest.approx(np.sqrt(total / n / FRAMES))
    assert found.rms_reduction == pytest.approx(
        100 * (1 - np.sqrt(total / (4 * n * (errors**2).sum())))
    )
    assert found.worst_node == pytest.approx(np.hypot(6e-4, 0.01))
    # 1, 2, 5 % of 0.05 m: 0.5, 1, 2.5 mm; frame 2 has 2.6 mm by its one node, n = 12.
    assert [found.within_1, found.within_2, found.within_5] == pytest.approx([0.02, 0.02, 0.02])
    speeds = np.diff(np.concatenate([[0.0], -errors])) / STEP
    at_node = beam.mass[3] * np.array([0, 0, 1, -1, 0, 0]) * 0.01 / STEP
    momentum = np.sqrt((beam.mass.sum() * speeds) ** 2 + at_node**2)
    size = beam.mass.sum() * 0.01 / STEP
    assert found.linear_momentum_error == pytest.approx(np.sqrt((momentum**2).mean()) / size)
    converged = mean_squared_error(model, case.runs["time-converged"])
    base = mean_squared_error(plain, case.runs["time-converged"])
    assert found.converged_omega == pytest.approx(100 * (1 - converged / base))


def test_times_within_a_limit():
    errors = np.array([0.0, 1.0, 2.0, 1.0, 3.0])
    assert time_within(errors, 1.0, 0.1) == pytest.approx(0.2)
    assert time_within(errors, 2.5, 0.1) == pytest.approx(0.4)
    assert time_within(errors, 3.0, 0.1) == pytest.approx(0.4)  # never beyond: the duration
    assert time_within(errors, 0.0, 0.1) == pytest.approx(0.1)


def test_the_stress_error_of_a_slightly_larger_strain_is_its_excess(beam):
    x = beam.positions
    pulled = 1e-5 * x * [1.0, -0.3, -0.3]
    factors = np.linspace(0, 1, FRAMES + 1)[:, None, None]
    reference = x + factors * pulled
    case = case_of(beam, reference)
    found = measure(case, Outcome(x + 1.1 * factors * pulled)).measures
    assert found.stress_error == pytest.approx(0.1, rel=1e-3)
    assert measure(case, Outcome(reference)).measures.stress_error == 0.0


def test_stress_does_not_see_rigid_motion_and_momentum_does(beam):
    reference = translated(beam, np.zeros(FRAMES + 1))
    reference[1:, :, 0] *= 1.001
    moved = reference + 0.02 * np.arange(FRAMES + 1)[:, None, None]
    found = measure(case_of(beam, reference), Outcome(moved)).measures
    assert found.stress_error == pytest.approx(0.0, abs=1e-9)
    assert found.linear_momentum_error > 1.0


def test_backward_euler_in_free_fall_loses_what_it_must():
    gravity = [{"kind": "gravity", "acceleration": [9.0, 0.0, 0.0]}]
    falling = pc.discretise(scene(clamps=[], loads=gravity))
    count = np.arange(FRAMES + 1)
    motion = translated(falling, 9.0 * STEP**2 * count * (count + 1) / 2)
    found = measure(case_of(falling, motion), Outcome(motion, base="plain")).measures
    assert found.energy_loss == pytest.approx(1 / FRAMES, rel=1e-6)


def test_no_loss_is_told_where_energy_goes_elsewhere():
    damped = pc.discretise(scene(damping={"mass": 1.0}))
    motion = translated(damped, 0.01 * np.arange(FRAMES + 1.0))
    found = measure(case_of(damped, motion), Outcome(motion)).measures
    assert found.energy_loss is None


def test_what_is_not_defined_is_none(beam):
    reference = translated(beam, np.zeros(FRAMES + 1))
    found = measure(case_of(beam, reference, plain=reference), Outcome(reference)).measures
    assert found.omega is None  # the plain run has no error to remove
    assert found.omega_base is None
    assert found.converged_omega is None
    assert found.gate_rate is None
    assert found.stress_error is found.energy_error is found.linear_momentum_error is None
    assert measure(case_of(beam, reference), Outcome()).measures == TrajectoryMeasures(0, 0)


# --- resampling ------------------------------------------------------------------------


def test_summaries_are_those_of_the_values():
    found = summarise(np.arange(101.0), np.arange(101))
    assert (found.mean, found.median, found.smallest, found.largest) == (50, 50, 0, 100)
    assert (found.q05, found.q95) == (5.0, 95.0)
    assert (found.count, found.meshes) == (101, 101)


def test_intervals_are_the_same_every_time_and_differ_by_seed():
    values = np.random.default_rng(3).normal(size=30)
    clusters = np.arange(30) // 3
    assert mean_interval(values, clusters, 5) == mean_interval(values, clusters, 5)
    assert mean_interval(values, clusters, 5) != mean_interval(values, clusters, 6)


def test_intervals_cover_the_true_mean_about_as_often_as_they_say():
    rng = np.random.default_rng(0)
    clusters = np.repeat(np.arange(25), 4)
    hits = by_value = 0
    for trial in range(200):
        values = rng.normal(size=25)[clusters] + 0.1 * rng.normal(size=100)
        low, high = mean_interval(values, clusters, trial, resamples=400)
        hits += low <= 0.0 <= high
        low, high = mean_interval(values, np.arange(100), trial, resamples=400)
        by_value += low <= 0.0 <= high
    assert 0.88 <= hits / 200 <= 0.99
    assert by_value / 200 < 0.8  # as if trajectories on one mesh told as much as others


@pytest.mark.parametrize(("count", "least"), [(5, 0.9), (10, 0.93), (20, 0.93)])
def test_intervals_of_few_meshes_cover_nearly_as_often_as_those_of_many(count, least):
    rng = np.random.default_rng(1)
    trials = 1000
    hits = 0
    for trial in range(trials):
        low, high = mean_interval(rng.normal(size=count), range(count), trial, resamples=1000)
        hits += low <= 0.0 <= high
    assert least <= hits / trials <= 0.97


def test_an_interval_of_equal_values_is_a_point_and_of_one_mesh_unknown():
    assert mean_interval([2.0] * 6, [0, 0, 1, 1, 2, 2]) == (2.0, 2.0)
    assert mean_interval([1.0, 2.0], [4, 4]) is None
    with pytest.raises(InputError, match="one or more of each"):
        mean_interval([1.0], [0, 1])
    with pytest.raises(InputError, match="level = 1"):
        mean_interval([1.0, 2.0], [0, 1], level=1.0)


def test_meshes_count_by_their_number_of_trajectories():
    values, clusters = [0.0] * 9 + [10.0], [0] * 9 + [1]
    low, high = mean_interval(values, clusters, resamples=4000)
    assert (low, high) == (0.0, 10.0)  # one mesh drawn twice, either one


def test_seeds_are_summed_up_by_mean_and_deviation():
    found = over_seeds([1.0, 2.0, 6.0])
    assert (found.seeds, found.mean, found.smallest, found.largest) == (3, 3.0, 1.0, 6.0)
    assert found.deviation == pytest.approx(np.sqrt(7.0))
    with pytest.raises(InputError, match="two or more"):
        over_seeds([1.0])


# --- files and tables ------------------------------------------------------------------


def test_trajectories_come_back_from_the_table_as_they_were(evaluation):
    rows = list(csv.DictReader(io.StringIO(tables.trajectories_csv(evaluation))))
    expected = [
        (run.name, t.measures) for run in evaluation.runs.values() for t in run.trajectories
    ]
    assert len(rows) == len(expected) == 4 * 7
    kinds = {
        f.name: int if "int" in str(f.type).split(" | ")[0] else float
        for f in fields(TrajectoryMeasures)
    }
    for row, (name, measures) in zip(rows, expected, strict=True):
        assert row.pop("run") == name
        found = {k: kinds[k](v) if v else None for k, v in row.items()}
        assert TrajectoryMeasures(**found) == measures


def test_errors_over_time_come_back_as_they_were(evaluation):
    rows = list(csv.DictReader(io.StringIO(tables.errors_csv(evaluation))))
    for one in evaluation.runs["best"].trajectories:
        m = one.measures
        mine = [
            r for r in rows
            if (r["run"], r["mesh"], r["simulation"]) == ("best", str(m.mesh), str(m.simulation))
        ]  # fmt: skip
        assert [float(r["rms_error"]) for r in mine] == one.errors.tolist()
        assert [float(r["time"]) for r in mine] == pytest.approx(STEP * np.arange(21))
    assert "reference" not in {r["run"] for r in rows}


def test_the_summary_holds_the_numbers_and_where_they_come_from(evaluation):
    text = tables.to_json(evaluation, {"command": "x"}, seed=3)
    found = json.loads(text)
    assert found["command"] == "x"
    assert found["bootstrap_seed"] == 3
    assert found["data"]["trajectories"] == 4
    assert set(found["data"]["shards"]) == {f"mesh-{k:04d}.h5" for k in range(3)}
    values, meshes = evaluation.runs["best"].values("omega")
    expected = json.loads(json.dumps(asdict(summarise(values, meshes, 3))))
    assert found["runs"]["best"]["measures"]["omega"] == expected
    assert found["runs"]["best"]["measures"]["omega"]["smallest"] == min(values)
    group = found["seeds"]["fakes"]
    assert group["models"] == ["perfect", "like plain"]
    assert group["measures"]["omega"]["mean"] == 50.0
    assert group["measures"]["omega"]["deviation"] == pytest.approx(100 / np.sqrt(2))


def test_tables_name_every_run_and_what_is_removed(evaluation):
    text = tables.markdown(evaluation, ["a note"])
    lines = {line.split("|")[1].strip(): line for line in text.splitlines() if "|" in line}
    assert {"perfect", "like plain", "best", "intermediate", "fakes"} <= set(lines)
    headings, rows = tables.headline(evaluation)
    found = dict(zip(headings, rows[0], strict=True))
    assert found["run"] == "perfect"
    assert found["Omega"] == "100.00"
    assert found["95 % interval"] == "100.00 to 100.00"
    assert found["refused"] == "10.00"
    assert found["failed"] == "0/4"
    assert "-0.00" not in text
    assert text.endswith("- a note\n")


def test_failures_are_counted_in_table_and_summary(evaluation):
    run = evaluation.runs["perfect"]
    one = run.trajectories[0]
    broken = replace(one, measures=replace(one.measures, failed=7))
    runs = {
        **evaluation.runs,
        "perfect": replace(run, trajectories=(broken, *run.trajectories[1:])),
    }
    changed = replace(evaluation, runs=runs)
    assert tables.headline(changed)[1][0][-1] == "1/4"
    found = json.loads(tables.to_json(changed))["runs"]["perfect"]["failed"]
    assert found == [{"mesh": one.measures.mesh, "simulation": 0, "step": 7}]


def test_mean_errors_are_of_all_trajectories_or_not_shown(evaluation):
    found = tables.mean_errors(evaluation)
    every = np.stack([t.errors for t in evaluation.runs["best"].trajectories])
    np.testing.assert_allclose(found["best"], every.mean(axis=0))
    run = evaluation.runs["best"]
    runs = {**evaluation.runs, "best": replace(run, trajectories=run.trajectories[1:])}
    assert "best" not in tables.mean_errors(replace(evaluation, runs=runs))


def test_histograms_are_drawn_and_nothing_is_refused(tmp_path):
    pytest.importorskip("matplotlib")
    path = plot_omega({"a": [1.0, 50.0], "b": [80.0]}, tmp_path / "omega.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    assert plot_omega({"a": [3.0]}, tmp_path / "one.svg").stat().st_size
    for values in ({}, {"a": []}):
        with pytest.raises(InputError, match="expected one model or more"):
            plot_omega(values, tmp_path / "none.png")


def test_validations_are_drawn_over_time(tmp_path):
    pytest.importorskip("matplotlib")
    path = plot_validations(
        {"a": ([1.0, 2.0], [5.0, 9.0]), "b": ([3.0], [-7.0])}, tmp_path / "v.png"
    )
    assert path.read_bytes().startswith(b"\x89PNG")
    for wrong in ({}, {"a": ([], [])}, {"a": ([1.0], [1.0, 2.0])}):
        with pytest.raises(InputError, match="each with times and values"):
            plot_validations(wrong, tmp_path / "none.png")


# --- rebuilt problems ------------------------------------------------------------------


@pytest.fixture(scope="module")
def stored():
    path = TINY / "evaluation" / "mesh-0002.h5"
    return read_shard(path), path


def test_rebuilt_problems_are_those_of_the_file(stored):
    shard, path = stored
    for run, element in (("plain", "hex8"), ("best", "hex8-bubble-mean")):
        problems = rebuilt_problems(shard, path, run)
        assert len(problems) == len(shard.simulations) == 2
        for problem, simulation in zip(problems, shard.simulations, strict=True):
            np.testing.assert_array_equal(problem.positions, shard.points)
            np.testing.assert_array_equal(problem.cells, shard.cells)
            np.testing.assert_array_equal(problem.free, shard.free)
            assert problem.element == element == simulation.runs[run].attributes["element"]
            assert problem.mass.sum() == pytest.approx(
                simulation.runs[run].attributes["total_mass"], rel=1e-12
            )
        forces = problems[1].external_forces(0.0, STEP)
        np.testing.assert_allclose(
            forces, shard.simulations[1].forces[0], atol=1e-6 * np.abs(forces).max()
        )
    fine = rebuilt_problems(shard, path, "reference")[0]
    assert len(fine.positions) == shard.simulations[0].runs["reference"].attributes["nodes"]


def test_a_rebuilt_step_is_the_stored_one(stored):
    shard, path = stored
    for run in ("plain", "best"):
        problem = rebuilt_problems(shard, path, run)[1]
        found = pc.ProjectiveDynamics(problem)(problem.rest_state()).state.positions
        np.testing.assert_allclose(found, shard.simulations[1].runs[run].positions[1], atol=1e-6)


def test_files_that_do_not_fit_their_scenes_are_refused(stored):
    shard, path = stored
    mixed = replace(shard.simulations[0], forces=1.001 * shard.simulations[0].forces)
    for name, changed in {
        "points rebuilt": replace(shard, points=shard.points + 1e-6),
        "cells rebuilt": replace(shard, cells=shard.cells[::-1]),
        "free rebuilt": replace(shard, free=~shard.free),
        "mass rebuilt": replace(shard, mass=2 * shard.mass),
        "young rebuilt": replace(shard, young=1.01 * shard.young),
        "time_step rebuilt": replace(shard, attributes={**shard.attributes, "time_step": 0.02}),
        "simulation 0: loads": replace(shard, simulations=(mixed, shard.simulations[1])),
        "simulation 0 has no scene": replace(
            shard, simulations=(replace(mixed, scene_toml=""), shard.simulations[1])
        ),
    }.items():
        with pytest.raises(InputError, match=rf"mesh-0002\.h5: {name}"):
            rebuilt_problems(changed, path)
    with pytest.raises(InputError, match="run 'intermediate': expected one of plain"):
        rebuilt_problems(shard, path, "intermediate")
    with pytest.raises(InputError, match="no run 'total-mass': expected one of best"):
        rebuilt_problems(shard, path, "total-mass")


# --- damaged files, commands -----------------------------------------------------------


@pytest.fixture
def damaged(tmp_path):
    """The tiny data set's evaluation split with a changed byte in its second file."""
    folder = tmp_path / "tiny"
    shutil.copytree(TINY / "evaluation", folder / "evaluation")
    path = folder / "evaluation" / "mesh-0001.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    return folder


def test_a_damaged_file_is_named_and_may_be_left_out(damaged):
    with pytest.raises(FileFormatError, match=r"mesh-0001\.h5"):
        evaluate([], damaged)
    found = evaluate([], damaged, skip_damaged=True)
    assert [path.name for path in found.damaged] == ["mesh-0001.h5"]
    assert {t.measures.mesh for t in found.runs["plain"].trajectories} == {0, 2}
    content = json.loads(tables.to_json(found))
    assert "checksum" in content["data"]["damaged"]["mesh-0001.h5"]


@pytest.fixture
def unfinished(tmp_path):
    """The tiny data set with a file of its evaluation split not there yet."""
    folder = tmp_path / "tiny"
    shutil.copytree(TINY, folder)
    (folder / "evaluation" / "mesh-0001.h5").unlink()
    return folder


def test_a_split_of_which_files_are_missing_is_evaluated_on_request_only(unfinished):
    with pytest.raises(InputError, match=r"evaluation: 1 of the files .* as mesh-0001\.h5"):
        evaluate([], unfinished)
    found = evaluate([], unfinished, incomplete=True)
    assert [path.name for path in found.missing] == ["mesh-0001.h5"]
    assert json.loads(tables.to_json(found))["data"]["missing"] == ["mesh-0001.h5"]
    assert {t.measures.mesh for t in found.runs["plain"].trajectories} == {0, 2}


def test_what_is_missing_is_what_was_not_read(unfinished, monkeypatch):
    def late(*arguments, **options):
        found = read_cases(*arguments, **options)
        shutil.copy(TINY / "evaluation" / "mesh-0001.h5", unfinished / "evaluation")
        return found

    monkeypatch.setattr("pdcorrect.evaluation.evaluation.read_cases", late)
    found = evaluate([], unfinished, incomplete=True)
    assert [path.name for path in found.missing] == ["mesh-0001.h5"]
    assert "mesh-0001.h5" not in found.shards


def test_a_configuration_that_cannot_be_used_is_told_before_anything_is_done(unfinished):
    (unfinished / "config.toml").write_text("name = 3")
    with pytest.raises(InputError, match="name"):
        evaluate([], unfinished)
    assert evaluate([], unfinished, incomplete=True).missing == ()


def test_the_command_says_what_was_missing(unfinished):
    refused = CliRunner().invoke(app, ["evaluate", str(unfinished)])
    assert "--incomplete" in str(refused.exception)
    done = CliRunner().invoke(app, ["evaluate", str(unfinished), "--incomplete"])
    assert done.exit_code == 0
    assert "1 of 3 files of the split are missing" in done.output


def untrained(folder, base="plain", seed=0, dataset="tiny", step=STEP):
    """A saved model whose correction is zero."""
    corrector = Corrector(preset("compact", layers=1, width=8))
    corrector.normaliser.output_scale.fill_(1e-3)
    averages = Moments()
    averages.add(torch.zeros(1, len(corrector.normaliser.average_low)))
    corrector.normaliser.fit_averages(averages)
    shapes, steps = Moments(), Moments()
    shapes.add(torch.zeros(1, len(corrector.normaliser.shape_low)))
    corrector.normaliser.fit_shapes(shapes)
    steps.add(torch.tensor([[step / 0.05]], dtype=torch.float64).log())  # of cells of 5 cm
    corrector.normaliser.fit_time_steps(steps)
    with torch.no_grad():
        corrector.network.decoder[-1].weight.zero_()
        corrector.network.decoder[-1].bias.zero_()
    training = {
        "config": {"base": base, "seed": seed, "velocity": "recomputed"}, "seconds": seed,
        "config_hash": "x",
    }  # fmt: skip
    record = ModelRecord(dataset=dataset, dataset_hash="abc", training=training)
    return save_model(corrector, folder, record=record)


def test_models_are_named_by_what_tells_them_apart_and_grouped_without_their_seed(tmp_path):
    paths = [untrained(tmp_path / f"seed-{k}" / "model", seed=k) for k in range(2)]
    paths.append(untrained(tmp_path / "other" / "model", base="best"))
    found = saved_candidates(paths)
    assert [one.candidate.name for one in found] == ["seed-0/model", "seed-1/model", "other/model"]
    groups = [one.candidate.group for one in found]
    assert groups[0] == groups[1] != groups[2]
    assert [one.candidate.base for one in found] == ["plain", "plain", "best"]
    assert found[1].record()["seed"] == 1
    assert found[0].warnings("tiny", "x", "evaluation") == []
    assert "trained on 'tiny', not on 'large'" in found[0].warnings("large", "x", "evaluation")[0]
    (told,) = found[0].warnings("tiny", "y", "evaluation")
    assert "trained on 'tiny' of another configuration than here: bodies, loads" in told
    assert "trained on this split" in found[0].warnings("tiny", "x", "training")[0]
    assert "chosen by this split" in found[0].warnings("tiny", "x", "validation")[0]
    with pytest.raises(InputError, match="comes twice"):
        saved_candidates([paths[0], paths[0]])


def test_the_gate_refuses_what_the_network_has_not_seen_unless_it_is_off(tmp_path, pair):
    """A fitted range of nothing: every body, and every input, lies outside."""
    _, stepper = pair
    path = untrained(tmp_path / "model")
    rates = {}
    gates = {
        "all": Gate(), "bodies": Gate(margin=None, average=None), "inputs": Gate(body=None),
        "none": None,
    }  # fmt: skip
    for name, gate in gates.items():
        (saved,) = saved_candidates([path], gate=gate)
        runs = roll_out(saved.candidate.hybrid(stepper), stepper, [2, 2])
        rates[name] = [run.refused.mean() for run in runs]
    assert rates.pop("none") == [0.0, 0.0]
    assert set(map(tuple, rates.values())) == {(1.0, 1.0)}


@pytest.mark.parametrize("gate", [None, pc.Gate()])
def test_scenes_alone_are_evaluated_as_in_a_batch(cases, gate):
    """Which a CPU does, since it is quicker: to the tolerance of the coarse solver."""
    (saved,) = saved_candidates(["tiny"], gate=gate)
    batch = replace(saved.candidate, name="batch", alone=None)
    found = evaluate([saved.candidate, batch], TINY, device="cpu")
    for one, other in zip(
        found.runs[saved.candidate.name].trajectories, found.runs["batch"].trajectories,
        strict=True,
    ):  # fmt: skip
        assert one.measures.failed == other.measures.failed
        assert one.measures.gate_rate == other.measures.gate_rate
        assert one.measures.omega == pytest.approx(other.measures.omega, abs=0.05)
        assert one.measures.step_omega == pytest.approx(other.measures.step_omega, abs=0.05)


def test_a_gate_refuses_and_pauses_alone_as_in_a_batch(cases):
    """Of the first scene; in others two gates may part where energy is at its bound."""
    (saved,) = saved_candidates(["tiny"], gate=Gate(energy=0.01))
    problem = cases[0].problems[saved.candidate.base]
    stepper = pc.BatchStepper([problem])
    (expected,) = roll_out(saved.candidate.hybrid(stepper), stepper, [20])
    found = roll_out_alone(saved.candidate.alone(problem), 20)
    assert {0, Reason.ENERGY, Reason.PAUSE} == set(found.reasons.tolist())
    np.testing.assert_array_equal(found.reasons, expected.reasons)


@pytest.mark.parametrize("lost", [np.nan, 1e9])
def test_a_scene_alone_that_is_lost_has_failed(cases, lost):
    (saved,) = saved_candidates(["tiny"], gate=None)
    hybrid = saved.candidate.alone(cases[0].problems[saved.candidate.base])
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
    hybrid = saved.candidate.alone(cases[0].problems[saved.candidate.base])
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


def run_command(*arguments):
    result = CliRunner().invoke(app, ["evaluate", *map(str, arguments)])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def test_the_command_measures_a_model_and_writes_everything(tmp_path, damaged):
    pytest.importorskip("matplotlib")
    model = untrained(tmp_path / "zero", dataset="other")
    (damaged / "evaluation" / "mesh-0000.h5").unlink()
    output = tmp_path / "found"
    result = run_command(model, damaged, "--skip-damaged", "-o", output)
    assert result.exit_code == 0
    assert "left out: " in result.stdout
    assert "zero was trained on 'other', not on 'tiny'" in result.stdout
    names = {
        "summary.json",
        "trajectories.csv",
        "errors.csv",
        "table.md",
        "errors.png",
        "omega.png",
    }
    assert {path.name for path in output.iterdir()} == names
    content = json.loads((output / "summary.json").read_text())
    assert content["models"]["zero"]["weights_sha256"]
    assert len(content["notes"]) == 5
    told, measures, way = (note for note in content["notes"] if note.startswith("zero: "))
    assert measures.startswith("zero: measures of bodies at rest that lie outside of the training")
    assert "Gate(body=None), or none (--no-gate)." in way
    assert "2 of 2 rollouts were refused in all steps by the gate (2 by body)" in told
    assert any("zero (all refused) |" in x for x in (output / "table.md").read_text().splitlines())
    assert content["environment"]["device"] == "cpu"
    found = content["runs"]["zero"]["measures"]
    assert abs(found["omega"]["mean"]) < 0.01  # solved again, to the data set's tolerance
    assert abs(found["step_omega"]["mean"]) < 0.1
    assert found["omega"]["interval"] is None  # one mesh


def test_the_command_says_by_what_whole_rollouts_are_refused(tmp_path, monkeypatch):
    model = untrained(tmp_path / "zero", step=0.5 * STEP)
    counted = "- zero: 4 of 4 rollouts were refused in all steps by the gate (4 by {})"
    step = (
        f"- zero: the time step per cell size is 2.0 times that of the training: {STEP:g} s, where "
        f"the training has {0.5 * STEP:g} s for cells of this size"
    )
    told = run_command(model, TINY).stdout  # its bodies are foreign, too
    assert counted.format("body and time step") in told
    assert step in told
    assert "- zero: measures of bodies at rest that lie outside of the training by more" in told
    for gate, reason in ((Gate(body=None), "time step"), (Gate(body=None, margin=0.0), None)):
        if reason is None:
            model = untrained(tmp_path / "zero")
        monkeypatch.setattr("pdcorrect.evaluation.candidates.DEFAULT_GATE", gate)
        told = run_command(model, TINY).stdout
        assert (counted.format(reason) in told) == (step in told) == (reason is not None)
        inputs = (
            "- zero: of the 80 steps of all rollouts 80 were refused by the gate (80 by features)"
        )
        assert (inputs in told) == (reason is None)
        assert "measures of bodies" not in told
        assert told.count("zero (all refused)") == 2  # in both tables
        assert "100.00" in told  # refused, per cent, by whatever
    told = run_command(model, TINY, "--no-gate").stdout
    assert "refused" not in told.split("| plain")[1]
    assert "all refused" not in told


def test_bad_input_is_told_in_a_sentence(tmp_path, capsys, monkeypatch):
    from pdcorrect.cli import main as cli

    for arguments, message in (
        ((str(tmp_path / "none"), str(TINY)), "none: not there: expected a folder with model.json"),
        ((str(tmp_path),), "no data set"),
        ((str(TINY), "--split", "test"), "no split 'test'"),
    ):
        monkeypatch.setattr("sys.argv", ["pdcorrect", "evaluate", *arguments])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert stop.value.code == 2
        assert message in capsys.readouterr().err


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


def test_solvers_are_compared_at_equal_accuracy():
    pulled = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]
    loaded = scene(loads=pulled)
    made = []

    def hybrid(stepper):
        made.append(Uncorrected(stepper))
        return made[0]

    coarse, fine = ([pc.discretise(loaded, refine=k)] * 2 for k in (1, 2))
    found = measure_speed(coarse, fine, hybrid, accuracy=1e-3, steps=2)
    solvers = (found.coarse, found.hybrid, found.fine, found.fine_one_by_one)
    assert all(0 < s.solver_error <= 1e-3 for s in solvers)
    assert all(s.seconds > 0 for s in solvers)
    assert made[0].steps == 4  # two of them to warm up
    assert made[0].stepper.tolerances == (found.coarse.tolerance,) * 2
    assert found.scenes == 2
    assert found.coarse.nodes == 2 * len(coarse[0].positions)
    quickest = min(found.fine.seconds, found.fine_one_by_one.seconds)
    assert found.speed_up == quickest / found.hybrid.seconds
    with pytest.raises(InputError, match="expected as many of both"):
        measure_speed(coarse, fine[:1], hybrid)


def test_the_loosest_tolerance_that_is_accurate_enough_is_taken():
    assert _loosest(lambda tolerance: 2 * tolerance, 1e-3) == (3e-4, 6e-4)
    assert _loosest(lambda tolerance: 0.5 * tolerance, 1e-3) == (1e-3, 5e-4)
    with pytest.raises(ConvergenceError, match="no tolerance down to"):
        _loosest(lambda tolerance: 1.0, 1e-3)
