"""Answers of many bodies in files, computed by several processes; started again, it goes on."""

from __future__ import annotations

import json
import os
import time
import zipfile
import zlib
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import make_folder, replacing, write_text
from pdcorrect.data.workers import one_thread
from pdcorrect.elements.answers import Answers, answers
from pdcorrect.elements.bodies import draw
from pdcorrect.errors import InputError

Array = NDArray[Any]

A_FILE = 25
"""Bodies in a file."""
_TURN, _FREE, _CUT = 10, 8, 9
"""Of ten files the ninth has free bodies, the tenth cut ones, see `draw`."""
_KIND = "bodies.json"
DRAWN = 2
"""Counts the ways in which bodies and loads have been drawn."""
_HALF = ("forces", "displacements", "modes")
"""Kept in half precision, each load and mode over its largest number: errors of 2e-4."""


def generate(
    folder: Path, count: int, seed: int, workers: int = 1, seconds: float | None = None
) -> int:
    """Compute the files that are missing of ``count`` bodies; how many are still missing.

    Body i depends on the seed and i alone.  After ``seconds`` nothing new is begun.

    Raises
    ------
    InputError
        If the folder has bodies of another seed or another way to draw them.
    """
    make_folder(folder)
    _mark(folder, {"drawn": DRAWN, "seed": seed})
    deadline = None if seconds is None else time.monotonic() + seconds
    paths = enumerate(file_paths(folder, count))
    missing = [(path, seed, n, deadline) for n, path in paths if not path.exists()]
    if workers == 1:
        return sum(not _write(*each) for each in missing)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        tasks = [pool.submit(_write, *each) for each in missing]
        return sum(not task.result() for task in as_completed(tasks))


def _mark(folder: Path, kind: dict[str, int]) -> None:
    """Write what a folder's bodies are, or refuse them if they are not."""
    path = folder / _KIND
    if not path.exists() and not any(folder.glob("bodies-*.npz")):
        write_text(path, json.dumps(kind) + "\n")
        return
    if (found := json.loads(path.read_text()) if path.exists() else {}) != kind:
        raise InputError(f"{path}: of {found}: expected {kind}. Use another folder.")


def read_file(path: Path) -> list[Answers]:
    """The bodies of one file."""
    try:
        with np.load(path) as data:
            return [
                Answers(**{name: _read(data, f"{i}/{name}") for name in Answers._fields})
                for i in range(A_FILE)
            ]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: {error}. Delete it and generate again.") from None


def _read(data: Mapping[str, Array], name: str) -> Any:
    kept, scale = data[name], f"{name} largest"
    return kept * data[scale] if scale in data else kept


def file_paths(folder: Path, count: int) -> list[Path]:
    """Files of the first ``count`` bodies."""
    return [folder / f"bodies-{number:04d}.npz" for number in range(-(-count // A_FILE))]


def _write(path: Path, seed: int, number: int, deadline: float | None) -> bool:
    """One file, unless it is too late."""
    if deadline is not None and time.monotonic() > deadline:
        return False
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    arrays: dict[str, Any] = {}
    with one_thread():
        for i in range(A_FILE):
            rng = np.random.default_rng([seed, number * A_FILE + i])
            body = draw(rng, cut=number % _TURN == _CUT, free=number % _TURN == _FREE)
            found = answers(body, rng)
            for name, value in found._asdict().items():
                kept, key = np.asarray(value), f"{i}/{name}"
                if name in _HALF:
                    largest = np.abs(kept).max(axis=(1, 2), keepdims=True) + 1e-300
                    arrays[f"{key} largest"] = largest
                    kept = (kept / largest).astype(np.float16)
                arrays[key] = kept
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return True
