"""The scripts of `models` and `docs/tables.py`, and what released models know of their training."""

import csv
import doctest
import importlib.util
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import pdcorrect as pc  # noqa: E402
import pdcorrect.errors  # noqa: E402
from pdcorrect import metrics  # noqa: E402
from pdcorrect.corrector.bodies import BodyGraph  # noqa: E402
from pdcorrect.data.configuration import DatasetConfig  # noqa: E402
from pdcorrect.data.plan import draw_scene, make_plan  # noqa: E402
from pdcorrect.elements.answers import VoxelMesh  # noqa: E402
from pdcorrect.evaluation.measures import read_cases  # noqa: E402
from pdcorrect.fem.neighbourhood import cell_graph, neighbours_of  # noqa: E402

ROOT = Path(__file__).parents[1]
TINY = ROOT / "datasets" / "tiny"


def script(path):
    """A script as a module."""
    path = ROOT / path
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # as where it runs as a program
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def raising(error):
    """A script that does."""

    def main():
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (pdcorrect.errors.InputError("wrong"), 2), (SystemExit("wrong"), 2), (SystemExit(0), 0),
        (pdcorrect.errors.ConvergenceError("wrong"), 1), (pdcorrect.errors.OutputError("wrong"), 1),
    ],
)  # fmt: skip
def test_a_script_ends_with_the_status_of_its_error(error, status):
    with pytest.raises(SystemExit) as stop:
        script("models/program.py").run_script(raising(error))
    assert stop.value.code == status
    with pytest.raises(KeyError):  # a mistake of its own, which is no wrong input
        script("models/program.py").run_script(raising(KeyError("wrong")))


# --- released models -------------------------------------------------------------------------

RELEASED = sorted(path.parent.name for path in (ROOT / "models").glob("*/model.json"))
FIRST_ONLY = ("torsion-exact",)
"""Models whose ranges are those of the first of their data sets."""


@cache
def training_shapes(dataset):
    """Measures at rest of a data set's training bodies."""
    config = DatasetConfig.load(ROOT / "datasets" / dataset / "config.toml")
    plans = [plan for plan in make_plan(config) if plan.split == "training"]
    problems = [pc.discretise(draw_scene(config, plan, 0)) for plan in plans]
    return BodyGraph.of(problems, dtype=torch.float64).shapes


