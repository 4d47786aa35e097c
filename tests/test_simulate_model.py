"""`pdcorrect simulate --model`: what it steps, continues, refuses and says."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli import main as cli
from pdcorrect.evaluation.refusal_text import SECTIONS

weights_digest = pytest.importorskip("pdcorrect.corrector.model_io").weights_digest

ROOT = Path(__file__).parent.parent
SCENE = ROOT / "examples" / "unseen_cross.toml"
MODEL = "torsion-exact-compact"


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
    assert f"gate: {'default' if gated else 'none'}" in out
    assert f"model {MODEL} on the base 'best', trained on 'torsion-exact'" in out
    assert "{" not in out
    digest = weights_digest(MODEL)
    assert digest not in out
    assert {"model": MODEL, "base": "best", "weights_sha256": digest}.items() <= (
        run.attributes.items()
    )
    assert run.attributes["dataset"] == pc.load_model(MODEL).record.dataset
    assert "corrections: at most" in out
    assert "refused" not in out
    assert len(list((tmp_path / "vtu").glob("run_*.vtu"))) == 4


def test_a_model_of_the_right_mass_steps_a_body_of_that_mass(program, learned, tmp_path):
    name, path = "torsion-as-published-total-mass", tmp_path / "run.h5"
    scene = ROOT / "examples" / "published_cross.toml"
    assert program("simulate", scene, "-o", path, "--frames", 1, "--model", name)[0] == 0
    expected = by_hand(pc.Scene.load(scene), name, 1, pc.Gate())
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
    assert status == cli.BAD_INPUT
    assert "its frames are of another run" in err
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--model", MODEL, "--refine", 2), "expected --refine 1"),
        (("--model", MODEL, "--solver", "newton"), "expected --solver pd"),
        (("--no-gate",), "--no-gate without --model"),
        (("--model", ""), "--model '': an empty name"),
        (("--model", "nothing"), "model 'nothing': not in"),
        (("--model", "./nothing"), "nothing: not there: expected a folder with model.json"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_the_work(
    program, learned, scene_file, tmp_path, more, words
):
    path = tmp_path / "run.h5"
    status, out, err = program("simulate", scene_file, "-o", path, *more)
    assert status == cli.BAD_INPUT
    assert err.startswith("error: ")
    assert words in err
    assert "Traceback" not in out + err
    assert not path.exists()


def test_a_model_of_an_unknown_base_is_named(learned, tmp_path, monkeypatch):
    from pdcorrect.corrector import hybrid as released

    shutil.copytree(ROOT / "models" / MODEL, tmp_path / "odd")
    kind = type(pc.load_model(tmp_path / "odd"))
    monkeypatch.setattr(kind, "base", "coarsest")
    with pytest.raises(pc.errors.InputError, match="odd: corrects 'coarsest': expected one of"):
        released.hybrid_of(pc.Scene.load(SCENE), tmp_path / "odd")


def test_a_hybrid_in_one_call_has_the_gate_that_it_is_given():
    scene, gate = pc.Scene.load(SCENE), pc.Gate(corners=0.0)
    for given, expected in ((True, pc.Gate()), (False, None), (None, None), (gate, gate)):
        assert pc.hybrid_of(scene, MODEL, gate=given).gate == expected
    for given in (1, "strict", {"corners": 0.0}):
        with pytest.raises(pc.errors.InputError, match="expected a Gate"):
            pc.hybrid_of(scene, MODEL, gate=given)


def with_integrator(name):
    return pc.Scene.load(SCENE).with_changes(time={"integrator": name})


def test_a_quasi_static_scene_is_refused(program, learned, tmp_path):
    scene, path = tmp_path / "s.toml", tmp_path / "run.h5"
    scene.write_text(with_integrator("quasi-static").to_toml(), encoding="utf-8")
    status, _, err = program("simulate", scene, "-o", path, "--model", MODEL)
    assert status == cli.BAD_INPUT
    assert f"{MODEL}: trained on steps by backward-euler" in err
    assert "'quasi-static', whose steps have no inertia: expected 'backward-euler'" in err
    assert not path.exists()


def test_an_integrator_that_the_model_never_saw_is_told(program, learned, tmp_path):
    scene, path = tmp_path / "s.toml", tmp_path / "run.h5"
    scene.write_text(with_integrator("midpoint").to_toml(), encoding="utf-8")
    status, out, _ = program("simulate", scene, "-o", path, "--model", MODEL, "--frames", 1)
    assert status == 0
    assert "by backward-euler, and the scene's integrator is midpoint" in out


def test_a_model_that_knows_another_integrator_is_asked_for_that(learned):
    from pdcorrect.corrector.model_io import LoadedModel

    known = pc.load_model(MODEL)
    training = {**known.record.training, "integrator": "quasi-static"}
    record = known.record.model_copy(update={"training": training})
    own = LoadedModel(known.corrector, record)
    assert (known.integrator, own.integrator) == ("backward-euler", "quasi-static")
    hybrid = pc.hybrid_of(with_integrator("quasi-static"), own)
    assert hybrid.coarse.integrator == "quasi-static"


def test_a_problem_in_place_of_the_models_own_is_checked(learned):
    scene = pc.Scene.load(SCENE)
    model = pc.load_model(MODEL)
    assert pc.hybrid_of(scene, model, problem=pc.coarse_model(scene, "best")).origin == {}
    for problem, words in (
        (pc.discretise(scene), "element hex8 and mass lumped: expected 1, hex8-bubble-mean"),
        (pc.discretise(pc.best_coarse(scene), 2), "problem is refined 2 times"),
    ):
        with pytest.raises(pc.errors.InputError, match=words):
            pc.hybrid_of(scene, model, problem=problem)


def test_without_torch_the_extra_is_named(program, scene_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    path = tmp_path / "run.h5"
    status, _, err = program("simulate", scene_file, "-o", path, "--model", MODEL)
    assert status == cli.BAD_INPUT
    assert "pip install 'pdcorrect[learn]'" in err
    assert not path.exists()
    assert program("simulate", scene_file, "-o", path)[0] == 0  # which needs no torch


def test_a_run_whose_corrections_are_refused_says_so_and_why(
    program, learned, scene_file, tmp_path
):
    path = tmp_path / "run.h5"
    status, out, _ = program("simulate", scene_file, "-o", path, "--model", MODEL)
    assert status == 0
    assert "2 of 2 corrections were refused by the gate (2 by body and time step)." in out
    beyond = pc.hybrid_of(pc.Scene.load(scene_file), MODEL).body_excess()
    named = out.split("a factor of 1.35): ")[1].split(".\n")[0].split("), ")
    far = sorted((x, name) for name, x in beyond.items() if x > 0.3)[::-1]
    assert len(named) == len(far)
    assert all(told.startswith(name) for told, (_, name) in zip(named, far, strict=True))
    assert "nodes 45 (in training 225 to 513)" in out
    assert "at most" not in out
    assert "The time step per cell size is 2.5 times that of the training: 0.01 s, where" in out
    assert "where the training has 0.004 s for cells of this size" in out
    (way,) = [line for line in out.splitlines() if line.startswith("Expected a body like")]
    assert all(f"#{SECTIONS[name]})" in way for name in ("body", "time step"))
    assert way.endswith("Gate(body=None, time_step=None), or none (--no-gate).")
    assert "This is no corrected run" in out
    run = pc.load_trajectory(path)
    best = pc.discretise(pc.best_coarse(pc.Scene.load(scene_file)))
    np.testing.assert_array_equal(run.positions, pc.rollout(pc.ProjectiveDynamics(best)).positions)
    assert json.loads(run.attributes["gate"])["body"] == 0.3


def test_of_a_foreign_body_it_is_also_told_whether_the_time_step_is_foreign(
    program, learned, scene_file, tmp_path
):
    for step in (0.02, 0.004):  # the training's for cells of 2 cm is 0.004 s
        scene = pc.Scene.load(scene_file).with_changes(time={"step": step, "frames": 2})
        (tmp_path / "s.toml").write_text(scene.to_toml(), encoding="utf-8")
        command = ("simulate", tmp_path / "s.toml", "--model", MODEL, "--overwrite", "-o")
        status, out, _ = program(*command, tmp_path / "run.h5")
        assert status == 0
        both = step == 0.02
        counted = "(2 by body and time step)" if both else "(2 by body)"
        assert f"2 of 2 corrections were refused by the gate {counted}." in out
        assert out.count("nodes 45 (in training 225 to 513)") == 1
        assert ("The time step per cell size is 5.0 times that of the training" in out) == both
        assert (SECTIONS["time step"] in out) == ("time_step=None" in out) == both
        status, out, _ = program(*command, tmp_path / "open.h5", "--no-gate")
        assert status == 0
        assert "The time step" not in out


@pytest.mark.parametrize("step", [0.02, 0.005])
def test_a_run_of_another_time_step_is_the_base_s_and_says_of_which_the_training_was(
    program, learned, tmp_path, step
):
    scene = pc.Scene.load(SCENE).with_changes(time={"step": step, "frames": 2})
    (tmp_path / "s.toml").write_text(scene.to_toml(), encoding="utf-8")
    path = tmp_path / "run.h5"
    status, out, _ = program("simulate", tmp_path / "s.toml", "-o", path, "--model", MODEL)
    assert status == 0
    assert "2 of 2 corrections were refused by the gate (2 by time step)" in out
    factor = {0.02: "2.0", 0.005: "0.5"}[step]
    told = f"The time step per cell size is {factor} times that of the training: {step:g} s, where"
    assert told in out
    assert (
        "the training has 0.01 s for cells of this size; the gate's bound is a factor of 1.1" in out
    )
    assert "Expected a time step of 0.01 s (docs/results.md#other-time-steps); or, at" in out
    assert "Measures of" not in out
    assert "This is no corrected run" in out
    run = pc.load_trajectory(path)
    assert run.attributes["trained_step"] == "0.01 s"
    best = pc.ProjectiveDynamics(pc.coarse_model(scene, "best"))
    np.testing.assert_array_equal(run.positions, pc.rollout(best).positions)


def test_of_a_model_of_several_time_steps_the_least_and_the_largest_are_told(learned, tmp_path):
    import torch

    from pdcorrect.corrector.normaliser import Moments

    model, steps = pc.load_model(MODEL), Moments()
    steps.add(torch.tensor([[0.4], [0.1], [0.2]], dtype=torch.float64).log())  # s/m
    model.corrector.normaliser.fit_time_steps(steps)
    pc.save_model(model.corrector, tmp_path / "several", record=model.record)
    scene = pc.Scene.load(SCENE)
    assert scene.body.cell_size == 0.05
    hybrid = pc.hybrid_of(scene, tmp_path / "several")
    assert hybrid.trained_step == hybrid.describe()["trained_step"] == "0.005 to 0.02 s"
    assert hybrid.time_step_excess() == 0.0


def test_inputs_of_the_first_step_that_they_refuse_are_named_also_when_continued(
    program, learned, tmp_path
):
    kick = {"kind": "gravity", "acceleration": [0.0, 0.0, -2e3]}
    late = {**kick, "table": [[0.0, 0.0], [0.01, 0.0], [0.011, 1.0]]}
    scene = pc.Scene.load(SCENE)
    loads = [*(load.model_dump() for load in scene.loads), late]
    (tmp_path / "s.toml").write_text(scene.with_changes(loads=loads).to_toml(), encoding="utf-8")
    command = ("simulate", tmp_path / "s.toml", "--model", MODEL, "-o", tmp_path / "run.h5")
    status, out, _ = program(*command, "--frames", 1)
    assert status == 0
    assert "Inputs" not in out
    status, out, _ = program(*command, "--frames", 3, "--resume")
    assert status == 0
    assert "2 of 3 corrections were refused by the gate (2 by features)." in out
    assert " in frame 2, in deviations of which the gate allows" in out
    assert "corrections: at most" in out
    hybrid = pc.hybrid_of(pc.Scene.load(tmp_path / "s.toml"), MODEL)
    run = pc.load_trajectory(tmp_path / "run.h5")
    state = pc.State(run.positions[1], run.velocities[1], 0.01)
    for one in hybrid.unknown_inputs(state):
        assert f" {one.name} by " in out
    assert hybrid.unknown_inputs(hybrid.problem.rest_state()) == []
