"""Data sets for other programs: MeshGraphNet tools and ParaView."""

from __future__ import annotations

import contextlib
import json
import shutil
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import check_new, make_folder, write_text
from pdcorrect.data.configuration import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.folder import missing_files, shard_paths, splits_of
from pdcorrect.data.schema import PLAIN, REFERENCE, SUFFIX, Shard, Simulation, read_shard
from pdcorrect.errors import InputError, OutputError, PdcorrectWarning
from pdcorrect.fem.graph import node_means, tetrahedra, velocities
from pdcorrect.io.vtk import write_vtu_series
from pdcorrect.trajectory import Trajectory

SIMULATOR = "pdcorrect"
"""In ``meta.json``."""


@contextlib.contextmanager
def _staging_folder(target: Path, overwrite: bool) -> Iterator[Path]:
    """A new folder in ``target``, from which files are moved there when all are written.

    Refuses files that are there already and, whatever ``overwrite``, others that would be taken
    for parts of the same export; then, and after other errors, ``target`` is as it was before.
    """
    existed = target.is_dir()
    staging = target / "export.part"
    shutil.rmtree(staging, ignore_errors=True)
    make_folder(staging)
    try:
        yield staging
        names = sorted(path.name for path in staging.iterdir())
        check_new(*(target / name for name in names), overwrite=overwrite)
        others = [path for path in sorted(target.glob("*.h5")) if path.name not in names]
        if "meta.json" in names and others:
            raise OutputError(f"{others[0]}: is of another export: expected an empty folder.")
        for name in names:
            (staging / name).replace(target / name)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error}).") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if not existed:
            with contextlib.suppress(OSError):  # not empty: it was filled
                target.rmdir()


NORMAL, HANDLE = 0, 3
"""Types of nodes, ``NodeType`` in google-deepmind/deepmind-research, meshgraphnets/common.py."""

_SPLITS = {TRAINING: "train", VALIDATION: "valid", EVALUATION: "test"}
_DYNAMIC = ("world_pos", "base_pos", "forces")
Array = NDArray[Any]


