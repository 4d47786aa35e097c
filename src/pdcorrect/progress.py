"""Progress of the command line: bars on a terminal, lines in a log."""

from __future__ import annotations

import time
from typing import Any


def progress_bar(unit: str = "", *, hidden: bool = False, apart: bool = False) -> Any:
    """A `rich.progress.Progress`: what, how far, and the time that is left.

    Parameters
    ----------
    unit : str
        Of what is counted.
    hidden : bool
        Whether to print nothing.
    apart : bool
        On standard error, so that standard output holds only results.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    counted = (TextColumn(unit),) if unit else ()
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *counted,
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), disable=hidden,
        console=Console(stderr=apart),
    )  # fmt: skip


class FileLines:
    """Prints a line for each finished file of a data set, for logs: see `OnFile`.

    Seconds since the start, the file, simulations that are there of all, and the seconds that
    the rest takes at the pace until now.
    """

    def __init__(self) -> None:
        self._started = time.monotonic()

    def __call__(self, name: str, done: int, total: int, new: int) -> None:
        elapsed = time.monotonic() - self._started
        rest = elapsed / new * (total - done)
        print(
            f"{elapsed:.0f} s: {name}, {done} of {total} simulations, about {rest:.0f} s left",
            flush=True,
        )
