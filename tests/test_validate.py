"""`pdcorrect validate`: cases found, run, resumed, judged and reported."""

import csv
import json
import math
import re

import pytest

from pdcorrect.errors import InputError
from pdcorrect.validation.cases import ValidationCase, find_cases
from pdcorrect.validation.outcome import Expectation, missing, outside, read_expectations
from pdcorrect.validation.running import run_case

CODE = """
from pathlib import Path
from pdcorrect.validation.outcome import Outcome, Picture, Table

HERE = Path(__file__).parent


def draw(path):
    from PIL import Image

    Image.new("RGB", (4, 4), "red").save(path)


def part(name, value):
    with open(HERE / "calls", "a") as calls:
        calls.write(name)
    if (HERE / f"broken-{name}").exists():
        raise RuntimeError("no luck with <" + name + ">")
    table = Table("values", ("part", "value"), ((name, value),))
    return Outcome({name: value}, (table,), (Picture(name, "part " + name, draw),))


def parts(quick):
    all_parts = {"a": 1.0, "b": "CONVERGED"} | ({} if quick else {"c": float("nan")})
    return {n: (lambda n=n, v=v: part(n, v)) for n, v in all_parts.items()}
"""
EXPECTED = {
    "a": {"value": 1.05, "tolerance": 0.1, "source": "theory", "quick": True},
    "b": {"status": ["CONVERGED", "RECOVERED"], "source": "theory", "quick": True},
}


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home folder with one case of two parts, or three in full."""
    folder = tmp_path / "home" / "validation" / "sums"
    folder.mkdir(parents=True)
    (folder / "run.py").write_text(CODE)
    (folder / "expected.json").write_text(json.dumps(EXPECTED))
    (folder / "README.md").write_text("# Sums\n\n**Question.** Is `a` < 2,\nand b fine?\n\nMore.\n")
    monkeypatch.setenv("PDCORRECT_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return folder


def calls(folder):
    """Parts run since this was last asked."""
    path = folder / "calls"
    done = path.read_text() if path.exists() else ""
    path.unlink(missing_ok=True)
    return done


def expect(folder, **changes):
    (folder / "expected.json").write_text(json.dumps(EXPECTED | changes))


def test_a_report_has_tables_pictures_and_verdicts_on_one_page(program, home, tmp_path):
    status, out, _ = program("validate", "--quick", "-o", "out")
    assert status == 0
    assert "sums: pass" in out
    page = (tmp_path / "out" / "index.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert page.count('src="data:image/png;base64,') == 2
    assert "Is a &lt; 2, and b fine?" in page
    text = (tmp_path / "out" / "report.md").read_text()
    assert "| a | 1 | 1.05 ± 0.1 | theory | ok |" in text
    for link in re.findall(r"!\[.*?\]\((.+?)\)", text):
        assert (tmp_path / "out" / link).is_file()
    rows = list(csv.DictReader((tmp_path / "out" / "figures.csv").open()))
    assert [(r["figure"], r["found"], r["as expected"]) for r in rows] == [
        ("a", "1.0", "yes"), ("b", "CONVERGED", "yes"),
    ]  # fmt: skip
    table = (tmp_path / "out" / "sums" / "values.csv").read_text()
    assert table == "part,value\na,1.0\nb,CONVERGED\n"


def test_what_is_done_is_not_run_again_unless_it_changed_or_is_asked_for(program, home):
    arguments = ("validate", "sums", "--quick")
    assert program(*arguments)[0] == 0
    assert calls(home) == "ab"
    assert program(*arguments)[0] == 0
    assert calls(home) == ""
    assert program(*arguments, "--again")[0] == 0
    assert calls(home) == "ab"
    expect(home, a={"value": 2.0, "tolerance": 0.1, "source": "theory", "quick": True})
    status, out, _ = program(*arguments)
    assert (status, calls(home)) == (1, "ab")
    assert "a: 1, expected 2 ± 0.1" in out
    (home.parent / "common.py").write_text("")
    program(*arguments)
    assert calls(home) == "ab"
    program("validate")  # in full
    assert calls(home) == "abc"


def test_pictures_left_out_are_drawn_when_asked_for(program, home, tmp_path):
    program("validate", "--quick", "--no-figures")
    assert "<img" not in (tmp_path / "report" / "index.html").read_text()
    assert calls(home) == "ab"
    program("validate", "--quick")
    assert "<img" in (tmp_path / "report" / "index.html").read_text()
    assert calls(home) == "ab"
    program("validate", "--quick", "--no-figures")
    assert calls(home) == ""


def test_a_case_that_ends_with_an_error_is_reported_and_resumed(program, home, tmp_path):
    (home / "broken-b").touch()
    status, out, err = program("validate", "--quick")
    assert status == 1
    assert "sums: fail" in out
    assert "no luck" in err
    assert "no luck with &lt;b&gt;" in (tmp_path / "report" / "index.html").read_text()
    assert not (tmp_path / "report" / "sums.json").exists()
    (home / "broken-b").unlink()
    calls(home)
    assert program("validate", "--quick")[0] == 0
    assert calls(home) == "b"
    assert not list((tmp_path / "report" / "sums").glob("part-*"))
    assert json.loads((tmp_path / "report" / "sums.json").read_text())["figures"]["a"] == 1.0


def test_an_interrupted_case_goes_on_with_the_part_that_was_cut_short(home, tmp_path):
    def stop(name, done, total):
        if name == "b":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_case(ValidationCase(home), tmp_path / "out", quick=True, on_part=stop)
    assert calls(home) == "a"
    record = run_case(ValidationCase(home), tmp_path / "out", quick=True)
    assert calls(home) == "b"
    assert record.figures == {"a": 1.0, "b": "CONVERGED"}
    assert list(record.pictures) == ["sums/a.png", "sums/b.png"]


def test_a_part_s_record_that_is_damaged_is_made_again(home, tmp_path):
    folder = tmp_path / "out" / "sums"
    folder.mkdir(parents=True)
    (folder / "part-a.json").write_text('{"digest": ')
    assert run_case(ValidationCase(home), tmp_path / "out", quick=True).passed
    assert calls(home) == "ab"


def test_figures_that_are_missing_or_no_number_are_outside(program, home):
    expect(home, c={"value": 0.0, "tolerance": 1e9, "source": "theory"})
    status, out, _ = program("validate")
    assert status == 1
    assert "c: none, expected 0" in out
    expect(home, d={"status": ["FINE"], "source": "theory", "quick": True})
    status, out, _ = program("validate", "--quick")
    assert status == 1
    assert "d: missing, expected FINE" in out


def test_a_known_failure_is_reported_until_it_is_mended(program, home, tmp_path):
    known = {"value": 9.0, "tolerance": 0.1, "source": "theory", "known_failure": "ill <luck>"}
    expect(home, a={**known, "quick": True})
    status, out, _ = program("validate", "--quick")
    assert status == 0
    assert "sums: pass, but for 1 figures that are known to fail" in out
    page = (tmp_path / "report" / "index.html").read_text()
    assert "fails, known: ill &lt;luck&gt;" in page
    expect(home, a={**known, "value": 1.0, "quick": True})
    status, out, _ = program("validate", "--quick")
    assert status == 1
    assert "a: 1, expected 1 ± 0.1" in out


def test_a_case_without_quick_figures_is_left_out_of_quick_runs(program, home):
    slow = {name: {**aim, "quick": False} for name, aim in EXPECTED.items()}
    (home / "expected.json").write_text(json.dumps(slow))
    assert program("validate", "--list")[1] == "sums: Sums (no quick part)\n"
    status, out, _ = program("validate", "--quick")
    assert (status, calls(home)) == (0, "")
    assert "sums" not in out


def test_an_unknown_case_or_home_is_bad_input(program, home, monkeypatch, tmp_path):
    status, _, err = program("validate", "products")
    assert status == 2
    assert "'products'" in err
    assert "expected one of sums" in err
    monkeypatch.setenv("PDCORRECT_HOME", str(tmp_path / "nowhere"))
    status, _, err = program("validate")
    assert status == 2
    assert "no validation cases" in err


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"value": 1.0, "source": "x"}, "a: expected value and tolerance together"),
        ({"source": "x"}, "expected value and tolerance, or at_least"),
        ({"value": 1.0, "tolerance": 0.1, "at_most": 2.0, "source": "x"}, "or status"),
        ({"at_most": 1.0, "at_least": 2.0, "source": "x"}, "expected at_least below at_most"),
        ({"value": 1.0, "tolerance": 0.1, "status": ["A"], "source": "x"}, "or status"),
        ({"value": 1.0, "tolerance": -0.1, "source": "x"}, "a.tolerance: "),
        ({"value": 1.0, "tolerance": 0.1}, "a.source: "),
        ({"value": 1.0, "tolerance": 0.1, "source": "x", "kwick": True}, "a.kwick: "),
        ({"status": [], "source": "x"}, "a.status: "),
    ],
)
def test_expectations_without_a_meaning_are_refused(program, home, entry, message):
    expect(home, a=entry)
    status, _, err = program("validate")
    assert status == 2
    assert message in err
    assert "expected.json" in err


@pytest.mark.parametrize(
    ("bounds", "told", "fine"),
    [
        ({"at_least": 1.0}, "at least 1", [1.0, 1.01, 1e9]),
        ({"at_most": 1.0}, "at most 1", [-1e9, 0.49, 0.5, 1.0]),
        ({"at_least": 0.5, "at_most": 1.0}, "at least 0.5, at most 1", [0.5, 1.0]),
    ],
)
def test_a_figure_may_be_bounded_on_either_side(bounds, told, fine):
    aim = Expectation(source="x", **bounds)
    assert aim.describe() == told
    assert [v for v in (-1e9, 0.49, 0.5, 1.0, 1.01, 1e9) if aim.met_by(v)] == fine
    assert not any(aim.met_by(v) for v in (math.nan, None, "CONVERGED"))


def test_expectations_that_are_no_json_are_refused(home):
    (home / "expected.json").write_text("{")
    with pytest.raises(InputError, match=r"expected\.json"):
        read_expectations(home / "expected.json")


def test_parts_whose_records_would_be_one_file_are_refused(home, tmp_path):
    (home / "run.py").write_text("def parts(quick):\n    return {'h 1e-3': None, 'h 1e+3': None}")
    with pytest.raises(InputError, match=r"'h 1e-3' and 'h 1e\+3'"):
        run_case(find_cases()[0], tmp_path / "out")


def test_a_module_without_a_case_is_refused(home, tmp_path):
    (home / "run.py").write_text("")
    with pytest.raises(InputError, match=r"run\.py: expected a function case"):
        run_case(find_cases()[0], tmp_path / "out")


def test_figures_are_judged_by_value_or_status():
    aims = {
        "x": Expectation(value=1.0, tolerance=0.5, source="s", quick=True),
        "y": Expectation(status=("A", "B"), source="s"),
    }
    assert outside({"x": 1.5, "y": "B", "z": 9.0}, aims) == []
    assert outside({"x": 1.6, "y": "C"}, aims) == ["x", "y"]
    assert outside({"x": None, "y": 1.0}, aims) == ["x", "y"]
    assert outside({"x": float("nan")}, aims) == ["x"]
    assert outside({"x": "A"}, aims) == ["x"]
    assert missing(["z"], aims, quick=True) == ["x"]
    assert missing(["z"], aims, quick=False) == ["x", "y"]


def test_a_changed_model_or_data_file_is_a_reason_to_run_a_case_again(program, home):
    root = home.parents[1]
    (root / "models" / "m").mkdir(parents=True)
    (root / "models" / "m" / "weights").write_bytes(b"1")
    (root / "models" / "m" / "README.md").write_text("words")
    (home / "inputs.txt").write_text("models/m\n")
    program("validate", "sums", "--quick", "--no-figures")
    assert calls(home) == "ab"
    record = json.loads((root.parent / "report" / "sums.json").read_text())
    assert list(record["inputs"]) == ["models/m/weights"]
    (root / "models" / "m" / "README.md").write_text("other words")
    program("validate", "sums", "--quick", "--no-figures")
    assert calls(home) == ""
    (root / "models" / "m" / "weights").write_bytes(b"2")
    program("validate", "sums", "--quick", "--no-figures")
    assert calls(home) == "ab"


def test_an_input_that_is_not_there_is_named(home):
    (home / "inputs.txt").write_text("models/none\n")
    with pytest.raises(InputError, match=r"inputs\.txt: 'models/none'"):
        ValidationCase(home).digest()


def test_the_page_begins_with_the_summary_and_says_what_each_case_found(program, home):
    (home.parent / "summary.md").write_text("## Which?\n\n| a | b |\n|---|---|\n| 1 | *two* |\n")
    (home / "README.md").write_text(
        "# Sums\n\n**Question.** Is it?\n\nHow, [here](../there.md).\n\n"
        "**What it says.** <b>Yes</b>, `c`.\n\n**Limits.** None.\n"
    )
    program("validate", "sums", "--quick", "--no-figures")
    page = (home.parents[2] / "report" / "index.html").read_text()
    assert page.index("<h2>Which?</h2>") < page.index("<em>two</em>") < page.index("Is it?")
    found, method = page.index("&lt;b&gt;Yes&lt;/b&gt;"), page.index("How, here.")
    assert found < method < page.index("<strong>Limits.</strong>")
    text = (home.parents[2] / "report" / "report.md").read_text()
    assert "**What it says.** <b>Yes</b>, `c`." in text
    assert "(../there.md)" not in text
    assert "Made 20" in text
    assert "load at the beginning" in text
