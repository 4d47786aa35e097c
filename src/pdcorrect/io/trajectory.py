"""Trajectories in HDF5: written frame by frame, readable at any moment.

Layout: ``positions`` and ``velocities`` (T+1, N, 3), ``times`` (T+1,),
``mesh/points``, ``mesh/cells``, ``stats/<name>`` (T,), and ``memory/<name>``
(T+1, N, 3) if the states remember anything; the scene and the attributes of the
run are attributes of the file.

A frame is one chunk, with a checksum, of every growing dataset.  ``times`` counts the
complete frames, because it is written after the others have reached the file.  While it
grows the file is in HDF5's single-writer/multiple-reader mode, which keeps readable what
was flushed: a killed writer and a full disk leave the frames before.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import check_new, part_of, replacing
from pdcorrect._version import __version__
from pdcorrect.errors import InputError, OutputError
from pdcorrect.io.trajectory_reader import (
    FORMAT,
    RESERVED,
    VERSION,
    file_end,
    load_trajectory,
    trajectory_fault,
    written_by,
)
from pdcorrect.io.write_lock import WriteLock
from pdcorrect.state import State, StepResult
from pdcorrect.trajectory import Trajectory

__all__ = ["TrajectoryWriter", "load_trajectory", "save_trajectory"]

_LIBRARY = ("v110", "v110")  # readable by HDF5 1.10 and later; what the swmr mode needs
_STATUS = h5py.string_dtype("ascii", 32)
_FILL = {"f": np.nan, "i": -1, "S": b""}
_REPLACE = (
    "choose another name, overwrite it with --overwrite (overwrite=True), or continue it with "
    "--resume (TrajectoryWriter.resume)"
)
_REMEDIES = {
    errno.EAGAIN: "It is open in another program: close it, or set HDF5_USE_FILE_LOCKING=FALSE.",
    errno.ENOLCK: "The file system has no locks: set HDF5_USE_FILE_LOCKING=FALSE.",
}
"""Of HDF5's own locks, which it takes only where the environment says so."""


