"""`pdcorrect simulate --model`: what it steps, continues, refuses and says."""

import json
import shutil
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli.common import BAD_INPUT

weights_digest = pytest.importorskip("pdcorrect.corrector.model_io").weights_digest

ROOT = Path(__file__).parent.parent
SCENE = ROOT / "examples" / "unseen_cross.toml"
MODEL = "torsion-exact"


@pytest.fixture
def learned():
    """Without PyTorch there is nothing to step by."""
    pytest.importorskip("torch_geometric")


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(beam((4, 2, 2), time={"frames": 2}).to_toml(), encoding="utf-8")
    return path


def by_hand(scene, name, frames, gate):
    model = pc.load_model(name)
    coarse = pc.ProjectiveDynamics(pc.coarse_model(scene, model.base))
    hybrid = pc.HybridStepper(coarse, model.corrector, velocity=model.velocity, gate=gate)
    return pc.rollout(hybrid, frames)


@pytest.mark.parametrize("gated", [True, False])
def test_the_steps_are_those_of_the_hybrid_on_its_own_base(program, learned, tmp_path, gated):
    path, scene = tmp_path / "run.h5", pc.Scene.load(SCENE)
    more = () if gated else ("--no-gate",)
    command = ("simulate", SCENE, "-o", path, "--frames", 3, "--model", MODEL, *more)
    status, out, err = program(*command, "--vtu", tmp_path / "vtu")
    assert (status, err) == (0, "")
    expected = by_hand(scene, MODEL, 3, pc.Gate() if gated else None)
    run = pc.load_trajectory(path)
    np.testing.assert_array_equal(run.positions, expected.positions)
    assert run.attributes["element"] == "hex8-bubble-mean"
    assert (run.attributes["gate"] == "none") == (not gated)
    assert MODEL in out
    digest = weights_digest(MODEL)
    assert {"model": MODEL, "base": "best", "weights_sha256": digest}.items() <= (
        run.attributes.items()
    )
    assert run.attributes["dataset"] == pc.load_model(MODEL).record.dataset
    assert not run.stats["refused"].any()
    assert "refused" not in out
    assert len(list((tmp_path / "vtu").glob("run_*.vtu"))) == 4


def test_a_model_of_the_right_mass_steps_a_body_of_that_mass(program, learned, tmp_path):
    from hybrid_samples import problems, saved

    scenes, path = problems((3, 2, 1)), tmp_path / "run.h5"
    name = str(saved(tmp_path / "heavy", scenes, base="total-mass"))
    scene = scenes[0].scene.with_changes(solver={"mass": "per-node"})
    (tmp_path / "s.toml").write_text(scene.to_toml(), encoding="utf-8")
    command = ("simulate", tmp_path / "s.toml", "-o", path, "--frames", 2, "--model", name)
    assert program(*command)[0] == 0
    expected = by_hand(scene, name, 2, pc.Gate())
    np.testing.assert_array_equal(pc.load_trajectory(path).positions, expected.positions)


def test_a_hybrid_is_continued_bit_for_bit(program, learned, tmp_path):
    whole, parts = tmp_path / "whole.h5", tmp_path / "parts.h5"
    command = ("simulate", SCENE, "--model", MODEL)
    assert program(*command, "-o", whole, "--frames", 4)[0] == 0
    for frames in (2, 4):
        status, out, _ = program(*command, "-o", parts, "--frames", frames, "--resume")
        assert status == 0
    assert "4 frames (2 resumed)" in out
    one, other = pc.load_trajectory(whole), pc.load_trajectory(parts)
    np.testing.assert_array_equal(one.positions, other.positions)
    np.testing.assert_array_equal(one.velocities, other.velocities)
    for name in ("correction", "refused", "gate", "iterations"):
        np.testing.assert_array_equal(one.stats[name], other.stats[name])


@pytest.mark.parametrize("other", [(), ("--model", MODEL, "--no-gate"), ("--model", "tiny")])
def test_a_hybrid_is_not_continued_as_something_else(program, learned, tmp_path, other):
    path = tmp_path / "run.h5"
    assert program("simulate", SCENE, "-o", path, "--frames", 1, "--model", MODEL)[0] == 0
    before = path.read_bytes()
    status, _, err = program("simulate", SCENE, "-o", path, "--frames", 2, "--resume", *other)
    assert status == BAD_INPUT
    assert str(path) in err
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--model", MODEL, "--refine", 2), "--refine 2"),
        (("--model", MODEL, "--solver", "newton"), "--solver newton"),
        (("--no-gate",), "--no-gate"),
        (("--model", ""), "--model ''"),
        (("--model", "nothing"), "'nothing'"),
        (("--model", "./nothing"), "nothing: "),
    ],
)
def test_what_cannot_be_meant_is_refused_before_the_work(
    program, learned, scene_file, tmp_path, more, named
):
    path = tmp_path / "run.h5"
    status, out, err = program("simulate", scene_file, "-o", path, *more)
    assert status == BAD_INPUT
    assert err.startswith("error: ")
    assert named in err
    assert "Traceback" not in out + err
    assert not path.exists()


