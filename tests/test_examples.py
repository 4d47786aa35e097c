"""Every scene and script in examples/ and every command and snippet of the documentation runs."""

import importlib
import importlib.util
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from pdcorrect import scene as scene_module
from pdcorrect.fem.mesh_files import read_hex_mesh

ROOT = Path(__file__).parent.parent
SCENES = sorted((ROOT / "examples").glob("*.toml"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_example_scenes_run_with_both_solvers(path):
    scene = pc.Scene.load(path)
    problem = pc.discretise(scene)
    pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-7), frames=12)
    newton = pc.rollout(pc.Newton(problem), frames=12)
    assert set(pd.stats["status"]) == {"CONVERGED"}
    assert np.abs(pd.positions - newton.positions).max() < 1e-5 * problem.cell_size
    assert pc.metrics.largest_displacement(pd) > 0.02 * problem.cell_size


def run_script(name, folder):
    """The summary of a script in examples/, which draws one figure of its name."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
        summary = module.main(folder)
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


def unmarked_commands(page):
    """Words of the lines in a page's ```text blocks, which take too long to be run as they are."""
    blocks = re.findall(r"```text\n(.*?)```", (ROOT / "docs" / page).read_text(), re.S)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


def shortened(recipe, folder):
    """A copy of a recipe of training with two iterations a stage, one simulation each."""
    text, count = re.subn(r"^iterations = \d+$", "iterations = 2", recipe.read_text(), flags=re.M)
    assert count
    folder.mkdir(parents=True, exist_ok=True)
    (folder / recipe.name).write_text(re.sub(r"^batch = \d+$", "batch = 1", text, flags=re.M))


def test_the_first_command_of_the_training_page_trains(monkeypatch, tmp_path, program):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    Path("datasets").symlink_to(ROOT / "datasets")
    first, *templates = unmarked_commands("training.md")
    assert all("RECIPE" in line for line in templates)
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
    shortened(OWN / "finetune.toml", copied)
    splits = dict.fromkeys(("training", "validation", "evaluation"), 1)
    scripts = {  # make_mesh.py has a test of its own, which needs Gmsh
        "material.py": lambda: own("material").fit(OWN / "tensile_test.csv"),
        "record.py": lambda folder: own("record").main(Path(folder), splits, frames=3, refine=2),
        "show.py": lambda *paths: own("show").main(*map(Path, paths), Path(), frames=2),
    }
    for line in unmarked_commands("bring_your_own.md"):
        if line[0] == "pdcorrect":
            status, _, err = program(*line[1:])
            assert status == 0, (line, err)
        elif line[0] == "python" and not line[1].endswith("make_mesh.py"):
            scripts.pop(Path(line[1]).name)(*line[2:])
        else:
            assert line[-1] in ("gmsh", "examples/bring_your_own/hook.msh")
    assert not scripts
    # of so short simulations the gate refuses all, of those of the page two fifths of one
    for folder, model in (("before", "torsion-exact"), ("after", "model")):
        table = Path(folder, "table.md").read_text()
        assert all(f"| {run} |" in table for run in (f"{model} (all refused)", "best")), table
    assert {path.name for path in Path("hook_vtu").iterdir()} >= {"hook_hybrid.pvd"}
    assert list(Path("hook_data_vtu").rglob("*.pvd"))
    assert Path("hook.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["finetune", "finetune_compact"])
def test_recipes_of_fine_tuning_have_the_architecture_of_the_model_they_start_from(name):
    pytest.importorskip("torch")
    from pdcorrect.training.config import TrainingConfig

    config = TrainingConfig.load(OWN / f"{name}.toml")
    assert config.start_from is not None
    assert config.architecture() == pc.load_model(config.start_from).corrector.config


def blocks(language):
    for page in PAGES:
        for i, text in enumerate(re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)):
            yield pytest.param(text, id=f"{page.stem}-{i}")


@pytest.mark.parametrize("text", list(blocks("python")))
def test_python_snippets_run(text, monkeypatch, example_folder):
    monkeypatch.chdir(example_folder)
    exec(compile(text, "snippet", "exec"), _names)


_names: dict = {}
"""Snippets of a page build on each other."""


@pytest.fixture
def example_folder(tmp_path):
    """A folder that looks like the checkout, where the pages' relative paths hold."""
    for name in ("examples", "datasets", "models"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def shell_lines():
    for page in PAGES:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.S):
            for line in block.splitlines():
                if line.startswith("pdcorrect "):
                    yield page.stem, line.split("#")[0].strip()


def test_documented_commands_run(monkeypatch, example_folder, capsys):
    """In the order of the pages, few frames each, as the commands build on each other's files."""
    from pdcorrect.cli import main as cli

    lines = list(dict.fromkeys(line for _, line in shell_lines()))
    assert len(lines) >= 4
    monkeypatch.chdir(example_folder)
    shutil.copytree("datasets/tiny", "tiny")  # generated but for its last file, to save time
    Path("tiny/evaluation/mesh-0001.h5").unlink()
    for line in lines:
        words = shlex.split(line)
        if words[1] in ("simulate", "compare") and "--frames" not in words:
            words += ["--frames", "2"]
        monkeypatch.setattr(sys, "argv", words)
        try:
            cli.main()
        except SystemExit as end:
            assert not end.code or words[1] == "doctor", (line, capsys.readouterr().err)


def test_the_scene_page_names_every_key():
    page = (ROOT / "docs" / "scene.md").read_text()
    models = [
        scene_module.Beam, scene_module.Cross, scene_module.Weight, scene_module.Voxels,
        scene_module.MeshFile, scene_module.Material, scene_module.Region, scene_module.Clamp,
        scene_module.Motion, scene_module.Gravity, scene_module.BodyForce, scene_module.Force,
        scene_module.Traction, scene_module.Pressure, scene_module.Torsion, scene_module.Time,
        scene_module.Solver, scene_module.Damping, scene_module.Scene,
    ]  # fmt: skip
    for model in models:
        for name, field in model.model_fields.items():
            key = field.alias or name
            assert re.search(rf"[`\[ ]{key}[`\] =]", page), f"{model.__name__}.{key}"


def test_the_first_data_set_of_the_pages_is_the_one_of_the_examples():
    text = (ROOT / "examples" / "datasets" / "small.toml").read_text()
    assert f"```toml\n{text}```" in (ROOT / "docs" / "datasets.md").read_text()


def test_the_data_set_page_names_every_key():
    from pdcorrect.data import config

    page = (ROOT / "docs" / "datasets.md").read_text()
    tables = {
        "": config.DatasetConfig, "material.": config.MaterialRange, "motion.": config.MotionRange,
        "reference.": config.Reference, "training.": config.Split, "evaluation.": config.Split,
        "extra.": config.ExtraSplit,
    }  # fmt: skip
    for start, model in tables.items():
        for name in model.model_fields:
            if f"{name}." not in tables:
                assert f"`{start}{name}`" in page, start + name


def test_documented_links_exist():
    for page in PAGES:
        for target in re.findall(r"\]\((?!http|#)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} -> {target}"


def test_the_documentation_builds_without_warnings(tmp_path):
    import subprocess

    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", ROOT / "docs", tmp_path]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "theory.html").exists()
