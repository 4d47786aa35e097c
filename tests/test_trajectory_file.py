"""Trajectory files survive round trips, killed writers, full disks and damage."""

import dataclasses
import itertools
import os
import random
import re
import signal
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from motion import assert_same, remembering, trajectory
from pdcorrect.errors import FileFormatError, FileVersionError, InputError, OutputError
from pdcorrect.io.trajectory import TrajectoryWriter, load_trajectory, save_trajectory
from pdcorrect.io.trajectory_reader import written_by
from pdcorrect.state import State, Status, StepResult


@pytest.fixture(scope="module")
def run():
    return trajectory()


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "run.h5"
    save_trajectory(path, run)
    return path


def step_results(run):
    for k in range(len(run)):
        stats = {name: float(run.stats[name][k]) for name in run.stats if "energy" in name}
        stats["external_work"] = float(run.stats["external_work"][k])
        yield (
            StepResult(
                run.state(k + 1),
                Status[run.stats["status"][k]],
                int(run.stats["iterations"][k]),
                float(run.stats["residual"][k]),
                float(run.stats["error_estimate"][k]),
                stats,
            ),
            float(run.stats["seconds"][k]),
        )


def writer_of(path, run, **options):
    return TrajectoryWriter(
        path, run.points, run.cells, run.state(0),
        scene_toml=run.scene_toml, attributes=run.attributes, **options,
    )  # fmt: skip


# --- round trips -----------------------------------------------------------------------


def test_what_is_saved_or_written_step_by_step_is_loaded_bit_by_bit(run, saved, tmp_path):
    assert_same(load_trajectory(saved), run)
    path = tmp_path / "run.h5"
    with writer_of(path, run) as writer:
        for result, seconds in step_results(run):
            writer.append(result, seconds)
    assert_same(load_trajectory(path), run)
    assert_same(load_trajectory(path, salvage=True), run)


def test_a_file_rewritten_by_other_tools_is_read(run, saved, tmp_path):
    """Contiguous datasets, an old superblock, no checksums."""
    path = tmp_path / "copy.h5"
    with h5py.File(saved) as old, h5py.File(path, "w", libver="earliest") as new:
        for name in ("positions", "velocities", "times", "mesh/points", "mesh/cells"):
            new[name] = old[name][...]
        for name in old["stats"]:
            new[f"stats/{name}"] = old[f"stats/{name}"][...]
        new.attrs.update(old.attrs)
    assert_same(load_trajectory(path), run)


def test_the_layout_is_the_documented_one(run, saved):
    with h5py.File(saved) as file:
        assert file.attrs["format"] == b"pdcorrect-trajectory"
        assert file.attrs["format_version"] == 1
        assert file.attrs["scene_toml"].decode() == run.scene_toml
        assert file["positions"].shape == file["velocities"].shape == run.positions.shape
        assert file["positions"].dtype == file["times"].dtype == np.float64
        assert file["mesh/cells"].shape == run.cells.shape
        assert set(file) == {"positions", "velocities", "times", "mesh", "stats"}  # no memory
        assert set(file["stats"]) == set(run.stats)
        assert file["stats/status"][0].decode() in Status.__members__


def test_runs_of_no_steps_without_statistics_or_with_a_very_long_scene(run, tmp_path):
    start = dataclasses.replace(
        run, positions=run.positions[:1], velocities=run.velocities[:1], times=run.times[:1],
        stats={},
    )  # fmt: skip
    save_trajectory(tmp_path / "start.h5", start)
    assert_same(load_trajectory(tmp_path / "start.h5"), start)
    bare = dataclasses.replace(run, stats={})
    save_trajectory(tmp_path / "bare.h5", bare)
    assert_same(load_trajectory(tmp_path / "bare.h5"), bare)
    large = dataclasses.replace(run, scene_toml="# ä\n" * 50000)
    save_trajectory(tmp_path / "large.h5", large)
    assert load_trajectory(tmp_path / "large.h5").scene_toml == large.scene_toml


def test_statistics_may_come_and_go(run, tmp_path):
    path = tmp_path / "run.h5"
    with writer_of(path, run) as writer:
        for k, (result, seconds) in enumerate(step_results(run)):
            stats = {"restarts": 3.0} if k in (2, 3) else {}
            writer.append(dataclasses.replace(result, stats=stats), seconds)
    loaded = load_trajectory(path)
    np.testing.assert_array_equal(
        loaded.stats["restarts"], [np.nan, np.nan, 3.0, 3.0, np.nan, np.nan]
    )
    np.testing.assert_array_equal(loaded.stats["iterations"], run.stats["iterations"])
    assert loaded.positions.tobytes() == run.positions.tobytes()


