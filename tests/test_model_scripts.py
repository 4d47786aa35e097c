"""The scripts in `models` that print tables, fit and widen ranges, and draw."""

import csv
import hashlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from safetensors.torch import load_file, save_file  # noqa: E402

import pdcorrect as pc  # noqa: E402
import pdcorrect.errors  # noqa: E402
from pdcorrect import metrics  # noqa: E402
from pdcorrect.corrector import model_io  # noqa: E402
from pdcorrect.corrector.batch_hybrid import BatchCoarseStep, BatchParts  # noqa: E402
from pdcorrect.corrector.bodies import BodyGraph  # noqa: E402
from pdcorrect.corrector.model_io import save_model  # noqa: E402
from pdcorrect.corrector.shapes import SHAPE_MEASURES  # noqa: E402
from pdcorrect.data.config import DatasetConfig  # noqa: E402
from pdcorrect.data.plan import draw_scene, make_plan  # noqa: E402
from pdcorrect.evaluation.measures import read_cases  # noqa: E402

ROOT = Path(__file__).parents[1]


def script(name):
    if str(ROOT / "models") not in sys.path:
        sys.path.append(str(ROOT / "models"))  # as where it runs as a program
    spec = importlib.util.spec_from_file_location(name, ROOT / "models" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_the_page_of_results_has_the_tables_of_the_records():
    page, tables = (ROOT / "docs" / "results.md").read_text(encoding="utf-8"), script("table")
    assert tables.table() in page
    assert tables.others_table() in page
    assert tables.bodies_table() in page
    assert tables.steps_table() in page
    assert tables.baselines_table() in page
    assert tables.together_table() in page
    assert tables.trainings_table() in page
    assert tables.splits_table() in page
    splits = {path.name for path in (tables.RESULTS / "other-splits").iterdir()}
    gated = {name for name in splits if not name.endswith("-no-gate")}
    assert splits - gated <= {f"{name}-no-gate" for name in gated}
    for alone in gated - {name.removesuffix("-no-gate") for name in splits - gated}:
        summary = json.loads((tables.RESULTS / "other-splits" / alone / "summary.json").read_text())
        found = [x for x in summary["runs"].values() if "gate_rate" in x["measures"]]
        assert [x["measures"]["gate_rate"]["largest"] for x in found] == [0.0]
    assert tables.splits_table().count("\n") == 1 + len(gated) > 1
    scenes = {path.stem for path in (tables.RESULTS / "other-scenes").glob("*.json")}
    bodies = list((tables.RESULTS / "other-bodies").glob("*.json"))
    assert len(tables.others_table().splitlines()) == 2 + len(scenes - gated) > 2
    assert len(tables.bodies_table().splitlines()) == 2 + len(bodies) > 5


def test_tables_are_printed_below_the_headings_of_the_page(monkeypatch, capsys):
    page, tables = (ROOT / "docs" / "results.md").read_text(encoding="utf-8"), script("table")
    monkeypatch.setattr(sys, "argv", ["table.py"])
    tables.main()
    told = capsys.readouterr().out
    assert len(tables.tables()) == 8
    for heading, text in tables.tables().items():
        assert f"**{heading}**\n\n{text}\n" in told
        before = page[: page.index(text)].splitlines()
        last = next(line for line in reversed(before) if line.startswith("#"))
        assert last.lstrip("# ") == heading
    assert told.count("**\n\n| ") == 8


def test_the_page_of_results_counts_what_the_gate_of_today_does_on_further_splits():
    tables = script("table")
    corrected, refused, harmed = [], 0, []
    for folder in sorted((tables.RESULTS / "other-splits").iterdir()):
        if folder.name.endswith(("no-gate", "double-step")):
            continue  # without a gate, and refused as a whole today
        runs = json.loads((folder / "summary.json").read_text())["runs"]
        (run,) = [name for name, found in runs.items() if "gate_rate" in found["measures"]]
        ratios = tables._over(f"other-splits/{folder.name}", run, runs[run]["base"], "rms_error")
        with (folder / "trajectories.csv").open(newline="") as file:
            for line in csv.DictReader(file):
                if line["run"] != run:
                    continue
                if float(line["gate_rate"]) == 100.0:
                    refused += 1
                    continue
                corrected.append(float(line["omega"]))
                ratio = ratios[line["mesh"], line["simulation"]]
                harmed += [ratio] if ratio > 1.05 else []
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert len(harmed) == 6
    assert (
        f"six of the {len(corrected)} in which any correction is applied; the other {refused} "
        in page
    )
    least, second, *_ = sorted(corrected)
    assert (
        f"none of the {len(corrected)} is worse: the least Ω is {least:.0f}, the next {second:.0f}"
        in page
    )


def test_each_script_has_its_row_in_the_list():
    lines = (ROOT / "models" / "README.md").read_text(encoding="utf-8").splitlines()
    told = " ".join(line.split("|")[1] for line in lines if line.startswith("| `"))
    for path in (ROOT / "models").glob("*.py"):
        is_program = 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
        assert (f"`{path.name}`" in told) == is_program, path.name


NORMALISER = "normaliser."


def as_version(version, folder):
    """A model as older versions had it.

    Time steps without the cell size (4), none at all (3), nor bodies at rest (2).
    """
    description = json.loads((folder / "model.json").read_text())
    dropped = ("shape_", "time_step_") if version == 2 else ("time_step_",)
    added = {"step_low": [np.log(0.01)], "step_high": [np.log(0.01)]} if version == 4 else {}
    known = {k: x for k, x in description["normalisation"].items() if not k.startswith(dropped)}
    weights = load_file(folder / "weights.safetensors")
    gone = tuple(NORMALISER + name for name in dropped)
    weights = {k: x for k, x in weights.items() if not k.startswith(gone)}
    weights |= {NORMALISER + k: torch.tensor(x, dtype=torch.float64) for k, x in added.items()}
    save_file(weights, folder / "weights.safetensors")
    digest = hashlib.sha256((folder / "weights.safetensors").read_bytes()).hexdigest()
    description |= {"version": version, "weights_sha256": digest, "normalisation": known | added}
    if version == 4:
        description["record"]["training"]["time_steps"] = {"tiny": 0.01}
    rewrite(folder, description)


def rewrite(folder, description):
    """Write a description with its checksum."""
    content = {key: x for key, x in description.items() if key != "checksum"}
    text = json.dumps({**content, "checksum": model_io.content_digest(content)})
    (folder / "model.json").write_text(text)


def ran(command, *arguments):
    """A script's process, when it has ended."""
    command = [sys.executable, ROOT / "models" / command, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def assert_refused(process, words):
    """It ended with one sentence."""
    assert process.returncode == 2
    assert process.stderr.startswith("error: ")
    assert "Traceback" not in process.stderr
    assert re.search(words, process.stderr), process.stderr


def copied(tmp_path):
    folder = tmp_path / "tiny"
    shutil.copytree(ROOT / "models" / "tiny", folder)
    return folder, ROOT / "datasets" / "tiny" / "config.toml"


def test_an_old_model_learns_its_training_bodies_from_the_configuration(tmp_path):
    folder, config = copied(tmp_path)
    before = pc.load_model(folder)
    as_version(2, folder)
    told = "version 2: expected 5: .*`python models/fit_shapes.py .*docs/files.md"
    with pytest.raises(pc.errors.FileVersionError, match=told):
        pc.load_model(folder)
    assert_refused(ran("fit_shapes.py", folder, config, config), "'tiny' comes twice")
    run = ran("fit_shapes.py", folder, config)
    assert run.returncode == 0, run.stderr
    assert "time step over cell size 0.2 to 0.2 s/m" in run.stdout
    after = pc.load_model(folder)
    values = before.corrector.state_dict()
    for name, tensor in after.corrector.state_dict().items():
        assert torch.equal(tensor, values[name]), name
    as_version(2, folder)
    (folder / "weights.safetensors").write_bytes(b"")
    assert_refused(ran("fit_shapes.py", folder, config), "damaged")
    told = after.record.training["shapes"]
    assert (told["dataset"], told["meshes"]) == ("tiny", 6)
    assert 0.0 < told["left_out"] < 1.0


@pytest.mark.parametrize("version", [3, 4])
def test_an_old_model_learns_the_time_steps_of_its_data_and_keeps_its_weights_to_the_last_bit(
    tmp_path, version
):
    folder, config = copied(tmp_path)
    new = load_file(folder / "weights.safetensors")
    record = pc.load_model(folder).record
    as_version(version, folder)
    old = load_file(folder / "weights.safetensors")
    assert set(new) - set(old) == {"normaliser.time_step_low", "normaliser.time_step_high"}
    told = rf"version {version}: expected 5: .*`python models/fit_time_steps.py .*docs/files.md"
    with pytest.raises(pc.errors.FileVersionError, match=told):
        pc.load_model(folder)
    run = ran("fit_time_steps.py", folder, config)
    assert run.returncode == 0, run.stderr
    assert "time step over cell size 0.2 to 0.2 s/m" in run.stdout
    assert pc.load_model(folder).record == record
    found = load_file(folder / "weights.safetensors")
    assert found.keys() == new.keys()
    for name, tensor in found.items():
        assert tensor.numpy().tobytes() == new[name].numpy().tobytes(), name


def test_time_steps_are_fitted_anew_to_the_data_sets_that_are_asked_for(tmp_path):
    folder, config = copied(tmp_path)
    other = tmp_path / "other.toml"
    changed = config.read_text().replace('name = "tiny"', 'name = "other"')
    changed = changed.replace("cell_size = 0.05", "cell_size = 0.1")
    other.write_text(changed.replace("step = 0.01", "step = 0.025"))
    before = (folder / "model.json").read_bytes()
    expected = "configurations of tiny, other: expected those of tiny"
    assert_refused(ran("fit_time_steps.py", folder, config, other), expected)
    assert_refused(ran("fit_time_steps.py", folder, other), "of other: expected those of tiny")
    twice = ran("fit_time_steps.py", folder, config, config, "--other")
    assert_refused(twice, "'tiny' comes twice")
    assert (folder / "model.json").read_bytes() == before
    assert ran("fit_time_steps.py", folder, config, other, "--other").returncode == 0
    model = pc.load_model(folder)
    assert model.corrector.normaliser.time_steps == pytest.approx((0.2, 0.25), rel=1e-12)
    assert ran("fit_time_steps.py", folder, config).returncode == 0
    assert (folder / "model.json").read_bytes() == before


@pytest.mark.parametrize("name", ["fit_shapes.py", "fit_time_steps.py"])
def test_scripts_ask_for_the_data_sets_of_the_ranges_and_not_of_the_weights(tmp_path, name):
    folder, config = copied(tmp_path)
    model = pc.load_model(folder)
    sets = [{"name": one, "config_hash": None} for one in ("before", "tiny")]
    model.record.training.update(data_sets=sets, fitted_to=["tiny"])
    save_model(model.corrector, folder, record=model.record)
    before = load_file(folder / "weights.safetensors")
    other = tmp_path / "other.toml"
    other.write_text(config.read_text().replace('name = "tiny"', 'name = "before"'))
    expected = (
        "configurations of tiny, before: expected those of tiny, the data sets of the model's "
        "ranges by its record; --other takes others."
    )
    assert_refused(ran(name, folder, config, other), expected)
    run = ran(name, folder, config)
    assert run.returncode == 0, run.stderr
    assert pc.load_model(folder).fitted_to == ["tiny"]
    after = load_file(folder / "weights.safetensors")
    assert all(torch.equal(after[key], x) for key, x in before.items())


def test_old_models_that_are_damaged_are_refused(tmp_path):
    folder, config = copied(tmp_path)
    as_version(2, folder)
    told = "of format version 2: fit_shapes.py fits this range, too"
    assert_refused(ran("fit_time_steps.py", folder, config), told)
    description = json.loads((folder / "model.json").read_text())
    rewrite(folder, {key: x for key, x in description.items() if key != "version"})
    expected = "version is None: expected 2 or 3 or 4 or 5"
    assert_refused(ran("fit_time_steps.py", folder, config), expected)
    rewrite(folder, {**description, "version": 3})  # whose tensors are those of version 2
    assert_refused(ran("fit_time_steps.py", folder, config), "not the tensors of its architecture")
    (folder / "model.json").write_text(json.dumps({**description, "parameters": 1}))
    assert_refused(ran("fit_time_steps.py", folder, config), "its checksum is not that")


def test_a_network_takes_the_ranges_of_another_model_of_the_same_normalisation(tmp_path):
    folder, _ = copied(tmp_path)
    wider = pc.load_model(folder)
    normaliser = wider.corrector.normaliser
    for name, values in normaliser.named_buffers():
        if name.endswith(("_low", "_high")):
            values += -1.0 if name.endswith("_low") else 1.0
    with torch.no_grad():
        wider.corrector.network.decoder[-1].bias += 1.0
    wider.record.training["fitted_to"] = ["wide"]
    save_model(wider.corrector, tmp_path / "wider", record=wider.record)
    run = ran("take_ranges.py", folder, tmp_path / "wider", "-o", tmp_path / "both")
    assert run.returncode == 0, run.stderr
    found = pc.load_model(tmp_path / "both")
    own, theirs = (load_file(path / "weights.safetensors") for path in (folder, tmp_path / "wider"))
    for name, values in found.corrector.state_dict().items():
        of = theirs if name.endswith(("_low", "_high")) else own
        assert torch.equal(values, of[name]), name
    digest = model_io.weights_digest(tmp_path / "wider")
    assert found.record.training["ranges_of"] == digest
    assert found.fitted_to == ["wide"]
    normaliser.average_mean += 0.1
    save_model(wider.corrector, tmp_path / "wider", record=wider.record)
    refused = ran("take_ranges.py", folder, tmp_path / "wider", "-o", tmp_path / "none")
    assert_refused(refused, "normalisation differs in average_mean: expected the same means and")
    refused = ran("take_ranges.py", folder, "torsion-exact", "-o", tmp_path / "none")
    assert_refused(refused, "of unlike architectures")
    assert not (tmp_path / "none").exists()


def test_ranges_are_not_written_over_what_is_there(tmp_path):
    folder, _ = copied(tmp_path)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for place in (folder, folder / "model.json", tmp_path):
        expected = f"{re.escape(str(place))}: exists already, and nothing is overwritten: expected"
        assert_refused(ran("take_ranges.py", "tiny", "tiny", "-o", place), expected)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    empty = tmp_path / "empty"
    empty.mkdir()
    run = ran("take_ranges.py", "tiny", "tiny", "-o", empty)
    assert run.returncode == 0, run.stderr
    assert pc.load_model(empty).data_sets == pc.load_model(folder).data_sets


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit_shapes.py", "docs", "x.toml"], "model 'docs': not in .*such as ./docs, which is a"),
        (["add_first_steps.py", "tiny", "x.toml"], "x.toml: cannot be read"),
        (["fit_body_ranges.py", "", "x.toml"], "model '': expected the name of a model"),
        (["rollout_strangeness.py", "tiny"], "'tiny': expected MODEL=CONFIG"),
        (["plot_histories.py", "no.csv", "no.png"], "no.csv: cannot be read"),
        (["plot_histories.py", "README.md", "no.png"], "README.md: expected the history.csv"),
    ],
)
def test_scripts_tell_what_is_wrong_in_a_sentence(arguments, words):
    assert_refused(ran(*arguments), words)


