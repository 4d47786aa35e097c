"""The program: what it writes, what it says, and how it ends."""

import csv
import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, cross
from pdcorrect.cli import main as cli
from pdcorrect.evaluation import report

ROOT = Path(__file__).parent.parent

PROGRAM = Path(sys.executable).parent / "pdcorrect"


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(beam((4, 2, 1), time={"frames": 4}).to_toml(), encoding="utf-8")
    return path


def test_simulate_writes_the_rollout(program, scene_file, tmp_path):
    output = tmp_path / "run.h5"
    status, out, err = program("simulate", scene_file, "-o", output)
    assert (status, err) == (0, "")
    problem = pc.discretise(pc.Scene.load(scene_file))
    expected = pc.rollout(pc.ProjectiveDynamics(problem))
    loaded = pc.load_trajectory(output)
    np.testing.assert_array_equal(loaded.positions, expected.positions)
    np.testing.assert_array_equal(loaded.stats["iterations"], expected.stats["iterations"])
    assert loaded.scene_toml == problem.scene.to_toml()
    for word in ("4 frames", "30 nodes", "iterations a frame", "worst residual", "energy", "wrote"):
        assert word in out


@pytest.mark.parametrize("solver", ["pd", "newton"])
def test_simulate_refines_and_takes_either_solver(program, scene_file, tmp_path, solver):
    output = tmp_path / "run.h5"
    arguments = ("--refine", 2, "--solver", solver, "--frames", 2, "--vtu", tmp_path / "vtu")
    status, out, _ = program("simulate", scene_file, "-o", output, *arguments)
    assert status == 0
    loaded = pc.load_trajectory(output)
    assert loaded.positions.shape == (3, 9 * 5 * 3, 3)
    method = {"pd": "projective dynamics (lbfgs)", "newton": "Newton"}[solver]
    assert loaded.attributes["solver"] == method
    assert method in out
    assert len(list((tmp_path / "vtu").glob("*.vtu"))) == 3


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_vtu_files_hold_the_stress_at_the_nodes(program, tmp_path, element):
    scene = beam((4, 2, 1), time={"frames": 2}, solver={"element": element})
    (tmp_path / "scene.toml").write_text(scene.to_toml(), encoding="utf-8")
    arguments = ("-o", tmp_path / "run.h5", "--refine", 2, "--vtu", tmp_path / "vtu")
    assert program("simulate", tmp_path / "scene.toml", *arguments)[0] == 0
    problem = pc.discretise(scene, refine=2)
    for frame, positions in enumerate(pc.load_trajectory(tmp_path / "run.h5").positions):
        data = meshio.read(tmp_path / "vtu" / f"run_{frame:04d}.vtu").point_data
        expected = pc.stress(problem, positions).nodal_cauchy
        for column, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)]):
            np.testing.assert_array_equal(data["stress"][:, column], expected[:, i, j])
        s = expected
        twice_squared = (s[:, 0, 0] - s[:, 1, 1]) ** 2 + (s[:, 1, 1] - s[:, 2, 2]) ** 2
        twice_squared += (s[:, 2, 2] - s[:, 0, 0]) ** 2
        twice_squared += 6 * (s[:, 0, 1] ** 2 + s[:, 1, 2] ** 2 + s[:, 0, 2] ** 2)
        np.testing.assert_allclose(
            data["von_mises"], np.sqrt(twice_squared / 2), rtol=1e-9, atol=1e-9
        )
    assert 100 < data["von_mises"].max() < 1e5


