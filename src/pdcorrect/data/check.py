"""Whether a data set is whole, consistent and fit for training: `check_dataset`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pdcorrect.data.check_file import cell_size, file_faults, plan_faults, reason, step_faults
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.folder import all_shards, manifest_content, shard_number
from pdcorrect.data.plan import MeshPlan, make_plan
from pdcorrect.data.schema import (
    CONFIG,
    MANIFEST,
    REFERENCE,
    SUFFIX,
    Array,
    Shard,
    Simulation,
    read_header,
    read_shard,
)
from pdcorrect.errors import InputError, MeshError
from pdcorrect.fem.mesh import HexMesh

_DIGITS = 6  # decimals, in cells, to which meshes are compared
_OTHERS = (CONFIG, MANIFEST, "README.md")
Severity = Literal["error", "warning"]


def body_digests(shard: Shard) -> tuple[str, str]:
    """Equal for equal meshes, and for equal meshes with equal materials.

    Neither the numbering of nodes and cells nor the place in space matters.
    """
    points = (shard.points - shard.points.min(axis=0)) / cell_size(shard)
    centres = points[shard.cells].mean(axis=1)
    points, centres = (np.round(x, _DIGITS) + 0.0 for x in (points, centres))  # no minus zero
    cells = np.column_stack([centres, shard.young, shard.poisson, shard.density])
    nodes, shape, body = (_digest(x[np.lexsort(x.T)]) for x in (points, centres, cells))
    return nodes + shape, nodes + body


def load_digest(simulation: Simulation) -> str:
    """Equal for equal forces; of simulations without, for those that start alike."""
    reference = simulation.runs.get(REFERENCE)
    if simulation.forces.any() or reference is None or reference.positions is None:
        return _digest(simulation.forces)
    return _digest(reference.positions[:2])


def _digest(values: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).data).hexdigest()


@dataclass(frozen=True)
class Finding:
    """What is wrong with a data set, and in which file."""

    path: Path
    severity: Severity  # errors make the data unfit for use
    message: str  # one sentence without full stop

    def __str__(self) -> str:
        return f"{self.severity}: {self.path}: {self.message}"


def check_dataset(
    folder: str | Path, on_file: Callable[[Path], None] | None = None, repeat: int = 1
) -> list[Finding]:
    """Read everything in a data set's folder and report what is wrong; nothing if it is sound.

    A file that cannot be read is one finding; the others are checked all the same.  Of a generated
    set forces are computed again, too, and in each simulation ``repeat`` steps of each coarse run
    and single steps from the reference are taken again, so that what files say of themselves is not
    all that is known of them.  ``on_file`` is called with each mesh's file after it was checked.

    Raises
    ------
    InputError
        If there is no such folder, or ``repeat`` is negative.
    """
    folder = Path(folder)
    if repeat < 0:
        raise InputError(f"repeat = {repeat}: expected 0 or more.")
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder: expected that of a data set.")
    check = _Check(folder, repeat)
    paths = all_shards(folder)
    check.load_config(paths)
    check.load_manifest()
    check.files(paths)
    for path in paths:
        check.shard(path)
        if on_file:
            on_file(path)
    return check.findings


@dataclass(eq=False)
class _Check:
    """The findings so far, and what files are compared with."""

    folder: Path
    repeat: int
    findings: list[Finding] = field(default_factory=list)
    config: DatasetConfig | None = None  # if it could be read
    plans: dict[Path, MeshPlan] | None = None  # of the files that should be there
    hashes: dict[str, Any] | None = None  # of the files' contents, by the manifest
    meshes: dict[str, Path] = field(default_factory=dict)  # first file with a mesh, by digest
    bodies: dict[str, Path] = field(default_factory=dict)  # and with a material, too
    forces: dict[str, str] = field(default_factory=dict)  # where forces on a mesh came first
    origins: dict[str, dict[str, Path]] = field(default_factory=dict)  # by code, and by device

    def note(self, path: Path, message: str, severity: Severity = "error") -> None:
        self.findings.append(Finding(path, severity, message))

    def load_config(self, paths: Sequence[Path]) -> None:
        """Read the configuration and derive the files that it asks for; imports have none."""
        path = self.folder / CONFIG
        try:
            if not path.exists() and _imported(paths):
                return
            self.config = DatasetConfig.load(path)
            self.plans = {plan.path(self.folder): plan for plan in make_plan(self.config)}
        except InputError as error:
            self.note(path, reason(path, error))

    def load_manifest(self) -> None:
        """Read the hashes that the manifest lists; unfinished data sets have none."""
        path = self.folder / MANIFEST
        if not path.exists():
            return
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            self.hashes = dict(content["files"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            self.note(path, "cannot be read: expected the hashes of all files, as JSON")
            return
        if self.config is not None and content != manifest_content(self.config, self.hashes):
            self.note(path, f"is not that of {CONFIG} and of the files it lists")

    def files(self, paths: list[Path]) -> None:
        """Files that are missing, and such as do not belong here."""
        missing = set(self.plans or ()) - set(paths)
        for path in sorted(missing):
            self.note(path, f"missing: {CONFIG} asks for it")
        known = {*paths, *(self.folder / name for name in _OTHERS)}
        for path in sorted(set(filter(Path.is_file, self.folder.rglob("*"))) - known):
            self.note(path, "not part of the data set", "warning")
        if self.plans is not None and not missing and not (self.folder / MANIFEST).exists():
            text = f"no {MANIFEST}: start generate again to write it"
            self.note(self.folder, text, "warning")

    def shard(self, path: Path) -> None:
        """Check one file, alone and against those before it."""
        try:
            shard = read_shard(path)
        except InputError as error:
            self.note(path, reason(path, error))
            return
        found, wanted = shard.attributes["config_hash"], self.config and self.config.hash()
        if wanted is not None and found != wanted:
            told = f"its config_hash is {found!r}: expected {wanted!r}"
            self.note(path, f"of another data set: {told}")
            return
        try:
            HexMesh.create(shard.points, shard.cells.astype(np.int64))
        except MeshError as error:
            self.note(path, f"its mesh cannot be used: {str(error).removesuffix('.')}")
            return
        for message in (*file_faults(shard), *self._config_faults(path, shard)):
            self.note(path, message)
        self._origin(path, shard)
        self._repetitions(path, shard)

    def _config_faults(self, path: Path, shard: Shard) -> Iterator[str]:
        """Where a file is not what the configuration asks for."""
        for name, value in {"split": path.parent.name, "number": shard_number(path)}.items():
            if shard.attributes[name] != value:
                yield f"its {name} is {shard.attributes[name]!r}: expected {value!r}"
        name = self._short(path).removesuffix(SUFFIX)
        if self.hashes is not None and self.hashes.get(name) != shard.content_hash:
            yield f"its content is not that of which {MANIFEST} has the hash"
        if self.config is None or self.plans is None:
            return
        if path not in self.plans:
            yield f"{CONFIG} does not ask for it"
            return
        found = list(plan_faults(self.config, self.plans[path], shard))
        yield from found
        if not found and self.repeat:
            limit = float(shard.attributes["tolerance"]) * cell_size(shard)
            yield from step_faults(path, shard, self.repeat, limit)

    def _origin(self, path: Path, shard: Shard) -> None:
        """Changes of the code and of the device between files, where they tell."""
        for what, told in (("code", "made by other code than {} (SHA-256 {:.12})"),
                           ("device", "computed on another device than {}: {}")):  # fmt: skip
            own, known = shard.provenance.get(what), self.origins.setdefault(what, {})
            if own is not None and known.setdefault(own, path) == path and len(known) > 1:
                first = self._short(next(iter(known.values())))
                self.note(path, told.format(first, own), "warning")

    def _repetitions(self, path: Path, shard: Shard) -> None:
        """Meshes, materials and loads that came before."""
        shape, body = body_digests(shard)
        first, twin = self.meshes.setdefault(shape, path), self.bodies.setdefault(body, path)
        if first.parent != path.parent:
            told = f"its mesh is that of {self._short(first)}"
            if self.plans is None:
                told += (
                    ": figures of this split are of one body under other loads, not of unseen "
                    "bodies"
                )
                self.note(path, told, "warning")
            else:
                self.note(path, f"leakage: {told}, in another split")
        elif twin != path:
            self.note(path, f"its mesh and material are those of {self._short(twin)}")
        for k, simulation in enumerate(shard.simulations):
            here = f"simulation {k:04d} of {self._short(path)}"
            before = self.forces.setdefault(shape + load_digest(simulation), here)
            if before != here:
                self.note(path, f"simulation {k:04d} has the mesh and the forces of {before}")

    def _short(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()


def _imported(paths: Sequence[Path]) -> bool:
    """Whether the first file that can be read was imported."""
    for path in paths:
        with suppress(InputError):
            return not read_header(path).config_hash
    return False