@pytest.mark.parametrize("first", [0, 1, 3])
def test_what_states_remember_is_stored_with_them(run, tmp_path, first):
    path = tmp_path / "run.h5"
    expected = remembering(run, first)
    save_trajectory(path, expected)
    loaded = load_trajectory(path)
    assert_same(loaded, expected)
    for k in range(len(run.times)):
        assert list(loaded.state(k).memory) == (["acceleration"] if k >= first else [])
    kept = loaded.state(-1).memory["acceleration"]
    assert kept.tobytes() == expected.memory["acceleration"][-1].tobytes()
    with h5py.File(path) as file:
        assert file["memory/acceleration"].shape == run.positions.shape
        assert np.isnan(file["memory/acceleration"][:first]).all()


# --- what a writer refuses -------------------------------------------------------------


def test_places_that_cannot_be_written_and_files_that_exist(run, saved, tmp_path):
    kept = tmp_path / "kept.h5"
    kept.write_text("precious")
    places = [
        tmp_path, tmp_path / "missing" / "run.h5", saved / "run.h5", Path("/proc/nothing.h5"), kept
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid():  # root may write it
        (tmp_path / "closed").mkdir(mode=0o500)
        places.append(tmp_path / "closed" / "run.h5")
    for path in places:
        with pytest.raises(OutputError) as caught:
            save_trajectory(path, run)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert kept.read_text() == "precious"
    save_trajectory(kept, run, overwrite=True)
    assert_same(load_trajectory(kept), run)


def test_states_that_do_not_fit_are_refused_and_leave_the_file_whole(run, tmp_path):
    path = tmp_path / "run.h5"
    good = run.state(1)
    with writer_of(path, run) as writer:
        writer.append_values(good, {})
        bad = good.positions.copy()
        bad[3, 1] = np.nan
        for state, words in (
            (State(good.positions[:-1], good.velocities[:-1], 1.0), "positions"),
            (State(bad, good.velocities, 1.0), "finite"),
            (State(good.positions, good.velocities, good.time), "time"),
            (State(good.positions, good.velocities, 1.0, {"a": bad}), "finite"),
            (State(good.positions, good.velocities, 1.0, {"a/b": bad}), "a/b"),
        ):
            with pytest.raises(InputError, match=words):
                writer.append_values(state, {})
        writer.append_values(run.state(2), {})
    assert load_trajectory(path).positions.tobytes() == run.positions[:3].tobytes()


SHAPE = trajectory().points.shape
PARTLY = np.full((7, *SHAPE), np.nan)
PARTLY[2, 3:] = 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cells": np.array([[0, 1, 2, 3, 4, 5, 6, 999]])}, "cells .*999"),
        ({"velocities": np.zeros((7, 2, 3))}, "velocities"),
        ({"times": np.zeros(7)}, "times"),
        ({"stats": {"residual": np.zeros(3)}}, "'residual'"),
        ({"stats": {"status": np.array(["FINE"] * 6)}}, "'FINE'"),
        ({"stats": {"a/b": np.zeros(6)}}, "a/b"),
        ({"memory": {"a": np.zeros((7, 2, 3))}}, "memory 'a'"),
        ({"memory": {"a/b": np.ones((7, *SHAPE))}}, "memory 'a/b'"),
        ({"memory": {"a": PARTLY}}, "memory 'a'"),
        ({"memory": {"a": np.full((7, *SHAPE), np.nan)}}, "memory 'a'"),
        ({"attributes": {"format": "mine"}}, "format"),
    ],
)
def test_contradictory_trajectories_are_not_saved(run, tmp_path, change, words):
    with pytest.raises(InputError, match=words):
        save_trajectory(tmp_path / "run.h5", dataclasses.replace(run, **change))
    assert not (tmp_path / "run.h5").exists()
    for memory in (np.zeros(4), np.zeros((4, 3))):
        with pytest.raises(InputError, match="memory 'a'"):
            State(run.positions[0], run.velocities[0], 0.0, {"a": memory})


# --- writers that do not finish --------------------------------------------------------


def write_on(pipe, path, ready):
    run = trajectory()
    writer = TrajectoryWriter(path, run.points, run.cells, run.state(0))
    for k in itertools.count(1):
        if k == ready:
            pipe.send("ready")
        state = State(run.positions[k % 7] + k, run.velocities[k % 7], 0.1 * k)
        values = {"seconds": 1.0 * k, "iterations": k, "status": "CONVERGED"}
        writer.append_values(state, values | ({"late": 0.5} if k > 20 else {}))