def test_every_script_ends_by_the_same_rules():
    for path in (ROOT / "models").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        if 'if __name__ == "__main__":' in text:
            assert text.endswith('if __name__ == "__main__":\n    run_script(main)\n'), path.name


def raising(error):
    """A script that does."""

    def main():
        raise error

    return main


def test_a_script_s_errors_are_told_by_their_kind(capsys):
    program = script("program")
    for error, status in (
        (pc.errors.InputError("wrong"), 2), (SystemExit("wrong"), 2),
        (pc.errors.ConvergenceError("wrong"), 1), (pc.errors.OutputError("wrong"), 1),
    ):  # fmt: skip
        with pytest.raises(SystemExit) as stop:
            program.run_script(raising(error))
        assert stop.value.code == status
        assert capsys.readouterr().err == "error: wrong\n"
    with pytest.raises(SystemExit) as stop:
        program.run_script(raising(SystemExit(0)))
    assert stop.value.code == 0
    with pytest.raises(KeyError):  # a mistake of the script's own
        program.run_script(raising(KeyError("wrong")))


def test_a_body_left_out_lies_outside_the_others_by_its_distance_from_the_next(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "models")
    each = torch.tensor([[0.0, 5.0], [3.0, 1.0], [1.0, 2.0]])
    assert script("fit_shapes").left_out(each) == 3.0


