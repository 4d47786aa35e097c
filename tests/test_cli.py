"""The program: what it writes, and how it ends."""

import dataclasses
import subprocess
import sys

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect._files import INTERRUPTED
from pdcorrect.cli.common import BAD_INPUT, FAILED
from pdcorrect.evaluation.report import inverted_frames


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(beam((4, 2, 2), time={"frames": 4}).to_toml(), encoding="utf-8")
    return path


def test_the_version_is_told(program):
    module = [sys.executable, "-m", "pdcorrect", "--version"]
    told = subprocess.run(module, capture_output=True, text=True, check=True).stdout
    assert program("--version") == (0, told, "")
    assert told.strip() == pc.__version__


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
    assert str(output) in out


@pytest.mark.parametrize("solver", ["pd", "newton"])
def test_simulate_refines_and_takes_either_solver(program, scene_file, tmp_path, solver):
    output = tmp_path / "run.h5"
    arguments = ("--refine", 2, "--solver", solver, "--frames", 2, "--vtu", tmp_path / "vtu")
    status, _, _ = program("simulate", scene_file, "-o", output, *arguments)
    assert status == 0
    loaded = pc.load_trajectory(output)
    assert loaded.positions.shape == (3, 9 * 5 * 5, 3)
    method = {"pd": "projective dynamics (lbfgs)", "newton": "Newton"}[solver]
    assert loaded.attributes["solver"] == method
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


def test_no_output_is_replaced_unless_told(program, tmp_path, monkeypatch):
    probes = [{"name": "end", "point": [0.08, 0, 0]}]
    scene, run = tmp_path / "scene.toml", tmp_path / "run.h5"
    scene.write_text(beam((4, 1, 1), time={"frames": 1}, probes=probes).to_toml())
    assert program("simulate", scene, "-o", run)[0] == 0
    text = scene.read_bytes()
    assert program("simulate", scene, "-o", scene, "--overwrite")[0] == BAD_INPUT
    assert scene.read_bytes() == text
    beside, plain = tmp_path / "b.h5", tmp_path / "plain.toml"
    plain.write_text(beam((4, 1, 1), time={"frames": 1}).to_toml())
    for arguments, name in (
        (("simulate", plain, "-o", run), "run.h5"),
        (("simulate", scene, "-o", beside), "b_probes.csv"),
        (("simulate", scene, "-o", beside, "--vtu", tmp_path), "b.pvd"),
        (("simulate", scene, "-o", beside, "--vtu", tmp_path), "b_0009.vtu"),
        (("simulate", scene, "-o", beside, "--report", tmp_path), "index.html"),
        (("compare", scene, "-o", tmp_path, "--no-figures", "--frames", 1), "index.html"),
        (("compare", scene, "-o", tmp_path, "--no-figures", "--frames", 1), "report.json"),
        (("render", run, "-o", tmp_path / "run.png", "--size", "200x200"), "run.png"),
        (("export", run, "-o", tmp_path, "--no-stress"), "run.pvd"),
        (("export", run, "-o", tmp_path, "--no-stress"), "run_0000.vtu"),
        (("evaluate", "tiny", "data", "-o", tmp_path, "--no-figures"), "summary.json"),
        (("evaluate", "tiny", "data", "-o", tmp_path, "--no-figures"), "errors.csv"),
        (("evaluate", "tiny", "data", "-o", tmp_path), "omega.png"),
        (("dataset", "info", "data", "--json", tmp_path / "info.json"), "info.json"),
    ):
        output = tmp_path / name
        kept = output.read_bytes() if output == run else b"precious"
        output.write_bytes(kept)
        status, _, err = program(*arguments)
        assert (status, output.read_bytes()) == (FAILED, kept)
        assert err.startswith(f"error: {output}: exists")
        assert not beside.exists()
        if arguments[0] in ("render", "export"):
            assert program(*arguments, "--overwrite")[0] == 0
            assert output.read_bytes() != kept
        if output != run:
            output.unlink()  # so that the next command meets its own output only


