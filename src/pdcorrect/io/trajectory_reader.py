"""Reading trajectory files, also damaged ones: every fault becomes one sentence."""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np

from pdcorrect.errors import FileFormatError, FileVersionError, InputError
from pdcorrect.state import Status
from pdcorrect.trajectory import Trajectory

if TYPE_CHECKING:
    from pdcorrect.fem.problem import Problem

FORMAT = "pdcorrect-trajectory"
VERSION = 1
RESERVED = frozenset({"format", "format_version", "scene_toml", "pdcorrect_version"})
"""Attributes of the file that are not the run's."""


def load_trajectory(path: str | Path, salvage: bool = False) -> Trajectory:
    """Read a trajectory file of `TrajectoryWriter`, finished or not.

    A file that is still being written, or whose writer was killed, is read up to its last complete
    frame.  ``salvage``: of a truncated or damaged file, return the frames before the damage.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is not a trajectory, or is damaged; says which, and how many
        frames could be salvaged.
    FileVersionError
        If it is of another version of the format.
    """
    with _opened(Path(path)) as (file, extent):
        return _read(file, extent, salvage)


def written_by(path: Path) -> str:
    """The version of pdcorrect that wrote a trajectory file; raises as `load_trajectory`."""
    with _opened(path) as (file, _):
        _check_format(file)
        name = "pdcorrect_version"
        return _attribute(file, name) if name in file.attrs else "of an unknown version"


class _Extent(NamedTuple):
    """Bytes that a file has and should have, and whether its writer never closed it."""

    size: int
    end: int
    in_writing: bool

    @property
    def truncated(self) -> bool:
        return self.size < self.end

    def lost(self) -> str:
        return f"expected {self.end} bytes, got {self.size}"


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, _Extent]]:
    """A file, open; whatever its content makes HDF5 raise becomes `FileFormatError`."""
    extent = _extent(path)
    try:
        unfinished = extent.truncated or extent.in_writing
        with (
            _Closed(path, extent) if unfinished else contextlib.nullcontext(path) as source,
            h5py.File(source, "r", locking=False) as file,
        ):
            yield file, extent
    except FileFormatError as error:
        raise type(error)(f"{path}: {error}.") from None
    except Exception as error:  # HDF5 raises nearly every type on damaged bytes
        lost = f"truncated ({extent.lost()})" if extent.truncated else "damaged"
        reason = " ".join(str(error.args[0] if error.args else type(error).__name__).split())
        raise FileFormatError(
            f"{path}: {lost}, with its index lost, so that no frame can be read ({reason})."
        ) from error


_SUPERBLOCK = struct.Struct("<9sBxB16xQ8xI")
"""HDF5's first bytes, version 3: signature, size of offsets, flags, end of file, checksum."""
_WORD = 0xFFFFFFFF
_SIGNATURE = b"\x89HDF\r\n\x1a\n\x03"  # with the version


def _extent(path: Path) -> _Extent:
    try:
        with path.open("rb") as file:
            head, size = file.read(_SUPERBLOCK.size), os.fstat(file.fileno()).st_size
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror}).") from None
    if not _SIGNATURE.startswith(head[:8]):
        raise FileFormatError(f"{path}: not an HDF5 file: expected a trajectory of pdcorrect.")
    if len(head) < _SUPERBLOCK.size:
        raise FileFormatError(f"{path}: truncated: no frame is left in {size} bytes.")
    signature, offsets, flags, end, checksum = _SUPERBLOCK.unpack(head)
    if signature != _SIGNATURE or offsets != 8:  # of another program: HDF5 checks it
        return _Extent(size, 0, False)
    if checksum != _lookup3(head[:-4]):
        raise FileFormatError(f"{path}: damaged: the checksum of its first bytes is wrong.")
    return _Extent(size, end, flags != 0)


def file_end(path: Path) -> int:
    """Bytes that HDF5 has used of a closed file of its own."""
    return _extent(path).end


