"""Files of a data set, read whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py

from pdcorrect.data.schema import (
    _HASH,
    ATTRIBUTES,
    FORMAT,
    MESH,
    STATISTICS,
    Run,
    Shard,
    Simulation,
    content_hash,
)
from pdcorrect.errors import FileFormatError


def read_shard(path: Path, *, verify: bool = True) -> Shard:
    """Read a file of a data set.

    Raises
    ------
    FileFormatError
        If it is damaged or is something else; the message names the file and the reason.
    """
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise FileFormatError(f"{path}: not a file of a data set.")
            if verify and content_hash(file) != file.attrs[_HASH]:
                raise FileFormatError(f"{path}: its content does not match its hash.")
            return _shard(file)
    except (OSError, KeyError) as error:
        raise FileFormatError(f"{path}: cannot be read ({error}).") from None


def _shard(file: h5py.File) -> Shard:
    simulations = []
    for key in sorted(file["simulations"]):
        group = file["simulations"][key]
        simulations.append(
            Simulation(
                group["forces"][()],
                {name: _run(run) for name, run in group["runs"].items()},
                group.attrs["scene"],
                int(group.attrs["attempt"]),
                tuple(group.attrs["rejected"]),
                dict(file["cost"][key].attrs),
            )
        )
    arrays: dict[str, Any] = {name: file[place][()] for name, (place, _, _) in MESH.items()}
    return Shard(
        attributes={name: kind(file.attrs[name]) for name, kind in ATTRIBUTES.items()},
        simulations=tuple(simulations),
        provenance=dict(file["provenance"].attrs),
        **arrays,
    )


def _run(group: h5py.Group) -> Run:
    arrays = {n: group[n][()] if n in group else None for n in ("positions", "predictions")}
    return Run(
        statistics={n: group[n][()] for n in STATISTICS if n in group},
        attributes=dict(group.attrs),
        **arrays,
    )
