"""Files of data sets: round trips and damage."""

import dataclasses
import os
import random
import shutil

import h5py
import numpy as np
import pytest

from dataset_samples import sample_config, sample_shard, with_run, with_simulation
from motion import trajectory
from pdcorrect.data import schema
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import MESH, content_hash, read_header, read_shard, write_shard
from pdcorrect.errors import FileFormatError, InputError, OutputError
from pdcorrect.io.trajectory import save_trajectory


@pytest.fixture(scope="module")
def shard():
    config = sample_config()
    return sample_shard(config, make_plan(config)[0])


@pytest.fixture(scope="module")
def saved(shard, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "shard.h5"
    write_shard(path, shard)
    return path


def assert_same(found, expected, dtype, runs=None):
    """All that a shard holds, its floats rounded to ``dtype``."""
    assert dict(found.attributes) == dict(expected.attributes)
    assert dict(found.provenance) == dict(expected.provenance)
    for name, (_, kind, _) in MESH.items():
        assert getattr(found, name).dtype == kind
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert len(found.simulations) == len(expected.simulations)
    for mine, wanted in zip(found.simulations, expected.simulations, strict=True):
        assert mine.forces.dtype == dtype
        np.testing.assert_array_equal(mine.forces, wanted.forces.astype(dtype))
        for name in ("scene_toml", "attempt", "rejected", "seconds"):
            assert getattr(mine, name) == getattr(wanted, name)
        assert sorted(mine.runs) == sorted(runs or wanted.runs)
        for name, run in mine.runs.items():
            assert_same_run(run, wanted.runs[name], dtype)


def assert_same_run(found, expected, dtype):
    assert dict(found.attributes) == dict(expected.attributes)
    for name in ("positions", "predictions"):
        mine, wanted = getattr(found, name), getattr(expected, name)
        assert (mine is None) == (wanted is None)
        if mine is not None:
            assert mine.dtype == dtype
            np.testing.assert_array_equal(mine, wanted.astype(dtype))
    assert set(found.statistics) == set(expected.statistics)
    for name, values in found.statistics.items():
        np.testing.assert_array_equal(values, expected.statistics[name].astype(values.dtype))


# --- round trips -------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_is_written_is_read(shard, tmp_path, dtype):
    write_shard(tmp_path / "new" / "shard.h5", shard, dtype)
    assert_same(read_shard(tmp_path / "new" / "shard.h5"), shard, dtype)
    assert not list(tmp_path.rglob("*.part"))


def test_runs_are_read_alone(shard, saved):
    found = read_shard(saved, runs=["reference", "plain", "worst"])
    assert_same(found, shard, "float32", ["plain", "reference"])
    assert [len(s.runs) for s in read_shard(saved, runs=()).simulations] == [0, 0]
    run = read_shard(saved, runs={"plain": ["predictions"]}).simulations[0].runs["plain"]
    assert run.positions is None
    assert run.predictions is not None


def test_texts_of_any_length_and_no_rejected_draws(shard, tmp_path):
    plain = with_simulation(
        shard, 0, attempt=0, rejected=(), scene_toml="# ä\n" * 50000, seconds={}
    )
    bare = dataclasses.replace(plain, provenance={}, simulations=plain.simulations[:1])
    write_shard(tmp_path / "shard.h5", bare)
    assert_same(read_shard(tmp_path / "shard.h5"), bare, "float32")


def test_other_programs_read_the_file(shard, saved):
    with h5py.File(saved) as file:
        assert file.attrs["format"] == "pdcorrect-dataset"
        assert file.attrs["version"] == 1
        assert file.userblock_size == schema.USER_BLOCK
        np.testing.assert_array_equal(file["mesh/points"][()], shard.points)
        run = file["simulations/0001/runs/plain"]
        np.testing.assert_array_equal(
            run["predictions"][()], shard.simulations[1].runs["plain"].predictions.astype("f4")
        )
    lines = saved.read_bytes()[: schema.USER_BLOCK].rstrip(b"\0").decode().splitlines()
    assert lines[:2] == ["pdcorrect-dataset 1", f"bytes {saved.stat().st_size}"]
    assert lines[2].startswith("sha256 ")


def test_the_hash_is_of_the_content_without_provenance_and_cost(shard, saved, tmp_path):
    def written(changed, dtype="float32"):
        return write_shard(tmp_path / "other.h5", changed, dtype, overwrite=True)

    expected = written(shard)
    with h5py.File(saved) as file:
        assert expected == file.attrs["content_hash"] == content_hash(file)
    for same in (
        dataclasses.replace(shard, provenance={"date": "other"}),
        with_simulation(shard, 1, seconds={"reference": 17.0}),
    ):
        assert written(same) == expected
    run = shard.simulations[0].runs["best"]
    moved = run.positions.copy()
    moved[2, 3, 1] += 1e-3
    for other in (
        dataclasses.replace(shard, young=1.001 * shard.young),
        dataclasses.replace(shard, attributes={**shard.attributes, "number": 3}),
        with_run(shard, 0, "best", positions=moved),
        with_run(shard, 0, "best", attributes={**run.attributes, "refine": 2}),
        with_simulation(shard, 1, scene_toml="other"),
        with_simulation(shard, 1, rejected=("another reason",)),
        dataclasses.replace(shard, simulations=shard.simulations[::-1]),
    ):
        assert written(other) != expected
    assert written(shard, "float64") != expected


def test_what_cannot_be_written_is_refused_and_a_file_is_replaced_only_when_asked(shard, tmp_path):
    path = str(tmp_path / "shard.h5")
    for dtype in ("float16", "f4", "text"):
        with pytest.raises(InputError, match=f"dtype = '{dtype}'"):
            write_shard(path, shard, dtype)
    assert not (tmp_path / "shard.h5").exists()
    first = write_shard(path, shard)
    with pytest.raises(OutputError, match=r"shard\.h5.*overwrite"):
        write_shard(path, shard, "float64")
    assert read_header(tmp_path / "shard.h5").content_hash == first
    assert write_shard(path, shard, "float64", overwrite=True) != first
    with pytest.raises(OutputError, match=r"shard\.h5"):
        write_shard(tmp_path / "shard.h5" / "other.h5", shard)


# --- damage ------------------------------------------------------------------------------


def refusal(path, read=read_shard):
    """Why a file is refused; fails if it is not, or in any other way."""
    with pytest.raises(FileFormatError) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message


def test_every_flipped_bit_truncation_and_overwritten_block_is_found(saved, tmp_path):
    data, path = saved.read_bytes(), tmp_path / "shard.h5"
    rng = random.Random(1)
    places = [*range(0, 200, 7), 300, 511, 512, 520, 600, len(data) - 1]
    places += [rng.randrange(len(data)) for _ in range(150)]
    for place in places:
        changed = bytearray(data)
        changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        refusal(path)
    for kind in range(60):  # zeroed, of noise, or of another place
        size = rng.randrange(16, 4096)
        one, other = (rng.randrange(len(data) - size) for _ in range(2))
        changed = bytearray(data)
        changed[one : one + size] = (
            bytes(size), rng.randbytes(size), data[other : other + size]
        )[kind % 3]  # fmt: skip
        if changed != data:
            path.write_bytes(changed)
            refusal(path)

    data, path = saved.read_bytes(), tmp_path / "shard.h5"
    rng = random.Random(2)
    for length in [1, 10, 30, 511, 512, 513, len(data) - 1, *rng.sample(range(len(data)), 50)]:
        path.write_bytes(data[:length])
        for read in (read_shard, read_header):
            assert "truncated" in refusal(path, read)
    path.write_bytes(data + b"\0")
    message = refusal(path)
    assert str(len(data)) in message
    assert str(len(data) + 1) in message


def test_other_formats_folders_and_pipes_are_refused(tmp_path):
    path = tmp_path / "shard.h5"

    def plain_hdf5():
        with h5py.File(path, "w", userblock_size=1024) as file:
            file["mesh/points"] = np.zeros((3, 3))

    def archive():
        with path.open("wb") as file:
            np.savez(file, a=np.arange(9))

    for write in (
        lambda: path.write_bytes(b""),
        lambda: save_trajectory(path, trajectory(frames=2)),
        plain_hdf5,
        archive,
        lambda: path.write_text('name = "a scene"\n'),
        lambda: path.write_bytes(random.Random(4).randbytes(5000)),
        lambda: path.write_bytes(b"pdcorrect-dataset 1\n".ljust(900, b"x")),
    ):
        path.unlink(missing_ok=True)
        write()
        for read in (read_shard, read_header):
            refusal(path, read)
    (tmp_path / "folder.h5").mkdir()
    (tmp_path / "loop.h5").symlink_to(tmp_path / "loop.h5")
    os.mkfifo(tmp_path / "pipe.h5")
    for name in ("none", "folder", "pipe", "loop"):
        refusal(tmp_path / f"{name}.h5")


def test_another_version_is_named(saved, tmp_path, monkeypatch):
    path = tmp_path / "shard.h5"
    monkeypatch.setattr(schema, "VERSION", 2)
    with_checksum(path, saved.read_bytes())
    for expected in (1, 3):
        monkeypatch.setattr(schema, "VERSION", expected)
        for read in (read_shard, read_header):
            words = refusal(path, read)
            assert "version 2" in words
            assert str(expected) in words


def with_checksum(path, data):
    """Write bytes with a checksum that fits them."""
    image = bytearray(data)
    schema.seal(memoryview(image))
    path.write_bytes(image)


def edited(saved, path, edit):
    """A copy whose HDF5 content ``edit`` has changed, with a checksum that fits."""
    shutil.copy(saved, path)
    with h5py.File(path, "r+") as file:
        edit(file)
    with_checksum(path, path.read_bytes())


def replaced(place, values):
    def edit(file):
        del file[place]
        file[place] = values

    return edit


FORCES, RUN = "simulations/0000/forces", "simulations/0001/runs/best/positions"


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda f: f.__delitem__("mesh/mass"), "mass"),
        (lambda f: f.__delitem__("simulations/0000/runs"), "runs"),
        (lambda f: f.move("cost/0001", "cost/0005"), "0001"),
        (lambda f: f.attrs.__delitem__("time_step"), "cannot be read"),
        (lambda f: f.attrs.__setitem__("number", "seven"), "seven"),
        (replaced("mesh", np.zeros(3)), "cannot be read"),
        (replaced("mesh/mass", h5py.SoftLink("/nowhere")), "cannot be read"),
        (replaced("mesh/points", np.full((63, 3), np.inf)), "mesh/points has infinite"),
        (replaced("mesh/points", np.zeros((62, 3))), "mesh/free has shape (63, 3)"),
        (replaced("mesh/cells", np.full((24, 8), 63, "i4")), "63 to 63: expected 0 to 62"),
        (replaced(FORCES, np.zeros((4, 63, 3), "f4")), "simulations/0000/runs/best/positions"),
        (replaced(FORCES, np.zeros((5, 63), "f4")), f"{FORCES} has shape (5, 63)"),
        (replaced(RUN, np.zeros((6, 4, 3), "f4")), f"{RUN} has shape (6, 4, 3)"),
        (replaced(RUN, np.full((6, 63, 3), np.nan, "f4")), f"{RUN} has infinite"),
    ],
)
def test_missing_parts_and_contradictions_are_named(saved, tmp_path, edit, words):
    path = tmp_path / "shard.h5"
    edited(saved, path, edit)
    assert words in refusal(path)
