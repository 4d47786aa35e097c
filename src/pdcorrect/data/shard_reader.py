"""Reading the files of a data set; every fault becomes one sentence that names the file."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import h5py
import numpy as np

from pdcorrect.data.schema import (
    ATTRIBUTES,
    FORMAT,
    HASH,
    MESH,
    MOTION,
    STATISTICS,
    USER_BLOCK,
    VERSION,
    Array,
    Run,
    Shard,
    Simulation,
)
from pdcorrect.errors import FileFormatError, FileVersionError

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
    path: str | Path,
    *,
    runs: Collection[str] | Mapping[str, Collection[str]] | None = None,
) -> Shard:
    """Read a file of a data set, and find every changed byte by its checksum.

    ``runs`` are names of those to read, as far as they are there; with names of arrays, such as
    "predictions", only these of each.  `FileFormatError` names the file and the reason if it cannot
    be read, is damaged or something else.
    """
    with _opened(Path(path), verify=True) as file:
        lengths: Lengths = {}
        arrays = {name: _array(file, at, shape, lengths) for name, (at, _, shape) in MESH.items()}
        low, high, nodes = arrays["cells"].min(), arrays["cells"].max(), lengths["N"]
        if low < 0 or high >= nodes:
            told = f"mesh/cells refers to nodes {low} to {high}: expected 0 to {nodes - 1}"
            raise FileFormatError(told)
        return Shard(
            attributes={name: kind(file.attrs[name]) for name, kind in ATTRIBUTES.items()},
            **arrays,
            simulations=tuple(
                _simulation(file, f"{k:04d}", runs, dict(lengths))
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


def _simulation(
    file: h5py.File,
    key: str,
    wanted: Collection[str] | Mapping[str, Collection[str]] | None,
    lengths: Lengths,
) -> Simulation:
    group, cost = file["simulations"][key], file["cost"][key]
    forces = _array(group, "forces", ("T", "N", 3), lengths)
    lengths["T+1"] = len(forces) + 1
    runs = {}
    for name, run in group["runs"].items():
        if wanted is None or name in wanted:
            arrays = wanted[name] if isinstance(wanted, Mapping) else (*MOTION, *STATISTICS)
            runs[name] = _run(run, arrays, lengths)
    return Simulation(
        forces=forces,
        runs=runs,
        scene_toml=str(group.attrs["scene"]),
        attempt=int(group.attrs["attempt"]),
        rejected=tuple(group.attrs["rejected"]),
        seconds={name: float(value) for name, value in cost.attrs.items()},
    )


def _run(group: h5py.Group, wanted: Collection[str], lengths: Lengths) -> Run:
    found = {
        name: _array(group, name, MOTION.get(name, ("T",)), lengths)
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


def _array(group: h5py.Group, name: str, shape: tuple[int | str, ...], lengths: Lengths) -> Array:
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
