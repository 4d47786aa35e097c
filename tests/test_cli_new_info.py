"""``pdcorrect new``, which writes a scene, and ``pdcorrect info``, which reads a run."""

import pytest
from typer.testing import CliRunner

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli.new import TEMPLATE
from pdcorrect.cli.program import app
from pdcorrect.errors import InputError, OutputError


def run(*command):
    return CliRunner().invoke(app, [str(part) for part in command])


def test_a_new_scene_runs(tmp_path):
    path = tmp_path / "my.toml"
    assert run("new", path).exit_code == 0
    done = run("simulate", path, "-o", tmp_path / "my.h5", "--frames", 1)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "my_probes.csv").is_file()
    assert isinstance(run("new", path).exception, OutputError)
    assert path.read_text() == TEMPLATE
    assert isinstance(run("new", tmp_path / "none" / "my.toml").exception, OutputError)


def test_all_keys_that_a_new_scene_proposes_are_known():
    every = pc.Scene.from_toml(TEMPLATE.replace("#: ", ""))
    plain = pc.Scene.from_toml(TEMPLATE)
    assert TEMPLATE.count("#: [[") == 4
    for section in ("materials", "loads", "obstacles", "actuators"):
        assert len(getattr(every, section)) == len(getattr(plain, section)) + 1
    assert every.clamps[0].motion is not None
    pc.discretise(every)


def test_info_tells_of_a_run(tmp_path):
    scene = beam(time={"step": 0.01, "frames": 2})
    made = pc.rollout(pc.Newton(pc.discretise(scene)), frames=2)
    pc.save_trajectory(tmp_path / "run.h5", made)
    told = run("info", tmp_path / "run.h5")
    assert told.exit_code == 0
    largest = f"{pc.metrics.largest_displacement(made):.4g}"
    for part in (
        str(len(made.points)),
        "2 to t = 0.02 s",
        largest,
        "2 converged",
        "generalised-alpha",
    ):
        assert part in told.output
    assert pc.Scene.from_toml(run("info", tmp_path / "run.h5", "--scene").output) == scene


@pytest.mark.parametrize("content", [None, b"no run"])
def test_info_refuses_what_is_no_run(tmp_path, content):
    path = tmp_path / "run.h5"
    if content is not None:
        path.write_bytes(content)
    assert isinstance(run("info", path).exception, InputError)
