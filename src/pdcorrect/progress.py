"""Progress bars of the command line, on a terminal or in a log."""

from __future__ import annotations

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
