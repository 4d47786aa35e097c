"""Whether a data set is whole, consistent and fit for training: `check_dataset`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pdcorrect.data.check_motion import load_faults, model_faults, step_faults, volume_faults
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.folder import all_shards, shard_number
from pdcorrect.data.manifest import manifest_content
from pdcorrect.data.plan import MeshPlan, draw_scene, make_plan
from pdcorrect.data.schema import (
    CONFIG,
    MANIFEST,
    NORMALISATION,
    REFERENCE,
    SUFFIX,
    Array,
    Run,
    Shard,
    Simulation,
)
from pdcorrect.data.shard_reader import read_shard, stored_hashes
from pdcorrect.data.simulate import models
from pdcorrect.data.statistics import load_statistics
from pdcorrect.errors import InputError, MeshError
from pdcorrect.fem.hexahedron import gauss_points, jacobians
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.problem import discretise

Severity = Literal["error", "warning"]
_OTHERS = (CONFIG, MANIFEST, NORMALISATION, "README.md")
_DIGITS = 6
"""Decimals, in cells, to which meshes are compared."""
_SLACK = 1e-6
"""Relative, for tolerances of numbers that are stored as float32."""


@dataclass(frozen=True)
class Finding:
    """What is wrong with a data set, and in which file.

    Attributes
    ----------
    path : Path
    severity : {"error", "warning"}
        Errors make the data unfit for use.
    message : str
        One sentence without full stop.
    """

    path: Path
    severity: Severity
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.path}: {self.message}"


def check_dataset(
    folder: str | Path, on_file: Callable[[Path], None] | None = None, repeat: int = 1
) -> list[Finding]:
    """Read everything in a data set's folder and report what is wrong.

    Of a generated one forces are computed again, too, and some steps of the coarse models taken
    again, so that what files say of themselves is not all that is known of them.

    Parameters
    ----------
    folder : path
        With ``config.toml`` and a folder of files for each split.
    on_file : callable, optional
        Called with each mesh's file after it was checked.
    repeat : int
        Steps of each coarse run, and single steps from the reference, that are taken again in
        each simulation of a generated data set.

    Returns
    -------
    list of Finding
        Empty for a sound data set.  A file that cannot be read is one finding; the others
        are checked all the same.

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
    check.load_config()
    check.load_manifest()
    check.load_statistics()
    paths = all_shards(folder)
    check.files(paths)
    for path in paths:
        check.shard(path)
        if on_file:
            on_file(path)
    return check.findings