def test_a_model_of_an_unknown_base_is_named(learned, tmp_path, monkeypatch):
    from pdcorrect.corrector.hybrid import hybrid_of

    shutil.copytree(ROOT / "models" / "tiny", tmp_path / "odd")
    kind = type(pc.load_model(tmp_path / "odd"))
    monkeypatch.setattr(kind, "base", "coarsest")
    with pytest.raises(pc.errors.InputError, match="odd: corrects 'coarsest'"):
        hybrid_of(pc.Scene.load(SCENE), tmp_path / "odd")


def test_a_hybrid_in_one_call_has_the_gate_that_it_is_given():
    scene, gate = pc.Scene.load(SCENE), pc.Gate(energy=1.0)
    for given, expected in ((True, pc.Gate()), (False, None), (None, None), (gate, gate)):
        assert pc.hybrid_of(scene, MODEL, gate=given).gate == expected
    assert pc.hybrid_of(scene, pc.load_model(MODEL)).origin == {}
    for given in (1, "strict", {"corners": 0.0}):
        with pytest.raises(pc.errors.InputError, match="gate"):
            pc.hybrid_of(scene, MODEL, gate=given)


@pytest.mark.parametrize("integrator", ["generalised-alpha", "midpoint", "backward-euler"])
def test_another_integrator_than_the_training_s_is_warned_of_in_one_line(learned, integrator):
    scene = pc.Scene.load(SCENE).with_changes(time={"integrator": integrator})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pc.hybrid_of(scene, MODEL)
    told = [str(w.message) for w in caught if w.category is pc.errors.PdcorrectWarning]
    if integrator == "backward-euler":
        assert not told
        return
    (line,) = told
    assert "\n" not in line
    assert f"{MODEL}: " in line
    assert repr(integrator) in line
    assert 'integrator = "backward-euler"' in line


def test_a_quasi_static_scene_is_refused_unless_the_model_was_trained_on_such(
    program, learned, tmp_path
):
    from pdcorrect.corrector.model_io import LoadedModel

    static = pc.Scene.load(SCENE).with_changes(time={"integrator": "quasi-static"})
    scene, path = tmp_path / "s.toml", tmp_path / "run.h5"
    scene.write_text(static.to_toml(), encoding="utf-8")
    status, _, err = program("simulate", scene, "-o", path, "--model", MODEL)
    assert status == BAD_INPUT
    assert f"{MODEL}: " in err
    assert "'quasi-static'" in err
    assert not path.exists()
    known = pc.load_model(MODEL)
    training = {**known.record.training, "integrator": "quasi-static"}
    own = LoadedModel(known.corrector, known.record.model_copy(update={"training": training}))
    assert (known.integrator, own.integrator) == ("backward-euler", "quasi-static")
    assert pc.hybrid_of(static, own).coarse.integrator == "quasi-static"


def test_without_torch_the_extra_is_named(program, scene_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    path = tmp_path / "run.h5"
    status, _, err = program("simulate", scene_file, "-o", path, "--model", MODEL)
    assert status == BAD_INPUT
    assert "pdcorrect[learn]" in err
    assert not path.exists()
    assert program("simulate", scene_file, "-o", path)[0] == 0  # which needs no torch


@pytest.mark.parametrize(("body", "step"), [(False, 0.02), (False, 0.005), (True, 0.004)])
def test_a_run_whose_corrections_are_all_refused_is_the_base_s_and_says_so(
    program, learned, scene_file, tmp_path, body, step
):
    """The training's time step is 0.2 s/m times the cell size."""
    from pdcorrect.corrector.gate import Reason

    scene = pc.Scene.load(scene_file if body else SCENE)
    scene = scene.with_changes(time={"step": step, "frames": 2})
    (tmp_path / "s.toml").write_text(scene.to_toml(), encoding="utf-8")
    path = tmp_path / "run.h5"
    status, out, _ = program("simulate", tmp_path / "s.toml", "-o", path, "--model", MODEL)
    assert status == 0
    assert "2 of 2" in out
    assert Reason.OUTSIDE.meaning in out
    run = pc.load_trajectory(path)
    assert run.stats["gate"].tolist() == [Reason.OUTSIDE] * 2
    assert run.attributes["trained_step"] == f"{0.2 * scene.body.cell_size:g} s"
    assert json.loads(run.attributes["gate"]) == pc.Gate().model_dump()
    best = pc.ProjectiveDynamics(pc.coarse_model(scene, "best"))
    np.testing.assert_array_equal(run.positions, pc.rollout(best).positions)