@pytest.mark.parametrize("ready", [1, 2, 17, 40])
def test_a_killed_writer_leaves_every_complete_frame(run, tmp_path, fork, ready):
    path = tmp_path / "run.h5"
    writer = fork(write_on, path, ready)
    try:
        assert writer.recv() == "ready"
        if ready > 1:
            assert len(load_trajectory(path)) >= ready - 1  # also while it is being written
            if ready != 17:  # it adds statistics soon after, and opens the file again
                with h5py.File(path, "r", swmr=True) as file:  # what other programs do
                    assert len(file["times"]) >= ready - 1
    finally:
        writer.kill()
        writer.join()
    loaded = load_trajectory(path)
    assert len(loaded) >= ready - 1
    for k in range(1, len(loaded.times)):
        assert (loaded.positions[k] == run.positions[k % 7] + k).all()
        assert (loaded.velocities[k] == run.velocities[k % 7]).all()
        assert loaded.times[k] == 0.1 * k
        assert loaded.stats["seconds"][k - 1] == loaded.stats["iterations"][k - 1] == k
        assert loaded.stats["status"][k - 1] == "CONVERGED"


@pytest.mark.parametrize("reached", [1, 2, 3, 4])
def test_an_interruption_inside_a_frame_drops_only_that_frame(run, tmp_path, reached):
    path = tmp_path / "run.h5"
    with writer_of(path, run) as writer:
        writer.append_values(run.state(1), {"seconds": 1.0})
        file = writer._file
        for name in ("positions", "velocities", "stats/seconds", "times")[:reached]:
            file[name].resize(2 if "stats" in name else 3, axis=0)
        file["positions"][2] = 7.0
    with h5py.File(path) as file:
        assert len(file["positions"]) == 3
        assert len(file["times"]) == (3 if reached == 4 else 2)
    assert load_trajectory(path).positions.tobytes() == run.positions[:2].tobytes()
    with pytest.raises(ZeroDivisionError), writer_of(tmp_path / "b.h5", run) as writer:  # noqa: PT012
        writer.append_values(run.state(1), {})
        raise ZeroDivisionError
    assert load_trajectory(tmp_path / "b.h5").positions.tobytes() == run.positions[:2].tobytes()
    h5py.File(tmp_path / "b.h5").close()  # which HDF5 refuses where the writer did not close it


@pytest.mark.parametrize("write", range(9))
def test_an_interruption_between_any_two_writes_drops_at_most_that_frame(
    run, tmp_path, monkeypatch, write
):
    path = tmp_path / "run.h5"
    real = TrajectoryWriter._extend
    left = [write]

    def interrupted(self, name, entries):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        real(self, name, entries)

    values = {name: run.stats[name][0] for name in ("seconds", "status")}
    with pytest.raises(KeyboardInterrupt), writer_of(path, run) as writer:  # noqa: PT012
        monkeypatch.setattr(TrajectoryWriter, "_extend", interrupted)
        writer.append_values(run.state(1), values)  # five writes
        writer.append_values(run.state(2), values)
    loaded = load_trajectory(path)
    assert len(loaded) == write // 5
    assert loaded.positions.tobytes() == run.positions[: 1 + write // 5].tobytes()


def write_with_limit(pipe, path, limit, reserved):
    import resource

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    if not reserved:  # where room cannot be, writing fails within HDF5
        TrajectoryWriter._reserve = lambda *_: None
    try:
        save_trajectory(path, trajectory(frames=60))
    except OutputError as error:
        pipe.send(str(error))
    os._exit(0)  # HDF5 may crash at its end


@pytest.mark.parametrize(
    ("limit", "reserved"), [(5000, True), (150_000, True), (150_000, False), (190_000, True)]
)
def test_a_full_disk_is_reported_and_keeps_the_frames_before(tmp_path, fork, limit, reserved):
    path = tmp_path / "run.h5"
    writer = fork(write_with_limit, path, limit, reserved)
    message = writer.recv()
    assert writer.join() == 0
    assert re.search(r"run\.h5: cannot be written", message), message
    if limit < 20_000:
        assert not path.exists()
    else:
        loaded = load_trajectory(path)
        assert f" {len(loaded.times)} frames" in message
        expected = trajectory(frames=60)
        assert len(loaded) > 5
        assert_same(loaded, expected, len(loaded.times))


# --- damaged and foreign files ---------------------------------------------------------


def test_truncation_at_any_length_is_refused_and_a_prefix_salvaged(run, saved, tmp_path):
    data = saved.read_bytes()
    path = tmp_path / "cut.h5"
    survivors = set()
    lengths = {0, 1, 7, 8, 40, 47, 48, 49, len(data) - 1, *range(100, len(data), 797)}
    for length in sorted(lengths):
        path.write_bytes(data[:length])
        with pytest.raises(FileFormatError) as refused:
            load_trajectory(path)
        message = str(refused.value)
        assert "cut.h5" in message
        if length >= 48:
            assert f"{len(data)} bytes" in message
            assert str(length) in message
        try:
            loaded = load_trajectory(path, salvage=True)
        except FileFormatError:
            survivors.add(0)
        else:
            survivors.add(len(loaded.times))
            assert f"{len(loaded.times)} of its {len(run.times)} frames" in message
            assert_same(loaded, run, len(loaded.times))
    assert survivors >= {0, 3, 4, 5, 6}

    with h5py.File(saved) as file:
        place = file["velocities"].id.get_chunk_info_by_coord((4, 0, 0)).byte_offset
    data = bytearray(saved.read_bytes())
    data[place + 11] ^= 4
    path = tmp_path / "damaged.h5"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="salvage"):
        load_trajectory(path)
    assert_same(load_trajectory(path, salvage=True), run, 4)


