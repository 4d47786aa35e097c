"""`check_dataset` on files whose seal, hash and manifest are in order and whose motion is not."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dataset_samples import with_run, with_simulation
from pdcorrect.data.check import check_dataset
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.folder import manifest_content
from pdcorrect.data.schema import write_shard
from pdcorrect.data.shard_reader import read_shard

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


def test_a_file_as_it_was_generated_is_sound(spoilt):
    assert spoilt(lambda shard: shard, repeat=5) == []


def reflected(shard):
    """The reference's free nodes of frame 5 mirrored in the middle of the body."""
    values = shard.simulations[0].runs["reference"].positions.copy()
    middle = shard.points.mean(axis=0)
    values[5] = np.where(shard.free, 2 * middle - values[5], values[5])
    return with_run(shard, 0, "reference", positions=values)


def test_a_reference_that_is_inside_out_is_found_by_its_positions(spoilt):
    assert spoilt(reflected, repeat=0) == [
        "simulation 0000: reference: a cell is inside out in its positions, first in row 5"
    ]


def test_predictions_that_are_inside_out_are_found(spoilt):
    def change(shard):
        values = shard.simulations[0].runs["best"].predictions.copy()
        values[7] = np.where(shard.free, 2 * shard.points.mean(axis=0) - values[7], values[7])
        return with_run(shard, 0, "best", predictions=values)

    assert spoilt(change, repeat=0) == [
        "simulation 0000: best: a cell is inside out in its predictions, first in row 7"
    ]


def test_det_f_of_every_run_is_looked_at(spoilt):
    def change(shard):
        told = dict(shard.simulations[0].runs["plain"].statistics)
        told["smallest_volume_ratios"] = np.full_like(told["smallest_volume_ratios"], -1.0)
        return with_run(shard, 0, "plain", statistics=told)

    assert spoilt(change) == ["simulation 0000: plain: det F is -1 after step 1"]


@pytest.mark.parametrize("name", ["smallest_volume_ratios", "error_estimates"])
def test_a_run_without_figures_of_its_steps_is_found(spoilt, name):
    def change(shard):
        told = dict(shard.simulations[0].runs["reference"].statistics)
        del told[name]
        return with_run(shard, 0, "reference", statistics=told)

    assert spoilt(change) == [f"simulation 0000: reference: no {name}: expected those of its steps"]


def test_forces_that_are_not_the_loads_are_found(spoilt):
    def change(shard):
        forces = shard.simulations[0].forces.copy()
        forces[-1] *= 1.001
        return with_simulation(shard, 0, forces=forces)

    (message,) = spoilt(change)
    assert message == "simulation 0000: its forces in step 20 are not what config.toml draws"


@pytest.mark.parametrize(
    ("run", "key", "value", "wanted"),
    [
        ("reference", "refine", 1, 4),
        ("plain", "solver", "x", "'pd'"),
        ("best", "time_step", 0.02, 0.01),
    ],
)
def test_a_run_of_another_model_is_found(spoilt, run, key, value, wanted):
    def change(shard):
        told = dict(shard.simulations[0].runs[run].attributes)
        return with_run(shard, 0, run, attributes={**told, key: value})

    assert spoilt(change) == [f"simulation 0000: {run}: its {key} is {value!r}: expected {wanted}"]


@pytest.mark.parametrize("what", ["positions", "predictions"])
def test_steps_that_the_model_would_not_take_are_found(spoilt, what):
    """A tenth of a cell in one direction, everywhere: smooth, and no cell is inside out."""

    def change(shard):
        values = getattr(shard.simulations[0].runs["plain"], what).copy()
        values[1:] += np.where(shard.free, 0.005, 0.0).astype(values.dtype)
        return with_run(shard, 0, "plain", **{what: values})

    assert spoilt(change, repeat=0) == []
    (message,) = spoilt(change, repeat=2)
    assert message.startswith("simulation 0000: plain: step ")
    assert f"of its {what} is 0.00" in message
    assert "off when it is taken again: expected at most 5." in message


def test_a_reference_in_reverse_is_found_by_what_is_predicted_from_it(spoilt):
    def change(shard):
        values = shard.simulations[0].runs["reference"].positions.copy()
        values[1:] = values[:0:-1]
        return with_run(shard, 0, "reference", positions=values)

    plain, best = spoilt(change, repeat=3)
    assert plain.startswith("simulation 0000: plain: step ")
    assert best.startswith("simulation 0000: best: step ")
    assert all("of its predictions is" in message for message in (plain, best))


@pytest.mark.parametrize("key", ["dataset", "config_hash", "content_hash"])
def test_a_manifest_of_something_else_is_found(tmp_path, key):
    folder = shutil.copytree(TINY, tmp_path / "tiny")
    content = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**content, key: "other"}))
    (finding,) = check_dataset(folder, repeat=0)
    assert finding.path == folder / "manifest.json"
    assert finding.message == f"its {key} is not that of config.toml and of the files it lists"


def test_statistics_of_other_files_are_found(tmp_path):
    folder = shutil.copytree(TINY, tmp_path / "tiny")
    content = json.loads((folder / "statistics.json").read_text())
    content["shards"]["mesh-0001.h5"] = "other"
    (folder / "statistics.json").write_text(json.dumps(content))
    (finding,) = check_dataset(folder, repeat=0)
    assert finding.path == folder / "statistics.json"
    assert finding.message.startswith("stale: mesh-0001.h5 has changed since")


def test_a_negative_number_of_steps_is_refused():
    with pytest.raises(ValueError, match="repeat = -1: expected 0 or more"):
        check_dataset(TINY, repeat=-1)