RELEASED = sorted(path.parent.name for path in (ROOT / "models").glob("*/model.json"))
FIRST_ONLY = ("torsion-exact",)
"""Models whose ranges are those of the first of their data sets."""


@cache
def training_shapes(dataset):
    """Measures at rest of a data set's training bodies."""
    config = DatasetConfig.load(ROOT / "datasets" / dataset / "config.toml")
    scenes = script("first_steps").scenes_of(config, "training", loads=1)
    problems = [pc.discretise(scene) for scene, _ in scenes]
    return BodyGraph.of(problems, dtype=torch.float64).shapes


@pytest.mark.parametrize("name", RELEASED)
def test_released_models_know_the_bodies_that_they_were_trained_on(name):
    model = pc.load_model(name)
    sets = [dataset for dataset, _ in model.data_sets]
    shapes = torch.cat([training_shapes(x) for x in (sets[:1] if name in FIRST_ONLY else sets)])
    known = model.corrector.normaliser
    assert float(known.shape_excess(shapes).max()) < 1e-6
    assert (shapes.amin(dim=0) - known.shape_low).abs().max() < 1e-6
    assert (shapes.amax(dim=0) - known.shape_high).abs().max() < 1e-6


def test_ranges_of_bodies_means_are_fitted_to_own_rollouts(tmp_path):
    folder = tmp_path / "tiny"
    shutil.copytree(ROOT / "models" / "tiny", folder)
    before = pc.load_model(folder).corrector.state_dict()
    config = ROOT / "datasets" / "tiny" / "config.toml"
    command = [sys.executable, ROOT / "models" / "fit_body_ranges.py", folder, config]
    subprocess.run([*command, "--batch", "4"], check=True, capture_output=True)
    model = pc.load_model(folder)
    after = model.corrector.state_dict()
    changed = {name for name in after if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("normaliser.average_") for name in changed)
    # the references that trainings fit to, and rollouts of the corrected model, are alike
    low, high, deviation = (
        before[f"normaliser.average_{part}"].numpy() for part in ("low", "high", "deviation")
    )
    middle = after["normaliser.average_mean"].numpy()
    assert ((low - deviation < middle) & (middle < high + deviation)).all()
    fitted = model.record.training["body_ranges"]
    assert fitted["steps"] == 20 * fitted["rollouts"] > 0
    assert np.isfinite(middle).all()