def test_an_existing_file_is_kept_unless_told(program, scene_file, tmp_path):
    output = tmp_path / "run.h5"
    output.write_text("precious")
    status, _, err = program("simulate", scene_file, "-o", output)
    assert status != 0
    assert "run.h5" in err
    assert output.read_text() == "precious"
    assert program("simulate", scene_file, "-o", output, "--overwrite", "--frames", 1)[0] == 0
    assert len(pc.load_trajectory(output)) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("poisson = 0.45|poisson = 0.5", "material.poisson = 0.5"),
        ("density = |weight = ", "material.weight: unknown key"),
        ("at = 0.0|at = 7.0", "contains no node"),
    ],
)
def test_bad_scenes_end_with_status_2_and_one_paragraph(
    program, scene_file, tmp_path, change, words
):
    old, new = change.split("|")
    text = scene_file.read_text()
    assert old in text
    scene_file.write_text(text.replace(old, new))
    status, out, err = program("simulate", scene_file, "-o", tmp_path / "run.h5")
    assert status == cli.BAD_INPUT
    assert words in err
    assert err.startswith("error: ")
    assert "Traceback" not in out + err
    assert not (tmp_path / "run.h5").exists()


def test_other_bad_input_ends_with_status_2(program, scene_file, tmp_path):
    out = tmp_path / "x.h5"
    for arguments in (
        ("simulate", tmp_path / "none.toml", "-o", out),
        ("simulate", scene_file, "-o", out, "--solver", "magic"),
        ("simulate", scene_file, "-o", out, "--refine", "0"),
        ("simulate", scene_file),
        ("render", tmp_path / "none.h5", "-o", tmp_path / "x.png"),
        ("render", scene_file, "-o", tmp_path / "x.png"),
        ("frobnicate",),
    ):
        status, _, err = program(*arguments)
        assert status == cli.BAD_INPUT, arguments
        assert "Traceback" not in err


def test_an_unwritable_output_is_named(program, scene_file):
    for target in (scene_file / "run.h5", "/proc/nowhere/run.h5"):
        status, _, err = program("simulate", scene_file, "-o", target)
        assert status != 0
        assert "run.h5" in err
        assert "Traceback" not in err


def test_a_run_that_fails_keeps_its_frames_and_ends_with_status_1(
    program, scene_file, tmp_path, monkeypatch
):
    real = pc.ProjectiveDynamics.__call__

    def fails_third(self, state, *rest, **named):
        result = real(self, state, *rest, **named)
        if state.time > 0.015:
            return dataclasses.replace(result, status=pc.Status.ITERATION_LIMIT)
        return result

    monkeypatch.setattr(pc.ProjectiveDynamics, "__call__", fails_third)
    output = tmp_path / "run.h5"
    status, _, err = program("simulate", scene_file, "-o", output)
    assert status == cli.FAILED
    assert "frame 3" in err
    assert len(pc.load_trajectory(output)) == 2


def test_compare_writes_its_report(program, tmp_path):
    scene = tmp_path / "cross.toml"
    scene.write_text(cross(0.4, name="small cross", solver={"tolerance": 1e-4}).to_toml())
    folder = tmp_path / "report"
    status, out, _ = program("compare", scene, "-o", folder, "--frames", 3)
    assert status == 0
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    best = ["best coarse PD", "intermediate PD", "fine best PD"]
    assert list(rows) == ["coarse PD", "coarse Newton", *best]
    assert float(rows["fine best PD"]["rms_error"]) == 0
    errors = [float(rows[k]["rms_error"]) for k in ("coarse PD", "intermediate PD")]
    assert errors[0] > 2 * errors[1] > 0
    assert float(rows["coarse PD"]["omega"]) == 0
    assert float(rows["intermediate PD"]["omega"]) == pytest.approx(
        100 * (1 - (errors[1] / errors[0]) ** 2)
    )
    record = json.loads((folder / "report.json").read_text())
    assert 0 < record["solver_error"] < 1e-2 * errors[0]
    assert all(row["unusual_frames"] == 0 for row in record["rows"])
    assert record["environment"]["threads"]
    text = (folder / "report.md").read_text()
    for name in ("comparison.png", "overlay.png", "node.png", "energy.png", "error_over_time.png"):
        assert f"]({name})" in text
        assert (folder / name).stat().st_size > 5000
    assert "small cross" in out
    for label in rows:
        assert label in out
        assert f"| {label} |" in text