class TrajectoryWriter:
    """Writes a run to an HDF5 file while it is computed; a context manager.

    If the process is killed, the file holds every frame that was complete.

    Parameters
    ----------
    path : path
        New file, in an existing folder.
    points : (N, 3) float
        Rest positions, m.
    cells : (C, K) int
        Node numbers, VTK order.
    initial : State
        Frame 0.
    scene_toml : str
        The scene that is run.
    attributes : mapping of str to str
        Solver, refinement and the like.
    overwrite : bool
        Replace an existing file, at once.

    Raises
    ------
    InputError
        If arrays contradict each other.
    OutputError
        If the file cannot be created, or another program is writing it.
    """

    def __init__(
        self,
        path: str | Path,
        points: NDArray[np.float64],
        cells: NDArray[np.int64],
        initial: State,
        *,
        scene_toml: str = "",
        attributes: Mapping[str, str] | None = None,
        overwrite: bool = False,
    ) -> None:
        first = Trajectory(
            positions=initial.positions[None],
            velocities=initial.velocities[None],
            times=np.array([initial.time]),
            stats={},
            points=np.ascontiguousarray(points, dtype=np.float64),
            cells=np.ascontiguousarray(cells, dtype=np.int64),
            scene_toml=scene_toml,
            attributes=dict(attributes or {}),
            memory={name: array[None] for name, array in initial.memory.items()},
        )
        _refuse(first)
        check_new(Path(path), overwrite=overwrite, remedy=_REPLACE)
        self._shape, self._time = first.points.shape, initial.time
        self._frames = 0
        self._growing: list[str] = []  # datasets but for times
        self._broken, self._reserved = False, 0
        with contextlib.ExitStack() as undo:
            self._lock = undo.enter_context(WriteLock(Path(path)))
            with io.BytesIO() as memory:  # HDF5 may crash where a disk is full
                self._begin(memory, first, initial)
                self._lock.write(memory.getvalue())
            undo.pop_all()

    @classmethod
    def resume(cls, path: str | Path, run: Trajectory | None = None) -> TrajectoryWriter:
        """Continue a finished or interrupted file after its last complete frame.

        The file is first rewritten, without what is damaged or half written; until that is done the
        old one stays.  ``run`` is what it is to hold before
        the next frame; by default what ``load_trajectory(path, salvage=True)`` reads from it.

        Raises
        ------
        FileFormatError
            If no frame can be read.
        InputError
            If another version of this package wrote the file.
        OutputError
            If another program is writing the file, or it cannot be rewritten; it is unchanged.
        """
        path = Path(path)
        with WriteLock(path):
            version = written_by(path)
            if version != __version__:
                raise InputError(
                    f"{path}: written by pdcorrect {version}, this is {__version__}: continue "
                    "it with the version that began it, or start again."
                )
            run = load_trajectory(path, salvage=True) if run is None else run
            part_of(part_of(path)).unlink(missing_ok=True)  # of a killed process
            try:
                with replacing(path) as part:
                    writer = cls._written(part, run, overwrite=True)
            except OSError as error:
                raise OutputError(
                    f"{path}: is unchanged, but the copy to continue with failed: {error}"
                ) from error
            writer._lock.path = path
        return writer

    @classmethod
    def _written(cls, path: Path, run: Trajectory, overwrite: bool) -> TrajectoryWriter:
        """The writer of a whole trajectory, which keeps the lock and opens the file for more."""
        _refuse(run)
        writer = cls(
            path, run.points, run.cells, run.state(0), scene_toml=run.scene_toml,
            attributes=run.attributes, overwrite=overwrite,
        )  # fmt: skip
        with contextlib.ExitStack() as undo:
            undo.enter_context(writer)
            for k in range(len(run)):
                values = {name: array[k] for name, array in run.stats.items()}
                writer.append_values(run.state(k + 1), values)
            writer._finish()
            undo.pop_all()
        return writer

    def _begin(self, memory: io.BytesIO, first: Trajectory, initial: State) -> None:
        """Write the mesh and frame 0."""
        with h5py.File(memory, "w", libver=_LIBRARY) as self._file:
            self._file.attrs.update(_file_attributes(first))
            for name, mesh in {"points": first.points, "cells": first.cells}.items():
                self._file.create_dataset(
                    f"mesh/{name}", data=mesh, chunks=mesh.shape, fletcher32=True
                )
            self._add(_entries(initial, {}))
            self._write(_entries(initial, {}))

    @property
    def path(self) -> Path:
        """Of the file."""
        return self._lock.path

    @property
    def steps(self) -> int:
        """Steps in the file, also where a signal came before the last was counted."""
        open_now = self._file and not self._broken
        return (len(self._file["times"]) if open_now else self._frames) - 1

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        # what stopped the run matters more than a failure to close its file
        with contextlib.suppress(OutputError) if kind else contextlib.nullcontext():
            self.close()

    def append(self, result: StepResult, seconds: float) -> None:
        """Write one step's frame and statistics; ``seconds`` of wall clock.

        Raises
        ------
        InputError
            If the state does not fit the file or is not finite.
        OutputError
            If the disk is full or fails; the frames before are intact.  If another program has
            replaced the file.
        """
        values: dict[str, Any] = {name: float(value) for name, value in result.stats.items()}
        values["status"] = result.status.name
        values["iterations"] = int(result.iterations)
        values["residual"] = float(result.residual)
        values["error_estimate"] = float(result.error_estimate)
        values["seconds"] = float(seconds)
        self.append_values(result.state, values)

    def append_values(self, state: State, values: Mapping[str, Any]) -> None:
        """Write one frame with statistics by name: numbers, and ``status`` as text.

        Those that other frames have are NaN, -1 or empty where they are left out.
        """
        _check_names(values, state.memory)
        self._check(state)
        if self._broken:
            raise OutputError(f"{self.path}: nothing more can be written after a failure.")
        self._check_own()
        entries = _entries(state, values)
        new = {n: x for n, x in entries.items() if n not in (*self._growing, "times")}
        if new or not self._file:
            self._open(new)
        with self._reporting():
            self._reserve(entries)
            self._write(entries)
        self._time = state.time

    def close(self) -> None:
        """Finish the file and let others write it; harmless when repeated."""
        try:
            self._finish()
        finally:
            self._lock.release()

    def _finish(self) -> None:
        if self._file and not self._broken:
            self._check_own()
            with self._reporting():
                self._file.close()
                if self._reserved:
                    os.truncate(self.path, file_end(self.path))

    def _check_own(self) -> None:
        """Give up a file whose name another one has by now."""
        try:
            self._lock.acquire()
        except OutputError:
            self._broken = True
            with contextlib.suppress(OSError, RuntimeError):
                self._file.close()
            raise

    def _check(self, state: State) -> None:
        where = f"{self.path}: frame {self._frames}"
        if state.positions.shape != self._shape:
            raise InputError(f"{where}: {state.positions.shape} positions, expected {self._shape}.")
        arrays = (state.positions, state.velocities, *state.memory.values())
        if not all(np.isfinite(array).all() for array in arrays):
            raise InputError(f"{where}: infinite or NaN entries; only finite states are stored.")
        if not state.time > self._time:
            raise InputError(f"{where}: time {state.time} s, expected more than {self._time} s.")

    def _open(self, new: Mapping[str, Any]) -> None:
        """Open the file, with more datasets; they are added to a copy that then replaces it."""
        self._finish()
        with self._reporting():
            if new:
                with io.BytesIO(self.path.read_bytes()) as memory:
                    with h5py.File(memory, "r+", libver=_LIBRARY) as self._file:
                        self._add(new)
                    self._lock.write(memory.getvalue())
            self._reserved = 0
            self._file = h5py.File(self.path, "r+", libver=_LIBRARY, locking=False)
            self._file.swmr_mode = True

    def _reserve(self, entries: Mapping[str, Any]) -> None:
        """Make room for a frame and the blocks of its index: HDF5 may crash on a full disk."""
        size = 2 * sum(np.asarray(entry).nbytes for entry in entries.values())
        size += 256 * (16 + math.isqrt(self._frames)) * len(entries) + 32768
        used = self._file.id.get_filesize()
        if used + size <= self._reserved or not hasattr(os, "posix_fallocate"):
            return
        with self.path.open("r+b") as file:
            try:
                os.posix_fallocate(file.fileno(), used, size)
            except OSError as error:
                if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS):
                    raise
        self._reserved = used + size

    def _add(self, entries: Mapping[str, Any]) -> None:
        """Create growing datasets, with the fill value for the frames before."""
        for name, value in entries.items():
            kind, shape, before = np.asarray(value).dtype.kind, np.shape(value), self._place(name)
            dtype = np.dtype(_STATUS if kind == "U" else np.float64 if kind == "f" else np.int64)
            dataset = self._file.create_dataset(
                name, (before, *shape), dtype, maxshape=(None, *shape), chunks=(1, *shape),
                fillvalue=_FILL[dtype.kind], fletcher32=True,
            )  # fmt: skip
            if before:
                dataset[...] = _FILL[dtype.kind]
        self._growing += [name for name in entries if name != "times"]

    def _write(self, entries: Mapping[str, Any]) -> None:
        for name in self._growing:
            self._extend(name, entries)
        self._file.flush()
        self._extend("times", entries)
        self._file.flush()
        self._frames += 1

    def _extend(self, name: str, entries: Mapping[str, Any]) -> None:
        dataset, place = self._file[name], self._place(name)
        dataset.resize(place + 1, axis=0)
        dataset[place] = entries.get(name, _FILL[dataset.dtype.kind])

    def _place(self, name: str) -> int:
        """Of the next frame in a dataset: statistics begin with the first step."""
        return self._frames - name.startswith("stats/")

    @contextlib.contextmanager
    def _reporting(self) -> Iterator[None]:
        """Turn what HDF5 raises into `OutputError`, and give the file up."""
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            self._broken = True
            if self._file:
                _abandon(self._file, self.path)
            number = getattr(error, "errno", None)
            reason = " ".join(str(error).split()) if number is None else os.strerror(number)
            remedy = _REMEDIES.get(number or 0, "Free some space or choose another place.")
            raise OutputError(
                f"{self.path}: cannot be written ({reason}); its first {self._frames} "
                f"frames are intact. {remedy}"
            ) from error


