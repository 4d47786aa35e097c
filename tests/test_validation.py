"""The cases of validation/, as far as they are quick: theory and published values."""

import importlib
import json
import sys

import pytest

import pdcorrect as pc
from pdcorrect.validation.cases import find_cases, read_summary
from pdcorrect.validation.outcome import missing, outside
from pdcorrect.validation.page import Section, to_csv, to_html, to_markdown
from pdcorrect.validation.records import PartRecord, Record, table_csv
from pdcorrect.validation.running import slug

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


@pytest.mark.parametrize("name", CASES)
def test_tables_beside_a_record_are_the_record_s(name):
    results = CASES[name].folder.parent / "results"
    record = json.loads((results / f"{name}.json").read_text())
    told = {f"{slug(table['name'])}.csv": table_csv(table) for table in record["tables"]}
    kept = {path.name: path.read_text() for path in (results / name).glob("*.csv")}
    assert kept == told


def test_the_page_recorded_is_that_of_the_records():
    results = find_cases()[0].folder.parent / "results"
    sections = [
        Section(case, Record(**json.loads((results / f"{name}.json").read_text())))
        for name, case in CASES.items()
    ]
    assert (results / "figures.csv").read_text() == to_csv(sections)
    assert (results / "report.md").read_text() == to_markdown(sections, read_summary())
    assert (results / "index.html").read_text() == to_html(sections, results, read_summary())


def test_recorded_rows_give_the_recorded_figures_and_tables(monkeypatch):
    pytest.importorskip("torch")  # for the models' bases
    case = CASES["error_time"]
    monkeypatch.syspath_prepend(case.folder)
    redraw = importlib.import_module("redraw")
    for name in ("redraw", "run"):  # other cases have a module of the second name
        del sys.modules[name]
    record = json.loads((case.folder.parent / "results" / "error_time.json").read_text())
    again = PartRecord("", quick=False, drawn=False)
    for motion in redraw.MOTIONS:
        for setting in redraw.SETTINGS:
            again.add(redraw.outcome(redraw.measured(record, motion, setting), False, ""))
    assert again.figures == pytest.approx(record["figures"], rel=1e-12)
    for table, kept in zip(again.tables, record["tables"], strict=True):
        assert (table["name"], list(table["headings"])) == (kept["name"], kept["headings"])
        for row, other in zip(table["rows"], kept["rows"], strict=True):
            for cell, told in zip(row, other, strict=True):
                assert cell == (pytest.approx(told, rel=1e-9) if isinstance(told, float) else told)


def test_recorded_rows_of_easy_and_hard_simulations_can_be_drawn_again(monkeypatch):
    pytest.importorskip("torch")
    case = CASES["easy_to_hard"]
    monkeypatch.syspath_prepend(case.folder)
    redraw = importlib.import_module("redraw")
    for name in ("redraw", "run"):
        del sys.modules[name]
    record = json.loads((case.folder.parent / "results" / "easy_to_hard.json").read_text())
    for table in record["tables"]:
        found = redraw.simulations(table)
        assert len(found) == 5
        for rows in found:
            plain, reference = rows["plain"], rows["reference"]
            assert (plain.omega, reference.omega, reference.error) == (0.0, 100.0, 0.0)
            left = {name: (row.error / plain.error) ** 2 for name, row in rows.items()}
            assert {n: 100.0 * (1.0 - x) for n, x in left.items()} == pytest.approx(
                {name: row.omega for name, row in rows.items()}, abs=0.02
            )


def test_the_models_of_error_against_time_are_inputs_of_the_case():
    case = CASES["error_time"]
    models = {name for names in case._module().MODELS.values() for name in names}
    assert {path.split("/")[1] for path in case.inputs() if path.startswith("models/")} == models


def test_the_models_and_records_of_easy_and_hard_simulations_are_inputs_of_the_case():
    case = CASES["easy_to_hard"]
    subjects = case._module().SUBJECTS.values()
    inputs = {path.rsplit("/", 1)[0] for path in case.inputs() if not path.startswith("datasets/")}
    models = {f"models/{name}" for subject in subjects for name in subject.models}
    assert inputs == models | {f"validation/results/{subject.record}" for subject in subjects}


def test_the_report_and_the_documentation_recommend_the_same():
    folder = find_cases()[0].folder.parents[1]

    def advice(path):
        lines = (folder / path).read_text().splitlines()
        first = lines.index("| you want | take | why |")
        return [line for line in lines[first : first + 9] if "midpoint" not in line]

    assert advice("validation/summary.md") == advice("docs/choosing.md")


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_whole_case(name):
    check(name, quick=False)
