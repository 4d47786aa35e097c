"""`models/table.py` and `models/fit_body_ranges.py`."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import pdcorrect as pc  # noqa: E402

ROOT = Path(__file__).parents[1]


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "models" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_the_page_of_results_has_the_table_of_the_records():
    assert script("table").table() in (ROOT / "docs" / "results.md").read_text(encoding="utf-8")


def test_the_body_ranges_of_a_model_are_those_of_its_own_rollouts(tmp_path):
    folder = tmp_path / "tiny"
    shutil.copytree(ROOT / "models" / "tiny", folder)
    before = pc.load_model(folder).corrector.state_dict()
    config = ROOT / "datasets" / "tiny" / "config.toml"
    command = [sys.executable, ROOT / "models" / "fit_body_ranges.py", folder, config]
    subprocess.run([*command, "--batch", "4"], check=True, capture_output=True)
    model = pc.load_model(folder)
    after = model.corrector.state_dict()
    changed = {name for name in after if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("normaliser.average_") for name in changed)
    # the references that trainings fit to, and rollouts of the corrected model, are alike
    low, high, deviation = (
        before[f"normaliser.average_{part}"].numpy() for part in ("low", "high", "deviation")
    )
    middle = after["normaliser.average_mean"].numpy()
    assert ((low - deviation < middle) & (middle < high + deviation)).all()
    fitted = model.record.training["body_ranges"]
    assert fitted["steps"] == 20 * fitted["rollouts"] > 0
    assert np.isfinite(middle).all()