@pytest.mark.parametrize("command", ["simulate", "compare"])
@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"probes": [{"name": "a", "point": [9, 0, 0]}]}, "probes[0].point"),
        ({"probes": [{"name": "a", "region": {"group": "b"}}]}, "probes[0].region.group"),
        ({"clamps": [{"region": {"group": "b"}}]}, "clamps[0].region.group"),
        ({"clamps": [], "time": {"integrator": "quasi-static"}}, "clamps let the body move"),
    ],
)
def test_errors_about_a_scene_name_its_file_before_a_step(
    program, tmp_path, monkeypatch, command, changes, key
):
    monkeypatch.setattr("pdcorrect.solvers.rollout.march", None)  # what works raises TypeError
    path = tmp_path / "scene.toml"
    path.write_text(beam((2, 1, 1), **changes).to_toml())
    status, _, err = program(command, path, "-o", tmp_path / "out")
    assert status == BAD_INPUT
    assert f"error: {path}: {key}" in err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("poisson = 0.45|poisson = 0.5", "material.poisson = 0.5"),
        ("density = |weight = ", "material.weight: unknown key"),
        ("at = 0.0|at = 7.0", "at = 7.0"),
    ],
)
def test_bad_scenes_end_with_status_2_and_one_paragraph(
    program, scene_file, tmp_path, change, told
):
    old, new = change.split("|")
    text = scene_file.read_text()
    assert old in text
    scene_file.write_text(text.replace(old, new))
    status, out, err = program("simulate", scene_file, "-o", tmp_path / "run.h5")
    assert status == BAD_INPUT
    assert told in err
    assert err.startswith("error: ")
    assert "Traceback" not in out + err
    assert not (tmp_path / "run.h5").exists()


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("simulate none.toml -o x.h5", "none.toml"),
        ("simulate scene.toml -o x.h5 --solver magic", "magic"),
        ("simulate scene.toml -o x.h5 --refine 0", "--refine"),
        ("simulate scene.toml", "--output"),
        ("compare scene.toml -o x --model nothing", "'nothing'"),
        ("compare scene.toml -o x --no-gate", "--no-gate"),
        ("render none.h5 -o x.png", "none.h5"),
        ("render scene.toml -o x.png", "scene.toml"),
        ("render run.h5 -o x.png --colour error", "--colour error"),
        ("render run.h5 -o x.png --overlay", "1 run"),
        ("render run.h5 run.h5 -o x.png --overlay --colour error", "--colour error"),
        ("render run.h5 -o x.gif --frame 1", "--frame"),
        ("render run.h5 -o x.png --frame 99", "99"),
        ("render run.h5 -o x.bmp2", "x.bmp2"),
        ("render run.h5 -o x.png --camera north", "north"),
        ("render run.h5 -o x.png --camera 1,2,3", "--camera 1,2,3"),
        ("render run.h5 -o x.png --section x", "--section x"),
        ("render run.h5 -o x.png --section x=99", "x = 99"),
        ("render run.h5 -o x.png --size 100", "--size 100"),
        ("render run.h5 run.h5 -o x.png --overlay --warp 2", "--warp"),
        ("frobnicate", "frobnicate"),
    ],
)
def test_other_bad_input_ends_with_status_2_and_names_it(
    program, scene_file, tmp_path, monkeypatch, command, named
):
    monkeypatch.chdir(tmp_path)
    if "run.h5" in command:
        assert program("simulate", "scene.toml", "-o", "run.h5", "--frames", 1)[0] == 0
    status, out, err = program(*command.split())
    assert status == BAD_INPUT
    assert named in err
    assert "Traceback" not in out + err
    assert not list(tmp_path.glob("x*"))


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
    assert status == FAILED
    assert "frame 3" in err
    assert len(pc.load_trajectory(output)) == 2


def test_render_draws_runs_side_by_side(program, scene_file, tmp_path):
    for name, solver in (("a", "pd"), ("b", "newton")):
        program(
            "simulate", scene_file, "-o", tmp_path / f"{name}.h5", "--solver", solver, "--frames", 1
        )
    files = (tmp_path / "a.h5", tmp_path / "b.h5")
    for name, options in (("moving.gif", ()), ("over.png", ("--overlay",))):
        status, _, err = program("render", *files, "-o", tmp_path / name, *options)
        assert (status, err) == (0, "")
        assert (tmp_path / name).stat().st_size > 5000
    options = ("--colour", "stress", "--camera", "30,-20", "--section", "x=0.02")
    options += ("--warp", 2, "--size", "300x200")
    assert program("render", *files, "-o", tmp_path / "cut.png", *options)[0] == 0
    assert (tmp_path / "cut.png").stat().st_size > 5000


