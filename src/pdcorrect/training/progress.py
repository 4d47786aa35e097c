"""`Progress`: where a training is; `HistoryFile`: its rows of numbers."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pdcorrect._config import as_toml
from pdcorrect.errors import InputError, OutputError, require_extra
from pdcorrect.training.recipe import Every

require_extra("tensorboard", "learn")

from torch.utils.tensorboard import SummaryWriter  # noqa: E402


@dataclass
class Mark:
    """When something was done last: iteration and second of the training."""

    iteration: int = 0
    seconds: float = 0.0


@dataclass
class Progress:
    """Where a training is.

    Attributes
    ----------
    stage, iteration : int
        Number of the stage, and iterations done in it.
    total : int
        Iterations in all stages.
    stage_seconds, seconds : float
        Time spent in the stage and in all, interruptions not counted.
    validated, saved : Mark
    best : float or None
        Mean Omega of the best weights so far, per cent.
    metrics : dict
        Of the best weights.
    """

    stage: int = 0
    iteration: int = 0
    total: int = 0
    stage_seconds: float = 0.0
    seconds: float = 0.0
    validated: Mark = field(default_factory=Mark)
    saved: Mark = field(default_factory=Mark)
    best: float | None = None
    metrics: dict[str, float] = field(default_factory=dict)

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

    Raises
    ------
    InputError
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


COLUMNS = (
    "iteration", "stage", "seconds", "loss", "rate", "steps", "skipped", "failed_scenes",
    "omega_mean", "omega_median", "omega_least", "failed_rollouts",
)  # fmt: skip

NAME = "history.csv"


class HistoryFile:
    """Rows of numbers by iteration, written at once.

    Parameters
    ----------
    folder : Path
    length : int
        Bytes of ``history.csv`` that are kept: what came later is repeated.
    iteration : int
        From which on TensorBoard forgets what it has.
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
