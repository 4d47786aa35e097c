"""The cases of validation/, as far as they are quick, and their records."""

import math
import sys
from pathlib import Path

import pytest

import pdcorrect as pc

VALIDATION = Path(__file__).parents[1] / "validation"
sys.path.insert(0, str(VALIDATION))
import harness  # noqa: E402
from expectations import outside  # noqa: E402

CASES = {case.name: case for case in harness.find_cases(folder=VALIDATION)}
QUICK = [name for name, case in CASES.items() if case.has_quick_part]


def check(name, quick):
    """All figures expected of the run are there, and none is outside."""
    figures = {}
    for part in CASES[name].parts(quick).values():
        figures |= part().figures
    assert outside(figures, CASES[name].expected, quick) == []


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
    points = [run.Point(n, t, e) for n, t, e in (("a", 1, 16), ("b", 4, 1), ("far", 2, 20))]
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


def test_a_simulation_is_its_set_up_and_its_frames():
    module, point = break_even(), CASES["error_time"].module.Point
    reached = {
        "a": [point("learned, 2", 20.0, 2.0), point("hex27, 2", 50.0, 2.0),
              point("best on 4x4x4, 1", 1000.0, 1.0)]
    }  # fmt: skip
    set_up = {"learned": 0.5, "hex27": 0.1, "best on 4x4x4": 3.0}
    (found,) = module.repaid(
        "learned, 2", 7.9, reached, {"frames": {"a": 40}, "set_up": {"a": set_up}}
    )
    assert found.equal == 10  # 7.9 s / (2.1 s - 1.3 s)
    assert found.fixed == (10, 1)
    assert found.near == (True, False)
    reached["a"][0] = point("learned, 2", 20.0, 0.5)
    (found,) = module.repaid(
        "learned, 2", 7.9, reached, {"frames": {"a": 40}, "set_up": {"a": set_up}}
    )
    assert found.equal is None  # no rival is so near
    del reached["a"][1:]
    with pytest.raises(KeyError):
        module.repaid("learned, 2", 7.9, reached, {"frames": {"a": 40}, "set_up": {"a": set_up}})


def test_all_cases_are_imported_side_by_side():
    assert all(case.module for case in CASES.values())
    assert CASES["error_time"].module.SCENES is not CASES["obstacles"].module.SCENES
