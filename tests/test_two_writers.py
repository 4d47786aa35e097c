"""One program at a time writes a trajectory file; others are told, and its readers are not kept."""

import os
import subprocess
import sys

import h5py
import numpy as np
import pytest

from conftest import beam
from motion import assert_same, trajectory
from pdcorrect.errors import OutputError
from pdcorrect.io.trajectory import TrajectoryWriter, load_trajectory, save_trajectory

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no locks there")


def write(pipe, path):
    """Three frames, and the rest when told to, with another statistic if it is given a name."""
    run, late = trajectory(), {}
    try:
        with writer_of(path, run) as writer:
            for k in range(len(run)):
                values = {name: array[k] for name, array in run.stats.items()}
                writer.append_values(run.state(k + 1), values | late)
                if k == 2:
                    pipe.send("begun")
                    late = dict.fromkeys(pipe.recv(), 1.0)
    except OutputError as error:
        pipe.send(str(error))
    else:
        pipe.send("done")


@pytest.fixture
def other(fork, tmp_path):
    """A process that has written three frames."""
    writer = fork(write, tmp_path / "run.h5")
    assert writer.recv() == "begun"
    return writer


def writer_of(path, run):
    return TrajectoryWriter(path, run.points, run.cells, run.state(0), overwrite=True)


def test_the_second_writer_is_refused_and_the_first_one_s_run_intact(tmp_path, other):
    path, run = tmp_path / "run.h5", trajectory()
    attempts = [
        lambda: writer_of(path, run),
        lambda: save_trajectory(path, run, overwrite=True),
        lambda: TrajectoryWriter.resume(path),
    ]
    for attempt in attempts:
        with pytest.raises(OutputError, match=r"run\.h5: is being written by another program"):
            attempt()
    assert len(load_trajectory(path)) == 3
    with h5py.File(path, "r", swmr=True) as file:  # what other programs do
        assert len(file["times"]) == 4
    other.send(["late"])
    assert other.recv() == "done"
    assert len(load_trajectory(path)) == len(run)
    assert [file.name for file in tmp_path.iterdir()] == ["run.h5"]
    writer_of(path, run).close()  # the lock has ended with the process
    assert len(load_trajectory(path)) == 0


def test_a_killed_writer_keeps_nobody(tmp_path, other):
    other.kill()
    other.join()
    with TrajectoryWriter.resume(tmp_path / "run.h5") as writer:
        assert writer.steps == 3


@pytest.mark.parametrize("late", [[], ["late"]])
@pytest.mark.parametrize("replace", [True, False])
def test_a_writer_whose_file_was_replaced_or_moved_says_so(tmp_path, other, replace, late):
    path, run = tmp_path / "run.h5", trajectory()
    if replace:
        save_trajectory(tmp_path / "new.h5", run)
        (tmp_path / "new.h5").replace(path)
    else:
        path.rename(tmp_path / "moved.h5")
    other.send(late)
    assert "run.h5: has been replaced, moved or deleted by another program" in other.recv()
    if replace:
        assert_same(load_trajectory(path), run)
    else:
        assert not path.exists()


def test_of_writers_that_start_at_once_one_writes(tmp_path):
    """Each finds no file, and its part is written before another's takes the name."""
    path, run = tmp_path / "run.h5", trajectory()
    with writer_of(path, run) as first:
        late = object.__new__(type(first._lock))
        late.path, late._file, late._status = path, None, None
        with pytest.raises(OutputError, match="is being written"):
            late.write(b"precious")
        first.append_values(run.state(1), {})
    assert len(load_trajectory(path)) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["run.h5"]


def test_a_failed_writer_and_one_that_is_forgotten_keep_nobody(tmp_path):
    path, run = tmp_path / "run.h5", trajectory()
    writer = writer_of(path, run)
    del writer
    with pytest.raises(ZeroDivisionError), writer_of(path, run):
        raise ZeroDivisionError
    save_trajectory(path, run, overwrite=True)
    assert_same(load_trajectory(path), run)


HOLDER = """
import fcntl, sys
file = open(sys.argv[1], "rb")
fcntl.flock(file, fcntl.LOCK_SH)
print("held", flush=True)
sys.stdin.readline()
"""


def test_a_file_that_another_program_reads_is_written(tmp_path):
    """HDF5's own locks are not asked for."""
    path, run = tmp_path / "run.h5", trajectory()
    writer, command = writer_of(path, run), [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        writer.append_values(run.state(1), {})
        writer.close()
        holder.communicate(b"\n")
    assert len(load_trajectory(path)) == 1


@pytest.mark.parametrize(
    ("number", "words"),
    [(11, "open in another program"), (37, "no locks.*HDF5_USE_FILE_LOCKING=FALSE")],
)
def test_lock_errors_of_hdf5_are_explained(tmp_path, monkeypatch, number, words):
    path, run = tmp_path / "run.h5", trajectory()
    with writer_of(path, run) as writer:
        refused = OSError(number, os.strerror(number))
        monkeypatch.setattr(h5py, "File", lambda *_, **__: (_ for _ in ()).throw(refused))
        with pytest.raises(OutputError, match=words):
            writer.append_values(run.state(1), {})
    monkeypatch.undo()
    assert len(load_trajectory(path)) == 0


def test_the_program_is_refused_with_one_line(tmp_path, other, program):
    (tmp_path / "scene.toml").write_text(beam((2, 1, 1), time={"frames": 2}).to_toml())
    command = "simulate", tmp_path / "scene.toml", "-o", tmp_path / "run.h5", "--overwrite"
    status, _, err = program(*command)
    assert status == 1
    assert "is being written by another program" in err
    other.send([])
    assert other.recv() == "done"
    assert program(*command)[0] == 0
    assert np.isfinite(load_trajectory(tmp_path / "run.h5").positions).all()
