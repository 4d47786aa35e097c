"""Reading the files of a data set; every fault becomes one sentence that names the file."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pdcorrect.data.checksum import FORMAT, VERSION, check_seal, read_sealed
from pdcorrect.data.hdf5_checks import (
    RefusalError,
    Value,
    attributes_of,
    check_inside,
    check_links,
    check_types,
    members_of,
    symbols,
    texts,
    type_name,
    values_of,
    words,
)
from pdcorrect.data.schema import (
    ATTRIBUTES,
    HASH,
    MESH,
    STATISTICS,
    Array,
    Run,
    Shard,
    Simulation,
    content_hash,
)
from pdcorrect.errors import FileFormatError

_GROUPS = frozenset({"mesh", "material", "simulations", "provenance", "cost"})
_PARTS = frozenset({"forces", "runs"})
_RESERVED = frozenset({"format", "version", HASH})
"""Attributes of the file that are not the shard's."""
_FLOATS = (np.dtype("<f4"), np.dtype("<f8"))
_RUN = {
    "positions": (_FLOATS, ("T+1", "N", 3)),
    "velocities": (_FLOATS, ("T+1", "N", 3)),
    "predictions": (_FLOATS, ("T", "N", 3)),
    **{name: ((np.dtype(kind),), ("T",)) for name, kind in STATISTICS.items()},
}
"""Datasets of a run: types and shape."""


def read_shard(
    path: str | Path,
    *,
    simulations: Collection[int] | None = None,
    runs: Collection[str] | None = None,
    verify: bool = True,
) -> Shard:
    """Read a file of a data set.

    Parameters
    ----------
    path : path
    simulations : collection of int, optional
        Numbers of those to read, in this order; all by default.
    runs : collection of str, optional
        Names of those to read; all by default.
    verify : bool
        Compare the file with its checksum, which reads all of it and finds every changed
        byte, and, where all is read, the content with its hash.  Without, only what is
        asked for is read, and only its size, format, types and values are checked: for
        files that were verified before.

    Returns
    -------
    Shard

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, is something else or lacks what is asked
        for; the message names the file and the reason.
    """
    path = Path(path)
    with opened(path, verify) as file:
        reader = _Reader(file, file.id.get_filesize())
        shard = reader.shard(simulations, runs)
        if verify and simulations is None and runs is None:
            reader.check_hash()
        return shard


@contextlib.contextmanager
def opened(path: Path, verify: bool) -> Iterator[h5py.File]:
    """A file of a data set, open; whatever fails in it is a `FileFormatError`.

    ``verify`` compares the file with its checksum first, see `read_shard`.  Whoever reads
    need not look at what is there: where that fails, the reason is what `read_shard` says.
    """
    try:
        with _unsealed(path, verify) as file:
            try:
                yield file
            except FileFormatError:
                raise
            except Exception:
                _Reader(file, file.id.get_filesize()).shard(None, None)
                raise
    except FileFormatError:
        raise
    except RefusalError as refusal:
        raise FileFormatError(f"{path}: {' '.join(str(refusal).split())}.") from None
    except Exception as error:  # HDF5 raises nearly every type on damaged bytes
        text = str(error.args[0]).splitlines() if error.args else []
        reason = text[0] if text else type(error).__name__
        raise FileFormatError(f"{path}: damaged, HDF5 cannot read it ({reason}).") from error


def stored_hashes(path: Path) -> tuple[str, str]:
    """The hashes of its configuration and its content that a file holds, if its seal is right.

    Raises
    ------
    FileFormatError
        As `read_shard`.
    """
    with opened(path, verify=True) as file:
        return str(file.attrs["config_hash"]), str(file.attrs[HASH])


@contextlib.contextmanager
def _unsealed(path: Path, verify: bool) -> Iterator[h5py.File]:
    if verify:
        with h5py.File(io.BytesIO(read_sealed(path)), "r") as file:
            yield file
        return
    check_seal(path)
    with h5py.File(path, "r", locking=False) as file:
        yield file


