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
from pdcorrect.data import checksum
from pdcorrect.data.check import check_dataset
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import (
    MESH,
    content_hash,
    content_of,
    write_shard,
)
from pdcorrect.data.shard_arrays import read_arrays, read_header
from pdcorrect.data.shard_reader import read_shard, stored_hashes
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
@pytest.mark.parametrize("verify", [True, False])
def test_what_is_written_is_read(shard, tmp_path, dtype, verify):
    write_shard(tmp_path / "new" / "shard.h5", shard, dtype)
    assert_same(read_shard(tmp_path / "new" / "shard.h5", verify=verify), shard, dtype)
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("verify", [True, False])
def test_parts_are_read_alone_and_those_that_are_not_there_are_refused(shard, saved, verify):
    found = read_shard(saved, simulations=[1], runs=["reference", "plain"], verify=verify)
    expected = dataclasses.replace(shard, simulations=shard.simulations[1:])
    assert_same(found, expected, "float32", ["plain", "reference"])
    assert [len(s.runs) for s in read_shard(saved, runs=(), verify=verify).simulations] == [0, 0]
    assert not read_shard(saved, simulations=(), verify=verify).simulations

    for arguments, words in (
        ({"simulations": [2]}, "simulation 2"),
        ({"simulations": [-1]}, "simulation -1"),
        ({"runs": ["worst"]}, "simulation 0000 .*'worst'"),
    ):
        with pytest.raises(FileFormatError, match=words) as caught:
            read_shard(saved, **arguments)
        assert str(saved) in str(caught.value)


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
        assert file.userblock_size == checksum.USER_BLOCK
        np.testing.assert_array_equal(file["mesh/points"][()], shard.points)
        run = file["simulations/0001/runs/plain"]
        np.testing.assert_array_equal(
            run["predictions"][()], shard.simulations[1].runs["plain"].predictions.astype("f4")
        )
    lines = saved.read_bytes()[: checksum.USER_BLOCK].rstrip(b"\0").decode().splitlines()
    assert lines[:2] == ["pdcorrect-dataset 1", f"bytes {saved.stat().st_size}"]
    assert lines[2].startswith("sha256 ")


def test_the_hash_is_of_the_content_without_provenance_and_cost(shard, saved, tmp_path):
    def written(changed, dtype="float32"):
        return write_shard(tmp_path / "other.h5", changed, dtype, overwrite=True)

    expected = written(shard)
    with h5py.File(saved) as file:
        assert expected == file.attrs["content_hash"] == content_hash(content_of(file))
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
    assert stored_hashes(tmp_path / "shard.h5")[1] == first
    assert write_shard(path, shard, "float64", overwrite=True) != first
    with pytest.raises(OutputError, match=r"shard\.h5/other\.h5"):
        write_shard(tmp_path / "shard.h5" / "other.h5", shard)


# --- damage ------------------------------------------------------------------------------


def refusal(path, **options):
    """Why a file is refused; fails if it is not, or in any other way."""
    with pytest.raises(FileFormatError) as caught:
        read_shard(path, **options)
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
        for verify in (True, False):
            assert "truncated" in refusal(path, verify=verify)
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
        for verify in (True, False):
            refusal(path, verify=verify)
    (tmp_path / "folder.h5").mkdir()
    (tmp_path / "loop.h5").symlink_to(tmp_path / "loop.h5")
    os.mkfifo(tmp_path / "pipe.h5")
    for name in ("none", "folder", "pipe", "loop"):
        refusal(tmp_path / f"{name}.h5")


def test_another_version_is_named(saved, tmp_path, monkeypatch):
    path = tmp_path / "shard.h5"
    monkeypatch.setattr(checksum, "VERSION", 2)
    with_checksum(path, saved.read_bytes())
    for expected in (1, 3):
        monkeypatch.setattr(checksum, "VERSION", expected)
        for verify in (True, False):
            words = refusal(path, verify=verify)
            assert "version 2" in words
            assert str(expected) in words


def with_checksum(path, data):
    """Write bytes with a checksum that fits them."""
    image = bytearray(data)
    checksum.seal(memoryview(image))
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