def test_flipped_bytes_give_the_right_data_or_a_refusal(run, saved, tmp_path):
    data = saved.read_bytes()
    path = tmp_path / "flipped.h5"
    chance = random.Random(1)
    places = [*range(48), *(chance.randrange(len(data)) for _ in range(100))]
    refused = 0
    for place in places:
        damaged = bytearray(data)
        damaged[place] ^= chance.choice([0xFF, 1 << chance.randrange(8)])
        path.write_bytes(damaged)
        try:
            assert_same(load_trajectory(path), run)
        except FileFormatError as error:
            refused += 1
            assert "flipped.h5" in str(error)
            assert "\n" not in str(error)
            try:
                loaded = load_trajectory(path, salvage=True)
            except FileFormatError:
                continue
            assert_same(loaded, run, len(loaded.times))
    assert refused > 0.46 * len(places)


def test_an_unfinished_file_is_not_held_in_memory_as_well(tmp_path):
    run = trajectory(frames=60)
    large = {
        name: np.tile(getattr(run, name), (100, 1))
        for name in ("points", "positions", "velocities")
    }
    path = tmp_path / "run.h5"
    save_trajectory(path, dataclasses.replace(run, **large))
    size = path.stat().st_size
    os.truncate(path, size - 10)
    peaks = []
    for read in (written_by, lambda path: load_trajectory(path, salvage=True)):
        tracemalloc.start()
        read(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[0] < 0.1 * size
    assert peaks[1] < 1.2 * size


@pytest.mark.parametrize("size", [3, 48, 5000])
@pytest.mark.parametrize("head", [b"", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n\x00\x00\x00\x00"])
def test_noise_and_folders_are_refused(tmp_path, size, head):
    path = tmp_path / "noise.h5"
    path.write_bytes(head + random.Random(size).randbytes(size))
    with pytest.raises(FileFormatError, match=r"noise\.h5: " + "not an HDF5 file" * (not head)):
        load_trajectory(path)
    for path in (tmp_path, tmp_path / "none.h5"):
        with pytest.raises(FileFormatError, match=path.name):
            load_trajectory(path)


def replace(file, name, data):
    del file[name]
    file[name] = data


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.attrs.__delitem__("format"), "'pdcorrect-trajectory'"),
        (lambda f: f.attrs.__setitem__("format", "other"), "'pdcorrect-trajectory'"),
        (lambda f: f.attrs.__setitem__("format_version", 2), "version 2"),
        (lambda f: f.__delitem__("velocities"), "'velocities'"),
        (lambda f: f.__delitem__("mesh"), "'mesh/points'"),
        (lambda f: replace(f, "times", f["times"][:][:, None]), "times"),
        (lambda f: replace(f, "times", f["times"][:].astype(int)), "times"),
        (lambda f: replace(f, "times", f["times"][:][::-1]), "times"),
        (lambda f: replace(f, "positions", f["positions"][:-1]), "positions"),
        (lambda f: replace(f, "positions", f["positions"][:, 1:]), "positions"),
        (
            lambda f: replace(f, "positions", f["positions"][:].astype("f4")),
            "float32",
        ),
        (lambda f: f["positions"].__setitem__((2, 3, 1), np.nan), "positions"),
        (lambda f: f["mesh/points"].__setitem__((0, 0), np.inf), "points"),
        (lambda f: f["mesh/cells"].__setitem__((1, 2), -1), "-1"),
        (lambda f: f["mesh/cells"].__setitem__((1, 2), 10**6), "1000000"),
        (lambda f: replace(f, "mesh/cells", f["mesh/cells"][:, :4]), "cells"),
        (lambda f: f["stats/status"].__setitem__(0, b"GREAT"), "'GREAT'"),
        (lambda f: replace(f, "stats/seconds", np.zeros(2)), "seconds"),
    ],
)
def test_files_that_break_the_layout_are_refused(saved, tmp_path, change, words):
    path = tmp_path / "broken.h5"
    path.write_bytes(saved.read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(FileFormatError) as refused:
        load_trajectory(path)
    assert words in str(refused.value)
    assert "broken.h5" in str(refused.value)
    assert isinstance(refused.value, FileVersionError) == (words == "version 2")
