"""Files of a data set, each of one mesh with its material and its simulations: write and read.

`docs/datasets.md` has the layout of the HDF5 file, version 1.  In front, in the room that HDF5
leaves to others, the user block, are three lines of text, padded with zeros::

    pdcorrect-dataset 1
    bytes 10485760
    sha256 0f3c...

the format's version, the size of the whole file, and the SHA-256 of the first two lines and of
everything after the user block.  A damaged file is thus found out before HDF5, which some damage
makes crash, sees any of it.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import check_new, make_folder, write_bytes
from pdcorrect.errors import FileFormatError, FileVersionError, InputError

FORMAT, VERSION = "pdcorrect-dataset", 1
USER_BLOCK = 512
"""Bytes."""
REFERENCE, PLAIN, BEST, TOTAL_MASS = "reference", "plain", "best", "total-mass"
"""Runs: the truth, and the coarse models, see `pdcorrect.fem.problem`."""
CONVERGED = "time-converged"
"""Run: the reference with smaller time steps."""
INTEGRATOR = "backward-euler"
"""The one that velocities and predictions of a data set suppose."""
SUFFIX = ".h5"
CONFIG, MANIFEST = "config.toml", "manifest.json"
"""Files of a data set besides those of its meshes."""
HASH = "content_hash"
"""Attribute of the file."""
_UNHASHED = ("provenance", "cost")

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Run:
    """One model's answer on the coarse nodes, see the layout."""

    positions: Array | None = None  # (T+1, N, 3): free rollout from rest, m
    # (T, N, 3): positions after one step from each frame of the reference but the last, m
    predictions: Array | None = None
    # (T,): of the rollout, or of the predictions where there is none, see `STATISTICS`
    statistics: Mapping[str, Array] = field(default_factory=dict)
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    # (T+1, N, 3): of the rollout, m/s, where they are not the differences of its positions
    velocities: Array | None = None


@dataclass(frozen=True, eq=False)
class Simulation:
    """One load on a mesh and what the models make of it."""

    forces: Array  # (T, N, 3): nodal forces of the plain coarse model, N
    runs: Mapping[str, Run]
    scene_toml: str = ""  # of the plain coarse model; empty for imported data
    attempt: int = 0  # how many draws were rejected before, and ``rejected`` why
    rejected: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)  # cost by run

    @property
    def steps(self) -> int:
        """T."""
        return len(self.forces)


@dataclass(frozen=True, eq=False)
class Shard:
    """One file: a mesh, its material, its simulations, by their names in the layout.

    ``content_hash`` is that of the file that it was read from, else empty.
    """

    attributes: Mapping[str, str | int | float]
    points: Array
    cells: Array
    free: Array
    mass: Array
    young: Array
    poisson: Array
    density: Array
    simulations: tuple[Simulation, ...]
    provenance: Mapping[str, str] = field(default_factory=dict)
    content_hash: str = ""


MESH: Mapping[str, tuple[str, type, tuple[int | str, ...]]] = {
    "points": ("mesh/points", np.float64, ("N", 3)),
    "cells": ("mesh/cells", np.int32, ("C", 8)),
    "free": ("mesh/free", np.bool_, ("N", 3)),
    "mass": ("mesh/mass", np.float64, ("N",)),
    "young": ("material/young", np.float64, ("C",)),
    "poisson": ("material/poisson", np.float64, ("C",)),
    "density": ("material/density", np.float64, ("C",)),
}
"""Arrays of a `Shard`: place, type and shape."""
MOTION: Mapping[str, tuple[int | str, ...]] = {
    "positions": ("T+1", "N", 3),
    "velocities": ("T+1", "N", 3),
    "predictions": ("T", "N", 3),
}
"""Arrays of a `Run`, m and m/s, and their shapes."""
STATISTICS = {
    "iterations": np.int32,
    "error_estimates": np.float32,
    "smallest_volume_ratios": np.float32,
}
"""Of a run's steps, (T,): types."""
ATTRIBUTES = {
    "dataset": str, "split": str, "number": int, "setting": str, "config_hash": str,
    "time_step": float, "tolerance": float,
}  # fmt: skip
"""Attributes of a `Shard` and their types."""


