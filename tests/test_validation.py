"""The cases of validation/, as far as they are quick, and their records."""

import dataclasses
import math
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam

VALIDATION = Path(__file__).parents[1] / "validation"
sys.path.insert(0, str(VALIDATION))
import harness  # noqa: E402
from expectations import outside  # noqa: E402

CASES = {case.name: case for case in harness.find_cases(folder=VALIDATION)}
QUICK = [name for name, case in CASES.items() if case.has_quick_part]


def check(name, quick):
    """All figures expected of the run are there, and none is outside."""
    record, module = harness.Record("", quick), CASES[name].module
    for part in CASES[name].parts(quick).values():
        outcome = part()
        record.add(outcome.figures, [vars(table) for table in outcome.tables])
    if hasattr(module, "summary") and not quick:
        record.add(module.summary(record).figures, ())
    assert outside(record.figures, CASES[name].expected, quick) == []


COVERED = {
    "breakdown": "test_integrators, test_steppers",
    "columns": "test_initial, test_integrators",
    "damping": "test_viscosity, test_energy_balance, test_integrators",
    "energy": "test_energy_balance",
    "error_time": "test_converged, test_error_estimate, and fronts below",
    "four_errors": "test_integrators, test_convergence_orders, test_metrics",
    "gallery": "test_examples, which runs its scenes by both solvers",
    "newton": "test_steppers, test_elements",
    "obstacles": "test_obstacles",
    "stability": "test_stability_case, test_robustness",
    "stress": "test_robustness, test_recovery, test_thin_cells",
    "time_error": "test_integrators",
    "time_orders": "test_integrators, test_loads_in_time",
    "unlike_families": "test_converged, test_error_estimate",
}
"""Quick parts whose behaviour smaller tests have, and which."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] if n in COVERED else []) for n in QUICK],
)
def test_quick_part(name):
    check(name, quick=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_whole_case(name):
    check(name, quick=False)


@pytest.mark.parametrize("name", CASES)
def test_recorded_figures_are_those_expected(name):
    record = harness.load(VALIDATION / "results" / f"{name}.json")
    assert outside(record.figures, CASES[name].expected) == record.outside == []
    judged = (VALIDATION / "results" / f"{name}.csv").read_text(encoding="utf-8")
    assert judged == harness.judged_csv(CASES[name], record)


def test_the_best_coarse_model_is_the_one_that_is_validated():
    run = CASES["best_coarse"].module
    best = pc.best_coarse(run.scene("short beam, bend")).solver
    assert (best.element, best.mass, run.BEST.lumped) == (run.BEST.element, "averaged", 0.5)


@pytest.mark.parametrize("motion", ["impulse", "stretch", "torsion"])
def test_recorded_errors_give_the_recorded_omega(motion):
    record = harness.load(VALIDATION / "results" / "easy_to_hard.json")
    rows = record.table(motion)["rows"]
    plain = {tuple(row[:3]): row[7] for row in rows if row[4] == "plain"}
    for row in rows:
        left = (row[7] / plain[tuple(row[:3])]) ** 2
        assert row[8] == pytest.approx(100.0 * (1.0 - left), abs=0.02)


@pytest.mark.parametrize("name", CASES)
def test_every_case_has_a_question_and_inputs_that_exist(name):
    assert CASES[name].question
    assert all(CASES[name].inputs().values())


def test_fronts_are_interpolated_by_logarithms_and_end():
    run = CASES["error_time"].module
    point = sys.modules["methods"].Point
    points = [point(n, t, e) for n, t, e in (("a", 1, 16), ("b", 4, 1), ("far", 2, 20))]
    assert [point.name for point in run.front(points)] == ["a", "b"]
    assert run.time_at(4.0, points) == pytest.approx(2.0)
    assert run.error_at(2.0, points) == pytest.approx(4.0)
    assert run.time_at(100.0, points) == pytest.approx(1.0)  # the quickest is nearer
    assert run.error_at(9.0, points) == pytest.approx(1.0)
    assert math.isnan(run.time_at(0.5, points))  # none is so near
    assert math.isnan(run.error_at(0.5, points))  # none is so quick


def break_even():
    assert CASES["error_time"].module  # its folder is on the path now
    import break_even

    return break_even


def test_a_cost_is_repaid_once_the_sums_are_equal_and_never_without_a_saving():
    simulations = break_even().simulations
    assert simulations(10.0, own=1.0, rival=3.0) == 5  # 10 + 5 x 1 = 5 x 3
    assert simulations(10.0, own=1.0, rival=4.0) == 4  # not after three: 13 > 12
    assert simulations(0.0, own=1.0, rival=3.0) == 0
    assert math.isinf(simulations(10.0, own=3.0, rival=3.0))
    assert math.isinf(simulations(0.0, own=4.0, rival=3.0))


def record_of(first, times, errors):
    """A record of the case with one scene "a" of 41 frames."""
    run = CASES["error_time"].module
    tables = (
        (run.ERRORS, ["scene", "nodes", "mm", *errors], ["a", 8, 1.0, *errors.values()]),
        (run.TIMES, ["scene", *times], ["a", *times.values()]),
        (run.ROUNDS, ["scene", "frames", "what", *first], ["a", 41.0, run.FIRST, *first.values()]),
    )
    record = harness.Record("", False)
    record.add({}, [{"name": n, "headings": h, "rows": [row]} for n, h, row in tables])
    return record


def test_a_simulation_is_its_first_frame_and_the_others():
    module = break_even()
    runs = "learned, 2", "hex27, 2", "best on 4x4x4, 1"
    rows = (0.5, 0.1, 3.0), (20.0, 50.0, 1000.0), (2.0, 2.0, 1.0)
    first, times, errors = (dict(zip(runs, row, strict=True)) for row in rows)
    record = record_of(first, times, errors)
    (found,) = module.repaid("learned, 2", 7.9, module.simulations_of(record))
    assert found.equal == 10  # 7.9 s / (2.1 s - 1.3 s)
    assert found.fixed == (10, 1)
    assert found.near == (True, False)
    record = record_of(first, times, errors | {"learned, 2": 0.5})
    reached = module.simulations_of(record)
    (found,) = module.repaid("learned, 2", 7.9, reached)
    assert found.equal is None  # no rival is so near
    del reached["a"][1:]
    with pytest.raises(KeyError):
        module.repaid("learned, 2", 7.9, reached)


class Sleeper:
    """A method whose steppers rest for so many seconds a step, or fail at a frame."""

    def __init__(self, seconds, failing=None):
        self.seconds, self.failing, self.made = seconds, failing, 0

    def stepper(self, scene):
        self.made += 1
        return Resting(pc.discretise(scene), self)


class Resting:
    def __init__(self, problem, method):
        self.problem, self.method = problem, method

    def __call__(self, state, forces=None):
        time.sleep(self.method.seconds)
        after = state.time + self.problem.scene.time.step
        fails = self.method.failing is not None and after > self.method.failing
        status = pc.Status.ITERATION_LIMIT if fails else pc.Status.CONVERGED
        return pc.StepResult(dataclasses.replace(state, time=after), status, 1, 0.0, 0.0)

    def describe(self):
        return {"method": "rest"}


def test_dear_methods_have_fewer_rounds_and_failures_have_none(monkeypatch, tmp_path):
    run = CASES["error_time"].module
    monkeypatch.setattr(sys.modules["rounds"], "ROUNDS", ((20.0, 3), (math.inf, 1)))
    scene = beam((1, 1, 1), time={"frames": 2})
    methods = {"cheap": Sleeper(0.001), "dear": Sleeper(0.03), "fails": Sleeper(0.0, 0.015)}
    judged = []

    def judge(name, trajectory):
        judged.append(name)
        return {"frames": len(trajectory)}

    found = run.timed(scene, methods, judge, tmp_path / "rounds")
    assert [each.wants() for each in found.values()] == [3, 1, 0]
    assert [method.made for method in methods.values()] == [4, 2, 2]  # one not timed
    assert [len(each.wall) for each in found.values()] == [3, 1, 0]
    assert judged == ["cheap", "dear"]
    assert found["dear"].found == {"frames": 2}
    assert min(found["cheap"].wall) >= 1.0
    assert min(found["dear"].first) >= 0.03
    assert max(found["dear"].cpu) < 20.0  # it rests
    assert not list(tmp_path.iterdir())


def test_rounds_go_on_where_they_were_ended(monkeypatch, tmp_path):
    run = CASES["error_time"].module
    monkeypatch.setattr(sys.modules["rounds"], "ROUNDS", ((math.inf, 3),))
    scene = beam((1, 1, 1), time={"frames": 2})
    methods = {"a": Sleeper(0.001), "b": Sleeper(0.001)}
    real = Sleeper.stepper

    def stopping(self, scene):
        if self.made == 3:
            raise KeyboardInterrupt
        return real(self, scene)

    with monkeypatch.context() as patch:
        patch.setattr(Sleeper, "stepper", stopping)
        with pytest.raises(KeyboardInterrupt):
            run.timed(scene, methods, lambda *_: {"error": 1.0}, tmp_path / "rounds")
    assert [method.made for method in methods.values()] == [3, 3]  # two rounds of each
    found = run.timed(scene, methods, None, tmp_path / "rounds")
    assert [len(each.wall) for each in found.values()] == [3, 3]
    assert found["b"].found == {"error": 1.0}
    assert [method.made for method in methods.values()] == [5, 5]
    assert not list(tmp_path.iterdir())


def test_levels_go_on_where_they_were_ended(tmp_path, monkeypatch):
    assert CASES["error_time"].module
    reference = sys.modules["reference"]
    monkeypatch.setenv("PDCORRECT_CACHE", str(tmp_path))
    monkeypatch.setattr(reference, "_EVERY", 0.0)
    load = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]
    scene = beam((2, 1, 1), loads=load, time={"frames": 4})
    whole = reference.positions(scene, 2, 2)
    (path,) = (tmp_path / "levels").iterdir()
    path.unlink()
    real, saved = reference._save, []

    def killed(path, frames, state=None):
        real(path, frames, state)
        saved.append(len(frames))
        if len(saved) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(reference, "_save", killed)
    with pytest.raises(KeyboardInterrupt):
        reference.positions(scene, 2, 2)
    np.testing.assert_array_equal(reference.positions(scene, 2, 2), whole)
    assert saved == [2, 3, 4, 5, 5]
    np.testing.assert_array_equal(reference.positions(scene, 2, 2), whole)
    assert len(saved) == 5


def test_all_cases_are_imported_side_by_side():
    assert all(case.module for case in CASES.values())
    assert CASES["error_time"].module.SCENES is not CASES["obstacles"].module.SCENES
