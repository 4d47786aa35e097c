"""Trajectories in HDF5: written frame by frame, readable at any moment.

Layout: ``positions`` and ``velocities`` (T+1, N, 3), ``times`` (T+1,),
``mesh/points``, ``mesh/cells``, ``stats/<name>`` (T,), and ``memory/<name>``
(T+1, N, 3) if the states remember anything; the scene and the attributes of the
run are attributes of the file.  The length of ``times`` counts the complete frames.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import part_of, replacing
from pdcorrect._version import __version__
from pdcorrect.errors import InputError, OutputError
from pdcorrect.io.growing_file import Column, GrowingFile
from pdcorrect.io.trajectory_reader import (
    FORMAT,
    RESERVED,
    VERSION,
    load_trajectory,
    read_storage,
    trajectory_fault,
)
from pdcorrect.state import State, StepResult
from pdcorrect.trajectory import Trajectory

__all__ = ["TrajectoryWriter", "load_trajectory", "save_trajectory"]

_FLOAT = np.dtype(np.float64)


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
    compress : bool
        gzip with byte shuffling; smaller files, slower writing.

    Raises
    ------
    InputError
        If arrays contradict each other.
    OutputError
        If the file cannot be created.

    Examples
    --------
    >>> with TrajectoryWriter("run.h5", points, cells, state) as writer:  # doctest: +SKIP
    ...     writer.append(result, seconds=0.01)
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
        compress: bool = False,
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
        self._shape = first.points.shape
        self._file = GrowingFile(
            Path(path),
            _frame_columns(self._shape) | _memory_columns(initial.memory, self._shape),
            "times",
            _entries(initial),
            _file_attributes(first),
            {"mesh/points": first.points, "mesh/cells": first.cells},
            overwrite=overwrite,
            compress=compress,
        )
        self._time = initial.time

    @classmethod
    def resume(cls, path: str | Path, run: Trajectory | None = None) -> TrajectoryWriter:
        """Reopen a finished or interrupted file, to append after its last complete frame.

        A file that was not closed, or has a damaged or half-written frame, is
        first rewritten without it; until that is done the old one stays.

        Parameters
        ----------
        path : path
            No other process may be writing it.
        run : Trajectory, optional
            What the file is to hold before the next frame; by default what
            ``load_trajectory(path, salvage=True)`` reads from it.

        Raises
        ------
        FileFormatError
            If no frame can be read.
        InputError
            If another version of this package wrote the file.
        OutputError
            If the file cannot be rewritten; it is unchanged.
        """
        path = Path(path)
        stored = read_storage(path)
        if stored.version != __version__:
            raise InputError(
                f"{path}: written by pdcorrect {stored.version}, this is {__version__}: continue "
                "it with the version that began it, or start again."
            )
        run = load_trajectory(path, salvage=True) if run is None else run
        _refuse(run)
        file = _reopened(path, run)
        if file is None:
            _rewrite(path, run, stored.compressed)
            file = _reopened(path, run)
        if file is None:
            raise OutputError(f"{path}: has changed meanwhile; is another process writing it?")
        for stale in (part_of(path), part_of(part_of(path))):  # of a killed process
            stale.unlink(missing_ok=True)
        writer = cls.__new__(cls)
        writer._file, writer._shape, writer._time = file, run.points.shape, float(run.times[-1])
        return writer

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    @property
    def steps(self) -> int:
        """Steps in the file, the initial state not counted."""
        return self._file.complete - 1

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
            If the disk is full or fails; the frames before are intact.
        """
        values: dict[str, Any] = {name: float(value) for name, value in result.stats.items()}
        values["status"] = result.status.name
        values["iterations"] = int(result.iterations)
        values["residual"] = float(result.residual)
        values["error_estimate"] = float(result.error_estimate)
        values["seconds"] = float(seconds)
        self.append_values(result.state, values)

    def append_values(self, state: State, values: Mapping[str, Any]) -> None:
        """Write one frame with statistics by name: numbers, and ``status`` as text."""
        columns = _stats_columns(values) | _memory_columns(state.memory, self._shape)
        self._check(state)
        entries = {f"stats/{name}": value for name, value in values.items()}
        self._file.append(entries | _entries(state), columns)
        self._time = state.time

    def close(self) -> None:
        """Finish the file; harmless when repeated."""
        self._file.close()

    def _check(self, state: State) -> None:
        where = f"{self.path}: frame {self._file.records}"
        if state.positions.shape != self._shape:
            raise InputError(f"{where}: {state.positions.shape} positions, expected {self._shape}.")
        arrays = (state.positions, state.velocities, *state.memory.values())
        if not all(np.isfinite(array).all() for array in arrays):
            raise InputError(f"{where}: infinite or NaN entries; only finite states are stored.")
        if not state.time > self._time:
            raise InputError(f"{where}: time {state.time} s, expected more than {self._time} s.")