def write_shard(
    path: str | Path, shard: Shard, dtype: str = "float32", overwrite: bool = False
) -> str:
    """Write a file whole or not at all; returns the hash of its content.

    ``dtype``, "float32" or "float64", is that of forces, positions and velocities.

    Raises
    ------
    InputError
        If the type is another.
    OutputError
        If the file exists already or cannot be written.
    """
    path = Path(path)
    if dtype not in ("float32", "float64"):
        raise InputError(f"dtype = {dtype!r}: expected 'float32' or 'float64'.")
    check_new(path, overwrite=overwrite)
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110"), userblock_size=USER_BLOCK) as file:
        _write(file, shard, np.dtype(dtype))
        found = content_hash(file)
        file.attrs[HASH] = found
    seal(image.getbuffer())
    make_folder(path.parent)
    write_bytes(path, image.getvalue())
    return found


def seal(image: memoryview) -> None:
    """Write the user block of a file that is whole but for it, in place."""
    lead = f"{FORMAT} {VERSION}\nbytes {len(image)}\n".encode()
    digest = hashlib.sha256(lead)
    digest.update(image[USER_BLOCK:])
    text = lead + f"sha256 {digest.hexdigest()}\n".encode()
    image[:USER_BLOCK] = text.ljust(USER_BLOCK, b"\0")


def _write(file: h5py.File, shard: Shard, dtype: np.dtype[Any]) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    for name, wanted in ATTRIBUTES.items():
        file.attrs[name] = wanted(shard.attributes[name])
    for name, (place, kind, _) in MESH.items():
        _write_array(file, place, np.asarray(getattr(shard, name)), np.dtype(kind))
    for k, simulation in enumerate(shard.simulations):
        group = file.create_group(f"simulations/{k:04d}")
        group.attrs["attempt"] = simulation.attempt
        group.attrs["scene"] = simulation.scene_toml
        group.attrs["rejected"] = np.array(simulation.rejected, dtype=h5py.string_dtype())
        _write_array(group, "forces", simulation.forces, dtype)
        for name, run in simulation.runs.items():
            _write_run(group.create_group(f"runs/{name}"), run, dtype)
        cost = file.create_group(f"cost/{k:04d}")
        cost.attrs.update(dict(simulation.seconds))
    file.create_group("provenance").attrs.update(dict(shard.provenance))


def _write_run(group: h5py.Group, run: Run, dtype: np.dtype[Any]) -> None:
    group.attrs.update(dict(run.attributes))
    for name in MOTION:
        if getattr(run, name) is not None:
            _write_array(group, name, getattr(run, name), dtype)
    for name, values in run.statistics.items():
        _write_array(group, name, np.asarray(values), np.dtype(STATISTICS[name]))


def _write_array(group: h5py.Group, name: str, values: Array, dtype: np.dtype[Any]) -> None:
    """One compressed chunk; its checksum is for programs that do not know the file's."""
    group.create_dataset(
        name, data=np.asarray(values, dtype=dtype), chunks=values.shape, compression="gzip",
        shuffle=True, fletcher32=True,
    )  # fmt: skip


def content_hash(file: h5py.File) -> str:
    """SHA-256 of a file's arrays and of its groups' attributes: all but provenance and cost."""
    items: dict[str, h5py.Group | h5py.Dataset] = {"": file}
    file.visititems(items.__setitem__)
    digest = hashlib.sha256()
    for name in sorted(items, key=lambda place: place.split("/")):
        if name.split("/")[0] in _UNHASHED:
            continue
        item = items[name]
        digest.update(f"{name}\n".encode())
        if isinstance(item, h5py.Dataset):
            values = item[()]
            digest.update(f"{values.dtype.str}{values.shape}\n".encode())
            digest.update(np.ascontiguousarray(values).data)
            continue
        for key in sorted(item.attrs):
            if key != HASH:
                digest.update(f"{key}={np.asarray(item.attrs[key]).tolist()!r}\n".encode())
    return digest.hexdigest()


