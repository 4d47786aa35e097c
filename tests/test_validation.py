"""The cases of validation/, as far as they are quick: theory and published values."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

import pdcorrect as pc

FOLDER = Path(__file__).parent.parent / "validation"
CASES = ("best_coarse", "cantilever", "cook", "four_errors", "locking")


def case(name):
    """The module of a case; its folder is no package."""
    spec = importlib.util.spec_from_file_location(f"{name}_run", FOLDER / name / "run.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def check(name, figures):
    """At least one of the figures has an expected value, and none is outside."""
    run = case(name)
    wanted = run.common.expected(FOLDER / name)
    assert set(wanted) & set(figures)
    assert run.common.outside(figures, wanted) == []


def test_cantilever_by_beam_theory():
    run = case("cantilever")
    figures = run.compute(("hex27",), (2,))
    for element in ("hex8", "hex8-bubble", "hex8-bubble-mean"):
        figures[f"end shear, {element} 1x1"] = run.end_shear(element, 1, [run.HELD])
    check("cantilever", figures)


def test_torsion_of_a_square_bar():
    run = case("cantilever")
    check(
        "cantilever", {"torsion, free to warp, hex27 4x4": run.torsion("hex27", 4, True, run.SIDE)}
    )


def test_cook_membrane_by_other_codes():
    figures = case("cook").compute(("plane strain", "near incompressible"), ("hex8",), (4, 8))
    figures |= case("cook").compute(("plane stress",), ("hex8-bubble",), (32,))
    check("cook", figures)


def test_shear_locking_and_distortion():
    run = case("locking")
    check("locking", run.shear(("hex8", "hex8-bubble", "hex8-bubble-mean"), (50,)))
    check("locking", run.distortion(("hex8-bubble", "hex27")))


def test_best_coarse_model_of_a_short_beam():
    run = case("best_coarse")
    best = pc.best_coarse(run.scene("short beam, bend")).solver
    assert (best.element, best.mass) == (run.BEST.element, "averaged")
    assert run.BEST.lumped == 0.5
    check("best_coarse", run.shares("short beam, bend", (run.BEST,)))
    for modes, count in (("3 warping", 6), ("6 products", 9)):
        assert run.zero_modes(modes) == count


def test_four_errors_of_a_beam_on_its_coarse_mesh():
    run = case("four_errors")
    check("four_errors", run.solver_error())
    check("four_errors", run.model_error())
    check("four_errors", run.time_error(("backward-euler", "midpoint"), (1, 2, 4), finest=64))


@pytest.mark.parametrize("name", CASES)
def test_results_recorded_are_those_expected(name):
    run, record = case(name), json.loads((FOLDER / "results" / f"{name}.json").read_text())
    wanted = run.common.expected(FOLDER / name)
    assert set(wanted) <= set(record["figures"])
    known = {key: value for key, value in record["figures"].items() if value is not None}
    assert run.common.outside(known, wanted) == record["outside"] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_whole_case(name):
    check(name, case(name).compute())