def failing_after_a_step(monkeypatch, kind, nodes, element="hex8"):
    """Have steppers of a class fail in their second step on such meshes."""
    step = kind.__call__

    def fails_second(self, state, *others, **named):
        result = step(self, state, *others, **named)
        fails = len(state.positions) in nodes and self.problem.element == element
        if fails and state.time > 0.0:
            return dataclasses.replace(result, status=pc.Status.ITERATION_LIMIT)
        return result

    monkeypatch.setattr(kind, "__call__", fails_second)


def nodes_of(scene, refine):
    return len(pc.discretise(scene, refine).positions)


@pytest.mark.parametrize("failing", ["coarse PD", "intermediate PD"])
def test_compare_goes_on_after_a_case_that_fails(
    program, scene_file, tmp_path, monkeypatch, failing
):
    refine = {case.label: case.refine for case in pc.evaluate.CASES}[failing]
    nodes = nodes_of(pc.Scene.load(scene_file), refine)
    failing_after_a_step(monkeypatch, pc.ProjectiveDynamics, {nodes})
    folder = tmp_path / "report"
    status, out, err = program("compare", scene_file, "-o", folder)
    assert (status, err) == (cli.FAILED, "")
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    others = ["coarse PD", "coarse Newton", "best coarse PD", "intermediate PD", "fine best PD"]
    assert list(rows) == [*(label for label in others if label != failing), failing]
    assert [row["failure"] != "" for row in rows.values()] == [False] * 4 + [True]
    record = json.loads((folder / "report.json").read_text())
    assert list(record["failures"]) == [failing]
    assert (record["solver_error"] is None) == (failing == "coarse PD")
    text = (folder / "report.md").read_text()
    assert f"| {failing} |  | failed |" in text
    for told in (text, " ".join(out.split())):
        assert f"{failing} failed and has no errors or times: frame 2" in told
        assert ("'Corrected' is" in told) == (failing != "coarse PD")  # whose error is its zero
    assert (folder / "comparison.png").stat().st_size > 5000


def test_compare_ends_where_its_reference_fails(program, scene_file, tmp_path, monkeypatch):
    nodes = nodes_of(pc.Scene.load(scene_file), 4)
    failing_after_a_step(monkeypatch, pc.ProjectiveDynamics, {nodes}, "hex8-bubble")
    status, _, err = program("compare", scene_file, "-o", tmp_path / "report")
    assert status == cli.FAILED
    assert "frame 2 (t = 0.02 s) failed" in err
    assert not (tmp_path / "report" / "report.md").exists()


def test_a_report_of_a_reference_alone_has_no_plots_of_errors(tmp_path, monkeypatch):
    scene = beam((4, 2, 1), time={"frames": 2})
    coarse = {nodes_of(scene, refine) for refine in (1, 2)}
    for kind in (pc.ProjectiveDynamics, pc.Newton):
        failing_after_a_step(monkeypatch, kind, coarse)
    found = pc.compare(scene, cases=pc.evaluate.CASES)
    assert [row.label for row in found.rows] == ["fine PD"]
    assert list(found.failures) == ["coarse Newton", "coarse PD", "intermediate PD"]
    text = report.write_report(found, tmp_path).read_text()
    assert "](comparison.png)" in text
    assert "](error_" not in text
    assert not list(tmp_path.glob("error_*.png"))


def test_a_case_that_cannot_be_set_up_has_failed(monkeypatch):
    scene = beam((2, 1, 1), time={"frames": 1})
    make = pc.evaluate.case_stepper

    def refuses(scene, case):
        if case.solver == "newton":
            raise pc.errors.ConvergenceError("no factor.")
        return make(scene, case)

    monkeypatch.setattr(pc.evaluate, "case_stepper", refuses)
    assert pc.compare(scene).failures == {"coarse Newton": "no factor."}


def test_compare_without_figures_needs_no_view_extra(program, scene_file, tmp_path, monkeypatch):
    for module in ("pyvista", "matplotlib"):
        monkeypatch.setitem(sys.modules, module, None)
    status, _, _ = program(
        "compare", scene_file, "-o", tmp_path / "r", "--frames", 2, "--no-figures"
    )
    assert status == 0
    assert not list((tmp_path / "r").glob("*.png"))
    status, _, err = program("compare", scene_file, "-o", tmp_path / "r2", "--frames", 2)
    assert status == cli.BAD_INPUT
    assert "pip install 'pdcorrect[view]'" in err


