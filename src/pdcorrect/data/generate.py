"""`generate`: the files of a data set, in any order, by any number of workers.

Each file is computed from the configuration alone and appears under its name only when it
is whole, so an interrupted generation is continued by starting it again.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba

from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.engines import OneByOne
from pdcorrect.data.folder import all_shards
from pdcorrect.data.plan import MeshPlan, make_plan
from pdcorrect.data.schema import (
    CONFIG,
    MANIFEST,
    SUFFIX,
    write_shard,
)
from pdcorrect.data.shard_reader import stored_hashes
from pdcorrect.data.simulate import Engines, simulate
from pdcorrect.environment import code_digest, environment
from pdcorrect.errors import (
    FileFormatError,
    FileVersionError,
    InputError,
    require_extra,
)
from pdcorrect.replacement import clear_parts, make_folder, write_text

LARGEST_BATCHED = 150_000
"""Nodes of the largest mesh that is stepped in batches.

A step takes about 11 kB a node of hex8-bubble-mean (`pdcorrect.batch.memory`), so a batch of 32
such meshes takes 56 GB.  The published meshes cut into 8 x 8 x 8 have 138 000 nodes.
"""
_PATIENCE = 600
"""Seconds to wait for the first worker of a scheduler."""
_ANSWER = 10
"""Seconds to wait for a scheduler's answer."""
_MOST_DIFFERENCES = 5
"""Keys of another configuration that are told."""
OnBegin = Callable[[int, int, Sequence[str]], None]
"""Called once before anything is computed with how many simulations of how many are there, and
with the names of files that are damaged and will be computed again.
"""
OnFile = Callable[[str, int, int, int], None]
"""Called with a finished file's name, how many simulations of how many are there now, and how
many of them are new since the generation was started.
"""


@dataclass(frozen=True)
class Workers:
    """Who computes.

    Attributes
    ----------
    count : int
        Processes on this machine, each with one thread.
    scheduler : str or None
        Address of a Dask scheduler whose workers are used instead.
    device : str
        "cpu": one simulation at a time.  "cuda": batches; with several workers on this
        machine each takes a GPU of its own.
    batch : int
        Simulations that are computed together on a GPU.

    Raises
    ------
    InputError
        If ``count`` or ``batch`` is less than 1.
    """

    count: int = 1
    scheduler: str | None = None
    device: str = "cpu"
    batch: int = 32

    def __post_init__(self) -> None:
        for name, value in (("count", self.count), ("batch", self.batch)):
            if value < 1:
                raise InputError(f"{name} = {value}: expected 1 or more.")


@dataclass(frozen=True)
class Generated:
    """What is there of a data set; true if that is all that was asked for.

    Attributes
    ----------
    simulations : mapping of str to (int, int)
        By split: how many simulations of how many are there.
    asked : tuple of str
        Splits that were to be computed.
    """

    simulations: Mapping[str, tuple[int, int]]
    asked: tuple[str, ...]

    def __bool__(self) -> bool:
        return not set(self.missing) & set(self.asked)

    @property
    def missing(self) -> list[str]:
        """Splits of which something is missing."""
        return [name for name, (there, total) in self.simulations.items() if there < total]

    def __str__(self) -> str:
        if not self:
            there, total = (sum(self.simulations[name][k] for name in self.asked) for k in (0, 1))
            return f"{there} of {total} simulations are there; the same command goes on"
        if not self.missing:
            return "complete"
        verb = "is" if len(self.missing) == 1 else "are"
        complete = [name for name in self.simulations if name not in self.missing]
        return f"{', '.join(complete)} complete; {', '.join(self.missing)} {verb} still missing"