def test_first_steps_of_training_scenes_are_within_widened_ranges(tmp_path):
    folder = tmp_path / "tiny"
    shutil.copytree(ROOT / "models" / "tiny", folder)
    path = ROOT / "datasets" / "tiny" / "config.toml"
    model = pc.load_model(folder)
    before = model.corrector.state_dict()
    names = model.corrector.normaliser.names
    with torch.no_grad():  # as if its ranges were those of a single value
        for name in names:
            key = name.replace("-", "_")
            before[f"normaliser.{key}__low"].copy_(before[f"normaliser.{key}__mean"])
            before[f"normaliser.{key}__high"].copy_(before[f"normaliser.{key}__mean"])
    pc.save_model(model.corrector, folder, record=model.record)
    narrow = tmp_path / "narrow"
    shutil.copytree(folder, narrow)
    first = first_step(path)
    assert (first(pc.load_model(folder)) > 0.9).all()
    command = [sys.executable, ROOT / "models" / "add_first_steps.py", folder, path]
    subprocess.run([*command, "--batch", "4"], check=True, capture_output=True)
    widened = pc.load_model(folder)
    assert (first(widened) == 0.0).all()
    after = widened.corrector.state_dict()
    changed = {name for name in after if not torch.equal(before[name], after[name])}
    assert all(
        name.endswith(("__low", "__high", "average_low", "average_high")) for name in changed
    )
    told = {"dataset": "tiny", "simulations": 10, "steps": 1}
    assert widened.record.training["first_steps"] == told
    more = tmp_path / "more"
    shutil.copytree(folder, more)
    changed = [sys.executable, ROOT / "models" / "add_first_steps.py", more, path]
    subprocess.run([*changed, "--batch", "4", "--steps", "3"], check=True, capture_output=True)
    after_more = pc.load_model(more)
    assert after_more.record.training["first_steps"] == {**told, "steps": 3}
    high = "normaliser.average_high"
    assert (after_more.corrector.state_dict()[high] >= after[high]).all()
    assert (after_more.corrector.state_dict()[high] > after[high]).any()
    command = [sys.executable, ROOT / "models" / "refused_first_steps.py"]
    pairs = [f"{narrow}={path}", f"{folder}={path}"]
    output = tmp_path / "record.json"
    counted = [*command, *pairs, "--split", "training", "--loads", "1", "--reference", "-o", output]
    subprocess.run(counted, check=True, capture_output=True)
    found = json.loads(output.read_text())["models"]
    assert [row["model"] for row in found] == ["narrow", "tiny"]
    counts = [[row["first_steps"], row["refused"]["features"], row["unknown_by_nodes"]]
              for row in found]  # fmt: skip
    assert counts == [[6, 6, 6], [6, 0, 0]]
    rises = found[0]["rise_of_energy"]
    assert rises["corrected"] == found[1]["rise_of_energy"]["corrected"]  # without a gate
    assert -1.0 < rises["reference"]["most"] < 1.0  # best masses are right