def test_render_draws_runs_side_by_side(program, scene_file, tmp_path):
    for name, solver in (("a", "pd"), ("b", "newton")):
        program("simulate", scene_file, "-o", tmp_path / f"{name}.h5", "--solver", solver)
    files = (tmp_path / "a.h5", tmp_path / "b.h5")
    for name in ("still.png", "moving.gif"):
        status, _, err = program("render", *files, "-o", tmp_path / name)
        assert (status, err) == (0, "")
        assert (tmp_path / name).stat().st_size > 5000
    assert program("render", *files, "-o", tmp_path / "over.png", "--overlay")[0] == 0
    assert (tmp_path / "over.png").stat().st_size > 5000
    status, _, err = program("render", *files, "-o", tmp_path / "x.png", "--frame", 99)
    assert status == cli.BAD_INPUT
    status, _, err = program("render", *files, "-o", tmp_path / "x.bmp2")
    assert status == cli.BAD_INPUT


def test_doctor_looks_at_everything(program):
    status, out, _ = program("doctor")
    for word in ("numpy", "scikit-fem", "BLAS", "kernel threads", "factorisation cholespy", "GPU",
                 "off-screen rendering"):  # fmt: skip
        assert word in out
    assert status in (0, 1)
    assert ("PROBLEM" in out) == (status == 1)


def test_help_names_every_command():
    out = subprocess.run([PROGRAM, "--help"], capture_output=True, text=True, check=True).stdout
    for command in ("simulate", "compare", "render", "doctor"):
        assert command in out
        help_text = subprocess.run(
            [PROGRAM, command, "--help"], capture_output=True, text=True, check=True,
            env={**os.environ, "COLUMNS": "100"},
        ).stdout  # fmt: skip
        assert "Usage" in help_text


