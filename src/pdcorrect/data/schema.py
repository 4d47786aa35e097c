"""What a file of a data set holds: one mesh with its material, and its simulations.

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

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import make_folder, write_bytes
from pdcorrect.errors import InputError, OutputError

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
    if path.exists() and not overwrite:
        raise OutputError(
            f"{path}: exists already; choose another name, or overwrite it with overwrite=True."
        )
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110"), userblock_size=USER_BLOCK) as file:
        _fill(file, shard, np.dtype(dtype))
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


def _fill(file: h5py.File, shard: Shard, dtype: np.dtype[Any]) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    for name, wanted in ATTRIBUTES.items():
        file.attrs[name] = wanted(shard.attributes[name])
    for name, (place, kind, _) in MESH.items():
        _array(file, place, np.asarray(getattr(shard, name)), np.dtype(kind))
    for k, simulation in enumerate(shard.simulations):
        group = file.create_group(f"simulations/{k:04d}")
        group.attrs["attempt"] = simulation.attempt
        group.attrs["scene"] = simulation.scene_toml
        group.attrs["rejected"] = np.array(simulation.rejected, dtype=h5py.string_dtype())
        _array(group, "forces", simulation.forces, dtype)
        for name, run in simulation.runs.items():
            _fill_run(group.create_group(f"runs/{name}"), run, dtype)
        cost = file.create_group(f"cost/{k:04d}")
        cost.attrs.update(dict(simulation.seconds))
    file.create_group("provenance").attrs.update(dict(shard.provenance))


def _fill_run(group: h5py.Group, run: Run, dtype: np.dtype[Any]) -> None:
    group.attrs.update(dict(run.attributes))
    for name in MOTION:
        if getattr(run, name) is not None:
            _array(group, name, getattr(run, name), dtype)
    for name, values in run.statistics.items():
        _array(group, name, np.asarray(values), np.dtype(STATISTICS[name]))


def _array(group: h5py.Group, name: str, values: Array, dtype: np.dtype[Any]) -> None:
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