# --- reading -----------------------------------------------------------------------------

Lengths = dict[int | str, int]
"""Of the axes that were met so far: N, C, and of a simulation T and T+1."""


@dataclass(frozen=True)
class ShardHeader:
    """What a file holds, found without reading its arrays."""

    path: Path
    number: int  # of the mesh in its split
    nodes: int
    cells: int
    steps: tuple[int, ...]  # T of each simulation
    # for each simulation: names of runs with positions, and of those with predictions
    runs: tuple[tuple[frozenset[str], frozenset[str]], ...]
    time_step: float  # s
    config_hash: str
    content_hash: str


def read_header(path: str | Path, *, verify: bool = False) -> ShardHeader:
    """Sizes and names of a file of a data set; ``verify`` compares all of it with its checksum."""
    with _opened(Path(path), verify) as file:
        groups = [file["simulations"][key] for key in sorted(file["simulations"])]
        return ShardHeader(
            path=Path(path),
            number=int(file.attrs["number"]),
            nodes=len(file[MESH["points"][0]]),
            cells=len(file[MESH["cells"][0]]),
            steps=tuple(len(group["forces"]) for group in groups),
            runs=tuple((_with(g, "positions"), _with(g, "predictions")) for g in groups),
            time_step=float(file.attrs["time_step"]),
            config_hash=str(file.attrs["config_hash"]),
            content_hash=str(file.attrs[HASH]),
        )


def _with(simulation: h5py.Group, name: str) -> frozenset[str]:
    return frozenset(run for run, group in simulation["runs"].items() if name in group)


def read_shard(
    path: str | Path, *, runs: Collection[str] | Mapping[str, Collection[str]] | None = None
) -> Shard:
    """Read a file of a data set, and find every changed byte by its checksum.

    ``runs`` are names of those to read, as far as they are there; with names of arrays, such as
    "predictions", only these of each.  `FileFormatError` names the file and the reason if it cannot
    be read, is damaged or something else.
    """
    with _opened(Path(path), verify=True) as file:
        lengths: Lengths = {}
        arrays = {
            name: _read_array(file, at, shape, lengths) for name, (at, _, shape) in MESH.items()
        }
        low, high, nodes = arrays["cells"].min(), arrays["cells"].max(), lengths["N"]
        if low < 0 or high >= nodes:
            told = f"mesh/cells refers to nodes {low} to {high}: expected 0 to {nodes - 1}"
            raise FileFormatError(told)
        return Shard(
            attributes={name: kind(file.attrs[name]) for name, kind in ATTRIBUTES.items()},
            **arrays,
            simulations=tuple(
                _read_simulation(file, f"{k:04d}", runs, dict(lengths))
                for k in range(len(file["simulations"]))
            ),
            provenance={name: str(text) for name, text in file["provenance"].attrs.items()},
            content_hash=str(file.attrs[HASH]),
        )


@contextlib.contextmanager
def _opened(path: Path, verify: bool) -> Iterator[h5py.File]:
    """A file of a data set, open; whatever fails in it is a `FileFormatError`."""
    if not path.is_file():
        raise FileFormatError(f"{path}: there is no such file.")
    try:
        with path.open("rb") as stream:
            _check_seal(stream, verify)
            with h5py.File(stream, "r") as file:
                yield file
    except FileFormatError as error:
        raise type(error)(f"{path}: {error}.") from None
    except Exception as error:  # HDF5 raises nearly every type on damaged bytes
        reason = " ".join(str(error.args[0] if error.args else type(error).__name__).split())
        raise FileFormatError(f"{path}: cannot be read ({reason}).") from error


