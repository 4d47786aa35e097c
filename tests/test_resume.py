"""A run that was stopped anywhere and continued equals one that never stopped."""

import contextlib
import dataclasses
import io
import os
import random
import re
import signal
import subprocess
import sys
import time
from itertools import count
from pathlib import Path

import h5py
import numpy as np
import pytest

import pdcorrect as pc
from conftest import LIMIT, beam
from motion import assert_same, remembering, trajectory
from pdcorrect import _files
from pdcorrect._files import INTERRUPTED, TERMINATED, Terminated, terminable
from pdcorrect.cli import main
from pdcorrect.cli.common import BAD_INPUT, FAILED
from pdcorrect.errors import FileFormatError, InputError, OutputError
from pdcorrect.evaluation import report
from pdcorrect.evaluation.compare import CASES
from pdcorrect.io import trajectory as files
from pdcorrect.io.trajectory import TrajectoryWriter, load_trajectory
from pdcorrect.solvers.rollout import StepLog, continue_from, differences


def content(path):
    """All that a file holds but the wall-clock seconds, byte by byte."""
    found = {}

    def note(name, item):
        if isinstance(item, h5py.Dataset) and name != "stats/seconds":
            kind = (item.dtype, item.shape, item.chunks, item.compression)
            found[name] = (*kind, item[...].tobytes())

    with h5py.File(path) as file:
        file.visititems(note)
        found |= {f"attribute {name}": file.attrs[name] for name in file.attrs}
    return found


def assert_same_file(path, expected):
    found, wanted = content(path), content(expected)
    assert list(found) == list(wanted)
    for name, value in wanted.items():
        assert found[name] == value, name
    assert not list(path.parent.glob(f"{path.name}*part*"))


# --- the file --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run():
    return remembering(trajectory())


def values(run, k):
    """Statistics of step ``k``, one of which comes late."""
    found = {name: array[k] for name, array in run.stats.items()}
    return found | ({"restarts": 2.0} if k >= 3 else {})


def write(path, run, **options):
    writer = TrajectoryWriter(
        path, run.points, run.cells, run.state(0),
        scene_toml=run.scene_toml, attributes=run.attributes, **options,
    )  # fmt: skip
    with writer:
        add(writer, run)


def add(writer, run, last=None):
    for k in range(writer.steps, len(run) if last is None else last):
        writer.append_values(run.state(k + 1), values(run, k))


def finish(path, run):
    """Resume a file and append the rest; returns the steps it held."""
    with TrajectoryWriter.resume(path) as writer:
        held = writer.steps
        add(writer, run)
    return held


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    write(path, run)
    return path


def test_a_file_left_between_any_two_writes_is_continued(run, whole, tmp_path, monkeypatch):
    """What a killed process leaves: the bytes on the disk, without what HDF5 still holds."""
    noted, left = [], {}  # what is on the disk again is tried once
    real = TrajectoryWriter._extend

    def note(file):
        if file.path.exists():
            noted.append(file._frames)
            left[file._frames, file.path.read_bytes()] = None

    def noting(self, name, entries):
        note(self)
        real(self, name, entries)
        note(self)

    with monkeypatch.context() as patch:
        patch.setattr(TrajectoryWriter, "_extend", noting)
        write(tmp_path / "noted.h5", run)
    assert len(noted) > 100
    assert len(left) > 80
    path = tmp_path / "run.h5"
    for records, data in left:
        path.write_bytes(data)
        assert finish(path, run) in (records - 1, records)
        assert_same_file(path, whole)


def test_a_file_cut_anywhere_is_continued(run, whole, tmp_path):
    data = whole.read_bytes()
    path = tmp_path / "run.h5"
    write(path, dataclasses.replace(run, times=run.times[:-1]))
    before_last = path.stat().st_size
    held = set()
    for length in (*range(100, before_last, 1994), *range(before_last - 500, len(data), 122)):
        path.write_bytes(data[:length])
        try:
            steps = finish(path, run)
        except FileFormatError:
            assert length < before_last
            assert path.read_bytes() == data[:length]
            continue
        held.add(steps)
        assert_same_file(path, whole)
    assert held >= {3, 4, 5}


@pytest.mark.parametrize("steps", [0, 1, 3, 6])
def test_a_closed_file_is_continued(run, whole, tmp_path, steps):
    path = tmp_path / "run.h5"
    write(path, dataclasses.replace(run, times=run.times[: steps + 1]))
    assert finish(path, run) == steps
    assert_same_file(path, whole)