class _Closed(io.FileIO):
    """A file read as if its writer had closed it, filled up to its whole length.

    HDF5 refuses it as it is, and its reading mode for files in writing waits for ever where
    something is damaged.  Every index and chunk of a trajectory has a checksum, so what is filled
    in is noticed and never taken for data; zeros would be, whose checksum is zero.
    """

    def __init__(self, path: Path, extent: _Extent) -> None:
        super().__init__(path)
        self._end = max(extent.size, extent.end)
        self._head = bytearray(self.read(_SUPERBLOCK.size))
        struct.pack_into("<B", self._head, 11, 0)
        struct.pack_into("<Q", self._head, 28, self._end)
        struct.pack_into("<I", self._head, 44, _lookup3(bytes(self._head[:44])))

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a byte; the end is that of the whole length."""
        return super().seek(offset + self._end * (whence == io.SEEK_END))

    def readinto(self, buffer: Any) -> int:
        """Fill the whole buffer."""
        start, view = self.tell(), memoryview(buffer)
        count = super().readinto(view)
        view[count:] = b"\1" * (len(view) - count)
        head = self._head[start : start + len(view)]
        view[: len(head)] = head
        return len(view)


def _lookup3(data: bytes) -> int:
    """Bob Jenkins's lookup3 hash of the superblock's 44 bytes, HDF5's checksum of metadata."""
    a = b = c = (0xDEADBEEF + len(data)) & _WORD
    *blocks, last = struct.iter_unpack("<3I", data.ljust(48, b"\0"))
    for x, y, z in blocks:
        a, b, c = (a + x) & _WORD, (b + y) & _WORD, (c + z) & _WORD
        for shift in (4, 6, 8, 16, 19, 4):
            a = ((a - c) & _WORD) ^ _rotated(c, shift)
            a, b, c = b, (c + b) & _WORD, a
    a, b, c = ((p + q) & _WORD for p, q in zip((a, b, c), last, strict=True))
    for shift in (14, 11, 25, 16, 4, 14, 24):
        a, b, c = b, ((c ^ b) - _rotated(b, shift)) & _WORD, a
    return b


def _rotated(x: int, k: int) -> int:
    return ((x << k) | (x >> (32 - k))) & _WORD


def trajectory_fault(trajectory: Trajectory) -> str | None:
    """What contradicts the description of `Trajectory`, or None."""
    frames, nodes = len(trajectory.times), len(trajectory.points)
    expected = {
        "positions": (trajectory.positions, (frames, nodes, 3)),
        "velocities": (trajectory.velocities, (frames, nodes, 3)),
        "times": (trajectory.times, (frames,)),
        "points": (trajectory.points, (nodes, 3)),
    }
    for name, (array, shape) in expected.items():
        if array.shape != shape or array.dtype != np.float64:
            return f"{name} has {array.dtype} of shape {array.shape}, expected float64 of {shape}"
        if not np.isfinite(array).all():
            return f"{name} has infinite or NaN entries"
    if not frames or not nodes:
        return "it has no frames" if nodes else "it has no nodes"
    if (np.diff(trajectory.times) <= 0).any():
        return "times do not increase"
    for name, array in trajectory.memory.items():
        fault = _memory_fault(array, (frames, nodes, 3))
        if fault:
            return f"memory {name!r} {fault}"
    return _cells_fault(trajectory.cells, nodes) or _stats_fault(trajectory, frames - 1)


def _memory_fault(array: Any, shape: tuple[int, ...]) -> str | None:
    if array.shape != shape or array.dtype != np.float64:
        return f"has {array.dtype} of shape {array.shape}, expected float64 of {shape}"
    finite = np.isfinite(array).all(axis=(1, 2))
    if not (finite | np.isnan(array).all(axis=(1, 2))).all():
        return "has infinite or NaN entries, expected all or none of a frame to be NaN"
    return None if finite.any() else "has no finite frame"


def _cells_fault(cells: Any, nodes: int) -> str | None:
    if cells.ndim != 2 or cells.shape[1] not in (8, 27) or cells.dtype.kind not in "iu":
        return f"cells has {cells.dtype} of shape {cells.shape}, expected integers of (C, 8 or 27)"
    if not len(cells):
        return "it has no cells"
    if cells.min() < 0 or cells.max() >= nodes:
        return f"cells refer to nodes {cells.min()} to {cells.max()}, expected 0 to {nodes - 1}"
    return None


def _stats_fault(trajectory: Trajectory, steps: int) -> str | None:
    for name, array in trajectory.stats.items():
        if array.shape != (steps,):
            return f"stats {name!r} has shape {array.shape}, expected ({steps},)"
        if (array.dtype.kind == "U") != (name == "status"):
            return f"stats {name!r} has {array.dtype}, expected numbers, and status as text"
    unknown = set(trajectory.stats.get("status", np.array([])).tolist()) - set(Status.__members__)
    return f"status {sorted(unknown)[0]!r} is unknown" if unknown else None