def save_trajectory(path: str | Path, trajectory: Trajectory, overwrite: bool = False) -> None:
    """Write a whole trajectory; `load_trajectory` returns the same arrays, bit by bit.

    Raises
    ------
    InputError
        If its arrays contradict each other; nothing is written.
    OutputError
        If the file cannot be written.
    """
    TrajectoryWriter._written(Path(path), trajectory, overwrite).close()


def _refuse(trajectory: Trajectory) -> None:
    fault = trajectory_fault(trajectory)
    if fault:
        raise InputError(f"this trajectory cannot be saved: {fault}.")
    taken = sorted(set(trajectory.attributes) & RESERVED)
    if taken:
        raise InputError(f"attribute {taken[0]!r} is the file's own: choose another name.")
    _check_names(trajectory.stats, trajectory.memory)


def _check_names(stats: Mapping[str, Any], memory: Mapping[str, Any]) -> None:
    for name in memory:
        if name in ("", ".") or "/" in name:
            raise InputError(f"memory {name!r}: expected a name without '/'.")
    for name, value in stats.items():
        kind = np.asarray(value).dtype.kind
        expected = "U" if name == "status" else "iubf"
        if name in ("", ".") or "/" in name or kind not in expected:
            raise InputError(f"stats {name!r} of kind {kind!r}: expected numbers, status as text.")


def _entries(state: State, values: Mapping[str, Any]) -> dict[str, Any]:
    """A frame, by the names of the datasets."""
    stats = {f"stats/{name}": value for name, value in values.items()}
    memory = {f"memory/{name}": array for name, array in state.memory.items()}
    nodal = {"positions": state.positions, "velocities": state.velocities}
    return stats | memory | nodal | {"times": state.time}


def _file_attributes(trajectory: Trajectory) -> dict[str, Any]:
    """Texts have a fixed length, so that they lie under the checksum of the file's index."""
    own = {"format": FORMAT, "scene_toml": trajectory.scene_toml, "pdcorrect_version": __version__}
    texts = {name: text.encode() for name, text in {**trajectory.attributes, **own}.items()}
    fixed = {
        name: np.array(data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))
        for name, data in texts.items()
    }
    return fixed | {"format_version": VERSION}


def _abandon(file: Any, path: Path) -> None:
    """Close an h5py file that can no longer be written, without changing it on the disk.

    HDF5, which would write its metadata, finishes on a scratch copy, if there is room for one.
    """
    with contextlib.suppress(Exception), tempfile.TemporaryFile() as scratch:
        with path.open("rb") as original:
            shutil.copyfileobj(original, scratch)
        scratch.flush()
        os.dup2(scratch.fileno(), file.id.get_vfd_handle())
        file.close()