FEW = ("tiny", "torsion-as-published")
"""Models that learned so few bodies that to make them all takes seconds."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in FEW else [pytest.mark.slow]) for name in RELEASED],
)
def test_released_models_know_the_bodies_that_they_were_trained_on(name):
    model = pc.load_model(name)
    sets = [dataset for dataset, _ in model.data_sets]
    shapes = torch.cat([training_shapes(x) for x in (sets[:1] if name in FIRST_ONLY else sets)])
    known = model.corrector.envelope
    assert float(known.shape_excess(shapes).max()) < 1e-6
    assert (shapes.amin(dim=0) - known.shape_low).abs().max() < 1e-6
    assert (shapes.amax(dim=0) - known.shape_high).abs().max() < 1e-6


@pytest.mark.parametrize("name", RELEASED)
def test_the_record_of_a_released_model_is_of_its_weights_and_trajectories(name):
    record = json.loads((ROOT / "models" / name / "evaluation.json").read_text())
    assert record["weights_sha256"] == script("models/record.py").weights_hash(name)
    with (ROOT / "models" / name / "trajectories.csv").open(newline="") as file:
        omegas = [float(row["omega"]) for row in csv.DictReader(file)]
    omega = record["runs"]["corrected"]["omega"]
    assert len(omegas) == record["data"]["trajectories"]
    assert np.mean(omegas) == pytest.approx(omega["mean"], abs=1e-3)
    assert min(omegas) == pytest.approx(omega["smallest"], abs=1e-3)


# --- scripts ---------------------------------------------------------------------------------


def test_an_evaluation_is_condensed_into_a_record(program, tmp_path, monkeypatch):
    whole, short = tmp_path / "whole", tmp_path / "short"
    assert program("evaluate", "tiny", TINY, "-o", whole, "--no-figures")[0] == 0
    short.mkdir()
    call = ["record.py", "tiny", whole, "-o", short, "--further", whole]
    monkeypatch.setattr(sys, "argv", [str(word) for word in call])
    script("models/record.py").main()
    record = json.loads((short / "evaluation.json").read_text())
    summary = json.loads((whole / "summary.json").read_text())
    omega = summary["runs"]["tiny"]["measures"]["omega"]
    assert record["runs"]["corrected"]["omega"]["mean"] == pytest.approx(omega["mean"], rel=1e-5)
    assert record["weights_sha256"] == record["evaluated_weights_sha256"]
    (split,) = record["further_splits"]
    assert split["omega_without_gate"] == split["omega"]["mean"]
    assert split["error_over_base"] == record["error_over_base"]
    assert len((short / "trajectories.csv").read_text().splitlines()) == 5


class Gated:
    """In the place of an evaluation with the gate, on a split of which it refused so much."""

    with_gate, run = True, "model"

    def __init__(self, refused):
        self.summary = {"data": {"split": "stiffer"}}
        self.runs = {"model": {"measures": {"gate_rate": {"mean": refused}}}}


@pytest.mark.parametrize("refused", [0.0, 0.1])
def test_a_gate_that_refused_steps_does_not_stand_for_the_run_without_one(monkeypatch, refused):
    record = script("models/record.py")
    monkeypatch.setattr(record, "Evaluation", lambda gated: gated)
    monkeypatch.setattr(record, "further_record", lambda *pair: pair)
    gated = Gated(refused)
    if refused:
        with pytest.raises(pdcorrect.errors.InputError, match=r"stiffer.*--no-gate"):
            record.further_records([gated])
    else:
        assert record.further_records([gated]) == [(gated, gated)]


def test_baselines_are_steps_of_changed_problems():
    baselines = script("models/baselines.py")
    cases = read_cases(TINY, "evaluation").cases[:1]

    def omega(change):
        return baselines.mean_omega(cases, change, "cpu", 10)

    best = [metrics.error_corrected(*(case.runs[r] for r in ("best", "plain")), case.reference)
            for case in cases]  # fmt: skip
    # solver tolerances apart: stored runs are another engine's
    assert omega(lambda problem: problem) == pytest.approx(0.0, abs=0.1)
    assert omega(baselines.with_stiffness(1.0)) == pytest.approx(0.0, abs=0.1)
    same = baselines.with_solver(element="hex8-bubble-mean", mass="averaged")
    assert omega(same) == pytest.approx(np.mean(best), abs=0.1)
    assert omega(baselines.with_stiffness(0.5)) < -50


def test_studies_of_the_element_leave_out_what_they_say():
    studies = script("models/element_studies.py")
    rng = np.random.default_rng(0)
    solid = np.ones((2, 2, 1), dtype=bool)
    neighbours = neighbours_of(VoxelMesh.of(solid).cells, np.argwhere(solid))
    held = rng.integers(0, 2, (4, 8)).astype(float)
    graph = cell_graph(neighbours, np.ones(4), np.full(4, 0.3), held)
    seen = torch.as_tensor(graph.numbers).float(), torch.as_tensor(graph.neighbours)
    answers = {}
    for kind in (studies.ElementNetwork, studies.WithoutMass, studies.OneOrientation):
        torch.manual_seed(0)
        network = kind(8, 1)
        torch.nn.init.normal_(network.last.weight)
        with torch.no_grad():
            answers[kind] = network(*seen)
    full, without, one = answers.values()
    assert torch.equal(without[0], full[0])
    assert not without[1].any()
    assert full[1].any()
    first = torch.zeros(1, dtype=torch.int64)
    assert not torch.allclose(one[0], full[0])
    with torch.no_grad():
        assert torch.equal(network(*seen, torch.arange(48))[0], network(*seen, first)[0])


@pytest.mark.slow
def test_a_stiffness_is_fitted_and_all_baselines_are_measured(tmp_path):
    command = [sys.executable, ROOT / "models" / "baselines.py", TINY, "-o", tmp_path]
    subprocess.run([*command, "--fit", "2"], check=True, capture_output=True)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"hex8-mean", "consistent mass", "fitted stiffness", "best"} < set(summary["runs"])
    assert 0.5 < summary["stiffness_factor"] < 1.5


def test_tables_are_written_between_their_marks(monkeypatch):
    tables = script("docs/tables.py")
    monkeypatch.setitem(tables.TABLES, "two", lambda: (("a", "b"), [["1", "2"]]))
    page = "x\n<!-- table: two -->\nold\n<!-- end -->\ny\n"
    text = tables.filled(page)
    assert "1|2" in text
    assert "old" not in text
    assert tables.filled(text) == text
    with pytest.raises(KeyError):
        tables.filled(page.replace("two", "three"))


def test_numbers_of_tables_have_their_digits():
    assert doctest.testmod(script("docs/records.py")).failed == 0