def test_scenes_in_which_the_gate_refuses_an_answer_are_left_out():
    steps, model = script("first_steps"), pc.load_model(ROOT / "models" / "tiny")
    config = DatasetConfig.load(ROOT / "datasets" / "tiny" / "config.toml")
    scenes = steps.scenes_of(config, "training", loads=1)[:2]
    problems = [pc.coarse_model(scene, model.base, refine) for scene, refine in scenes]

    def rolled_out(gate):
        return steps.seen_in_rollouts(model, problems, 3, "cpu", lambda v: v.bodies.bodies, gate)

    seen, whole = rolled_out(None)
    assert (seen, whole.tolist()) == ([2, 2, 2], [True, True])
    nothing_passes = pc.Gate(margin=None, average=None, volume=10.0)
    seen, whole = rolled_out(nothing_passes)
    assert (seen, whole.tolist()) == ([2, 2, 2], [False, False])
    assert "of_view" not in vars(model.corrector)


def first_step(path):
    """A function from models to the share of nodes outside their ranges in one first step."""
    config = DatasetConfig.load(path)
    plan = next(plan for plan in make_plan(config) if plan.split == "training")
    problem = pc.discretise(pc.best_coarse(draw_scene(config, plan, 0)))
    stepper = pc.BatchStepper([problem])

    def outside(model):
        parts = BatchParts(stepper, model.corrector, model.velocity)
        step = BatchCoarseStep(parts, stepper.rest_state(), None)
        return model.corrector.outside(step.view(step.solved()), 1e-6)

    return outside


