"""The cases of validation/, as far as they are quick: theory and published values."""

import json

import pytest

import pdcorrect as pc
from pdcorrect.validation.cases import find_cases
from pdcorrect.validation.outcome import missing, outside

CASES = {case.name: case for case in find_cases()}
QUICK = [name for name, case in CASES.items() if case.has_quick_part]


def check(name, quick):
    """All figures expected of the run are there, and none is outside."""
    case, figures = CASES[name], {}
    for part in case.parts(quick).values():
        figures |= part().figures
    assert missing(figures, case.expected, quick) == []
    assert outside(figures, case.expected) == []


@pytest.mark.parametrize("name", QUICK)
def test_quick_part(name):
    check(name, quick=True)


def test_the_best_coarse_model_is_the_one_that_is_validated():
    run = CASES["best_coarse"]._module()
    best = pc.best_coarse(run.scene("short beam, bend")).solver
    assert (best.element, best.mass) == (run.BEST.element, "averaged")
    assert run.BEST.lumped == 0.5


@pytest.mark.parametrize("name", CASES)
def test_results_recorded_are_those_expected(name):
    case = CASES[name]
    record = json.loads((case.folder.parent / "results" / f"{name}.json").read_text())
    assert missing(record["figures"], case.expected, quick=False) == []
    # figures that are no number, where there is no equilibrium, are recorded as None
    known = {key: value for key, value in record["figures"].items() if value is not None}
    assert outside(known, case.expected) == record["outside"] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_whole_case(name):
    check(name, quick=False)