def test_a_half_written_frame_of_a_closed_file_is_dropped(run, whole, tmp_path):
    path = tmp_path / "run.h5"
    write(path, dataclasses.replace(run, times=run.times[:5]))
    with h5py.File(path, "r+") as file:
        file["positions"].resize(6, axis=0)
        file["positions"][5] = 7.0
    assert finish(path, run) == 4
    assert_same_file(path, whole)


def test_a_damaged_frame_is_dropped_with_those_after_it(run, whole, tmp_path):
    path = tmp_path / "run.h5"
    data = bytearray(whole.read_bytes())
    with h5py.File(whole) as file:
        data[file["velocities"].id.get_chunk_info_by_coord((4, 0, 0)).byte_offset + 11] ^= 4
    path.write_bytes(data)
    assert finish(path, run) == 3
    assert_same_file(path, whole)


@pytest.mark.parametrize("error", [KeyboardInterrupt, Terminated, OutputError])
@pytest.mark.parametrize("reached", range(5))
def test_a_failure_while_reopening_loses_nothing(run, whole, tmp_path, monkeypatch, error, reached):
    path = tmp_path / "run.h5"
    cut = whole.read_bytes()[:-10]
    path.write_bytes(cut)
    real, left = TrajectoryWriter.append_values, count(reached, -1)

    def failing(self, *arguments):
        if not next(left):
            raise error("no more")
        real(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(TrajectoryWriter, "append_values", failing)
        with pytest.raises(error):
            TrajectoryWriter.resume(path)
    assert path.read_bytes() == cut
    assert list(tmp_path.iterdir()) == [path]
    finish(path, run)
    assert_same_file(path, whole)


def test_what_killed_writers_leave_behind_is_removed(run, whole, tmp_path, monkeypatch):
    """Killed before a file takes its place: at the beginning, at more datasets, at reopening."""
    path = tmp_path / "run.h5"
    real = Path.replace

    def replaced(self, target):
        if not next(left):
            raise Terminated
        return real(self, target)

    kills = 0
    for act in (write, lambda *_: finish(path, run)):
        for reached in range(20):
            left = count(reached, -1)
            with monkeypatch.context() as patch:
                patch.setattr(Path, "replace", replaced)
                patch.setattr(Path, "unlink", lambda *_, **__: None)  # the process is no more
                with contextlib.suppress(Terminated):
                    act(path, run)
                    break
            kills += 1
            assert list(tmp_path.glob("run.h5*part*"))
            if path.exists():
                finish(path, run)
            else:
                write(path, run)
            assert_same_file(path, whole)
            path.unlink() if act is write else path.write_bytes(whole.read_bytes()[:-10])
    assert kills >= 5


def test_no_beginning_is_half(run, tmp_path, monkeypatch):
    def half(self, data):
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise Terminated

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(Terminated):
        write(tmp_path / "run.h5", run)
    assert not list(tmp_path.iterdir())


def test_other_files_are_continued_or_refused_and_kept(run, whole, tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    with h5py.File(whole) as old, h5py.File(path, "w", libver="earliest") as new:
        old.visititems(lambda n, d: new.__setitem__(n, d[:]) if hasattr(d, "shape") else None)
        new.attrs.update(old.attrs)
    finish(path, run)
    assert_same_file(path, whole)

    path = tmp_path / "run.h5"
    for data in (b"", b"noise", whole.read_bytes()[:300]):
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match=r"run\.h5"):
            TrajectoryWriter.resume(path)
        assert path.read_bytes() == data
    path.write_bytes(whole.read_bytes())
    monkeypatch.setattr(files, "__version__", "9.9")
    with pytest.raises(InputError, match=rf"{re.escape(pc.__version__)}.*9\.9"):
        TrajectoryWriter.resume(path)
    assert path.read_bytes() == whole.read_bytes()


# --- the stepper -----------------------------------------------------------------------


def small(**changes):
    """A beam that swings for as long as it is looked at."""
    load = {
        "kind": "body-force", "density": [0.0, 3e3, -9e3],
        "table": [[0.1 * k, (-1.0) ** k] for k in range(500)],
    }  # fmt: skip
    return beam((3, 2, 2), loads=[load], **{"time": {"step": 0.01, "frames": 12}, **changes})


def test_a_run_is_the_same_run_whatever_its_number_of_frames_but_not_on_another_mesh():
    stepper = pc.ProjectiveDynamics(pc.discretise(small()))
    run = pc.rollout(stepper, 1)
    assert differences(stepper, run) == []
    longer = pc.ProjectiveDynamics(pc.discretise(small(time={"frames": 99})))
    assert differences(longer, run) == []
    moved = dataclasses.replace(run, points=run.points + 1e-15)
    assert "nodes" in "; ".join(differences(stepper, moved))
    lines = run.scene_toml.splitlines()
    (unwritten,) = (line for line in lines if line.startswith("spectral_radius"))
    older = "\n".join(line for line in lines if line != unwritten)  # so it has its default
    assert differences(stepper, dataclasses.replace(run, scene_toml=older)) == []
    foreign = dataclasses.replace(run, scene_toml="= no TOML")
    assert "unreadable" in "; ".join(differences(stepper, foreign))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time": {"step": 0.02}}, r"time\.step.* 0\.01.* 0\.02"),
        ({"material": {"young": 2e6}}, r"material\.young.* 1000000\.0.* 2000000\.0"),
        ({"solver": {"tolerance": 1e-4}}, "tolerance.* 1e-05.* 0.0001"),
        ({"solver": {"mass": "averaged"}}, "mass.* lumped.* averaged"),
        ({"body": {"cells": [4, 1, 1]}}, "nodes.*36.*20"),
        ({"clamps": []}, "clamps"),
    ],
)
def test_what_differs_from_the_run_so_far_is_named(change, words):
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(small())), 1)
    other = pc.ProjectiveDynamics(pc.discretise(small(**change)))
    assert re.search(words, "; ".join(differences(other, run)))
    with pytest.raises(InputError, match=words):
        continue_from(other, run)


