"""`generate`: the files of a data set, in any order, by any number of workers.

Each file is computed from the configuration alone and appears under its name only when it
is whole, so an interrupted generation is continued by starting it again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from pdcorrect._files import clear_parts, make_folder, write_text
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.folder import all_shards, manifest_content
from pdcorrect.data.plan import MeshPlan, make_plan
from pdcorrect.data.schema import CONFIG, MANIFEST, read_header
from pdcorrect.data.simulate import lacking, work_per_node
from pdcorrect.data.workers import ONE_WORKER, Workers, computed
from pdcorrect.errors import FileFormatError, FileVersionError, InputError

_LONGEST = 4  # most of the work of a full batch of usual simulations that a GPU takes at once

OnBegin = Callable[[int, int, Sequence[str]], None]
"""Called before anything is computed: how many simulations of how many are there, and the names
of damaged files that will be computed again.
"""
OnFile = Callable[[str, int, int, int], None]
"""Called with a finished file's name, how many simulations of how many are there now, and how
many of them are new.
"""


@dataclass(frozen=True)
class Generated:
    """What is there of a data set; true if that is all that was asked for."""

    # by split: how many simulations of how many are there
    simulations: Mapping[str, tuple[int, int]]
    asked: tuple[str, ...]  # splits that were to be computed

    def __bool__(self) -> bool:
        return all(self.simulations[name][0] == self.simulations[name][1] for name in self.asked)

    def __str__(self) -> str:
        if all(there == total for there, total in self.simulations.values()):
            return "complete"
        told = ", ".join(f"{name} {k} of {total}" for name, (k, total) in self.simulations.items())
        return f"{told} simulations are there; the same command goes on"


def generate(
    config: DatasetConfig,
    folder: str | Path,
    workers: Workers = ONE_WORKER,
    *,
    splits: Sequence[str] | None = None,
    seconds: float | None = None,
    on_begin: OnBegin | None = None,
    on_file: OnFile | None = None,
) -> Generated:
    """Compute what is not there yet of a data set, and again what is damaged.

    Parameters
    ----------
    config : DatasetConfig
    folder : path
        New, or of a generation of the same configuration that was interrupted.
    workers : Workers
    splits : sequence of str, optional
        Only these.
    seconds : float, optional
        Begin nothing new after so much time; what is under way is finished.
    on_begin, on_file : callable, optional
        For progress, see `OnBegin` and `OnFile`.

    Returns
    -------
    Generated
        True if all that was asked for is there.  Once that is the whole data set,
        ``manifest.json`` lists the hashes of its files.

    Raises
    ------
    InputError
        If the folder holds another data set, a split is unknown, the family has fewer bodies
        than the configuration asks for, or no scheduler or worker answers.
    ConvergenceError, OutputError
        If the loads are so strong that no draw is accepted, or a file cannot be written.
    """
    folder = Path(folder)
    plans = make_plan(config)
    chosen = _chosen(plans, splits)
    _claim(config, folder)
    clear_parts(folder)
    hashes = {plan.name: finished(config, folder, plan) for plan in chosen}
    missing = [plan for plan in chosen if hashes[plan.name] is None]
    total, left = (sum(plan.simulations for plan in part) for part in (chosen, missing))
    if on_begin:
        on_begin(total - left, total, [p.name for p in missing if p.path(folder).exists()])
    deadline = None if seconds is None else time.monotonic() + seconds
    begun = left
    for unit in computed(config, folder, _units(config, missing, workers), workers, deadline):
        for plan in unit:
            left -= plan.simulations
            if on_file:
                on_file(plan.name, total - left, total, begun - left)
    for plan in plans:
        if hashes.get(plan.name) is None:
            hashes[plan.name] = finished(config, folder, plan)
    if None not in hashes.values():
        write_text(folder / MANIFEST, json.dumps(manifest_content(config, hashes), indent=1) + "\n")
    counts: dict[str, tuple[int, int]] = {}
    for plan in plans:
        there, total = counts.get(plan.split, (0, 0))
        new = 0 if hashes[plan.name] is None else plan.simulations
        counts[plan.split] = there + new, total + plan.simulations
    return Generated(counts, tuple(dict.fromkeys(plan.split for plan in chosen)))


def finished(config: DatasetConfig, folder: Path, plan: MeshPlan) -> str | None:
    """The hash of a mesh's file; None if there is none, or one that is to be made again.

    That is one that is damaged, or lacks a run or the single steps of one.
    """
    path = plan.path(folder)
    if not path.exists():
        return None
    try:
        header = read_header(path, verify=True)
    except FileVersionError:
        raise
    except FileFormatError:
        return None
    if header.config_hash != config.hash():
        raise InputError(f"{path} is of another data set: move it, or use another folder.")
    if any(lacking(config, plan, number, *has) for number, has in enumerate(header.runs)):
        return None
    return header.content_hash


def _claim(config: DatasetConfig, folder: Path) -> None:
    """Make the folder this configuration's, or find that it is."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: not a folder: expected that of a data set, or a new one.")
    path = folder / CONFIG
    if path.exists():
        if DatasetConfig.load(path).hash() != config.hash():
            raise InputError(
                f"{path} is another configuration: expected a new folder, or the one that this "
                "data set was begun in."
            )
        return
    if all_shards(folder):
        raise InputError(f"{folder} holds files of meshes but no {CONFIG}: use another folder.")
    make_folder(folder)
    write_text(path, config.to_toml())


def _chosen(plans: Sequence[MeshPlan], splits: Sequence[str] | None) -> list[MeshPlan]:
    if splits is None:
        return list(plans)
    known = list(dict.fromkeys(plan.split for plan in plans))
    unknown = sorted(set(splits) - set(known))
    if unknown:
        raise InputError(f"splits {', '.join(unknown)}: expected some of {', '.join(known)}.")
    return [plan for plan in plans if plan.split in splits]


def _units(
    config: DatasetConfig, plans: Sequence[MeshPlan], workers: Workers
) -> list[list[MeshPlan]]:
    """What is computed together: a mesh on a CPU, some meshes of one split on a GPU.

    There meshes of like size, since a batch is padded to its largest, and the longest units
    first, so that none is left over when all others are done.
    """
    if workers.device == "cpu":
        return [[plan] for plan in plans]
    splits = list(dict.fromkeys(plan.split for plan in plans))
    plans = sorted(plans, key=lambda plan: (splits.index(plan.split), plan.design.nodes))
    usual = median([work_per_node(config, plan) for plan in plans] or [0.0])
    most = _LONGEST * workers.batch * usual
    units: list[list[MeshPlan]] = []
    count, work = 0, 0.0
    for plan in plans:
        own = plan.simulations * work_per_node(config, plan)
        fits = count + plan.simulations <= workers.batch and work + own <= most
        if not units or units[-1][0].split != plan.split or not fits:
            units.append([])
            count, work = 0, 0.0
        units[-1].append(plan)
        count, work = count + plan.simulations, work + own
    return sorted(units, key=lambda unit: -unit_work(config, unit))


def unit_work(config: DatasetConfig, unit: Sequence[MeshPlan]) -> float:
    """About how much it is to compute some meshes: steps of nodes."""
    return sum(p.simulations * p.design.nodes * work_per_node(config, p) for p in unit)
