"""Evaluations of data sets: files that are missing or damaged, tables, records, the command."""

import csv
import io
import json
import shutil
from dataclasses import asdict, fields, replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import pdcorrect as pc  # noqa: E402
from evaluation_samples import STEP, TINY, as_stored, fake, perfect, untrained  # noqa: E402
from pdcorrect.data.schema import read_shard  # noqa: E402
from pdcorrect.data.simulate import rebuilt_problems  # noqa: E402
from pdcorrect.errors import FileFormatError, InputError  # noqa: E402
from pdcorrect.evaluation import tables  # noqa: E402
from pdcorrect.evaluation.evaluation import evaluate, saved_candidates  # noqa: E402
from pdcorrect.evaluation.measures import TrajectoryMeasures, read_cases  # noqa: E402
from pdcorrect.figures.curves import plot_omega  # noqa: E402


@pytest.fixture(scope="module")
def evaluation():
    cases = read_cases(TINY, bases=["best"]).cases
    candidates = [
        fake(cases, perfect, "perfect", refused=(1, 2)),
        fake(cases, as_stored("plain"), "like plain"),
        fake(cases, as_stored("best"), "like best", "best"),
    ]
    return evaluate(candidates, TINY, batch=3)


# --- files and tables ------------------------------------------------------------------


def test_trajectories_and_errors_come_back_from_their_tables_as_they_were(evaluation):
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
    expected = json.loads(json.dumps(asdict(tables.summarise(values, meshes, 3))))
    assert found["runs"]["best"]["measures"]["omega"] == expected
    assert found["runs"]["best"]["measures"]["omega"]["smallest"] == min(values)


def test_tables_name_every_run_and_what_is_removed(evaluation):
    text = tables.markdown(evaluation, ["a note"])
    lines = {line.split("|")[1].strip(): line for line in text.splitlines() if "|" in line}
    assert {"perfect", "like plain", "best", "intermediate"} <= set(lines)
    headings, rows = tables.headline(evaluation)
    found = dict(zip(headings, rows[0], strict=True))
    assert found["run"] == "perfect"
    assert found["Omega"] == "100.00"
    assert found["95 % interval"] == "100.00 to 100.00"
    assert found["refused"] == "10.00"
    assert found["failed"] == "0/4"
    assert "-0.00" not in text


def test_failures_and_runs_without_all_trajectories_are_told(evaluation):
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
        with pytest.raises(InputError):
            plot_omega(values, tmp_path / "none.png")


# --- rebuilt problems ------------------------------------------------------------------


@pytest.fixture(scope="module")
def stored():
    path = TINY / "evaluation" / "mesh-0002.h5"
    return read_shard(path), path


def test_rebuilt_problems_and_steps_are_those_of_the_file(stored):
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
        found = pc.ProjectiveDynamics(problems[1])(problems[1].rest_state()).state.positions
        np.testing.assert_allclose(found, shard.simulations[1].runs[run].positions[1], atol=1e-6)
        forces = problems[1].external_forces(0.0, STEP)
        np.testing.assert_allclose(
            forces, shard.simulations[1].forces[0], atol=1e-6 * np.abs(forces).max()
        )
    fine = rebuilt_problems(shard, path, "reference")[0]
    assert len(fine.positions) == shard.simulations[0].runs["reference"].attributes["nodes"]


def test_files_that_do_not_fit_their_scenes_are_refused(stored):
    shard, path = stored
    mixed = replace(shard.simulations[0], forces=1.001 * shard.simulations[0].forces)
    for name, changed in {
        "points": replace(shard, points=shard.points + 1e-6),
        "cells": replace(shard, cells=shard.cells[::-1]),
        "free": replace(shard, free=~shard.free),
        "mass": replace(shard, mass=2 * shard.mass),
        "young": replace(shard, young=1.01 * shard.young),
        "time_step": replace(shard, attributes={**shard.attributes, "time_step": 0.02}),
        "the loads of simulation 0": replace(shard, simulations=(mixed, shard.simulations[1])),
        "a simulation has no scene": replace(
            shard, simulations=(replace(mixed, scene_toml=""), shard.simulations[1])
        ),
    }.items():
        with pytest.raises(InputError, match=rf"mesh-0002\.h5: {name}"):
            rebuilt_problems(changed, path)
    for run in ("intermediate", "total-mass"):
        with pytest.raises(InputError, match=f"'{run}'"):
            rebuilt_problems(shard, path, run)


# --- damaged and missing files ---------------------------------------------------------


def test_a_damaged_file_is_named(tmp_path):
    folder = tmp_path / "tiny"
    shutil.copytree(TINY / "evaluation", folder / "evaluation")
    path = folder / "evaluation" / "mesh-0001.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"mesh-0001\.h5"):
        evaluate([], folder)