def save_trajectory(
    path: str | Path, trajectory: Trajectory, overwrite: bool = False, compress: bool = False
) -> None:
    """Write a whole trajectory; `load_trajectory` returns the same arrays, bit by bit.

    Parameters are those of `TrajectoryWriter`.

    Raises
    ------
    InputError
        If its arrays contradict each other; nothing is written.
    OutputError
        If the file cannot be written.
    """
    _refuse(trajectory)
    with TrajectoryWriter(
        path,
        trajectory.points,
        trajectory.cells,
        trajectory.state(0),
        scene_toml=trajectory.scene_toml,
        attributes=trajectory.attributes,
        overwrite=overwrite,
        compress=compress,
    ) as writer:
        for k in range(len(trajectory)):
            values = {name: array[k] for name, array in trajectory.stats.items()}
            writer.append_values(trajectory.state(k + 1), values)


def _refuse(trajectory: Trajectory) -> None:
    fault = trajectory_fault(trajectory)
    if fault:
        raise InputError(f"this trajectory cannot be saved: {fault}.")
    taken = sorted(set(trajectory.attributes) & RESERVED)
    if taken:
        raise InputError(f"attribute {taken[0]!r} is the file's own: choose another name.")
    _columns(trajectory)


def _reopened(path: Path, run: Trajectory) -> GrowingFile | None:
    return GrowingFile.reopen(path, _columns(run), "times", len(run.times), _file_attributes(run))


def _rewrite(path: Path, run: Trajectory, compress: bool) -> None:
    try:
        with replacing(path) as part:
            save_trajectory(part, run, overwrite=True, compress=compress)
    except OSError as error:
        raise OutputError(
            f"{path}: is unchanged, but the copy to continue with failed: {error}"
        ) from error


def _entries(state: State) -> dict[str, Any]:
    memory = {f"memory/{name}": array for name, array in state.memory.items()}
    return memory | {
        "positions": state.positions, "velocities": state.velocities, "times": state.time
    }  # fmt: skip


def _columns(run: Trajectory) -> dict[str, Column]:
    """All growing datasets of a run's file."""
    values = {name: array[0] if len(array) else array for name, array in run.stats.items()}
    stats, shape = _stats_columns(values), run.points.shape
    fixed = _frame_columns(shape) | _memory_columns(run.memory, shape)
    return fixed | stats if len(run) else fixed  # statistics come with the first step


def _frame_columns(shape: tuple[int, ...]) -> dict[str, Column]:
    nodal = Column(_FLOAT, shape)
    return {"positions": nodal, "velocities": nodal, "times": Column(_FLOAT)}


def _memory_columns(memory: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, Column]:
    for name in memory:
        if name in ("", ".") or "/" in name:
            raise InputError(f"memory {name!r}: expected a name without '/'.")
    return {f"memory/{name}": Column(_FLOAT, shape) for name in memory}


def _stats_columns(values: Mapping[str, Any]) -> dict[str, Column]:
    return {f"stats/{name}": _column(name, value) for name, value in values.items()}


def _column(name: str, value: Any) -> Column:
    """How a statistic is stored: text, 64-bit integers or floats."""
    kind = np.asarray(value).dtype.kind
    if name in ("", ".") or "/" in name or (kind == "U") != (name == "status"):
        raise InputError(f"stats {name!r} of kind {kind!r}: expected numbers, and status as text.")
    if kind == "U":
        return Column(np.dtype(h5py.string_dtype("ascii", 32)), first=1)
    if kind not in "iubf":
        raise InputError(f"stats {name!r} of kind {kind!r}: expected real numbers.")
    return Column(_FLOAT if kind == "f" else np.dtype(np.int64), first=1)


def _file_attributes(trajectory: Trajectory) -> dict[str, str | int]:
    return {
        **trajectory.attributes,
        "format": FORMAT,
        "format_version": VERSION,
        "scene_toml": trajectory.scene_toml,
        "pdcorrect_version": __version__,
    }