def test_a_trajectory_of_a_data_set_is_drawn(tmp_path):
    pytest.importorskip("pyvista")
    command = [sys.executable, ROOT / "models" / "draw_first.py", tmp_path, "torsion-exact"]
    subprocess.run([*command, "--frames", "2"], check=True, capture_output=True)
    record = json.loads((tmp_path / "first.json").read_text())
    rows = record["trajectories"]["torsion-exact"]["runs"]
    assert set(rows) == {"coarse PD", "hybrid torsion-exact"}
    assert 0 < rows["hybrid torsion-exact"]["rms_mm"] < rows["coarse PD"]["rms_mm"]
    for name in ("node", "overlay"):
        assert (tmp_path / f"torsion-exact-{name}.png").stat().st_size > 5000


def test_baselines_are_steps_of_changed_problems():
    baselines, data = script("baselines"), ROOT / "datasets" / "tiny"
    cases = read_cases(data, "evaluation", skip_damaged=False).cases[:2]

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


@pytest.mark.parametrize("split", ["training", "validation"])
def test_a_stiffness_is_fitted_and_all_baselines_are_measured(tmp_path, split):
    command = [sys.executable, ROOT / "models" / "baselines.py", ROOT / "datasets" / "tiny"]
    options = [] if split == "training" else ["--fit-split", split]  # training by default
    subprocess.run(
        [*command, "-o", tmp_path, "--fit", "2", *options], check=True, capture_output=True
    )
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"hex8-mean", "consistent mass", "fitted stiffness", "best"} < set(summary["runs"])
    assert 0.5 < summary["stiffness_factor"] < 1.5
    assert summary["notes"][0].endswith(f"fitted to 2 simulations of {split}")