def generate(
    config: DatasetConfig,
    folder: str | Path,
    workers: Workers = Workers(),
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
        New, or of a generation of the same configuration that was interrupted.  One that was
        begun with another configuration is taken over as long as it holds no file of a mesh
        and its ``config.toml`` is as it was written.
    workers : Workers
    splits : sequence of str, optional
        Only these.
    seconds : float, optional
        Begin nothing new after so much time; what is under way is finished.
    on_begin, on_file : callable, optional
        For progress.

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
    ConvergenceError
        If the loads are so strong that no draw is accepted.
    OutputError
        If a file cannot be written.
    """
    folder = Path(folder)
    check_device(workers.device)
    if seconds is not None and not seconds >= 0:
        raise InputError(f"seconds = {seconds}: expected 0 or more.")
    plans = make_plan(config)
    chosen = _chosen(plans, splits)
    _claim(config, folder)
    clear_parts(folder)
    hashes = {plan.name: finished(config, folder, plan) for plan in chosen}
    missing = [plan for plan in chosen if hashes[plan.name] is None]
    total, left = (sum(plan.simulations for plan in part) for part in (chosen, missing))
    if on_begin:
        on_begin(total - left, total, [p.name for p in missing if _file(folder, p).exists()])
    deadline = None if seconds is None else time.monotonic() + seconds
    begun = left
    for unit in _compute(config, folder, _units(missing, workers), workers, deadline):
        for plan in unit:
            left -= plan.simulations
            if on_file:
                on_file(plan.name, total - left, total, begun - left)
    for plan in plans:
        if hashes.get(plan.name) is None:
            hashes[plan.name] = finished(config, folder, plan)
    _write_manifest(config, folder, hashes)
    return _generated(plans, chosen, hashes)


def _generated(
    plans: Sequence[MeshPlan], chosen: Sequence[MeshPlan], hashes: Mapping[str, str | None]
) -> Generated:
    counts: dict[str, tuple[int, int]] = {}
    for plan in plans:
        there, total = counts.get(plan.split, (0, 0))
        new = 0 if hashes[plan.name] is None else plan.simulations
        counts[plan.split] = there + new, total + plan.simulations
    return Generated(counts, tuple(dict.fromkeys(plan.split for plan in chosen)))


def finished(config: DatasetConfig, folder: Path, plan: MeshPlan) -> str | None:
    """The hash of a mesh's file; None if there is none, or a damaged one to be made again.

    Raises
    ------
    InputError
        If there is a whole file of something else.
    """
    path = _file(folder, plan)
    if not path.exists():
        return None
    try:
        config_hash, content_hash = stored_hashes(path)
    except FileVersionError:
        raise
    except FileFormatError:
        return None
    if config_hash != config.hash():
        raise InputError(f"{path} is of another data set: move it, or use another folder.")
    return content_hash


def _file(folder: Path, plan: MeshPlan) -> Path:
    return folder / f"{plan.name}{SUFFIX}"


def _claim(config: DatasetConfig, folder: Path) -> None:
    """Make the folder this configuration's, or find that it is."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: not a folder: expected that of a data set, or a new one.")
    path = folder / CONFIG
    if path.exists() and not _replaceable(config, path):
        return
    if not path.exists() and all_shards(folder):
        raise InputError(f"{folder} holds files of meshes but no {CONFIG}: use another folder.")
    make_folder(folder)
    write_text(path, config.to_toml())


def _replaceable(config: DatasetConfig, path: Path) -> bool:
    """Whether ``config.toml`` was written here for another configuration and never used.

    Raises
    ------
    InputError
        If it is another one and in use, or written by hand.
    """
    there = DatasetConfig.load(path)
    if there.hash() == config.hash():
        return False
    if not all_shards(path.parent) and path.read_text(encoding="utf-8") == there.to_toml():
        return True
    found = config.differences(there)
    told = "; ".join(found[:_MOST_DIFFERENCES])
    more = len(found) - _MOST_DIFFERENCES
    raise InputError(
        f"{path} is another configuration ({told}{f'; {more} more' if more > 0 else ''}): expected "
        "a new folder, or the one that this data set was begun in."
    )


def _chosen(plans: Sequence[MeshPlan], splits: Sequence[str] | None) -> list[MeshPlan]:
    if splits is None:
        return list(plans)
    if isinstance(splits, str):
        raise InputError(f"splits = {splits!r}: expected a list of names, such as [{splits!r}].")
    known = list(dict.fromkeys(plan.split for plan in plans))
    unknown = sorted(set(splits) - set(known))
    if unknown:
        raise InputError(f"splits {', '.join(unknown)}: expected some of {', '.join(known)}.")
    return [plan for plan in plans if plan.split in splits]


def _units(plans: Sequence[MeshPlan], workers: Workers) -> list[list[MeshPlan]]:
    """What is computed together: a mesh on a CPU, some meshes of one split on a GPU.

    There meshes of like size, since a batch is padded to its largest.
    """
    if workers.device == "cpu":
        return [[plan] for plan in plans]
    splits = list(dict.fromkeys(plan.split for plan in plans))
    plans = sorted(plans, key=lambda plan: (splits.index(plan.split), plan.design.nodes))
    units: list[list[MeshPlan]] = []
    count = 0
    for plan in plans:
        fits = count + plan.simulations <= workers.batch
        if not units or units[-1][0].split != plan.split or not fits:
            units.append([])
            count = 0
        units[-1].append(plan)
        count += plan.simulations
    return units


def produce(
    config: DatasetConfig, folder: Path, plans: list[MeshPlan], device: str
) -> list[MeshPlan]:
    """Compute and write some meshes' files."""
    engines = make_engines(config, device)
    with one_thread():
        shards = simulate(config, plans, engines)
    provenance = _provenance(device)
    for plan, shard in zip(plans, shards, strict=True):
        path = _file(folder, plan)
        write_shard(path, replace(shard, provenance=provenance), config.dtype, overwrite=True)
    return plans


def check_device(device: str) -> None:
    """Refuse what is neither the CPU nor a CUDA device."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise InputError(f"device {device!r}: expected cpu, cuda or cuda:N.")


def make_engines(config: DatasetConfig, device: str) -> Engines:
    """The engines for a device.

    Newton, and on a GPU meshes of more than `LARGEST_BATCHED` nodes, of which a batch might
    not fit, step one problem after the other on the CPU.
    """
    alone = OneByOne("pd", config.tolerance)
    newton = config.reference.solver == "newton"
    truth = OneByOne("newton", config.tolerance) if newton else None
    if device == "cpu":
        return Engines(alone, truth or alone, truth or alone)
    require_extra("torch", "learn")
    from pdcorrect.data.batch_engine import Batched

    batched = Batched(device, config.tolerance)
    return Engines(batched, truth or batched, truth or alone, LARGEST_BATCHED)


def _compute(
    config: DatasetConfig,
    folder: Path,
    units: Sequence[list[MeshPlan]],
    workers: Workers,
    deadline: float | None,
) -> Iterator[list[MeshPlan]]:
    """Units in order of completion."""
    if workers.scheduler is None and min(workers.count, len(units)) < 2:
        for unit in units:
            if _over(deadline):
                return
            yield produce(config, folder, unit, workers.device)
        return
    yield from _distributed(config, folder, units, workers, deadline)


def _over(deadline: float | None) -> bool:
    return deadline is not None and time.monotonic() > deadline


def _distributed(
    config: DatasetConfig,
    folder: Path,
    units: Sequence[list[MeshPlan]],
    workers: Workers,
    deadline: float | None,
) -> Iterator[list[MeshPlan]]:
    """The same on Dask workers: a unit is handed out when a worker is free."""
    distributed = require_extra("distributed", "cluster")
    folder = folder.resolve()
    with _client(distributed, workers) as client, client.as_current():
        _wait_for_worker(client)
        waiting = iter(units)
        running = distributed.as_completed(raise_errors=True)

        def hand_out() -> None:
            """Keep every worker busy, also those that have joined since."""
            while running.count() < sum(client.nthreads().values()):
                unit = None if _over(deadline) else next(waiting, None)
                if unit is None:
                    return
                call = client.submit(_work, config, folder, unit, workers.device, pure=False)
                running.add(call)

        hand_out()
        for future in running:
            yield future.result()
            hand_out()


def _client(distributed: Any, workers: Workers) -> Any:
    """A client of the given scheduler, or of new processes on this machine."""
    if workers.scheduler is not None:
        return _scheduler_client(distributed, workers.scheduler)
    return distributed.Client(local_cluster(workers.count), set_as_default=False)


def local_cluster(count: int) -> Any:
    """A Dask cluster of ``count`` processes on this machine, each with one thread.

    Its workers are named 0, 1, ..., by which each finds a GPU of its own.
    """
    distributed = require_extra("distributed", "cluster")
    names = {"n_workers": count, "threads_per_worker": 1, "processes": True}
    quiet = {"silence_logs": logging.CRITICAL}  # errors come with the results
    with _ctrl_c_ignored():
        return distributed.LocalCluster(**names, **quiet, dashboard_address=":0", memory_limit=0)


@contextlib.contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    """For processes started now: this one ends them, and they need not complain of Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _scheduler_client(distributed: Any, address: str) -> Any:
    """A client of a scheduler that was seen to answer: a failed one takes long to close."""
    with ThreadPoolExecutor(1) as thread:  # this one may have a loop of its own
        try:
            thread.submit(asyncio.run, _greet(address)).result()
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler {address}: no scheduler answers there ({error}): expected the "
                "address of one that is running, such as tcp://HOST:8786."
            ) from None
    return distributed.Client(address, set_as_default=False)