def test_an_output_that_cannot_be_written_is_found_before_the_work(program, scene_file, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    for arguments in (
        ("compare", scene_file, "-o", blocked),
        ("simulate", scene_file, "-o", tmp_path / "a.h5", "--vtu", blocked / "vtu"),
    ):
        status, out, err = program(*arguments)
        assert status == cli.FAILED
        assert "file" in err
        assert "frames of" not in out
    assert not (tmp_path / "a.h5").exists()


def test_a_name_that_reads_nan_survives_the_report(tmp_path):
    scene = beam((2, 1, 1), name="NaN study", time={"frames": 1})
    comparison = pc.compare(scene, cases=pc.evaluate.CASES[2:3])
    record = json.loads(report.to_json(comparison))
    assert "NaN study" in record["scene"]
    assert record["rows"][0]["omega"] is None
    with pytest.raises(pc.errors.InputError, match="cases is empty"):
        pc.compare(scene, cases=())


def test_frames_that_needed_a_fallback_are_reported(monkeypatch):
    real = pc.Newton.__call__
    monkeypatch.setattr(
        pc.Newton,
        "__call__",
        lambda self, *args: dataclasses.replace(real(self, *args), status=pc.Status.SUBSTEPPED),
    )
    comparison = pc.compare(beam((3, 1, 1), time={"frames": 2}))
    assert comparison.solver_error is None
    assert any("coarse Newton: 2 of 2 frames" in note for note in report.notes(comparison))


def fold(patch, solver, since, status=pc.Status.INVERTED):
    """Let steps that end after ``since`` (s) end with an inverted cell."""
    real = solver.__call__

    def folded(self, state, *rest):
        result = real(self, state, *rest)
        if result.state.time < since:
            return result
        stats = {**result.stats, "smallest_volume_ratio": -0.5}
        return dataclasses.replace(result, status=status, stats=stats)

    patch.setattr(solver, "__call__", folded)


@pytest.mark.parametrize("status", [pc.Status.INVERTED, pc.Status.RECOVERED])
def test_the_summary_counts_frames_with_inverted_cells(
    program, scene_file, tmp_path, monkeypatch, status
):
    _, out, _ = program("simulate", scene_file, "-o", tmp_path / "upright.h5")
    assert "folded" not in out
    fold(monkeypatch, pc.ProjectiveDynamics, 0.025, status)
    _, out, _ = program("simulate", scene_file, "-o", tmp_path / "run.h5", "--frames", 3)
    expected = " frames ended with inverted or folded cells, the first of them frame 3 (t = 0.03 s)"
    assert "1 of 3" + expected in out
    _, out, _ = program("simulate", scene_file, "-o", tmp_path / "run.h5", "--resume")
    assert "2 of 4" + expected in out


def test_the_report_counts_frames_with_inverted_cells(monkeypatch):
    scene = beam((3, 1, 1), time={"frames": 3})
    assert not any("folded" in note for note in report.notes(pc.compare(scene)))
    fold(monkeypatch, pc.Newton, 0.015)
    notes = report.notes(pc.compare(scene))
    expected = (
        "coarse Newton: 2 of 3 frames ended with inverted or folded cells, the first of them "
        "frame 2 (t = 0.02 s)."
    )
    assert [note for note in notes if "folded" in note] == [expected]


def test_an_interrupted_run_says_what_it_kept(program, scene_file, tmp_path, monkeypatch):
    real = pc.ProjectiveDynamics.__call__

    def interrupted(self, state, *rest):
        if state.time > 0.015:
            raise KeyboardInterrupt
        return real(self, state, *rest)

    monkeypatch.setattr(pc.ProjectiveDynamics, "__call__", interrupted)
    status, _, err = program("simulate", scene_file, "-o", tmp_path / "run.h5")
    assert status == cli.INTERRUPTED
    assert "2 of 4 frames are in" in err
    assert len(pc.load_trajectory(tmp_path / "run.h5")) == 2


def test_render_refuses_what_would_mislead(program, scene_file, tmp_path):
    program("simulate", scene_file, "-o", tmp_path / "a.h5")
    for more, words in (
        (("--colour", "error", "-o", tmp_path / "x.png"), "two runs"),
        (("--frame", "1", "-o", tmp_path / "x.gif"), "all frames"),
        (("--overlay", "-o", tmp_path / "x.png"), "two to"),
        (("--overlay", "--colour", "error", tmp_path / "a.h5", "-o", tmp_path / "x.png"), "leave"),
    ):
        status, _, err = program("render", tmp_path / "a.h5", *more)
        assert status == cli.BAD_INPUT
        assert words in err


def test_compare_with_a_corrector_adds_it_and_the_model_that_it_corrects(program, tmp_path):
    pytest.importorskip("torch_geometric")
    scene, folder = ROOT / "examples" / "unseen_cross.toml", tmp_path / "report"
    command = ("compare", scene, "-o", folder, "--frames", 6, "--no-figures")
    assert program(*command, "--model", "torsion-exact-compact")[0] == 0
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    coarse = ["coarse PD", "coarse Newton", "best coarse PD", "hybrid torsion-exact-compact"]
    assert list(rows) == [*coarse, "intermediate PD", "fine best PD"]
    errors = [float(rows[name]["rms_error"]) for name in coarse]
    assert errors[3] < 0.5 * errors[2] < 0.5 * errors[0]
    assert [rows[name]["refused_frames"] for name in coarse] == ["", "", "", "0"]
    assert rows[coarse[3]]["solver"] == "hybrid"
    record = json.loads((folder / "report.json").read_text())
    about = record["models"][coarse[3]]
    assert (about["base"], about["dataset"]) == ("best", "torsion-exact")
    assert any("trained on scenes of 'torsion-exact'" in x for x in record["notes"])


def test_a_corrector_of_the_plain_mesh_is_held_against_the_plain_fine_run():
    pytest.importorskip("torch_geometric")
    cases = pc.evaluate.cases_with(["torsion-as-published"])
    assert cases[:-1] == pc.evaluate.CASES
    assert (cases[-1].label, cases[-1].base) == ("hybrid torsion-as-published", "plain")


def test_correctors_of_the_plain_mesh_and_of_the_right_mass_share_a_reference():
    pytest.importorskip("torch_geometric")
    models = ["torsion-as-published", "torsion-as-published-total-mass"]
    cases = pc.evaluate.cases_with([*models, models[1].replace("torsion", "stretch")])
    assert cases[:4] == pc.evaluate.CASES
    bases = ["total-mass", "plain", "total-mass", "total-mass"]
    assert [case.base for case in cases[4:]] == bases
    assert cases[4].label == "coarse PD, total mass"


def test_a_base_is_known_and_on_a_mesh_that_it_is_for():
    scene, case = beam((2, 1, 1)), pc.evaluate.CASES[1]
    for base in ("total-mass", "worst"):
        with pytest.raises(pc.errors.InputError, match="refined 2 times: expected 'plain' or"):
            dataclasses.replace(case, base=base).problem(scene)
    with pytest.raises(pc.errors.InputError, match="base 'worst': expected one of plain, best"):
        dataclasses.replace(case, base="worst", refine=1).problem(scene)
    assert dataclasses.replace(case, base="best").problem(scene).element == "hex8-bubble"


def test_refused_corrections_are_told():
    pytest.importorskip("torch_geometric")
    scene = pc.Scene.load(ROOT / "examples" / "unseen_cross.toml")
    stiff = scene.with_changes(material={"young": 1e7}, time={"frames": 2})
    cases = pc.evaluate.cases_with(["torsion-exact"])[-1:]
    notes = report.notes(pc.compare(stiff, cases=cases))
    assert (
        "hybrid torsion-exact: 2 of 2 corrections were refused by the gate (2 by features)."
        in notes
    )


def test_correctors_without_a_gate_are_refused_nothing():
    pytest.importorskip("torch_geometric")
    scene = pc.Scene.load(ROOT / "examples" / "unseen_cross.toml")
    stiff = scene.with_changes(material={"young": 1e7}, time={"frames": 2})
    cases = pc.evaluate.cases_with(["torsion-exact"], gate=False)[-1:]
    found = pc.compare(stiff, cases=cases)
    (row,) = found.rows
    assert (row.label, row.refused_frames) == ("hybrid torsion-exact, no gate", 0)
    assert any("of no use, and it has no gate." in note for note in report.notes(found))


def test_correctors_are_told_apart_and_are_of_one_coarse_model(tmp_path):
    pytest.importorskip("torch_geometric")
    for name in ("one", "two"):
        shutil.copytree(ROOT / "models" / "torsion-exact-compact", tmp_path / name / "model")
    models = [str(tmp_path / name / "model") for name in ("one", "two")]
    labels = [case.label for case in pc.evaluate.cases_with(models)]
    assert labels[-2:] == ["hybrid one/model", "hybrid two/model"]
    with pytest.raises(pc.errors.InputError, match="of best, plain: expected of 'best' or"):
        pc.evaluate.cases_with([models[0], "torsion-as-published"])
    with pytest.raises(pc.errors.InputError, match="coarse PD, coarse PD: expected each one once"):
        pc.compare(beam((2, 1, 1)), cases=pc.evaluate.CASES[2:3] * 2)


def test_compare_with_a_model_that_is_not_there_is_bad_input(program, scene_file, tmp_path):
    pytest.importorskip("torch_geometric")
    status, _, err = program("compare", scene_file, "-o", tmp_path / "r", "--model", "nothing")
    assert status == cli.BAD_INPUT
    assert "nothing" in err
    assert not (tmp_path / "r").exists()


def test_compiling_is_told_of_once(tmp_path):
    """In a process of its own, whose kernels are not on disk."""
    code = (
        "from numba import njit; from pdcorrect.cli.common import tell_of_compiling\n"
        "tell_of_compiling(); tell_of_compiling()\n"
        "for power in (2, 3):\n"
        "    njit(lambda x, p=power: x**p)(2.0)\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stderr.count("compiling kernels") == 1
    assert ran.stdout == ""
