"""What a worker does for one file of a data set: it computes the simulations and writes them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numba

from pdcorrect._environment import code_digest, environment
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.engines import OneByOne
from pdcorrect.data.plan import MeshPlan
from pdcorrect.data.schema import SUFFIX, write_shard
from pdcorrect.data.simulate import Engines, simulate
from pdcorrect.errors import require_extra

LARGEST_BATCHED = 150_000
"""Nodes of the largest mesh that is stepped in batches.

A step takes about 11 kB a node of hex8-bubble-mean (`pdcorrect.batch.states`), so a batch of 32
such meshes takes 56 GB.  The published meshes cut into 8 x 8 x 8 have 138 000 nodes.
"""


def produce(
    config: DatasetConfig, folder: Path, plans: list[MeshPlan], device: str
) -> list[MeshPlan]:
    """Compute and write some meshes' files."""
    engines = make_engines(config, device)
    with one_thread():
        shards = simulate(config, plans, engines)
    provenance = _provenance(config, device)
    for plan, shard in zip(plans, shards, strict=True):
        path = shard_path(folder, plan)
        write_shard(path, replace(shard, provenance=provenance), config.dtype, overwrite=True)
    return plans


def shard_path(folder: Path, plan: MeshPlan) -> Path:
    """Where a mesh's file belongs."""
    return folder / f"{plan.name}{SUFFIX}"


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
    date = time.strftime("%Y-%m-%d", time.gmtime())
    return {
        **environment(),
        "code": code_digest(),
        "threads": "1",
        "device": _device_name(device),
        "date": date,
        "configuration": config.to_toml(),
    }


def _device_name(device: str) -> str:
    if not device.startswith("cuda"):
        return device
    import torch

    return str(torch.cuda.get_device_name(device))
