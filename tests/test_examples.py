"""Every scene and script in examples/ runs, and so does the walk-through of one's own body."""

import importlib
import importlib.util
import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from pdcorrect.fem.mesh_files import read_hex_mesh

ROOT = Path(__file__).parent.parent
SCENES = sorted((ROOT / "examples").glob("*.toml"))


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_example_scenes_run_with_both_solvers(path):
    scene = pc.Scene.load(path)
    problem = pc.discretise(scene)
    frames = {"dropped_jelly": 9, "crawler": 2}.get(path.stem, 5)  # the jelly lands in the eighth
    pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-7), frames)
    newton = pc.rollout(pc.Newton(problem), frames)
    assert set(pd.stats["status"]) == {"CONVERGED"}
    assert np.abs(pd.positions - newton.positions).max() < 1e-5 * problem.cell_size
    assert pc.metrics.largest_displacement(pd) > 0.02 * problem.cell_size


def run_script(name, folder, **options):
    """The summary of a script in examples/, which draws one figure of its name."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
        summary = module.main(folder, **options)
    finally:
        del sys.modules[name]
    assert [path.name for path in folder.iterdir()] == [f"{name}.png"]
    return summary


def test_the_material_is_recovered(tmp_path):
    summary = run_script("recover_material", tmp_path)
    assert summary["error of young"] < 0.002
    assert summary["error of poisson"] < 0.002
    assert summary["rms cells"] == pytest.approx(3**0.5 * 1e-4, rel=0.05)


def test_the_target_is_reached(tmp_path):
    distances = run_script("reach_target", tmp_path)
    assert set(distances) == {"initial velocity", "six actuators"}
    assert max(distances.values()) < 1e-3


def test_a_stride_gets_longer(tmp_path):
    ways = run_script("crawl", tmp_path, iterations=1)
    assert ways["optimised"] > ways["start"] + 1e-3


@pytest.mark.slow  # of the layer's derivatives test_torch_layer has more
def test_the_network_learns_to_reach_targets(tmp_path):
    pytest.importorskip("torch")
    summary = run_script("train_with_layer", tmp_path)
    assert summary["factor"] > 20.0


OWN = ROOT / "examples" / "bring_your_own"


@pytest.fixture
def own(monkeypatch):
    """The scripts of examples/bring_your_own by name."""
    monkeypatch.syspath_prepend(str(OWN))
    loaded = set()

    def load(name):
        monkeypatch.delitem(sys.modules, name, raising=False)
        loaded.add(name)
        return importlib.import_module(name)

    yield load
    for name in loaded:  # other folders have modules of these names
        sys.modules.pop(name, None)


def test_the_mesh_of_ones_own_body_is_what_its_script_makes(own, tmp_path):
    try:
        importlib.import_module("gmsh")
    except (ImportError, OSError) as error:  # the wheel loads libraries of X11
        pytest.skip(f"gmsh: {error}")
    own("make_mesh").main(tmp_path / "hook.msh")
    found, kept = (read_hex_mesh(folder / "hook.msh", 1e-3) for folder in (tmp_path, OWN))
    np.testing.assert_allclose(found.positions, kept.positions, atol=1e-9)
    np.testing.assert_array_equal(found.cells, kept.cells)


def test_the_cells_of_ones_own_body_number_their_corners_alike():
    """As node frames at rest suppose: neighbours' axes are at most a bend apart."""
    mesh = read_hex_mesh(OWN / "hook.msh", 1e-3)
    corners = mesh.positions[mesh.cells]
    axes = np.stack([corners[:, k] - corners[:, 0] for k in (1, 3, 4)], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    for node in range(len(mesh.positions)):
        own = axes[(mesh.cells == node).any(axis=1)]
        assert (np.einsum("nai,ai->na", own, own[0]) > 0.8).all()


def test_the_material_of_ones_own_body_is_that_of_its_test(own):
    young, poisson = own("material").fit(OWN / "tensile_test.csv")
    scene = pc.Scene.load(OWN / "hook.toml")
    assert scene.material.young == pytest.approx(young, rel=0.005)
    assert scene.material.poisson == pytest.approx(poisson, abs=0.005)


def commands_in_text(page):
    """Words of the lines in a page's ```text blocks, which take too long to be run as they are."""
    blocks = re.findall(r"```text\n(.*?)```", (ROOT / "docs" / page).read_text(), re.S)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


def shortened(recipe, folder):
    """A copy of a recipe of training with two iterations a stage, one simulation each."""
    text, count = re.subn(r"^iterations = \d+$", "iterations = 2", recipe.read_text(), flags=re.M)
    assert count
    folder.mkdir(parents=True, exist_ok=True)
    (folder / recipe.name).write_text(re.sub(r"^batch = \d+$", "batch = 1", text, flags=re.M))


@pytest.mark.slow  # test_training_runs has this command, with a smaller recipe
def test_the_first_command_of_the_training_page_trains(monkeypatch, tmp_path, program):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    Path("datasets").symlink_to(ROOT / "datasets")
    first = commands_in_text("training.md")[0]
    shortened(ROOT / first[2], Path(first[2]).parent)
    status, _, err = program(*first[1:])
    assert status == 0, err
    assert Path("trained/model/model.json").exists()
    assert Path("trained/evaluation/table.md").exists()


def test_ones_own_body_is_recorded_learned_judged_and_drawn(own, monkeypatch, tmp_path, program):
    """The walk-through of docs/bring_your_own.md with fewer and shorter simulations."""
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    Path("models").symlink_to(ROOT / "models")
    copied = Path(shutil.copytree(OWN, "examples/bring_your_own"))
    shutil.copy(ROOT / "examples" / "unseen_cross.toml", "examples")
    shortened(OWN / "finetune.toml", copied)
    splits = dict.fromkeys(("training", "validation", "evaluation"), 1)
    scripts = {  # make_mesh.py has a test of its own, which needs Gmsh
        "material.py": lambda: own("material").fit(OWN / "tensile_test.csv"),
        "record.py": lambda folder: own("record").main(Path(folder), splits, frames=2, refine=2),
        "show.py": lambda *paths: own("show").main(*map(Path, paths), Path(), frames=1),
    }
    for line in commands_in_text("bring_your_own.md"):
        if line[0] == "pdcorrect":
            fewer = ("--iterations", 1) if line[1] == "tune-element" else ()
            status, _, err = program(*line[1:], *fewer)
            assert status == 0, (line, err)
        elif line[0] == "python" and Path(line[1]).name in scripts:
            scripts.pop(Path(line[1]).name)(*line[2:])
    assert not scripts
    judged = json.loads(Path("hook.json").read_text())
    assert judged["before"]["runs"]["torsion-exact"]["gate_rate"] == 100.0
    assert "model" in judged["after"]["runs"]
    assert {path.name for path in Path("hook_vtu").iterdir()} >= {"hook_hybrid.pvd"}
    assert list(Path("hook_data_vtu").rglob("*.pvd"))
    assert Path("hook.png").stat().st_size > 10_000


def test_the_recipe_of_fine_tuning_has_the_architecture_of_the_model_it_starts_from():
    pytest.importorskip("torch")
    from pdcorrect.training.recipe import TrainingConfig

    config = TrainingConfig.load(OWN / "finetune.toml")
    assert config.start_from is not None
    assert config.corrector.config() == pc.load_model(config.start_from).corrector.config