def remember(patch):
    """Let steps depend on the number of steps before, by way of the state's memory."""
    real = pc.ProjectiveDynamics.__call__

    def stepped(self, state, forces=None):
        before = state.memory.get("steps", np.zeros_like(state.positions))
        result = real(self, state, 1e-3 * before)
        after = dataclasses.replace(result.state, memory={"steps": before + 1})
        return dataclasses.replace(result, state=after)

    patch.setattr(pc.ProjectiveDynamics, "__call__", stepped)


def test_a_rollout_keeps_and_passes_on_what_states_remember(monkeypatch):
    remember(monkeypatch)
    stepper = pc.ProjectiveDynamics(pc.discretise(small()))
    run = pc.rollout(stepper, 6)
    assert run.memory["steps"].shape == run.positions.shape
    assert np.isnan(run.memory["steps"][0]).all()
    assert (run.memory["steps"][6] == 6).all()
    first = pc.rollout(stepper, 2)
    second = pc.rollout(stepper, 4, state=continue_from(stepper, first))
    assert second.positions.tobytes() == run.positions[2:].tobytes()
    assert second.memory["steps"].tobytes() == run.memory["steps"][2:].tobytes()
    assert not pc.restrict(run, run).memory  # which is of the run's own mesh
    log = StepLog({**first.stats, "restarts": np.ones(2)})
    log.add(stepper(first.state(-1)), 0.5)
    stats = log.arrays()
    assert len(log) == 3
    np.testing.assert_array_equal(stats["residual"][:2], first.stats["residual"])
    np.testing.assert_array_equal(stats["restarts"], [1, 1, np.nan])
    assert stats["seconds"][2] == 0.5


# --- the program -----------------------------------------------------------------------


REMEMBERING = {
    "time": {"step": 0.01, "frames": 12, "integrator": "bdf2"},
    "damping": {"mass": 2.0, "stiffness": 2e-3},
    "solver": {"element": "hex8-bubble"},
}
"""A step needs the state before the last as well, and damps internal modes."""


