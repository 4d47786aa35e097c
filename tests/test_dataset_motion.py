"""`check_dataset` on files whose checksums and manifest are in order and whose motion is not."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dataset_samples import with_run, with_simulation
from pdcorrect.data.check import check_dataset
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.folder import manifest_content
from pdcorrect.data.schema import read_shard, write_shard

TINY = Path(__file__).parent.parent / "datasets" / "tiny"
FILE = "training/mesh-0000.h5"


@pytest.fixture
def spoilt(tmp_path):
    """A function that writes tiny with a change to its first file, and tells what is found."""

    def spoil(change, repeat=1):
        folder = tmp_path / "tiny"
        (folder / FILE).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(TINY / "config.toml", folder)
        content = write_shard(folder / FILE, change(read_shard(TINY / FILE)), overwrite=True)
        hashes = json.loads((TINY / "manifest.json").read_text())["files"]
        hashes[FILE.removesuffix(".h5")] = content
        config = DatasetConfig.load(folder / "config.toml")
        (folder / "manifest.json").write_text(json.dumps(manifest_content(config, hashes)))
        found = check_dataset(folder, repeat=repeat)
        return [f.message for f in found if f.path == folder / FILE]

    return spoil


def reflected(run, what, row):
    """Free nodes of one row mirrored in the middle of the body."""

    def change(shard):
        values = getattr(shard.simulations[0].runs[run], what).copy()
        mirrored = 2 * shard.points.mean(axis=0) - values[row]
        values[row] = np.where(shard.free, mirrored, values[row])
        return with_run(shard, 0, run, **{what: values})

    return change


def inverted(shard):
    told = dict(shard.simulations[0].runs["plain"].statistics)
    told["smallest_volume_ratios"] = np.full_like(told["smallest_volume_ratios"], -1.0)
    return with_run(shard, 0, "plain", statistics=told)


def pulled_harder(shard):
    forces = shard.simulations[0].forces.copy()
    forces[-1] *= 1.001
    return with_simulation(shard, 0, forces=forces)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (reflected("reference", "positions", 5), ("reference", "positions", "row 5")),
        (reflected("best", "predictions", 7), ("best", "predictions", "row 7")),
        (inverted, ("plain", "-1", "step 1")),
        (pulled_harder, ("forces", "step 20")),
    ],
)
def test_what_no_solver_would_have_written_is_found_and_named(spoilt, change, named):
    assert spoilt(lambda shard: shard, repeat=0) == []
    (message,) = spoilt(change, repeat=0)
    assert all(word in message for word in ("simulation 0000", *named)), message


@pytest.mark.parametrize("what", ["positions", "predictions"])
def test_steps_that_the_model_would_not_take_are_found(spoilt, what):
    """A tenth of a cell in one direction, everywhere: smooth, and no cell is inside out."""

    def change(shard):
        values = getattr(shard.simulations[0].runs["plain"], what).copy()
        values[1:] += np.where(shard.free, 0.005, 0.0).astype(values.dtype)
        return with_run(shard, 0, "plain", **{what: values})

    assert spoilt(lambda shard: shard, repeat=2) == []
    assert spoilt(change, repeat=0) == []
    (message,) = spoilt(change, repeat=2)
    assert message.startswith("simulation 0000: plain: step ")
    assert what in message


def test_a_reference_in_reverse_is_found_by_what_is_predicted_from_it(spoilt):
    def change(shard):
        values = shard.simulations[0].runs["reference"].positions.copy()
        values[1:] = values[:0:-1]
        return with_run(shard, 0, "reference", positions=values)

    plain, best = spoilt(change, repeat=3)
    assert plain.startswith("simulation 0000: plain: step ")
    assert best.startswith("simulation 0000: best: step ")
    assert all("predictions" in message for message in (plain, best))


@pytest.mark.parametrize("key", ["dataset", "config_hash", "content_hash"])
def test_a_manifest_of_something_else_is_found(tmp_path, key):
    folder = shutil.copytree(TINY, tmp_path / "tiny")
    manifest = folder / "manifest.json"
    before = manifest.read_text()
    manifest.write_text(json.dumps({**json.loads(before), key: "other"}))
    (finding,) = check_dataset(folder, repeat=0)
    assert finding.path == manifest
    if key == "content_hash":
        with pytest.raises(ValueError, match="repeat = -1"):
            check_dataset(folder, repeat=-1)
