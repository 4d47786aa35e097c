"""`datasets/make_all.py`: several sets by the same workers, each with its summary."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SET = """
name = "{name}"
seed = {seed}
family = "cross"
setting = "as-published"
coarse_nodes = [72, 108]
cell_size = 0.05
step = 0.01
frames = 3
validation_share = 0.5

[reference]
refine = 2

[material]
young = [1.0e5, 4.0e5]
poisson = [0.3, 0.45]
density = [800.0, 1200.0]

[motion]
kind = "torsion"
strength = [1.0, 4.0]

[training]
meshes = 2
simulations = 2

[evaluation]
meshes = 1
simulations = 1
"""


def make(folder, *options, status=0):
    script = folder / "datasets" / "make_all.py"
    command = [sys.executable, script, folder / "data", folder / "summaries", *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def sets(tmp_path):
    (tmp_path / "datasets").mkdir()
    for name in ("make_all.py", "card.py"):
        shutil.copy(ROOT / "datasets" / name, tmp_path / "datasets")
    for seed, name in enumerate(("one", "two")):
        folder = tmp_path / "datasets" / name
        folder.mkdir()
        (folder / "config.toml").write_text(SET.format(name=name, seed=seed))
    return tmp_path


def test_sets_are_made_by_the_same_workers_and_summarised(sets):
    said = make(sets, "one", "two", "--workers", "2")
    for name in ("one", "two"):
        assert f"{name}: 0 findings" in said
        kept = {path.name for path in (sets / "summaries" / name).iterdir()}
        assert kept == {"README.md", "manifest.json"}
        manifest = json.loads((sets / "summaries" / name / "manifest.json").read_text())
        assert manifest["dataset"] == name


def test_a_set_that_cannot_be_made_does_not_keep_the_next_from_it(sets):
    config = sets / "datasets" / "one" / "config.toml"
    config.write_text(config.read_text().replace("frames = 3", "frames = none"))
    said = make(sets, "one", "two", status=1)
    assert "two: 0 findings" in said
    assert not (sets / "summaries" / "one").exists()


def test_without_time_nothing_is_begun(sets):
    assert "no time left" in make(sets, "one", "--seconds", "-1", status=1)
    assert not (sets / "data").exists()


def test_a_summary_that_cannot_be_written_is_a_failure(sets):
    (sets / "summaries").write_text("in the way")
    assert "summaries" in make(sets, "one", status=1)