@pytest.fixture
def scene_file(tmp_path, request):
    """Of the small beam, with the changes that a test asks for."""
    path = tmp_path / "scene.toml"
    changes = getattr(request, "param", {})
    path.write_text(small(**changes).to_toml(), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("scene_file", "solver"),
    [({}, "pd"), ({}, "newton"), (REMEMBERING, "pd"), (REMEMBERING, "newton")],
    ids=["plain", "plain by Newton", "damped bdf2", "damped bdf2 by Newton"],
    indirect=["scene_file"],
)
def test_a_run_in_three_parts_equals_one_at_once(program, scene_file, tmp_path, solver):
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    more = ("--solver", solver)
    assert program("simulate", scene_file, "-o", expected, *more)[0] == 0
    resume = ("simulate", scene_file, "-o", path, "--resume", *more)
    for held, frames in ((0, 3), (3, 7), (7, 12)):
        status, out, err = program(*resume, "--frames", frames)
        assert (status, err) == (0, "")
        assert f"{held} of {frames} frames" in out or not held
        assert len(load_trajectory(path)) == frames
    assert_same_file(path, expected)
    assert f"in {load_trajectory(path).stats['seconds'].sum():.2f} s" in out  # of all parts
    before = path.stat()
    status, out, _ = program(*resume, "--frames", 5)
    assert status == 0
    assert "nothing to do" in out
    assert os.path.samestat(path.stat(), before)
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    if solver == "pd" and "bdf2" not in scene_file.read_text(encoding="utf-8"):
        scene_file.write_text(small(time={"frames": 15}).to_toml(), encoding="utf-8")
        program("simulate", scene_file, "-o", expected, "--overwrite")
        assert program(*resume, "--vtu", tmp_path / "vtu")[0] == 0  # the longer scene is in it
        assert_same_file(path, expected)
        assert len(list((tmp_path / "vtu").glob("*.vtu"))) == 16


def test_another_run_is_not_continued(program, scene_file, tmp_path):
    path = tmp_path / "run.h5"
    program("simulate", scene_file, "-o", path, "--frames", 2)
    before = path.read_bytes()
    resume = ("simulate", scene_file, "-o", path, "--resume")
    for more, words in (
        (("--refine", "2"), "refine.* 1.* 2"),
        (("--solver", "newton"), "solver.*Newton"),
        (("--overwrite",), "--overwrite"),
    ):
        status, _, err = program(*resume, *more)
        assert status == BAD_INPUT
        assert re.search(words, err)
    scene_file.write_text(small(material={"density": 900.0}).to_toml(), encoding="utf-8")
    status, _, err = program(*resume)
    assert status == BAD_INPUT
    assert "run.h5" in err
    assert re.search(r"material\.density.* 1000\.0.* 900\.0", err)
    assert path.read_bytes() == before


def test_a_stepper_is_told_of_the_run_that_it_continues(program, scene_file, tmp_path, monkeypatch):
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    told = []
    real, real_restore = pc.ProjectiveDynamics.__call__, pc.ProjectiveDynamics.restore

    def restore(self, run):
        real_restore(self, run)
        told.append(run)
        self.taken = len(run)

    def adaptive(self, state, forces=None):
        self.taken = getattr(self, "taken", 0) + 1
        result = real(self, state, np.full_like(state.positions, 1e-3 * self.taken))
        return dataclasses.replace(result, stats={**result.stats, "taken": float(self.taken)})

    monkeypatch.setattr(pc.ProjectiveDynamics, "restore", restore)
    monkeypatch.setattr(pc.ProjectiveDynamics, "__call__", adaptive)
    program("simulate", scene_file, "-o", expected)
    program("simulate", scene_file, "-o", path, "--frames", 5)
    assert told == []
    halfway = load_trajectory(path)
    program("simulate", scene_file, "-o", path, "--resume")
    assert len(told) == 1
    assert_same(told[0], halfway)
    assert_same_file(path, expected)