async def _greet(address: str) -> None:
    """Connect to a scheduler and leave."""
    comm = await require_extra("distributed.comm", "cluster").connect(address, timeout=_ANSWER)
    await comm.close()


def _wait_for_worker(client: Any) -> None:
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError:
        raise InputError(
            f"--scheduler: no worker joined in {_PATIENCE} s: expected one or more."
        ) from None


def _work(
    config: DatasetConfig, folder: Path, plans: list[MeshPlan], device: str
) -> list[MeshPlan]:
    """`produce` on a Dask worker; its name says which GPU of the machine is its own."""
    if device == "cuda":
        import torch
        from distributed import get_worker

        name = str(get_worker().name)
        if name.isdigit():
            device = f"cuda:{int(name) % torch.cuda.device_count()}"
    return produce(config, folder, plans, device)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Kernels on one thread, so that the numbers do not depend on how many there are."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _provenance(device: str) -> dict[str, str]:
    date = time.strftime("%Y-%m-%d", time.gmtime())
    return {
        **environment(),
        "code": code_digest(),
        "threads": "1",
        "device": _device_name(device),
        "date": date,
    }


def _device_name(device: str) -> str:
    if not device.startswith("cuda"):
        return device
    import torch

    return str(torch.cuda.get_device_name(device))


def _write_manifest(config: DatasetConfig, folder: Path, hashes: Mapping[str, str | None]) -> None:
    """List the files' hashes if all are there."""
    if None in hashes.values():
        return
    whole = hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()
    content = {
        "dataset": config.name,
        "config_hash": config.hash(),
        "content_hash": whole,
        "files": dict(hashes),
    }
    write_text(folder / MANIFEST, json.dumps(content, indent=1) + "\n")
