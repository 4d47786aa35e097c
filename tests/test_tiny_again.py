"""The committed data set `datasets/tiny`, computed again."""

import contextlib
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdcorrect.data.check_file import same_scene
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.generate import generate
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.data.schema import MANIFEST, read_shard
from pdcorrect.data.simulate import simulate
from pdcorrect.data.workers import make_engines

TINY = Path(__file__).parents[1] / "datasets" / "tiny"


def test_a_committed_file_is_computed_again_to_the_tolerance():
    """Its first ten frames."""
    config = DatasetConfig.load(TINY / "config.toml")
    (plan, *_) = make_plan(config)
    (again,) = simulate(config, [replace(plan, frames=10)], make_engines(config, "cpu"))
    committed = read_shard(TINY / f"{plan.name}.h5")
    np.testing.assert_array_equal(again.cells, committed.cells)
    assert len(again.simulations) == len(committed.simulations)
    for k, (new, old) in enumerate(zip(again.simulations, committed.simulations, strict=True)):
        assert same_scene(old.scene_toml, draw_scene(config, plan, k, old.attempt))
        assert new.runs.keys() == old.runs.keys()
        for name, run in old.runs.items():
            differences = [new.runs[name].positions - run.positions[:11]]
            if run.predictions is not None:
                differences.append(new.runs[name].predictions - run.predictions[:10])
            for difference in differences:
                largest = np.linalg.norm(difference, axis=-1).max()
                assert largest < config.tolerance * config.cell_size


def kill_after(count, folder, workers):
    """Generate the whole set in processes of its own, and kill them when ``count`` files are there.

    Returns the finished files, each with what tells whether it is written again.
    """
    psutil = pytest.importorskip("psutil")
    command = [
        sys.executable, "-m", "pdcorrect", "dataset", "generate", TINY / "config.toml",
        "-o", folder, "--workers", str(workers),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while len(list(folder.rglob("*.h5"))) < count:
        assert process.poll() is None, "the generation ended before it was killed"
        time.sleep(0.2)
    every = [process, *psutil.Process(process.pid).children(recursive=True)]
    for each in every:
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            each.kill()
    process.wait()
    psutil.wait_procs(every[1:], timeout=30)
    return identities(folder)


def identities(folder):
    """Inode and time of change of each file of a mesh."""
    found = {path: path.stat() for path in sorted(folder.rglob("*.h5"))}
    return {path: (stat.st_ino, stat.st_mtime_ns) for path, stat in found.items()}


@pytest.mark.slow
def test_one_worker_and_two_that_were_killed_compute_the_same_whole_set(tmp_path):
    pytest.importorskip("distributed")
    config = DatasetConfig.load(TINY / "config.toml")
    assert generate(config, tmp_path / "one")
    finished = kill_after(4, tmp_path / "two", workers=2)
    assert 4 <= len(finished) < len(make_plan(config))
    command = [
        sys.executable, "-m", "pdcorrect", "dataset", "generate", TINY / "config.toml",
        "-o", tmp_path / "two", "--workers", "2",
    ]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    later = identities(tmp_path / "two")
    assert {path: later[path] for path in finished} == finished
    one, two = (json.loads((tmp_path / n / MANIFEST).read_text()) for n in ("one", "two"))
    assert len(one["files"]) == len(make_plan(config)) == 11
    assert one["files"] == two["files"]
    assert one["content_hash"] == two["content_hash"]