_SEAL = re.compile(
    rb"(?P<lead>pdcorrect-dataset (?P<version>\d{1,9})\nbytes (?P<size>\d{1,18})\n)"
    rb"sha256 (?P<sum>[0-9a-f]{64})\n\0*"
)


def _check_seal(file: IO[bytes], verify: bool) -> None:
    """Compare an open file's size and version with its user block, if asked to all its bytes."""
    block, size = file.read(USER_BLOCK), os.fstat(file.fileno()).st_size
    found = _SEAL.fullmatch(block) if len(block) == USER_BLOCK else None
    if found is None:
        cut = 0 < size < USER_BLOCK and block.startswith(FORMAT.encode()[:size])
        what = "truncated" if cut else "no file of a data set, or damaged at its beginning"
        raise FileFormatError(f"{what}: expected {FORMAT!r} and a checksum in front")
    if int(found["size"]) != size:
        what = "truncated" if size < int(found["size"]) else "damaged"
        raise FileFormatError(f"{what}: expected {int(found['size'])} bytes, got {size}")
    if verify:
        digest = hashlib.file_digest(file, lambda: hashlib.sha256(found["lead"]))  # type: ignore[arg-type]
        if digest.hexdigest() != found["sum"].decode():
            raise FileFormatError(
                "damaged: its checksum (SHA-256) is not the one in front; copy or generate it again"
            )
    if int(found["version"]) != VERSION:
        raise FileVersionError(
            f"format version {int(found['version'])}: this pdcorrect reads version {VERSION}"
        )


def _read_simulation(
    file: h5py.File,
    key: str,
    wanted: Collection[str] | Mapping[str, Collection[str]] | None,
    lengths: Lengths,
) -> Simulation:
    group, cost = file["simulations"][key], file["cost"][key]
    forces = _read_array(group, "forces", ("T", "N", 3), lengths)
    lengths["T+1"] = len(forces) + 1
    runs = {}
    for name, run in group["runs"].items():
        if wanted is None or name in wanted:
            arrays = wanted[name] if isinstance(wanted, Mapping) else (*MOTION, *STATISTICS)
            runs[name] = _read_run(run, arrays, lengths)
    return Simulation(
        forces=forces,
        runs=runs,
        scene_toml=str(group.attrs["scene"]),
        attempt=int(group.attrs["attempt"]),
        rejected=tuple(group.attrs["rejected"]),
        seconds={name: float(value) for name, value in cost.attrs.items()},
    )


def _read_run(group: h5py.Group, wanted: Collection[str], lengths: Lengths) -> Run:
    found = {
        name: _read_array(group, name, MOTION.get(name, ("T",)), lengths)
        for name in wanted
        if name in group
    }
    return Run(
        **{name: found.get(name) for name in MOTION},
        statistics={name: values for name, values in found.items() if name in STATISTICS},
        attributes={
            name: value if isinstance(value, str) else value.item()
            for name, value in group.attrs.items()
        },
    )


def _read_array(
    group: h5py.Group, name: str, shape: tuple[int | str, ...], lengths: Lengths
) -> Array:
    """A dataset, finite and of a given shape, in which a new letter stands for any length."""
    dataset = group[name]
    place = dataset.name.lstrip("/")
    values = np.asarray(dataset[()])
    if values.ndim == len(shape):
        lengths |= {n: m for n, m in zip(shape, values.shape, strict=True) if n not in lengths}
    expected = tuple(lengths.get(n, n) if isinstance(n, str) else n for n in shape)
    if values.shape != expected:
        raise FileFormatError(f"{place} has shape {values.shape}: expected {shape} = {expected}")
    if not np.isfinite(values).all():
        raise FileFormatError(f"{place} has infinite or NaN entries")
    return values