@dataclass(eq=False)
class _Reader:
    """Reads and checks one open file.

    Attributes
    ----------
    size : int
        Bytes of the file.
    content : dict of str to arrays or attributes
        What was read so far of what counts for the hash.
    lengths : dict of str to int
        Of the axes: N, C, and of the simulation being read T and T+1.
    """

    file: h5py.File
    size: int
    content: dict[str, Array | dict[str, Any]] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)

    def shard(self, simulations: Collection[int] | None, runs: Collection[str] | None) -> Shard:
        """The file's content, or the chosen part of it."""
        check_links(self.file)
        self._check_members(self.file, "", _GROUPS, _GROUPS)
        attributes = self._noted(self.file, "")
        if attributes.get("format") != FORMAT or attributes.get("version") != VERSION:
            raise RefusalError(
                f"its format is {attributes.get('format')!r}, version "
                f"{attributes.get('version')!r}: expected {FORMAT!r}, version {VERSION}"
            )
        check_types(attributes, {**ATTRIBUTES, HASH: str}, "the file")
        groups = {name: self._group(self.file, "", name) for name in _GROUPS}
        mesh = self._mesh(groups)
        chosen = self._chosen(groups, simulations)
        self._check_members(groups["provenance"], "provenance", (), ())
        provenance = values_of(groups["provenance"], "provenance")
        return Shard(
            attributes={k: v for k, v in attributes.items() if k not in _RESERVED},
            **mesh,
            simulations=tuple(
                self._simulation(groups["simulations"], groups["cost"], k, runs) for k in chosen
            ),
            provenance={name: str(value) for name, value in provenance.items()},
        )

    def check_hash(self) -> None:
        """Compare what was read, which is everything, with the hash of the content."""
        expected = dict(self.content[""])[HASH]
        if content_hash(self.content) != expected:
            raise RefusalError(f"damaged: its content is not that of its attribute {HASH!r}")

    def _mesh(self, groups: Mapping[str, h5py.Group]) -> dict[str, Array]:
        for name in ("mesh", "material"):
            names = [place.split("/")[1] for place, _, _ in MESH.values() if place.startswith(name)]
            self._check_members(groups[name], name, names, names)
            self._noted(groups[name], name)
        arrays = {}
        for field_name, (place, kind, shape) in MESH.items():
            group, name = place.split("/")
            arrays[field_name] = self._array(groups[group], group, name, (np.dtype(kind),), shape)
        self._check_cells(arrays["cells"])
        return arrays

    def _check_cells(self, cells: Array) -> None:
        nodes = self.lengths["N"]
        if not nodes or not len(cells):
            raise RefusalError("mesh/points or mesh/cells is empty")
        if cells.min() < 0 or cells.max() >= nodes:
            raise RefusalError(
                f"mesh/cells refers to nodes {cells.min()} to {cells.max()}: expected 0 to "
                f"{nodes - 1}"
            )

    def _chosen(
        self, groups: Mapping[str, h5py.Group], wanted: Collection[int] | None
    ) -> list[int]:
        """Numbers of the simulations to read."""
        count = len(groups["simulations"])
        if not count:
            raise RefusalError("it holds no simulation")
        names = [f"{k:04d}" for k in range(count)]
        for name in ("simulations", "cost"):
            self._check_members(groups[name], name, names, names)
        self._noted(groups["simulations"], "simulations")
        for k in wanted or ():
            if not 0 <= k < count:
                raise RefusalError(f"it has no simulation {k}: expected 0 to {count - 1}")
        return list(range(count)) if wanted is None else list(wanted)

    def _simulation(
        self, simulations: h5py.Group, cost: h5py.Group, k: int, wanted: Collection[str] | None
    ) -> Simulation:
        place, where = f"simulations/{k:04d}", f"simulation {k:04d}"
        group = self._group(simulations, "simulations", f"{k:04d}")
        self._check_members(group, place, _PARTS, _PARTS)
        attributes = self._raw(group, place)
        rejected = texts(attributes, "rejected", where)
        values = values_of({n: v for n, v in attributes.items() if n != "rejected"}, where)
        check_types(values, {"attempt": int, "scene": str}, where)
        self.lengths = {name: self.lengths[name] for name in "NC"}
        forces = self._array(group, place, "forces", _FLOATS, ("T", "N", 3))
        if not len(forces):
            raise RefusalError(f"forces of {where} has no step")
        self.lengths["T+1"] = len(forces) + 1
        costs = self._group(cost, "cost", f"{k:04d}")
        self._check_members(costs, f"cost/{k:04d}", (), ())
        seconds = values_of(costs, f"cost of {where}")
        check_types(seconds, dict.fromkeys(seconds, float), f"cost of {where}")
        return Simulation(
            forces=forces,
            runs=self._runs(self._group(group, place, "runs"), f"{place}/runs", wanted),
            scene_toml=str(values["scene"]),
            attempt=int(values["attempt"]),
            rejected=rejected,
            seconds={name: float(value) for name, value in seconds.items()},
        )

    def _runs(
        self, group: h5py.Group, place: str, wanted: Collection[str] | None
    ) -> dict[str, Run]:
        names = members_of(group, words(place))
        if not names:
            raise RefusalError(f"{words(place)} is empty")
        for name in wanted or ():
            if name not in names:
                raise RefusalError(
                    f"{words(place)} has no {name!r}: expected one of {', '.join(names)}"
                )
        self._noted(group, place)
        return {
            name: self._run(group, place, name) for name in (names if wanted is None else wanted)
        }

    def _run(self, runs: h5py.Group, place: str, name: str) -> Run:
        group, place = self._group(runs, place, name), f"{place}/{name}"
        members = self._check_members(group, place, (), _RUN)
        if not members & {"positions", "predictions"}:
            raise RefusalError(f"{words(place)} has neither positions nor predictions")
        arrays = {k: self._array(group, place, k, *_RUN[k]) for k in _RUN if k in members}
        return Run(
            positions=arrays.get("positions"),
            predictions=arrays.get("predictions"),
            statistics={k: arrays[k] for k in STATISTICS if k in arrays},
            attributes=self._noted(group, place),
            velocities=arrays.get("velocities"),
        )

    def _group(self, parent: h5py.Group, place: str, name: str) -> h5py.Group:
        group = parent[name]
        if not isinstance(group, h5py.Group):
            raise RefusalError(f"{words(f'{place}/{name}'.lstrip('/'))} is not a group")
        return group

    def _check_members(
        self, group: h5py.Group, place: str, needed: Collection[str], known: Collection[str]
    ) -> set[str]:
        """Names in a group; refuses one that lacks something or holds something unknown."""
        found = set(members_of(group, words(place) or "the file"))
        inside = f"{place}/".lstrip("/")
        for name in sorted(set(needed) - found):
            raise RefusalError(f"{words(inside + name)} is missing")
        for name in sorted(found - set(known)):
            raise RefusalError(
                f"{words(inside + name)} is unknown in version {VERSION} of the format"
            )
        return found

    def _raw(self, group: h5py.Group, place: str) -> dict[str, Any]:
        """A group's attributes as they are, noted for the hash."""
        attributes = attributes_of(group, words(place) or "the file")
        self.content[place] = attributes
        return attributes

    def _noted(self, group: h5py.Group, place: str) -> dict[str, Value]:
        """A group's attributes as texts and numbers, noted for the hash."""
        return values_of(self._raw(group, place), words(place) or "the file")

    def _array(
        self,
        group: h5py.Group,
        place: str,
        name: str,
        types: tuple[Any, ...],
        shape: tuple[int | str, ...],
    ) -> Array:
        """A dataset of given types and shape, in which a new letter stands for any length."""
        place = f"{place}/{name}"
        dataset = group.get(name)
        if dataset is None:
            raise RefusalError(f"{words(place)} is missing")
        if not isinstance(dataset, h5py.Dataset):
            raise RefusalError(f"{words(place)} is not a dataset")
        found, kind = dataset.shape, dataset.dtype
        if not self._fits(found, shape):
            known = tuple(self.lengths.get(str(n), n) for n in shape)
            raise RefusalError(
                f"{words(place)} has shape {found}: expected {symbols(shape)}"
                + (f" = {known}" if all(isinstance(n, int) for n in known) else "")
            )
        if kind not in types:
            expected = " or ".join(str(t) for t in types)
            raise RefusalError(f"{words(place)} has type {type_name(kind)}: expected {expected}")
        check_inside(dataset, self.size, words(place))
        try:
            values = dataset[()]
        except OSError as error:
            raise RefusalError(f"{words(place)} is damaged ({error})") from None
        if kind.kind == "f" and not np.isfinite(values).all():
            raise RefusalError(f"{words(place)} has infinite or NaN entries")
        self.content[place] = values
        self.lengths |= {n: m for n, m in zip(shape, found, strict=True) if isinstance(n, str)}
        return values

    def _fits(self, found: tuple[int, ...] | None, shape: tuple[int | str, ...]) -> bool:
        if found is None or len(found) != len(shape):
            return False
        return all(
            m == (self.lengths.get(n, m) if isinstance(n, str) else n)
            for m, n in zip(found, shape, strict=True)
        )