@pytest.fixture
def unfinished(tmp_path):
    """The tiny data set with a file of its evaluation split not there yet."""
    folder = tmp_path / "tiny"
    shutil.copytree(TINY, folder)
    (folder / "evaluation" / "mesh-0001.h5").unlink()
    return folder


def test_a_split_of_which_files_are_missing_is_evaluated_on_request_only(
    unfinished, monkeypatch, program
):
    with pytest.raises(InputError, match=r"evaluation: 1 .*mesh-0001\.h5"):
        evaluate([], unfinished)
    status, _, err = program("evaluate", unfinished)
    assert (status, "--incomplete" in err) == (2, True)
    status, out, _ = program("evaluate", unfinished, "--incomplete")
    assert (status, "1 of 3 files" in out) == (0, True)

    def late(*arguments, **options):
        found = read_cases(*arguments, **options)
        shutil.copy(TINY / "evaluation" / "mesh-0001.h5", unfinished / "evaluation")
        return found

    monkeypatch.setattr("pdcorrect.evaluation.evaluation.read_cases", late)
    found = evaluate([], unfinished, incomplete=True)  # missing is what was not read
    assert [path.name for path in found.missing] == ["mesh-0001.h5"]
    assert "mesh-0001.h5" not in found.shards
    assert json.loads(tables.to_json(found))["data"]["missing"] == ["mesh-0001.h5"]
    assert {t.measures.mesh for t in found.runs["plain"].trajectories} == {0, 2}


def test_a_configuration_that_cannot_be_used_is_told_before_anything_is_done(unfinished):
    (unfinished / "config.toml").write_text("name = 3")
    with pytest.raises(InputError, match="name"):
        evaluate([], unfinished)
    assert evaluate([], unfinished, incomplete=True).missing == ()


# --- models and the command ------------------------------------------------------------


def test_models_are_named_by_what_tells_them_apart_and_say_what_they_know(tmp_path):
    paths = [untrained(tmp_path / f"seed-{k}" / "model", seed=k) for k in range(2)]
    paths.append(untrained(tmp_path / "other" / "model", base="best"))
    found = saved_candidates(paths)
    assert [one.name for one in found] == ["seed-0/model", "seed-1/model", "other/model"]
    assert [one.base for one in found] == ["plain", "plain", "best"]
    assert found[1].record()["seed"] == 1
    assert found[0].warnings("tiny", "x", "evaluation") == []
    for dataset, config_hash, split in (
        ("large", "x", "evaluation"), ("tiny", "y", "evaluation"), ("tiny", "x", "training"),
        ("tiny", "x", "validation"),
    ):  # fmt: skip
        (told,) = found[0].warnings(dataset, config_hash, split)
        assert "seed-0/model" in told
    sets = [{"name": name, "config_hash": "x"} for name in ("tiny", "other")]
    found[0].model.record.training["data_sets"] = sets
    (told,) = found[0].warnings("other", "x", "evaluation")  # tiny may hold meshes of this split
    assert "'other'" in told
    with pytest.raises(InputError, match="seed-0"):
        saved_candidates([paths[0], paths[0]])


def test_the_command_measures_a_model_and_writes_everything(tmp_path, program):
    pytest.importorskip("matplotlib")
    model = untrained(tmp_path / "zero", dataset="other")
    folder = tmp_path / "tiny"
    (folder / "evaluation").mkdir(parents=True)
    shutil.copy(TINY / "evaluation" / "mesh-0002.h5", folder / "evaluation")
    output = tmp_path / "found"
    status, out, _ = program("evaluate", model, folder, "-o", output)
    assert status == 0
    assert {path.name for path in output.iterdir()} == {
        "summary.json", "trajectories.csv", "errors.csv", "table.md", "errors.png", "omega.png"
    }  # fmt: skip
    content = json.loads((output / "summary.json").read_text())
    assert content["models"]["zero"]["weights_sha256"]
    assert content["gate"] == pc.Gate().model_dump()
    assert any("zero" in note and "'other'" in note for note in content["notes"])
    assert content["environment"]["device"] == "cpu"
    found = content["runs"]["zero"]["measures"]
    assert found["gate_rate"]["mean"] == 100.0  # of a body that the model does not know
    assert abs(found["omega"]["mean"]) < 0.01  # solved again, to the data set's tolerance
    assert abs(found["step_omega"]["mean"]) < 0.1
    assert found["omega"]["interval"] is None  # one mesh
    status, out, _ = program("evaluate", model, folder, "--no-gate")
    assert status == 0
    assert "refused (" not in out

    for arguments, words in (
        ((tmp_path / "none", TINY), "none"),
        ((tmp_path,), tmp_path.name),
        ((TINY, "--split", "test"), "'test'"),
    ):
        status, _, err = program("evaluate", *arguments)
        assert status == 2
        assert words in err
