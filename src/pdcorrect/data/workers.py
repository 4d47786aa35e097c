"""`Workers`: who computes a data set's files, in this process or by Dask in others."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

import numba

from pdcorrect._environment import code_digest, environment
from pdcorrect._files import ctrl_c_ignored
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.engines import Engine, OneByOne
from pdcorrect.data.plan import MeshPlan
from pdcorrect.data.schema import write_shard
from pdcorrect.data.simulate import Engines, simulate
from pdcorrect.errors import InputError, require_extra


def produce(
    config: DatasetConfig, folder: Path, plans: list[MeshPlan], device: str
) -> list[MeshPlan]:
    """Compute and write some meshes' files."""
    engines = make_engines(config, device)
    with one_thread():
        shards = simulate(config, plans, engines)
    provenance = _provenance(config, device)
    for plan, shard in zip(plans, shards, strict=True):
        named = replace(shard, provenance=provenance)
        write_shard(plan.path(folder), named, config.dtype, overwrite=True)
    return plans


def make_engines(config: DatasetConfig, device: str) -> Engines:
    """The engines for a device; Newton steps one problem after the other on the CPU."""
    adds_up = config.setting == "converged"
    models: Engine = OneByOne("pd", config.tolerance, adds_up)
    if device != "cpu":
        require_extra("torch", "learn")
        from pdcorrect.data.batch_engine import Batched

        models = Batched(device, config.tolerance, adds_up=adds_up)
    newton = config.reference.solver == "newton"
    return Engines(models, OneByOne("newton", config.tolerance, adds_up) if newton else models)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Kernels on one thread, so that the numbers do not depend on how many there are."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _provenance(config: DatasetConfig, device: str) -> dict[str, str]:
    if device.startswith("cuda"):
        import torch

        device = str(torch.cuda.get_device_name(device))
    return {
        **environment(),
        "code": code_digest(),
        "threads": "1",
        "device": device,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "configuration": config.to_toml(),
    }


_PATIENCE, _ANSWER = 600, 10
"""Seconds to wait for the first worker of a scheduler, and for a scheduler's answer."""


@dataclass(frozen=True)
class Workers:
    """Who computes.

    Raises
    ------
    InputError
        If ``count`` or ``batch`` is less than 1, or the device is another.
    """

    count: int = 1  # processes on this machine, each with one thread
    scheduler: str | None = None  # address of a Dask scheduler whose workers are used instead
    # "cpu": one simulation at a time.  "cuda": batches; with several workers on this machine each
    # takes a GPU of its own
    device: str = "cpu"
    batch: int = 32  # simulations that are computed together on a GPU

    def __post_init__(self) -> None:
        for name, value in (("count", self.count), ("batch", self.batch)):
            if value < 1:
                raise InputError(f"{name} = {value}: expected 1 or more.")
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise InputError(f"device {self.device!r}: expected cpu, cuda or cuda:N.")


ONE_WORKER = Workers()
"""This process, on the CPU."""


def computed(
    config: DatasetConfig,
    folder: Path,
    units: Sequence[list[MeshPlan]],
    workers: Workers,
    deadline: float | None,
) -> Iterator[list[MeshPlan]]:
    """Units in order of completion; none is begun after the deadline."""
    waiting = takewhile(lambda _: deadline is None or time.monotonic() <= deadline, units)
    if workers.scheduler is None and min(workers.count, len(units)) < 2:
        for unit in waiting:
            yield produce(config, folder, unit, workers.device)
        return
    yield from _distributed(partial(_work, config, folder.resolve()), waiting, workers)


def _distributed(
    work: Callable[[list[MeshPlan], str], list[MeshPlan]],
    waiting: Iterator[list[MeshPlan]],
    workers: Workers,
) -> Iterator[list[MeshPlan]]:
    """The same on Dask workers: a unit is handed out when a worker is free."""
    distributed = require_extra("distributed", "cluster")
    with _client(distributed, workers) as client, client.as_current():
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError:
            raise InputError(
                f"--scheduler: no worker joined in {_PATIENCE} s: expected one or more."
            ) from None
        running = distributed.as_completed(raise_errors=True)

        def hand_out() -> None:
            """Keep every worker busy, also those that have joined since."""
            while running.count() < sum(client.nthreads().values()):
                unit = next(waiting, None)
                if unit is None:
                    return
                running.add(client.submit(work, unit, workers.device, pure=False))

        hand_out()
        for future in running:
            yield future.result()
            hand_out()


def _client(distributed: Any, workers: Workers) -> Any:
    """A client of the given scheduler, or of new processes on this machine."""
    address = workers.scheduler
    if address is None:
        return distributed.Client(local_cluster(workers.count), set_as_default=False)
    try:
        return distributed.Client(address, timeout=_ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {address}: no scheduler answers there ({error}): expected the address of "
            "one that is running, such as tcp://HOST:8786."
        ) from None


def local_cluster(count: int) -> Any:
    """A Dask cluster of ``count`` processes on this machine, each with one thread.

    Its workers are named 0, 1, ..., by which each finds a GPU of its own.
    """
    distributed = require_extra("distributed", "cluster")
    with ctrl_c_ignored():
        return distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0",
            memory_limit=0, silence_logs=logging.CRITICAL,  # errors come with the results
        )  # fmt: skip


@contextlib.contextmanager
def local_scheduler(count: int) -> Iterator[str | None]:
    """The address of a cluster of ``count`` processes on this machine; None if that is one.

    Many may take longer to leave than Dask waits for; these end with this process.
    """
    if count < 2:
        yield None
        return
    cluster = local_cluster(count)
    try:
        yield cluster.scheduler_address
    finally:
        with contextlib.suppress(TimeoutError):
            cluster.close()


def _work(
    config: DatasetConfig, folder: Path, plans: list[MeshPlan], device: str
) -> list[MeshPlan]:
    """`produce` on a Dask worker; its name says which GPU of the machine is its own."""
    name = str(require_extra("distributed", "cluster").get_worker().name)
    if device == "cuda" and name.isdigit():
        device = _own_gpu(int(name))
    return produce(config, folder, plans, device)


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    import torch

    count = torch.cuda.device_count()
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",")[:count] if named else [str(k) for k in range(count)]


def _own_gpu(worker: int) -> str:
    """The device of a worker, by its number.

    Where CUDA has not started yet its process sees no other: kernels that are compiled for the
    first GPU are then found in the caches by all workers.
    """
    import torch

    gpus = visible_gpus()
    if len(gpus) > 1:
        own = worker % len(gpus)
        if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
            return f"cuda:{own}"
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[own]
    return "cuda"
