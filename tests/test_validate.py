"""The validation harness: cases found, run, resumed, judged and reported."""

import csv
import json
import math
import shutil
import sys
from pathlib import Path

import pytest

from pdcorrect.errors import InputError, OutputError

VALIDATION = Path(__file__).parents[1] / "validation"
sys.path.insert(0, str(VALIDATION))
import harness  # noqa: E402
from expectations import Expectation, outside, read_expectations  # noqa: E402

CODE = """
from pathlib import Path
from harness import Outcome, Table
from pdcorrect.errors import ConvergenceError, OutputError

ERRORS = {"a": ConvergenceError, "c": OutputError}
HERE = Path(__file__).parent


def part(name, value):
    with open(HERE / "calls", "a") as calls:
        calls.write(name)
    if (HERE / f"broken-{name}").exists():
        raise ERRORS.get(name, RuntimeError)(name)
    return Outcome({name: value}, (Table("values", ("part", "value"), ((name, value),)),))


def parts(quick):
    all_parts = {"a": 1.0, "b": "CONVERGED"} | ({} if quick else {"c": float("nan")})
    return {n: (lambda n=n, v=v: part(n, v)) for n, v in all_parts.items()}


def draw(record, path):
    path.write_bytes(repr(record.figures).encode())
"""
EXPECTED = {
    "a": {"value": 1.05, "tolerance": 0.1, "source": "theory", "quick": True},
    "b": {"status": ["CONVERGED", "RECOVERED"], "source": "theory", "quick": True},
}


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The folder of a case of two parts, or three in full, in a home of its own."""
    folder = tmp_path / "home" / "validation" / "sums"
    folder.mkdir(parents=True)
    for name in ("harness.py", "expectations.py", "report.py"):
        shutil.copy(VALIDATION / name, folder.parent)
    (folder / "run.py").write_text(CODE)
    (folder / "README.md").write_text("# Sums\n\n**Question.** Is `a` < 2,\nand b?\n\nMore.\n")
    expect(folder)
    monkeypatch.setenv("PDCORRECT_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    return folder


def expect(folder, **changes):
    (folder / "expected.json").write_text(json.dumps(EXPECTED | changes))


def calls(folder):
    """Parts run since this was last asked."""
    path = folder / "calls"
    done = path.read_text() if path.exists() else ""
    path.unlink(missing_ok=True)
    return done


def quick(folder, **options):
    return harness.run_case(harness.Case(folder), "out", quick=True, **options)


def test_figures_are_judged_by_value_bounds_or_status():
    aims = {
        "x": Expectation(value=1.0, tolerance=0.5, source="s", quick=True),
        "y": Expectation(status=("A", "B"), source="s"),
        "z": Expectation(at_least=0.0, at_most=1.0, source="s"),
    }
    assert outside({"x": 1.5, "y": "B", "z": 1.0, "other": 9.0}, aims) == []
    assert outside({"x": 1.6, "y": "C", "z": -0.1}, aims) == ["x", "y", "z"]
    assert outside({"x": math.nan, "y": 1.0, "z": None}, aims) == ["x", "y", "z"]
    assert outside({}, aims) == ["x", "y", "z"]
    assert outside({}, aims, quick=True) == ["x"]
    known = {"x": Expectation(value=1.0, tolerance=0.5, source="s", known_failure="why")}
    assert outside({"x": 2.0}, known) == []
    assert outside({"x": 1.0}, known) == ["x"]  # it is mended


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ({"value": 1.0, "source": "x"}, "tolerance"),
        ({"source": "x"}, "value"),
        ({"value": 1.0, "tolerance": 0.1, "at_most": 2.0, "source": "x"}, "bounds"),
        ({"at_most": 1.0, "at_least": 2.0, "source": "x"}, "at_least"),
        ({"value": 1.0, "tolerance": -0.1, "source": "x"}, "tolerance"),
        ({"value": 1.0, "tolerance": 0.1}, "source"),
        ({"value": 1.0, "tolerance": 0.1, "source": "x", "kwick": True}, "kwick"),
    ],
)
def test_expectations_without_a_meaning_are_refused(home, entry, key):
    expect(home, a=entry)
    with pytest.raises(InputError, match=rf"expected\.json: a: .*{key}"):
        read_expectations(home / "expected.json")


def test_a_run_writes_figures_tables_and_a_report(program, home, tmp_path):
    status, out, _ = program("validate", "-o", "out")
    assert status == 0
    assert [line.split(":")[0] for line in out.splitlines()] == ["sums", "sums", "report"]
    record = json.loads((tmp_path / "out" / "sums.json").read_text())
    assert record["figures"] == {"a": 1.0, "b": "CONVERGED", "c": None}
    assert record["tables"][0]["rows"] == [["a", 1.0], ["b", "CONVERGED"], ["c", None]]
    with (tmp_path / "out" / "sums.csv").open() as rows:
        assert [(r["figure"], r["verdict"]) for r in csv.DictReader(rows)] == [
            ("a", "ok"), ("b", "ok"),
        ]  # fmt: skip
    assert (tmp_path / "out" / "figures" / "sums.png").is_file()
    assert "Is `a` &lt; 2, and b?" in (tmp_path / "out" / "index.html").read_text()
    assert "figures/sums.png" in (tmp_path / "out" / "report.md").read_text()


def test_what_is_done_is_run_again_when_something_changed_or_that_is_asked_for(home):
    quick(home)
    quick(home)
    assert calls(home) == "ab"
    quick(home, again=True)
    assert calls(home) == "ab"
    expect(home, a={**EXPECTED["a"], "value": 2.0})
    assert quick(home).outside == ["a"]
    (home.parent / "common.py").write_text("")
    quick(home)
    assert calls(home) == "abab"
    assert harness.run_case(harness.Case(home), "out").quick is False
    assert calls(home) == "abc"


def test_a_changed_input_is_a_reason_to_run_again(home):
    weights = home.parents[1] / "weights"
    weights.write_bytes(b"1")
    (home / "inputs.txt").write_text("weights\n")
    assert list(quick(home).inputs) == ["weights"]
    weights.write_bytes(b"2")
    quick(home)
    assert calls(home) == "abab"
    weights.unlink()
    with pytest.raises(InputError, match="'weights'"):
        quick(home)


def test_a_case_that_ends_with_an_error_goes_on_with_the_part_that_failed(program, home, tmp_path):
    (home / "broken-b").touch()
    status, out, _ = program("validate", "--quick", "-o", "out")
    assert status == 1
    assert "RuntimeError: b" in out
    assert not (tmp_path / "out" / "sums.json").exists()
    (home / "broken-b").unlink()
    calls(home)
    assert quick(home).figures == {"a": 1.0, "b": "CONVERGED"}
    assert calls(home) == "b"
    assert not (tmp_path / "out" / "parts").exists()


def other_case(folder):
    """A second case beside it, after it by name."""
    return shutil.copytree(folder, folder.with_name("totals"))


def test_a_step_that_fails_ends_its_own_case_only(program, home, tmp_path):
    other_case(home)
    (home / "broken-a").touch()
    status, out, _ = program("validate", "--quick", "-o", "out")
    assert status == 1
    assert "ConvergenceError: a" in out
    assert not (tmp_path / "out" / "sums.json").exists()
    assert (tmp_path / "out" / "totals.json").exists()


def test_a_result_that_cannot_be_written_ends_the_run(home):
    (home / "broken-c").touch()
    with pytest.raises(OutputError):
        harness.run_case(harness.Case(home), "out")


@pytest.mark.parametrize("function", ["finding(record)", "draw(record, path)"])
def test_a_finding_or_figure_of_no_number_is_the_case_s_error(program, home, tmp_path, function):
    other_case(home)
    with (home / "run.py").open("a") as code:
        code.write(f"\n\ndef {function}:\n    return f'{{record.figures[\"c\"]:.1f}}'\n")
    for _ in range(2):  # the kept record fails as well
        status, out, _ = program("validate", "-o", "out")
        assert status == 1
        assert "TypeError" in out
        for name in ("report.md", "index.html"):
            text = (tmp_path / "out" / name).read_text()
            assert "TypeError" in text
            assert "figures/totals.png" in text
            assert "figures/sums.png" not in text


def test_a_part_s_record_that_is_damaged_is_made_again(home, tmp_path):
    (tmp_path / "out" / "parts" / "sums").mkdir(parents=True)
    (tmp_path / "out" / "parts" / "sums" / "a.json").write_text('{"digest": ')
    assert quick(home).passed
    assert calls(home) == "ab"


def test_the_exit_status_tells_figures_outside_and_wrong_names(program, home, monkeypatch):
    expect(home, a={**EXPECTED["a"], "value": 2.0})
    assert program("validate", "--quick")[0] == 1
    assert program("validate", "products")[0] == 2
    with pytest.raises(InputError, match=r"'products'.*sums"):
        harness.find_cases(["products"])
    monkeypatch.setenv("PDCORRECT_HOME", str(home))
    assert program("validate")[0] == 2


def test_quick_runs_leave_out_cases_without_quick_figures(program, home):
    expect(home, **{name: {**aim, "quick": False} for name, aim in EXPECTED.items()})
    assert program("validate", "--list")[0] == 0
    assert program("validate", "--quick")[0] == 0
    assert calls(home) == ""


@pytest.mark.parametrize(
    ("code", "key"),
    [("", "case"), ("def parts(quick):\n    return {'h 1e-3': None, 'h 1e+3': None}", "h 1e-3")],
)
def test_a_module_that_defines_no_case_is_refused(home, code, key):
    (home / "run.py").write_text(code)
    with pytest.raises(InputError, match=rf"run\.py: .*{key}"):
        harness.run_case(harness.find_cases()[0], "out")