def export_meshgraphnet(
    folder: str | Path,
    target: str | Path,
    *,
    base: str = PLAIN,
    split: str | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write a data set in the layout of DeepMind's MeshGraphNet data sets, as HDF5.

    ``target`` gets ``meta.json`` and one file a split: ``train.h5``, ``valid.h5``,
    ``test.h5`` and ``NAME.h5`` of extra splits, with ``meta-NAME.json`` where trajectories have
    another length than those of ``meta.json``.  A file holds a group "0", "1", … for each
    trajectory.  As in the converted TFRecords that PyTorch ports read, each field is
    (frames, rows, width), also the static ones:

    ================  ============  =======================================================
    ``cells``         (F, 6C, 4)    int32, tetrahedra, as in ``deforming_plate``: six for each
                                    hexahedron, whose edges include diagonals
    ``hexahedra``     (F, C, 8)     int32, VTK order
    ``node_type``     (F, N, 1)     int32, 3 (handle) where all components are held, else 0
    ``free``          (F, N, 3)     int32, 1 where a component may move
    ``mesh_pos``      (F, N, 3)     rest positions, m
    ``world_pos``     (F, N, 3)     the reference, m
    ``base_pos``      (F, N, 3)     one step of the base model from this frame of the
                                    reference, m; in the last frame ``world_pos``; not of sets
                                    of the setting "converged", which have no single steps
    ``forces``        (F, N, 3)     of the step from this frame, N; in the last frame 0
    ``young``, …      (F, N, 1)     and ``poisson``, ``density``: means over a node's cells
    ================  ============  =======================================================

    Parameters
    ----------
    folder, target : path
    base : str
        Run whose predictions become ``base_pos``.
    split : str, optional
        The only one to write; all by default.
    overwrite : bool
        Replace files of the same names in ``target``.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    InputError
        If there is no data set or no such split, the base model's predictions are missing, or
        a split has trajectories of different lengths.
    OutputError
        If ``target`` cannot be written, or holds a file of the same name.
    """
    splits = splits_of(folder) if split is None else [split]
    with contextlib.suppress(InputError):  # of config.toml, which no export needs
        missing = missing_files(folder, split)
        if missing:
            told = f"{len(missing)} files that its config.toml asks for, as {missing[0]}"
            warnings.warn(f"the data set lacks {told}.", PdcorrectWarning, stacklevel=2)
    with _staging_folder(Path(target), overwrite) as staging:
        written = _write_splits(staging, folder, splits, base)
    return [Path(target) / path.name for path in written]


def _write_splits(target: Path, folder: str | Path, splits: Sequence[str], base: str) -> list[Path]:
    written: list[Path] = []
    common: dict[str, Any] | None = None
    for split in splits:
        name = _SPLITS.get(split, f"extra-{split}" if split in _SPLITS.values() else split)
        path = target / f"{name}.h5"
        meta = _write_split(path, folder, split, base)
        written.append(path)
        if meta == common:
            continue
        path = target / ("meta.json" if common is None else f"meta-{name}.json")
        write_text(path, json.dumps(meta, indent=1) + "\n")
        written.append(path)
        common = common or meta
    return written


def export_vtu(
    folder: str | Path,
    target: str | Path,
    split: str,
    mesh: int,
    simulation: int,
    runs: Sequence[str] | None = None,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write a simulation's reference and runs as VTU series for ParaView; their PVD files.

    Points are the current positions on the coarse mesh.  Point data: ``displacement`` (m),
    ``velocity`` (m/s), ``error`` (to the reference, m; of runs only) and ``force`` (of the step
    that ends in the frame, N).  Cell data: ``young`` (Pa), ``poisson``, ``density`` (kg/m3). The
    reference's file comes first; ``SPLIT-MMMM-K-reference.pvd`` is that of mesh MMMM of the split
    and simulation K on it.

    Parameters
    ----------
    folder, target : path
    split : str
    mesh, simulation : int
    runs : sequence of str, optional
        With rollouts; "plain" by default, if it has one.
    overwrite : bool
        Replace files of the same names in ``target``.

    Raises
    ------
    InputError
        If there is no such simulation or run.
    OutputError
        If ``target`` cannot be written, or holds a file of the same name.
    """
    paths = {path.stem: path for path in shard_paths(folder, split)}
    stem = f"mesh-{mesh:04d}"
    if stem not in paths:
        raise InputError(f"{folder}: {split} has no {stem}{SUFFIX}: expected {', '.join(paths)}.")
    shard = read_shard(paths[stem])
    if not 0 <= simulation < len(shard.simulations):
        raise InputError(
            f"simulation = {simulation}: mesh {mesh} of {split} has {len(shard.simulations)}: "
            f"expected 0 to {len(shard.simulations) - 1}."
        )
    found = shard.simulations[simulation]
    if runs is None:
        plain = found.runs.get(PLAIN)
        runs = () if plain is None or plain.positions is None else (PLAIN,)
    names = [REFERENCE, *(name for name in runs if name != REFERENCE)]
    for name in names:
        _positions(found, name)
    series = f"{split}-{mesh:04d}-{simulation}"
    with _staging_folder(Path(target), overwrite) as staging:
        written = [_write_series(shard, found, name, staging, series) for name in names]
    return [Path(target) / path.name for path in written]


def _write_split(path: Path, folder: str | Path, split: str, base: str) -> dict[str, Any]:
    """One file of the MeshGraphNet layout; returns its description."""
    first: dict[str, Any] = {}
    with h5py.File(path, "w", locking=False) as file:
        for number, (where, shard, simulation) in enumerate(_simulations(folder, split)):
            fields = _fields(where, shard, simulation, base)
            meta = _meta(fields, float(shard.attributes["time_step"]))
            first = first or meta
            if meta != first:
                raise InputError(
                    f"{where}: {simulation.steps} steps of {shard.attributes['time_step']} s, "
                    f"unlike the first simulation of {split}: expected the same in a split."
                )
            _write_group(file.create_group(str(number)), fields, simulation.steps + 1)
    return first


def _simulations(folder: str | Path, split: str) -> Iterator[tuple[str, Shard, Simulation]]:
    for path in shard_paths(folder, split):
        shard = read_shard(path)
        for k, simulation in enumerate(shard.simulations):
            yield f"{path}, simulation {k}", shard, simulation


def _fields(where: str, shard: Shard, simulation: Simulation, base: str) -> dict[str, Array]:
    run = simulation.runs.get(base)
    single = shard.attributes["setting"] != "converged"
    if run is None or (single and run.predictions is None):
        names = [name for name, each in simulation.runs.items() if each.predictions is not None]
        raise InputError(f"{where}: no predictions of run {base!r}: {_expected(names)}.")
    world, nodes = _positions(simulation, REFERENCE), len(shard.points)
    handles = np.where(shard.free.any(axis=1), NORMAL, HANDLE)
    moduli = {name: getattr(shard, name) for name in ("young", "poisson", "density")}
    fields = {
        "cells": tetrahedra(shard.cells),
        "hexahedra": shard.cells,
        "node_type": handles[:, None],
        "free": shard.free,
        "mesh_pos": shard.points,
        "world_pos": world,
        **({"base_pos": np.concatenate([run.predictions, world[-1:]])} if single else {}),
        "forces": np.concatenate([simulation.forces, np.zeros_like(simulation.forces[:1])]),
        **{name: node_means(x, shard.cells, nodes)[:, None] for name, x in moduli.items()},
    }
    whole = ("cells", "hexahedra", "node_type", "free")
    return {
        name: np.asarray(x, dtype=np.int32 if name in whole else np.float32)
        for name, x in fields.items()
    }


def _meta(fields: dict[str, Array], time_step: float) -> dict[str, Any]:
    """As ``meta.json`` there: rows, which differ between meshes, are -1."""
    frames = len(fields["world_pos"])
    features = {
        name: {
            "type": "dynamic" if name in _DYNAMIC else "static",
            "shape": [frames if name in _DYNAMIC else 1, -1, values.shape[-1]],
            "dtype": str(values.dtype),
        }
        for name, values in fields.items()
    }
    return {
        "simulator": SIMULATOR,
        "dt": time_step,
        "trajectory_length": frames,
        "field_names": list(fields),
        "features": features,
    }


def _write_group(group: h5py.Group, fields: dict[str, Array], frames: int) -> None:
    for name, values in fields.items():
        every = values if name in _DYNAMIC else np.broadcast_to(values, (frames, *values.shape))
        group.create_dataset(
            name, data=every, chunks=(1, *every.shape[1:]), compression="gzip", shuffle=True
        )


def _positions(simulation: Simulation, name: str) -> Array:
    run = simulation.runs.get(name)
    if run is None or run.positions is None:
        names = [key for key, each in simulation.runs.items() if each.positions is not None]
        raise InputError(f"no positions of run {name!r}: {_expected(names)}.")
    return run.positions


def _expected(names: Sequence[str]) -> str:
    return f"expected one of {', '.join(names)}" if names else "the simulation has none at all"


def _write_series(
    shard: Shard, simulation: Simulation, name: str, target: Path, series: str
) -> Path:
    step = float(shard.attributes["time_step"])
    positions, reference = (
        np.asarray(_positions(simulation, each), dtype=np.float64) for each in (name, REFERENCE)
    )
    forces = np.concatenate([np.zeros((1, *shard.points.shape)), simulation.forces])
    times: NDArray[np.float64] = np.arange(len(positions), dtype=np.float64) * step
    stored = simulation.runs[name].velocities
    trajectory = Trajectory(
        positions,
        velocities(positions, step) if stored is None else stored.astype(np.float64), times, {},
        shard.points, shard.cells.astype(np.int64),
    )  # fmt: skip

    def points(frame: int) -> dict[str, NDArray[np.float64]]:
        error = {} if name == REFERENCE else {"error": positions[frame] - reference[frame]}
        return {**error, "force": forces[frame].astype(np.float64)}

    moduli = {"young": shard.young, "poisson": shard.poisson, "density": shard.density}
    return write_vtu_series(
        trajectory, target, name=f"{series}-{name}", point_data=points,
        cell_data=lambda frame: moduli,
    )  # fmt: skip