def everything(saved):
    """Places of datasets and groups, and arrays of the former; of simulations, the second's."""
    arrays, groups = {}, []
    with h5py.File(saved) as file:
        file.visititems(
            lambda name, item: (
                arrays.update({name: item[()]})
                if isinstance(item, h5py.Dataset)
                else groups.append(name)
            )
        )
    groups = [place for place in groups if not place.startswith("simulations/0000/")]
    arrays = {k: x for k, x in arrays.items() if not k.startswith("simulations/0000/")}
    return arrays, groups


OPTIONAL = {
    "iterations", "error_estimates", "smallest_volume_ratios", "predictions", "best", "plain",
    "reference",
}  # fmt: skip
"""What a simulation may lack."""


def test_every_missing_or_wrong_part_is_named(saved, tmp_path):
    path = tmp_path / "shard.h5"
    arrays, groups = everything(saved)
    for place in [*arrays, *groups]:
        edited(saved, path, lambda file, place=place: file.__delitem__(place))
        last = place.split("/")[-1]
        if last in OPTIONAL or place.endswith(("plain/positions", "best/positions")):
            assert "not that of its attribute 'content_hash'" in refusal(path)
        else:
            assert last in refusal(path)
    edited(saved, path, lambda file: file.move(RUN, f"{RUN}s"))
    with pytest.raises(FileFormatError, match="runs/reference/positions of simulation 0000"):
        read_arrays(path)

    path = tmp_path / "shard.h5"
    arrays, _ = everything(saved)
    for place, values in arrays.items():
        name = place.split("/")[-1]
        wrong = {"shape": values[..., None], "type": values.astype(np.complex128)}
        if place != "mesh/points" and place != "mesh/cells" and name != "forces":
            wrong["shape "] = values[:-1]
        if values.ndim > 1:
            wrong[" shape"] = values[:, :-1]
        if values.dtype.kind == "f":
            bad = values.copy()
            bad[tuple(n // 2 for n in bad.shape)] = np.nan if len(place) % 2 else np.inf
            wrong["infinite or NaN"] = bad
        for words, array in wrong.items():
            edited(saved, path, replaced(place, array))
            message = refusal(path)
            assert words.strip() in message
            assert name in message
            if place.startswith("simulations/0001"):
                assert "of simulation 0001" in message
    edited(saved, path, replaced("simulations/0001/runs/best/positions", np.zeros((6, 4, 3), "f4")))
    message = refusal(path)
    assert "runs/best/positions of simulation 0001" in message
    assert "(6, 4, 3)" in message
    assert "(6, 63, 3)" in message


def test_wrong_attributes_and_contradictions_within_a_file_are_named(saved, tmp_path, shard):
    path = tmp_path / "shard.h5"
    with h5py.File(saved) as file:
        names = list(file.attrs)
    for name in names:
        edited(saved, path, lambda file, name=name: file.attrs.__delitem__(name))
        assert name in refusal(path)
        edited(saved, path, lambda file, name=name: file.attrs.create(name, np.arange(3)))
        assert name in refusal(path)
    simulation = "simulations/0000"
    for place, name, value in (
        ("/", "number", "seven"), ("/", "time_step", np.nan), ("/", "time_step", "0.1"),
        ("/", "dataset", 3), ("/", "format", "other"), ("/", "version", 2),
        (simulation, "attempt", 0.5), (simulation, "scene", 4), (simulation, "rejected", 5),
        (simulation, "rejected", np.arange(4)), ("cost/0001", "plain", "long"),
        (f"{simulation}/runs/plain", "refine", np.zeros(2)),
    ):  # fmt: skip
        edited(saved, path, lambda f, p=place, n=name, v=value: f[p].attrs.__setitem__(n, v))
        assert name in refusal(path)

    path = tmp_path / "shard.h5"
    cells = shard.cells.astype(np.int32)
    first = "simulations/0000"

    def huge(file, place, shape, **options):
        del file[place]
        file.create_dataset(place, shape, "f4" if "sim" in place else "f8", **options)

    def elsewhere(file):
        layout = h5py.VirtualLayout((len(shard.points), 3), "f8")
        layout[:] = h5py.VirtualSource(saved, "mesh/points", (len(shard.points), 3))
        del file["mesh/points"]
        file.create_virtual_dataset("mesh/points", layout)

    def raw(file):
        del file["mesh/mass"]
        bytes_of = [(str(saved), 0, 8 * len(shard.points))]
        file.create_dataset("mesh/mass", (len(shard.points),), "f8", external=bytes_of)

    def changed(file):
        file["mesh/points"][3] += 1e-3

    def no_cells(file):
        for place in ("mesh/cells", "material/young", "material/poisson", "material/density"):
            replaced(place, file[place][:0])(file)

    def loop(file):
        file[f"{first}/runs/again"] = file[first]

    for edit, words in (
        (replaced("mesh/cells", np.where(cells == 5, len(shard.points), cells)), "0 to 63"),
        (replaced("mesh/cells", cells - 1), "-1 to "),
        (no_cells, "mesh/cells"),
        (replaced(f"{first}/forces", np.zeros((0, 63, 3), "f4")), "forces"),
        (replaced(f"{first}/forces", np.zeros((4, 63, 3), "f4")), "of simulation 0000"),
        (lambda file: huge(file, "mesh/points", (10**12, 3)), "mesh/points"),
        (lambda f: huge(f, f"{first}/forces", (10**9, 63, 3), chunks=(1, 63, 3)), "forces"),
        (
            lambda f: huge(f, f"{first}/forces", (9**9, 63, 3), chunks=(1, 63, 3), compression=4),
            "forces",
        ),
        (elsewhere, "mesh/points"),
        (raw, "mesh/mass"),
        (changed, "content_hash"),
        (loop, "runs/again/forces of simulation 0000"),
        (lambda file: file.__setitem__("mesh/colour", np.zeros(3)), "mesh/colour"),
        (lambda file: file.move("simulations/0001", "simulations/0002"), "0001"),
        (lambda file: file.move("cost/0001", "cost/0005"), "cost/0001"),
        (lambda file: file.__setitem__("extra", np.zeros(3)), "extra"),
        (replaced("mesh", np.zeros(3)), "mesh"),
        (replaced("mesh/mass", h5py.SoftLink("/nowhere")), "mesh/mass"),
    ):
        edited(saved, path, edit)
        assert words in refusal(path), words


def referring(place, dangling):
    """A dataset becomes object references, to the mesh or to what is no longer there."""

    def edit(file):
        shape, target = file[place].shape, file.create_group("gone")
        reference = (target if dangling else file["mesh"]).ref
        del file[place]
        file.create_dataset(place, shape, h5py.ref_dtype)[...] = reference
        del file["gone"]

    return edit


def regions(place):
    def edit(file):
        shape, reference = file[place].shape, file[place].regionref[...]
        del file[place]
        file.create_dataset(place, shape, h5py.regionref_dtype)[...] = reference

    return edit


def of_dtype(place, dtype, shape=None):
    def edit(file):
        found = file[place].shape if shape is None else shape
        del file[place]
        file.create_dataset(place, found, dtype)

    return edit


def attribute(place, name, value, dtype=None):
    return lambda file: file[place].attrs.create(name, value, dtype=dtype)


def references_in(place, name):
    """An attribute becomes three dangling references, which NumPy shows on several lines."""

    def edit(file):
        gone = file.create_group("gone").ref
        values = np.array([gone] * 3, dtype=h5py.ref_dtype)
        file[place].attrs.create(name, values, dtype=h5py.ref_dtype)
        del file["gone"]

    return edit


def nameless(place):
    """A name that is not UTF-8, of a group in a group."""
    return lambda file: h5py.h5g.create(file[place].id, b"\xff\xfe")


def nameless_attribute(place):
    def edit(file):
        space = h5py.h5s.create(h5py.h5s.SCALAR)
        h5py.h5a.create(file[place].id, b"\xff\xfe", h5py.h5t.NATIVE_INT32, space).write(
            np.array(3, dtype="i4")
        )

    return edit


def every(*edits):
    def edit(file):
        for one in edits:
            one(file)

    return edit


FORCES, FORCES_TOLD = "simulations/0000/forces", "forces of simulation 0000"
RUN = "simulations/0000/runs/reference"
RUN_TOLD = "runs/reference of simulation 0000"
ODD = {
    "dangling references": (referring(FORCES, dangling=True), FORCES_TOLD),
    "references": (referring("mesh/cells", dangling=False), "mesh/cells"),
    "regions": (regions("mesh/points"), "mesh/points"),
    "several dangling references": (
        every(*(referring(f"mesh/{name}", dangling=True) for name in ("points", "cells", "mass"))),
        "mesh/points",
    ),
    "a dangling link": (replaced(FORCES, h5py.SoftLink("/nowhere/x")), FORCES_TOLD),
    "several dangling links": (
        every(
            replaced("mesh/points", h5py.SoftLink("/nowhere/x")),
            replaced(f"{RUN}/positions", h5py.SoftLink("/nowhere/y")),
            replaced("cost", h5py.SoftLink("/nowhere/z")),
        ),
        "cost, mesh/points, runs/reference/positions of simulation 0000",
    ),
    "very many dangling links": (
        every(*(replaced(place, h5py.SoftLink("/nowhere")) for place, _, _ in MESH.values())),
        "material/poisson, material/young, mesh/cells, mesh/free",
    ),
    "a link to itself": (replaced("mesh", h5py.SoftLink("/mesh")), "mesh"),
    "a link to another file": (replaced(RUN, h5py.ExternalLink("other.h5", "/run")), RUN_TOLD),
    "a type in place of an array": (replaced(FORCES, np.dtype("f4")), FORCES_TOLD),
    "a type in place of a group": (replaced(RUN, np.dtype("f4")), RUN_TOLD),
    "nothing": (replaced("mesh/points", h5py.Empty("f8")), "mesh/points"),
    "texts": (of_dtype("mesh/points", h5py.string_dtype()), "mesh/points"),
    "rows": (of_dtype("mesh/points", h5py.vlen_dtype("f8")), "mesh/points"),
    "records": (of_dtype("mesh/cells", [("a", "f4"), ("b", "f4")]), "mesh/cells"),
    "a reference among attributes": (references_in("/", "number"), "number of the file"),
    "references among texts": (
        references_in("simulations/0000", "rejected"),
        "rejected of simulation 0000",
    ),
    "an empty attribute": (attribute("/", "time_step", h5py.Empty("f4")), "time_step of the file"),
    "no reasons": (
        lambda file: file["simulations/0001"].attrs.__delitem__("rejected"),
        "rejected of simulation 0001",
    ),
    "bytes": (attribute("/", "dataset", np.bytes_(b"set")), "dataset of the file"),
    "a name of two lines": (lambda file: file.create_group("mesh/a\nb"), "mesh/a b"),
    "a group without a name": (nameless("simulations/0000/runs"), "runs of simulation 0000"),
    "an attribute without a name": (nameless_attribute("simulations/0000"), "simulation 0000"),
    "a group among costs": (lambda file: file.create_group("cost/0001/more"), "cost/0001/more"),
    "a group in the provenance": (
        lambda file: file.create_group("provenance/more"),
        "provenance/more",
    ),
}


@pytest.mark.parametrize("kind", ODD)
def test_what_hdf5_may_hold_instead_is_named_with_its_place(saved, tmp_path, kind):
    edit, place = ODD[kind]
    path = tmp_path / "training" / "mesh-0000.h5"
    path.parent.mkdir()
    edited(saved, path, edit)
    for verify in (True, False):
        assert place in refusal(path, verify=verify)
    (found,) = check_dataset(tmp_path)[1:]  # the first says that there is no configuration
    assert found.path == path
    assert place in found.message
    assert len(str(found).splitlines()) == 1
    for read in (read_header, lambda path: read_arrays(path, ("plain",), ("plain",))):
        try:  # they need not look at it
            read(path)
        except FileFormatError as error:
            assert str(error).startswith(f"{path}: ")
            assert place in str(error)


def test_damaged_chunks_are_named_without_the_checksum(saved, tmp_path):
    path, place = tmp_path / "shard.h5", "simulations/0001/runs/plain/predictions"
    with h5py.File(saved) as file:
        chunk = file[place].id.get_chunk_info(0)
    data = bytearray(saved.read_bytes())
    data[checksum.USER_BLOCK + chunk.byte_offset + chunk.size // 2] ^= 4
    path.write_bytes(data)
    assert "checksum" in refusal(path)
    assert "runs/plain/predictions of simulation 0001" in refusal(path, verify=False)
    read_shard(path, simulations=[0], verify=False)
