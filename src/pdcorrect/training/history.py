"""How a training went: ``history.csv`` and TensorBoard's files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pdcorrect.errors import OutputError, require_extra

require_extra("tensorboard", "learn")

from torch.utils.tensorboard import SummaryWriter  # noqa: E402

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