def _read(file: Any, extent: _Extent, salvage: bool) -> Trajectory:
    _check_format(file)
    remembered = list(file["memory"]) if "memory" in file else []
    # times first: a frame that a writer adds meanwhile is in the others before
    names = ("times", "positions", "velocities", *(f"memory/{name}" for name in remembered))
    for name in (*names, "mesh/points", "mesh/cells"):
        if name not in file:
            raise FileFormatError(f"{name!r} is missing")
    datasets = {name: file[name] for name in names}
    frames = datasets["times"].shape[0]
    stats = dict(file["stats"].items()) if "stats" in file else {}
    if salvage or extent.truncated or extent.in_writing:
        intact = _intact_frames([*datasets.values()], [*stats.values()], frames)
        if not salvage and extent.truncated and (intact < frames or not extent.in_writing):
            raise FileFormatError(
                f"truncated: {extent.lost()}; {intact} of its {frames} frames are intact, which "
                "load_trajectory(path, salvage=True) reads"
            )
        frames = intact
    try:
        written = np.flatnonzero(~np.isnan(datasets["times"][:frames]))
        frames = int(written.max(initial=-1)) + 1
        arrays = {name: dataset[:frames] for name, dataset in datasets.items()}
        values = {name: dataset[: max(0, frames - 1)] for name, dataset in stats.items()}
    except OSError as error:
        raise FileFormatError(
            f"damaged ({error}); salvage reads the frames before the damage"
        ) from None
    if not frames:
        raise FileFormatError("no complete frame is left")
    trajectory = Trajectory(
        positions=arrays["positions"],
        velocities=arrays["velocities"],
        times=arrays["times"],
        stats={
            name: np.char.decode(array, "ascii") if array.dtype.kind == "S" else array
            for name, array in values.items()
        },
        points=file["mesh/points"][...],
        cells=file["mesh/cells"][...].astype(np.int64, copy=False),
        scene_toml=_attribute(file, "scene_toml"),
        attributes={name: _attribute(file, name) for name in file.attrs if name not in RESERVED},
        memory={
            name: arrays[f"memory/{name}"]
            for name in remembered
            if not np.isnan(arrays[f"memory/{name}"]).all()  # added, but its frame never completed
        },
    )
    fault = trajectory_fault(trajectory)
    if fault:
        raise FileFormatError(fault)
    return trajectory


def _check_format(file: Any) -> None:
    if "format" not in file.attrs or _attribute(file, "format") != FORMAT:
        raise FileFormatError(f"an HDF5 file, but not a trajectory: its format is not {FORMAT!r}")
    version = file.attrs.get("format_version")
    if version != VERSION:
        raise FileVersionError(
            f"format version {version}, expected {VERSION}: use the matching pdcorrect"
        )


def _attribute(file: Any, name: str) -> str:
    value = file.attrs[name]
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _intact_frames(frame_data: list[Any], step_data: list[Any], frames: int) -> int:
    """Number of leading frames whose every chunk is there and has the right checksum."""
    for k in range(frames):
        parts = [(dataset, k) for dataset in frame_data]
        parts += [(dataset, k - 1) for dataset in step_data if k]
        if not all(_is_intact(*part) for part in parts):
            return k
    return frames


def _is_intact(dataset: Any, index: int) -> bool:
    try:
        return dataset[index] is not None
    except (OSError, RuntimeError, ValueError):
        return False


_ROUNDING = 1e-9  # of a cell size: the same mesh, made on another machine


def problem_of(run: Trajectory) -> Problem:
    """The run's own problem, or one made anew from the scene that its file holds.

    Its density is the scene's, also where the run had another one, as of `with_total_mass`:
    Cauchy stress at given positions does not depend on it.  `InputError` is raised if the file does
    not say enough or its mesh is not the scene's, and what the scene raises.
    """
    if run.problem is not None:
        return run.problem
    from pdcorrect.fem.problem import discretise  # reading alone needs none of these
    from pdcorrect.scene import Scene
    from pdcorrect.solvers.rollout import DENSITY_CHANGED

    if not run.scene_toml:
        raise InputError("it holds no scene: expected a run that pdcorrect has computed.")
    changed = run.attributes.get("material", "the scene's")
    if changed not in ("the scene's", DENSITY_CHANGED):
        raise InputError(
            f"its material was {changed} had been read, and the file does not say to what: "
            "expected a run with the scene's material; simulate --vtu writes the stress of others."
        )
    scene = Scene.from_toml(run.scene_toml, source="its scene")
    problem = discretise(scene, _refinement(run))
    same = problem.cells.shape == run.cells.shape and problem.positions.shape == run.points.shape
    close = _ROUNDING * problem.cell_size
    if (
        not same
        or (problem.cells != run.cells).any()
        or np.abs(problem.positions - run.points).max() > close
    ):
        raise InputError(
            f"its mesh ({len(run.points)} nodes, {len(run.cells)} cells) is not the one that its "
            f"scene has now ({len(problem.positions)} nodes, {len(problem.cells)} cells): expected "
            "all nodes of the run, and the mesh file as it was."
        )
    return problem


def _refinement(run: Trajectory) -> int:
    text = run.attributes.get("refine", "1")
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise InputError(f"its refinement is {text!r}: expected a whole number of at least 1.")
    return int(text)