def test_what_states_remember_is_taken_up_again(program, scene_file, tmp_path, monkeypatch):
    remember(monkeypatch)
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    program("simulate", scene_file, "-o", expected)
    program("simulate", scene_file, "-o", path, "--frames", 5)
    program("simulate", scene_file, "-o", path, "--resume")
    assert_same_file(path, expected)
    assert (load_trajectory(path).state(-1).memory["steps"] == 12).all()


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, INTERRUPTED), (signal.SIGTERM, TERMINATED)]
)
def test_a_signal_closes_the_file_and_the_run_can_go_on(
    program, scene_file, tmp_path, monkeypatch, request, number, status
):
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    program("simulate", scene_file, "-o", expected)
    real = pc.ProjectiveDynamics.__call__
    handler = signal.getsignal(signal.SIGTERM)
    # a shell without job control lets what it starts in the background ignore SIGINT
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, interrupt))

    def stopped(self, state, *rest):
        if state.time > 0.035:
            for _ in range(20):  # Python drops an exception that is raised in a destructor
                signal.raise_signal(number)
            pytest.fail("the step went on")
        return real(self, state, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(pc.ProjectiveDynamics, "__call__", stopped)
        ended, _, err = program("simulate", scene_file, "-o", path)
    assert ended == status
    assert "4 of 12 frames" in err
    assert "--resume" in err
    assert signal.getsignal(signal.SIGTERM) == handler
    assert len(load_trajectory(path)) == 4
    assert program("simulate", scene_file, "-o", path, "--resume")[0] == 0
    assert_same_file(path, expected)


def test_sigterm_inside_the_writing_of_a_frame_drops_only_that_frame(
    program, scene_file, tmp_path, monkeypatch
):
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    program("simulate", scene_file, "-o", expected)
    real = TrajectoryWriter._extend

    def stopped(self, name, entries):
        if self._frames == 6 and name == "stats/residual":
            signal.raise_signal(signal.SIGTERM)
        real(self, name, entries)

    with monkeypatch.context() as patch:
        patch.setattr(TrajectoryWriter, "_extend", stopped)
        assert program("simulate", scene_file, "-o", path)[0] == TERMINATED
    assert len(load_trajectory(path)) == 5
    h5py.File(path).close()  # HDF5 refuses files that were not closed
    program("simulate", scene_file, "-o", path, "--resume")
    assert_same_file(path, expected)


def test_sigterm_in_a_destructor_still_ends_the_run(program, scene_file, tmp_path, monkeypatch):
    """Python drops what is raised there."""

    class Fragile:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    real = pc.ProjectiveDynamics.__call__

    def stepped(self, state, *rest):
        if 0.015 < state.time < 0.025:
            Fragile()
        time.sleep(0.02)
        return real(self, state, *rest)

    monkeypatch.setattr(pc.ProjectiveDynamics, "__call__", stepped)
    hook = sys.unraisablehook
    status, _, err = program("simulate", scene_file, "-o", tmp_path / "run.h5")
    assert status == TERMINATED
    assert "ignored" not in err
    assert 2 <= len(load_trajectory(tmp_path / "run.h5")) < 12
    assert sys.unraisablehook is hook


def test_sigterm_while_a_report_is_written_leaves_no_half_of_a_file(
    program, scene_file, tmp_path, monkeypatch
):
    folder = tmp_path / "report"
    folder.mkdir()
    (folder / "report.csv").write_text("of yesterday")

    def half(self, data):
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Path, "write_bytes", half)
    arguments = ("compare", scene_file, "-o", folder, "--frames", 1, "--no-figures")
    status, _, err = program(*arguments, "--overwrite")
    assert status == TERMINATED
    assert "SIGTERM" in err
    assert [p.name for p in folder.iterdir()] == ["report.csv"]
    assert (folder / "report.csv").read_text() == "of yesterday"


def test_a_plot_appears_under_its_name_only_when_it_is_whole(tmp_path, monkeypatch):
    figure = pytest.importorskip("matplotlib.figure")
    comparison = pc.compare(small(), 2, cases=CASES[2:])

    def half(self, output, **options):
        Path(output).write_bytes(b"half a picture")
        raise Terminated

    monkeypatch.setattr(figure.Figure, "savefig", half)
    monkeypatch.setattr(pc.figures, "render", lambda *a, **k: None)
    with pytest.raises(Terminated):
        report.write_report(comparison, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"report.csv", "report.json", "index.html"}


# --- processes -------------------------------------------------------------------------