def test_folded_steps_are_counted_and_compared_where_gates_differ(monkeypatch):
    folded = script("folded_steps")
    config = DatasetConfig.load(ROOT / "datasets" / "tiny" / "config.toml")
    plan = next(plan for plan in make_plan(config) if plan.split == "evaluation")
    model = pc.load_model("tiny")
    row = folded.simulation(config, plan, model)
    assert row["refused"]["default"] == row["refused"]["corners"] < plan.frames == row["steps"]
    assert 0.0 < row["least_corner"] < 1.0
    assert "rms_mm" not in row
    # a bound above all corners refuses every step, and what is left is the base
    monkeypatch.setitem(folded.GATES, "corners", pc.Gate(corners=10.0))
    row = folded.simulation(config, plan, model)
    assert row["refused"]["corners"] == plan.frames
    errors = row["rms_mm"]
    assert errors["corners"] == pytest.approx(errors["base"], rel=1e-12)
    assert errors["default"] < errors["base"]


def test_a_simulation_is_repeated_with_and_without_a_gate(tmp_path):
    config, record = ROOT / "datasets" / "tiny" / "config.toml", tmp_path / "record.json"
    command = [sys.executable, ROOT / "models" / "with_and_without_gate.py", config]
    options = ["--model", "tiny", "0/0", "-o", record, "--frames", "2"]  # as its usage has it
    subprocess.run([*command, *options], check=True, capture_output=True)
    found = json.loads(record.read_text())
    (simulation,) = found["simulations"]
    assert (simulation["mesh"], simulation["load"]) == (0, 0)
    row = simulation["models"]["tiny"]
    if not row["refused"]:
        assert row["with_gate"] == row["without"]
    assert row["without"] > row["own_base"]
    assert found["omega"]["tiny"]["without"] == dict.fromkeys(
        ("mean", "median", "least"), row["without"]
    )
    assert found["bodies"] == {"family": "cross", "coarse_nodes": [72, 108]}
    assert max(row["body_beyond"].values()) < found["gate"]["body"]
    harm = found["error_over_base"]["tiny"]["without"]
    ratio = row["rms_mm_without"] / row["rms_mm_own_base"]
    assert harm == {"median": ratio, "largest": ratio, "above_1.05": 0}
    assert ratio == pytest.approx(((100 - row["without"]) / (100 - row["own_base"])) ** 0.5)