def test_doctor_looks_at_everything(program):
    status, out, _ = program("doctor")
    for word in ("numpy", "scikit-fem", "BLAS", "threads", "cholespy", "GPU", "rendering"):
        assert word in out
    assert ("PROBLEM" in out) == (status == FAILED)


def test_help_names_every_command_and_each_has_its_own(program):
    commands = ("simulate", "compare", "render", "view", "export", "train", "evaluate", "validate",
                "dataset", "doctor")  # fmt: skip
    status, out, _ = program("--help")
    assert status == 0
    for command in commands:
        assert command in out
        status, own, _ = program(command, "--help")
        assert status == 0
        assert f"pdcorrect {command}" in own
        assert ("same command" in own) <= (command != "train")  # which goes on by --resume


def test_outputs_that_cannot_be_written_are_named_before_the_work(
    program, scene_file, tmp_path, monkeypatch
):
    monkeypatch.setattr("pdcorrect.solvers.rollout.march", None)  # what works raises TypeError
    (tmp_path / "file").write_text("")
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "vtu").write_text("")
    for arguments, named in (
        (("simulate", scene_file, "-o", scene_file / "run.h5"), "run.h5"),
        (("simulate", scene_file, "-o", "/proc/nowhere/run.h5"), "run.h5"),
        (("simulate", scene_file, "-o", tmp_path / "a.h5", "--vtu", tmp_path / "file"), "file"),
        (("compare", scene_file, "-o", tmp_path / "file"), "file"),
        (("simulate", scene_file, "-o", tmp_path / "x.h5", "--report", tmp_path / "file"), "file"),
        (("compare", scene_file, "-o", tmp_path / "r", "--vtu", "--no-figures"), "vtu"),
    ):
        status, out, err = program(*arguments)
        assert status == FAILED
        assert named in err
        assert "Traceback" not in out + err
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize("status", ["INVERTED", "RECOVERED"])
def test_frames_with_inverted_cells_are_counted_and_the_first_is_named(status):
    ratios = np.array([0.9, 0.8, -0.5, 0.1, -0.2])
    names = np.array(["CONVERGED", "CONVERGED", status, "CONVERGED", status])
    told = inverted_frames({"status": names, "smallest_volume_ratio": ratios}, 0.01)
    assert "2 of 5" in told
    assert "0.03 s" in told
    assert (inverted_frames({"status": names}, 0.01) == "") == (status == "RECOVERED")
    assert inverted_frames({"status": names[:2], "smallest_volume_ratio": ratios[:2]}, 0.01) == ""


def test_an_interrupted_run_says_what_it_kept(program, scene_file, tmp_path, monkeypatch):
    real = pc.ProjectiveDynamics.__call__

    def interrupted(self, state, *rest):
        if state.time > 0.015:
            raise KeyboardInterrupt
        return real(self, state, *rest)

    monkeypatch.setattr(pc.ProjectiveDynamics, "__call__", interrupted)
    status, _, err = program("simulate", scene_file, "-o", tmp_path / "run.h5")
    assert status == INTERRUPTED
    assert "2 of 4" in err
    assert len(pc.load_trajectory(tmp_path / "run.h5")) == 2


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


def test_a_run_that_gains_energy_by_turning_far_in_a_step_says_so(program, tmp_path):
    for turn, young, told in ((60.0, 5e6, True), (5.0, 5e4, False)):
        scene = beam(
            (4, 2, 2), clamps=[], loads=[], material={"young": young},
            initial={"angular_velocity": [0.0, 0.0, turn]},
            time={"step": 0.01, "frames": 10, "integrator": "midpoint"},
        )  # fmt: skip
        (tmp_path / "scene.toml").write_text(scene.to_toml(), encoding="utf-8")
        status, out, _ = program(
            "simulate", tmp_path / "scene.toml", "-o", tmp_path / f"{turn}.h5", "--overwrite"
        )
        assert status == 0
        assert ("J that nothing put in" in out) is told
