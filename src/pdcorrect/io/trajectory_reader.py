"""Reading trajectory files, also damaged ones: every fault becomes one sentence."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np

from pdcorrect.errors import FileFormatError, InputError
from pdcorrect.io.superblock import RepairedFile, Superblock, read_superblock
from pdcorrect.state import Status
from pdcorrect.trajectory import Trajectory

if TYPE_CHECKING:
    from pdcorrect.fem.problem import Problem

FORMAT = "pdcorrect-trajectory"
VERSION = 1
RESERVED = frozenset({"format", "format_version", "scene_toml", "pdcorrect_version"})
"""Attributes of the file that are not the run's."""


def load_trajectory(path: str | Path, salvage: bool = False) -> Trajectory:
    """Read a trajectory file, finished or not.

    A file that is still being written, or whose writer was killed, is read up
    to its last complete frame.

    Parameters
    ----------
    path : path
        A file of `TrajectoryWriter`.
    salvage : bool
        Of a truncated or damaged file, return the frames before the damage.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is not a trajectory, or is damaged; says
        which, and how many frames could be salvaged.
    """
    with _opened(Path(path)) as (file, block):
        return _read(file, block, salvage)


class Storage(NamedTuple):
    """How a file is stored: with gzip or not, and the pdcorrect that wrote it."""

    compressed: bool
    version: str


def read_storage(path: Path) -> Storage:
    """What rewriting a trajectory file has to keep; raises as `load_trajectory`."""
    with _opened(path) as (file, _):
        _check_format(file)
        known = "pdcorrect_version" in file.attrs
        version = _attribute(file, "pdcorrect_version") if known else "of an unknown version"
        return Storage(file["positions"].compression is not None, version)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Superblock]]:
    """A file, open; whatever its content makes HDF5 raise becomes `FileFormatError`."""
    block = read_superblock(path)
    try:
        whole = not (block.truncated or block.in_writing)
        with h5py.File(path if whole else RepairedFile(path, block), "r", locking=False) as file:
            yield file, block
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}.") from None
    except Exception as error:  # HDF5 raises nearly every type on damaged bytes
        lost = f"truncated ({_lost(block)})" if block.truncated else "damaged"
        reason = " ".join(str(error.args[0] if error.args else type(error).__name__).split())
        raise FileFormatError(
            f"{path}: {lost}, with its index lost, so that no frame can be read ({reason})."
        ) from error


def _lost(block: Superblock) -> str:
    return f"expected {block.end} bytes, got {block.size}"


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


def _read(file: Any, block: Superblock, salvage: bool) -> Trajectory:
    _check_format(file)
    remembered = list(file["memory"]) if "memory" in file else []
    names = ("positions", "velocities", "times", *(f"memory/{name}" for name in remembered))
    for name in (*names, "mesh/points", "mesh/cells"):
        if name not in file:
            raise FileFormatError(f"{name!r} is missing")
    datasets = {name: file[name] for name in names}
    frames = datasets["times"].shape[0]
    stats = dict(file["stats"].items()) if "stats" in file else {}
    if salvage or block.truncated or block.in_writing:
        intact = _intact_frames([*datasets.values()], [*stats.values()], frames, block.size)
        if not salvage and block.truncated and (intact < frames or not block.in_writing):
            raise FileFormatError(
                f"truncated: {_lost(block)}; {intact} of its {frames} frames are intact, which "
                "load_trajectory(path, salvage=True) reads"
            )
        frames = intact
    try:
        frames = _written(datasets["times"][:frames])
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
        stats={name: _text(v) if v.dtype.kind == "S" else v for name, v in values.items()},
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
        raise FileFormatError(
            f"format version {version}, expected {VERSION}: use the matching pdcorrect"
        )


def _attribute(file: Any, name: str) -> str:
    value = file.attrs[name]
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _written(times: Any) -> int:
    """Number of frames that were complete: a time that was not written yet is NaN."""
    written = np.flatnonzero(~np.isnan(times))
    return int(written[-1]) + 1 if len(written) else 0


def _intact_frames(frame_data: list[Any], step_data: list[Any], frames: int, size: int) -> int:
    """Number of leading frames whose every chunk is complete and has the right checksum."""
    stored = {dataset: _chunks(dataset, size) for dataset in (*frame_data, *step_data)}
    for k in range(frames):
        parts = [(dataset, k) for dataset in frame_data]
        parts += [(dataset, k - 1) for dataset in step_data if k]
        if not all(_intact(dataset, index, stored[dataset]) for dataset, index in parts):
            return k
    return frames


def _chunks(dataset: Any, size: int) -> set[int]:
    """First index of each chunk that lies in the first ``size`` bytes of the file."""
    found: set[int] = set()

    def note(chunk: Any) -> None:
        if chunk.byte_offset is not None and chunk.byte_offset + chunk.size <= size:
            found.add(chunk.chunk_offset[0])

    with contextlib.suppress(OSError, RuntimeError, ValueError):  # those before the damage count
        if dataset.chunks:
            dataset.id.chunk_iter(note)
    return found


def _intact(dataset: Any, index: int, stored: set[int]) -> bool:
    if dataset.chunks and index - index % dataset.chunks[0] not in stored:
        return False
    try:
        dataset[index]
    except (OSError, RuntimeError, ValueError):
        return False
    return True


def _text(values: Any) -> Any:
    return np.char.decode(values, "ascii")


_ROUNDING = 1e-9
"""Of a cell size: the same mesh, made on another machine."""


def problem_of(run: Trajectory) -> Problem:
    """The run's own problem, or one made anew from the scene that its file holds.

    Its density is the scene's, also where the run had another one, as of `with_total_mass`:
    Cauchy stress at given positions does not depend on it.

    Raises
    ------
    InputError
        If the file does not say enough: it holds no scene, or only a part of the nodes, or its
        moduli were changed after the scene had been read.
    SceneError, MeshError
        If the scene cannot be read or discretised, as where the file of its mesh is gone.
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