@dataclass(eq=False)
class _Check:
    """The findings so far, and what files are compared with.

    Attributes
    ----------
    config : DatasetConfig or None
        If it could be read.
    plans : dict of Path to MeshPlan, or None
        Of the files that should be there.
    hashes : dict of str to str, or None
        Hashes of the files' contents by the manifest, if there is one.
    meshes, bodies : dict of str to Path
        First file with a mesh, and with a mesh and its material, by their digests.
    forces : dict of str to str
        Where forces on a mesh came first.
    origins : dict of str to dict of str to Path
        First file made by each state of the code, and on each device.
    """

    folder: Path
    repeat: int
    findings: list[Finding] = field(default_factory=list)
    config: DatasetConfig | None = None
    plans: dict[Path, MeshPlan] | None = None
    hashes: dict[str, Any] | None = None
    meshes: dict[str, Path] = field(default_factory=dict)
    bodies: dict[str, Path] = field(default_factory=dict)
    forces: dict[str, str] = field(default_factory=dict)
    origins: dict[str, dict[str, Path]] = field(default_factory=dict)

    def error(self, path: Path, message: str) -> None:
        """Note an error."""
        self.findings.append(Finding(path, "error", message))

    def warn(self, path: Path, message: str) -> None:
        """Note a warning."""
        self.findings.append(Finding(path, "warning", message))

    def load_config(self) -> None:
        """Read the configuration and derive the files that it asks for."""
        path = self.folder / CONFIG
        if not path.exists() and self._imported():
            return
        try:
            self.config = DatasetConfig.load(path)
            plans = make_plan(self.config)
        except InputError as error:
            self.error(path, _reason(path, error))
            return
        self.plans = {self.folder / f"{plan.name}{SUFFIX}": plan for plan in plans}

    def _imported(self) -> bool:
        """Whether the first file that can be read says that other solvers made the data."""
        for path in all_shards(self.folder):
            try:
                return not stored_hashes(path)[0]
            except InputError:
                continue
        return False

    def load_manifest(self) -> None:
        """Read the hashes that the manifest lists; unfinished data sets have none."""
        path = self.folder / MANIFEST
        if not path.exists():
            return
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            self.hashes = dict(content["files"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            self.error(path, "cannot be read: expected the hashes of all files, as JSON")
            return
        if self.config is not None:
            for key, value in manifest_content(self.config, self.hashes).items():
                if content.get(key) != value:
                    self.error(path, f"its {key} is not that of {CONFIG} and of the files it lists")

    def load_statistics(self) -> None:
        """Compare the statistics, if there are some, with the files of the training split."""
        if not (self.folder / NORMALISATION).exists():
            return
        try:
            load_statistics(self.folder)
        except InputError as error:
            self.error(self.folder / NORMALISATION, _reason(self.folder / NORMALISATION, error))

    def files(self, paths: list[Path]) -> None:
        """Files that are missing, and such as do not belong here."""
        if self.plans is None:
            self._gaps(paths)
        for path in sorted(set(self.plans or ()) - set(paths)):
            self.error(path, "missing: config.toml asks for it")
        for path in sorted(path for path in self.folder.rglob("*") if path.is_file()):
            if path.suffix == ".part":
                text = "left over from a write that was interrupted; it may be deleted"
                self.warn(path, text)
            elif path not in paths and path not in [self.folder / name for name in _OTHERS]:
                self.warn(path, "not part of the data set")
        whole = self.plans is not None and set(self.plans) <= set(paths)
        if whole and not (self.folder / MANIFEST).exists():
            self.warn(self.folder, f"no {MANIFEST}: start generate again to write it")

    def _gaps(self, paths: list[Path]) -> None:
        """Numbers left out in a split, where no configuration tells how many there are."""
        for split in sorted({path.parent for path in paths}):
            numbers = {shard_number(path) for path in paths if path.parent == split}
            for number in sorted(set(range(max(numbers))) - numbers):
                self.error(split / f"mesh-{number:04d}{SUFFIX}", "missing: later numbers are there")

    def shard(self, path: Path) -> None:
        """Check one file, alone and against those before it."""
        try:
            shard = read_shard(path)
        except InputError as error:
            self.error(path, _reason(path, error))
            return
        found = shard.attributes["config_hash"]
        if self.config is not None and found != self.config.hash():
            wanted = self.config.hash()
            self.error(
                path, f"of another data set: its config_hash is {found!r}: expected {wanted!r}"
            )
            return
        try:
            HexMesh.create(shard.points, shard.cells.astype(np.int64))
        except MeshError as error:
            self.error(path, f"its mesh cannot be used: {str(error).removesuffix('.')}")
            return
        for message in _faults(shard):
            self.error(path, message)
        for message in self._config_faults(path, shard):
            self.error(path, message)
        self._origin(path, shard)
        self._repetitions(path, shard)

    def _config_faults(self, path: Path, shard: Shard) -> Iterator[str]:
        """Where a file is not what the configuration asks for."""
        wanted = {"split": path.parent.name, "number": shard_number(path)}
        plan = self.plans.get(path) if self.plans is not None else None
        if self.config is not None:
            wanted |= {
                "dataset": self.config.name,
                "setting": self.config.setting,
                "tolerance": self.config.tolerance,
            }
        if plan is not None:
            wanted["time_step"] = plan.step
        for name, value in wanted.items():
            if shard.attributes[name] != value:
                yield f"its {name} is {shard.attributes[name]!r}: expected {value!r}"
        name = self._short(path).removesuffix(SUFFIX)
        if self.hashes is not None and self.hashes.get(name) != stored_hashes(path)[1]:
            yield f"its content is not that of which {MANIFEST} has the hash"
        if self.plans is not None and plan is None:
            yield "config.toml does not ask for it"
        if plan is not None and self.config is not None:
            found = list(_plan_faults(self.config, plan, shard))
            yield from found
            if not found and self.repeat:
                limit = float(shard.attributes["tolerance"]) * _cell_size(shard)
                yield from step_faults(path, shard, self.repeat, limit)

    def _origin(self, path: Path, shard: Shard) -> None:
        """Changes of the code and of the device between files, where they tell."""
        for what, told in (("code", "made by other code than {} (SHA-256 {:.12})"),
                           ("device", "computed on another device than {}: {}")):  # fmt: skip
            own = shard.provenance.get(what)
            if own is None:
                continue
            known = self.origins.setdefault(what, {})
            if known and own not in known:
                self.warn(path, told.format(self._short(next(iter(known.values()))), own))
            known.setdefault(own, path)

    def _repetitions(self, path: Path, shard: Shard) -> None:
        """Meshes, materials and loads that came before."""
        shape, body = _digests(shard)
        first, twin = self.meshes.setdefault(shape, path), self.bodies.setdefault(body, path)
        if first.parent != path.parent and self.plans is None:
            self.warn(
                path,
                f"its mesh is that of {self._short(first)}: figures of this split are of one body "
                "under other loads, not of unseen bodies",
            )
        elif first.parent != path.parent:
            self.error(path, f"leakage: its mesh is that of {self._short(first)}, in another split")
        elif twin != path:
            self.error(path, f"its mesh and material are those of {self._short(twin)}")
        for k, simulation in enumerate(shard.simulations):
            key = shape + _digest(_cause(simulation))
            here = f"simulation {k:04d} of {self._short(path)}"
            before = self.forces.setdefault(key, here)
            if before != here:
                self.error(path, f"simulation {k:04d} has the mesh and the forces of {before}")

    def _short(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()


def _reason(path: Path, error: InputError) -> str:
    return str(error).removeprefix(f"{path}: ").removesuffix(".")


# --- one file ----------------------------------------------------------------------------


def _faults(shard: Shard) -> Iterator[str]:
    """What is wrong within one file whose mesh can be used."""
    for name in ("young", "density", "mass"):
        if getattr(shard, name).min() <= 0:
            yield f"{name} is {getattr(shard, name).min():g} somewhere: expected more than 0"
    cell = _cell_size(shard)
    for k, simulation in enumerate(shard.simulations):
        for message in _simulation_faults(shard, simulation, cell):
            yield f"simulation {k:04d}: {message}"
    yield from _unlike_runs(shard)


def _cell_size(shard: Shard) -> float:
    """Cube root of the mean cell volume, m."""
    volumes = jacobians(shard.points, shard.cells.astype(np.int64), gauss_points(2)).mean(axis=1)
    return float(np.cbrt(volumes.mean()))


def _simulation_faults(shard: Shard, simulation: Simulation, cell: float) -> Iterator[str]:
    reference = simulation.runs.get(REFERENCE)
    if reference is None or reference.positions is None:
        yield f"there is no rollout {REFERENCE!r}"
    yield from volume_faults(shard, simulation)
    if len(simulation.rejected) != simulation.attempt:
        yield (
            f"attempt is {simulation.attempt}, with {len(simulation.rejected)} reasons of "
            "rejected draws: expected as many"
        )
    for name, run in simulation.runs.items():
        for message in _run_faults(shard, run, cell):
            yield f"{name}: {message}"


def _run_faults(shard: Shard, run: Run, cell: float) -> Iterator[str]:
    errors = run.statistics.get("error_estimates")
    limit = float(shard.attributes["tolerance"]) * cell
    if errors is not None and errors.max() > limit * (1 + _SLACK):
        yield (
            f"the solver's error estimate is {errors.max():.3g} m after step "
            f"{errors.argmax() + 1}: expected at most {limit:.3g} m"
        )
    if run.positions is not None:
        away = _distance(run.positions[:1], shard.points)
        if away > _rounding(run.positions, shard.points, cell):
            yield f"frame 0 is {away:.3g} m off the rest shape"
    for name in ("positions", "predictions"):
        values = getattr(run, name)
        if values is None or shard.free.all():
            continue
        away = _distance(values, shard.points, ~shard.free)
        if away > _rounding(values, shard.points, cell):
            yield f"held nodes are up to {away:.3g} m off their place in its {name}"


def _distance(values: Array, points: Array, where: Array | None = None) -> float:
    """Largest difference of a component from its rest position, m."""
    moved = np.abs(values - points)
    return float(moved.max() if where is None else moved[:, where].max())


def _rounding(values: Array, points: Array, cell: float) -> float:
    """How far stored positions may be off for being rounded, m."""
    return float(4 * np.finfo(values.dtype).eps * np.abs(points).max() + 1e-9 * cell)


def _unlike_runs(shard: Shard) -> Iterator[str]:
    """Simulations that lack runs; the first one of a mesh may have some more."""
    first = set(shard.simulations[0].runs)
    names = [set(simulation.runs) for simulation in shard.simulations]
    common = set.union(*names[1:]) if len(names) > 1 else first
    for k, own in enumerate(names):
        missing = sorted(common - own)
        if missing:
            yield f"simulation {k:04d} has no run {missing[0]!r}, unlike others"


def _plan_faults(config: DatasetConfig, plan: MeshPlan, shard: Shard) -> Iterator[str]:
    """Where a file is not the mesh, the material, the loads and the runs that it should be."""
    if len(shard.simulations) != plan.simulations:
        yield f"{len(shard.simulations)} simulations: expected {plan.simulations}"
    problem = discretise(draw_scene(config, plan, 0))
    arrays: tuple[tuple[str, Array], ...] = (
        ("points", problem.positions),
        ("cells", problem.cells),
        ("free", problem.free),
        ("mass", problem.mass),
        ("young", problem.materials.young),
        ("poisson", problem.materials.poisson),
        ("density", problem.materials.density),
    )
    alike = True
    for name, wanted in arrays:
        found = getattr(shard, name)
        if found.shape != wanted.shape or not np.allclose(found, wanted, rtol=1e-12, atol=1e-12):
            alike = False
            yield f"its {name} is not what config.toml draws"
    for k, simulation in enumerate(shard.simulations):
        if simulation.steps != plan.frames:
            yield f"simulation {k:04d} has {simulation.steps} frames: expected {plan.frames}"
        scene = draw_scene(config, plan, k, simulation.attempt)
        if simulation.scene_toml != scene.to_toml():
            yield f"simulation {k:04d}: its scene is not the one that config.toml draws"
        if alike and simulation.steps == plan.frames:
            for message in load_faults(problem.with_loads(scene.loads), shard, simulation):
                yield f"simulation {k:04d}: {message}"
        named = {n for n, model in models(config, plan).items() if k == 0 or not model.sample}
        missing = sorted(named - set(simulation.runs))
        if missing:
            yield f"simulation {k:04d} has no run {missing[0]!r}"
    yield from model_faults(config, plan, shard)


# --- comparison of files -------------------------------------------------------------------


def _digests(shard: Shard) -> tuple[str, str]:
    """Equal for equal meshes, and for equal meshes with equal materials.

    Neither the numbering of nodes and cells nor the place in space matters.
    """
    scale = 1.0 / _cell_size(shard)
    points = _rounded(scale * (shard.points - shard.points.min(axis=0)))
    centres = points[shard.cells].mean(axis=1)
    shape = _digest(_sorted(points)) + _digest(_sorted(_rounded(centres)))
    material = np.column_stack([shard.young, shard.poisson, shard.density])
    return shape, shape + _digest(_sorted(np.hstack([_rounded(centres), material])))


def _cause(simulation: Simulation) -> Array:
    """What makes a simulation unlike others on its mesh: forces, or else how it starts."""
    reference = simulation.runs.get(REFERENCE)
    if simulation.forces.any() or reference is None or reference.positions is None:
        return simulation.forces
    return reference.positions[:2]


def _rounded(values: Array) -> Array:
    return np.round(values, _DIGITS) + 0.0  # no minus zero


def _sorted(rows: Array) -> Array:
    return rows[np.lexsort(rows.T)]


def _digest(values: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).data).hexdigest()
