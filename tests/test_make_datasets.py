"""`datasets/make_all.py`: several sets by the same workers, each with its summary."""

import importlib
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
frames = 2
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


def make(folder, *options):
    """Status and words."""
    script = folder / "datasets" / "make_all.py"
    command = [sys.executable, script, folder / "data", folder / "summaries", *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500)
    return done.returncode, done.stdout + done.stderr


@pytest.fixture
def sets(tmp_path):
    (tmp_path / "datasets").mkdir()
    for name in ("make_all.py", "card.py"):
        shutil.copy(ROOT / "datasets" / name, tmp_path / "datasets")
    for seed, name in enumerate(("one", "two", "wrong")):
        folder = tmp_path / "datasets" / name
        folder.mkdir()
        (folder / "config.toml").write_text(SET.format(name=name, seed=seed))
    config = tmp_path / "datasets" / "wrong" / "config.toml"
    config.write_text(config.read_text().replace("frames = 2", "frames = none"))
    return tmp_path


def assert_kept(sets, *names):
    for name in names:
        kept = {path.name for path in (sets / "summaries" / name).iterdir()}
        assert kept == {"README.md", "manifest.json"}
        manifest = json.loads((sets / "summaries" / name / "manifest.json").read_text())
        assert manifest["dataset"] == name


@pytest.mark.slow  # five processes that import torch
def test_sets_are_made_by_the_same_workers_and_summarised(sets):
    status, said = make(sets, "one", "two", "--workers", "2")
    assert status == 0, said
    assert "one: 0 findings" in said
    assert_kept(sets, "one", "two")


def test_a_set_or_summary_that_cannot_be_made_does_not_keep_the_next_from_it(sets):
    (sets / "summaries").mkdir()
    (sets / "summaries" / "one").write_text("in the way")
    status, said = make(sets, "wrong", "one", "two")
    assert status == 1
    assert "wrong: " in said
    assert str(sets / "summaries" / "one") in said
    assert "two: 0 findings" in said
    assert_kept(sets, "two")
    assert not (sets / "summaries" / "wrong").exists()


def test_without_time_nothing_is_begun(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "datasets")
    arguments = [str(tmp_path / name) for name in ("data", "summaries")]
    monkeypatch.setattr(sys, "argv", ["make_all.py", *arguments, "one", "--seconds", "-1"])
    assert importlib.import_module("make_all").main() == 1
    assert "one: no time left" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