def test_bodies_of_other_sizes_are_drawn_for_a_gate_to_refuse(tmp_path):
    config, record = ROOT / "datasets" / "tiny" / "config.toml", tmp_path / "record.json"
    command = [sys.executable, ROOT / "models" / "with_and_without_gate.py", config, "0/0"]
    bodies = ["--coarse-nodes", "144", "180", "--family", "beam", "--frames", "2"]
    command += ["--model", "tiny", "-o", record, *bodies]
    subprocess.run(command, check=True, capture_output=True)
    found = json.loads(record.read_text())
    subprocess.run(command, check=True, capture_output=True)  # knows its own record
    assert json.loads(record.read_text()) == found
    for wrong, told in ((["--split", "validation"], "no --split"), (["--frames", "3"], "frames")):
        refused = subprocess.run([*command, *wrong], capture_output=True, text=True)
        assert refused.returncode != 0
        assert told in refused.stderr
    (simulation,) = found["simulations"]
    assert found["bodies"] == {"family": "beam", "coarse_nodes": [144, 180]}
    assert 144 <= simulation["nodes"] <= 180
    row = simulation["models"]["tiny"]
    assert row["body_beyond"]["nodes"] == pytest.approx(np.log(simulation["nodes"] / 108))
    assert row["refused"] == {"1": "body", "2": "body"}
    assert row["with_gate"] == row["own_base"] != row["without"]


def test_bodies_that_a_gate_refuses_are_counted_by_split(tmp_path):
    record, far = tmp_path / "record.json", ROOT / "validation" / "gate" / "far.toml"
    pairs = [f"tiny={path}" for path in (ROOT / "datasets" / "tiny" / "config.toml", far)]
    pairs.append(f"tiny={ROOT / 'datasets' / 'torsion-pilot' / 'config.toml'}")
    command = [sys.executable, ROOT / "models" / "known_bodies.py", *pairs, "-o", record]
    subprocess.run(command, check=True, capture_output=True)
    found = json.loads(record.read_text())
    own, near, large = (row["splits"] for row in found["models"])
    assert own["evaluation"]["meshes"] == 3
    assert all(split["refused"] == 0 for split in [*own.values(), *near.values()])
    assert max(split["farthest"] for split in near.values()) < found["gate"]["body"]
    assert set(near) > {"evaluation", "stiffer", "half-step", "long"}
    assert large["evaluation"]["refused"] == large["evaluation"]["meshes"] == 10
    assert large["evaluation"]["measure"] in SHAPE_MEASURES


def rolled_out(output, *models, meshes):
    """What `seen_and_unseen` records of models on tiny's data."""
    command = [sys.executable, ROOT / "models" / "seen_and_unseen.py", ROOT / "datasets" / "tiny"]
    command += [*models, "--meshes", str(meshes), "-o", output]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    return json.loads(output.read_text())["rollouts"]


def test_models_and_means_of_their_weights_roll_out_seen_and_unseen_bodies(tmp_path):
    rows = rolled_out(tmp_path / "record.json", "tiny", "models/tiny+models/tiny", meshes=2)
    assert [(r["model"], r["split"], r["simulations"]) for r in rows] == [
        (name, *of_split) for name in ("tiny", "models/tiny+models/tiny")
        for of_split in (("training", 3), ("validation", 4))
    ]  # fmt: skip
    seen, unseen, *averaged = rows
    meshes = {name.split("/")[1] for name in seen["names"]}
    assert meshes == {"mesh-0000", "mesh-0003"}  # of six
    assert seen["omega_mean"] > 99.0 > unseen["omega_mean"] > 80.0
    for row, same in zip((seen, unseen), averaged, strict=True):
        np.testing.assert_allclose(same["omegas"], row["omegas"], atol=0.01)


def test_a_mean_of_weights_lies_between_them_and_wants_models_alike(tmp_path):
    averaged, model = script("seen_and_unseen").averaged, pc.load_model("tiny")
    state, other = model.corrector.state_dict(), str(tmp_path / "other")
    name = next(key for key in state if key.startswith("network.") and state[key].dim() == 2)
    before = state[name].clone()
    state[name] += 1.0
    save_model(model.corrector, other, record=model.record)
    mean = averaged(["tiny", other], "cpu").corrector.state_dict()
    torch.testing.assert_close(mean[name], before + 0.5)
    state["normaliser.output_scale"] *= 2.0
    save_model(model.corrector, other, record=model.record)
    for unlike in (other, "torsion-exact"):
        with pytest.raises(pdcorrect.errors.InputError, match="another architecture, base, vel"):
            averaged(["tiny", unlike], "cpu")
