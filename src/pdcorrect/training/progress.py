"""`Progress`: where a training is; its checkpoints, and `HistoryFile`, its rows of numbers.

A checkpoint is one safetensors file that is replaced whole; JSON lies in its metadata, with a
SHA-256 over everything else, so that a damaged file is refused.  Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from pdcorrect._config import as_toml
from pdcorrect._files import write_bytes
from pdcorrect.errors import (
    FileFormatError,
    FileVersionError,
    InputError,
    OutputError,
    require_extra,
)
from pdcorrect.training.recipe import Every

require_extra("safetensors", "learn")
require_extra("tensorboard", "learn")

from safetensors import SafetensorError, safe_open  # noqa: E402
from safetensors import torch as safetensors  # noqa: E402
from torch.utils.tensorboard import SummaryWriter  # noqa: E402

FORMAT = "pdcorrect-checkpoint"
VERSION = 1
NAME = "history.csv"
COLUMNS = (
    "iteration", "stage", "seconds", "loss", "rate", "steps", "skipped", "failed_scenes",
    "omega_mean", "omega_median", "omega_least", "failed_rollouts",
)  # fmt: skip


@dataclass
class Mark:
    """When something was done last: iteration and second of the training."""

    iteration: int = 0
    seconds: float = 0.0


@dataclass
class Progress:
    """Where a training is."""

    # number of the stage, and iterations done in it
    stage: int = 0
    iteration: int = 0
    total: int = 0  # iterations in all stages
    # time spent in the stage and in all, interruptions not counted
    stage_seconds: float = 0.0
    seconds: float = 0.0
    validated: Mark = field(default_factory=Mark)
    saved: Mark = field(default_factory=Mark)
    best: float | None = None  # mean Omega of the best weights so far, per cent
    metrics: dict[str, float] = field(default_factory=dict)  # of the best weights

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Progress:
        """From ``dataclasses.asdict``."""
        marks = {name: Mark(**content[name]) for name in ("validated", "saved")}
        return cls(**{**content, **marks})

    def due(self, every: Every, last: Mark) -> bool:
        """Whether it is time for something again."""
        if every.iterations is not None:
            return self.total - last.iteration >= every.iterations
        return self.seconds - last.seconds >= (every.seconds or 0.0)

    def now(self) -> Mark:
        """The present moment."""
        return Mark(self.total, self.seconds)

    def stepped(self, seconds: float) -> None:
        """Count an iteration."""
        self.iteration, self.total = self.iteration + 1, self.total + 1
        self.passed(seconds)

    def passed(self, seconds: float) -> None:
        """Count time."""
        self.stage_seconds += seconds
        self.seconds += seconds

    def next_stage(self) -> None:
        """Begin another stage."""
        self.stage, self.iteration, self.stage_seconds = self.stage + 1, 0, 0.0


def check_same(found: Any, expected: Any, where: str, key: str = "") -> None:
    """Refuse to go on with other settings, naming the first that differs.

    A key that is not there counts as one of None.
    """
    if isinstance(found, dict) and isinstance(expected, dict):
        for name in sorted(found.keys() | expected.keys()):
            check_same(found.get(name), expected.get(name), where, f"{key}.{name}".lstrip("."))
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        for k, (one, other) in enumerate(zip(found, expected, strict=True)):
            check_same(one, other, where, f"{key}.{k}")
    elif found != expected:
        before, now = ("none" if x is None else f"{as_toml(x):.80}" for x in (found, expected))
        raise InputError(
            f"{where}: was begun with {key} = {before}, and is now to go on with {now}: expected "
            "the same; begin another one in another folder."
        )


# --- checkpoints -------------------------------------------------------------------------


def write_checkpoint(path: Path, content: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Replace a checkpoint by JSON, whose floats keep all their digits, and tensors by name."""
    held = {name: t.detach().to("cpu").contiguous().clone() for name, t in tensors.items()}
    text = json.dumps(content, sort_keys=True)
    head = {"format": FORMAT, "version": str(VERSION), "content": text, "hash": _hash(text, held)}
    write_bytes(path, safetensors.save(held, head))


def read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Content and tensors of a checkpoint, on the CPU."""
    try:
        with safe_open(path, framework="pt") as file:
            head = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: missing, damaged or something else ({error}).") from None
    if head.get("format") != FORMAT:
        raise FileFormatError(f"{path}: no checkpoint of a training: expected format {FORMAT!r}.")
    if head.get("version") != str(VERSION):
        raise FileVersionError(
            f"{path}: version {head.get('version')} of its format: expected {VERSION}: another "
            "pdcorrect wrote it, and this one cannot go on with it: train anew, in another folder."
        )
    text = head.get("content", "")
    if head.get("hash") != _hash(text, tensors):
        raise FileFormatError(f"{path}: damaged: its content is not that of its hash.")
    return json.loads(text), tensors


def _hash(text: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        t = tensors[name]
        digest.update(f"{name} {t.dtype} {tuple(t.shape)}\n".encode())
        digest.update(t.reshape(-1).numpy().tobytes())
    return digest.hexdigest()


# --- history -----------------------------------------------------------------------------


class HistoryFile:
    """Rows of numbers by iteration, in ``history.csv`` and for TensorBoard, written at once.

    Of what is there ``length`` bytes are kept, and what TensorBoard has of iterations before
    ``iteration``: what came later is repeated.
    """

    def __init__(self, folder: Path, length: int = 0, iteration: int = 0) -> None:
        path = folder / NAME
        try:
            self._file = path.open("r+b" if path.exists() else "w+b")
            self._file.truncate(min(length, self._file.seek(0, os.SEEK_END)))
            self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error}).") from None
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=iteration)
        if not self.length:
            self._write(",".join(COLUMNS))

    @property
    def length(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    def add(self, iteration: int, **values: Any) -> None:
        """A row; columns that are not given stay empty."""
        row = {"iteration": iteration, **values}
        self._write(",".join(_text(row.get(name)) for name in COLUMNS))
        for name, value in values.items():
            self._board.add_scalar(name.replace("_", "/", 1), value, iteration)
        self._board.flush()

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        self._board.close()

    def _write(self, line: str) -> None:
        self._file.write(f"{line}\n".encode())
        self._file.flush()


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