def run_with_limit(pipe, limit, *arguments):
    """The program in a copy of this process, with a limit on the size of a file, bytes."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    sys.argv, said, status = ["pdcorrect", *map(str, arguments)], io.StringIO(), 0
    try:
        with contextlib.redirect_stderr(said):
            main()
    except SystemExit as end:
        status = end.code
    pipe.send((status, said.getvalue()))
    os._exit(0)  # HDF5 may crash at its end


def start(*arguments):
    """The program in its own process."""
    return subprocess.Popen(
        [sys.executable, "-m", "pdcorrect", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def wait_for(process, condition):
    """Wait until the condition holds or the process has ended."""
    while process.poll() is None and not condition():
        time.sleep(0.002)


def swallow(pipe):
    with terminable():
        try:
            pipe.send("started")
            time.sleep(LIMIT)
        except BaseException:  # as some library might
            pipe.send("swallowed")
        time.sleep(LIMIT)


def closes(pipe):
    with terminable():
        try:
            pipe.send("started")
            time.sleep(LIMIT)
        finally:
            pipe.send("closing")
            time.sleep(0.2)
            pipe.send("closed")


def test_a_second_sigterm_ends_what_has_lost_the_first(fork, monkeypatch):
    monkeypatch.setattr(_files, "_CLOSING", 0.1)
    copy = fork(swallow)
    for expected in ("started", "swallowed"):
        assert copy.recv() == expected
        copy.terminate()
    time.sleep(0.2)
    copy.terminate()
    assert copy.join() == -signal.SIGTERM


def test_a_second_sigterm_is_ignored_while_files_are_closed(fork, monkeypatch):
    monkeypatch.setattr(_files, "_CLOSING", LIMIT)
    copy = fork(closes)
    assert copy.recv() == "started"
    copy.terminate()
    assert copy.recv() == "closing"
    copy.terminate()
    assert copy.recv() == "closed"


def test_a_run_on_a_full_disk_goes_on_when_there_is_room(program, fork, scene_file, tmp_path):
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    simulate = ("simulate", scene_file, "--frames", 150, "-o")
    program(*simulate, expected)
    limit = expected.stat().st_size * 2 // 3
    status, message = fork(run_with_limit, limit, *simulate, path).recv()
    assert status == FAILED
    assert "File too large" in message
    held = load_trajectory(path)
    assert 10 < len(held) < 150
    kept = path.read_bytes()
    status, message = fork(run_with_limit, limit // 4, *simulate, path, "--resume").recv()
    assert status == FAILED
    assert "run.h5" in message
    assert path.read_bytes() == kept
    assert sorted(p.name for p in tmp_path.glob("run*")) == ["run.h5"]
    assert program(*simulate, path, "--resume")[0] == 0
    assert_same_file(path, expected)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
@pytest.mark.parametrize(
    ("kills", "frames", "scene_file"),
    [
        # starts of the program; the files that they leave are continued above
        pytest.param(2, 400, {}, marks=pytest.mark.slow),
        pytest.param(20, 6000, {}, marks=pytest.mark.slow),
        pytest.param(10, 3000, REMEMBERING, marks=pytest.mark.slow),
    ],
    indirect=["scene_file"],
    ids=["plain", "plain, often", "damped bdf2"],
)
def test_a_run_killed_again_and_again_equals_one_that_was_not(
    program, scene_file, tmp_path, kills, frames
):
    path, expected = tmp_path / "run.h5", tmp_path / "expected.h5"
    simulate = ("simulate", scene_file, "--frames", frames, "-o")
    assert program(*simulate, expected)[0] == 0
    chance = random.Random(20)
    killed, steps = 0, []
    while killed < kills:
        process = start(*simulate, path, "--resume")
        try:
            if killed % 4:  # while frames are computed and written
                before = changed(path)
                wait_for(process, lambda seen=before: changed(path) != seen)
                if killed == kills - 1:  # however slow the machine is, not all in vain
                    wait_for(process, lambda: stored(path))
                time.sleep(chance.uniform(0.0, 0.1))
            else:  # anywhere, also before there is a file
                time.sleep(chance.uniform(0.0, 1.5))
        finally:
            process.kill()
            process.communicate()
        assert process.returncode == -signal.SIGKILL, "the run is too short to be killed"
        killed += 1
        if path.exists():
            steps.append(len(load_trajectory(path, salvage=True)))
    assert steps == sorted(steps)
    assert 0 < steps[-1] < frames
    process = start(*simulate, path, "--resume")
    process.communicate(timeout=300)
    assert process.returncode == 0
    assert_same_file(path, expected)


def stored(path):
    """Frames that a run has written so far."""
    try:
        return len(load_trajectory(path, salvage=True))
    except (FileFormatError, InputError):  # not begun, or no frame yet
        return 0


def changed(path):
    return path.stat().st_mtime_ns if path.exists() else 0


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs POSIX signals")
@pytest.mark.parametrize("command", ["simulate", "compare"])
def test_sigterm_ends_the_program_with_143(scene_file, tmp_path, command):
    scene_file.write_text(small(time={"frames": 90_000}).to_toml(), encoding="utf-8")
    path, folder = tmp_path / "run.h5", tmp_path / "report"
    process = start(command, scene_file, "-o", path if command == "simulate" else folder)
    wait_for(process, (path if command == "simulate" else folder).exists)
    time.sleep(0.2)
    process.terminate()
    _, message = process.communicate(timeout=60)
    assert process.returncode == TERMINATED
    assert "stopped" in message
    assert "Traceback" not in message
    if command == "simulate":
        assert f"{len(load_trajectory(path))} of 90000 frames" in message
        h5py.File(path).close()  # HDF5 refuses files that were not closed
    else:
        assert not list(folder.iterdir())
