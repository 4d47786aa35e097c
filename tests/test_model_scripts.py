"""`models/table.py` and `models/fit_body_ranges.py`."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from safetensors.torch import load_file, save_file  # noqa: E402

import pdcorrect as pc  # noqa: E402
import pdcorrect.errors  # noqa: E402

ROOT = Path(__file__).parents[1]


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "models" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_the_page_of_results_has_the_table_of_the_records():
    assert script("table").table() in (ROOT / "docs" / "results.md").read_text(encoding="utf-8")


def as_version_1(folder):
    """A model as it was before there were ranges of bodies' means."""
    description = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps({**description, "version": 1}))
    weights = {k: x for k, x in load_file(folder / "weights.safetensors").items()
               if ".average_" not in k}  # fmt: skip
    save_file(weights, folder / "weights.safetensors")


def test_the_body_ranges_of_an_old_model_are_those_of_its_own_rollouts(tmp_path):
    folder = tmp_path / "tiny"
    shutil.copytree(ROOT / "models" / "tiny", folder)
    before = pc.load_model(folder).corrector.state_dict()
    as_version_1(folder)
    with pytest.raises(pc.errors.FileVersionError, match="version 1"):
        pc.load_model(folder)
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
