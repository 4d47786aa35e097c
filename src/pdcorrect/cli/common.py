"""What several commands of the program share."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from pdcorrect.errors import InputError, require_extra

FAILED, BAD_INPUT = 1, 2
"""Exit statuses."""

SceneFile = Annotated[Path, typer.Argument(help="Scene in TOML.", show_default=False)]

Frames = Annotated[
    Optional[int], typer.Option(help="Frames to run; the scene's by default.", min=1)
]
ConfigFile = Annotated[Path, typer.Argument(help="Configuration, TOML.", show_default=False)]
OutputFolder = Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there already.")]
Gated = Annotated[
    bool, typer.Option(help="Of correctors: let the default gate refuse corrections.")
]


def _use_threads(count: int | None) -> None:
    """Before numba is imported, which reads these once."""
    if count is not None:
        for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ[name] = str(count)


Threads = Annotated[
    Optional[int],
    typer.Option(help="Of the kernels; by default as many as cores.", min=1, callback=_use_threads),
]
Learned = Annotated[bool, typer.Option("--learned", help="With the learned element.")]
EstimateError = Annotated[
    bool, typer.Option("--estimate-error", help="Also estimate errors, by a far longer run.")
]
Device = Annotated[str, typer.Option(help="cpu, or cuda (extra 'learn').")]
Batch = Annotated[int, typer.Option(help="Simulations at once on a GPU.", min=1)]
Seconds = Annotated[
    Optional[float],
    typer.Option(help="Stop after about so many seconds; the same command goes on.", min=0),
]
Figures = Annotated[bool, typer.Option(help="Draw figures (extra 'view').")]
Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1)]
SkipDamaged = Annotated[
    bool, typer.Option("--skip-damaged", help="Leave out and name files that are damaged.")
]
Incomplete = Annotated[
    bool, typer.Option("--incomplete", help="Also if files of a split are missing.")
]


def say(text: str) -> None:
    """Print a paragraph, unless it is empty."""
    if text:
        typer.echo(text)


@cache
def tell_of_compiling() -> None:
    """Say on standard error, once in this process, that numba compiles, if it does."""
    from numba.core import event

    class Told(event.Listener):  # type: ignore[misc]
        """Hears of each kernel that was not on disk, and speaks of the first."""

        def on_start(self, event: object) -> None:
            if not self.done:
                typer.echo("compiling kernels: a minute or two, the first time only", err=True)
            self.done = True

        def on_end(self, event: object) -> None:
            """Nothing to say."""

        done = False

    event.register("numba:compile", Told())  # type: ignore[no-untyped-call]


def check_models(models: Sequence[str], gate: bool) -> None:
    """Refuse options of correctors that cannot be meant, before anything is computed."""
    if any(not model.strip() for model in models):
        raise InputError("--model '': expected the name of a model, or the path of its folder.")
    if models:
        require_extra("torch", "learn")
    elif not gate:
        raise InputError("--no-gate without --model: expected --model NAME beside it.")


def console() -> Any:
    """Standard output for tables, which are not broken where it is no terminal."""
    from rich.console import Console

    found = Console(markup=False)
    return found if found.is_terminal else Console(width=400, markup=False)


def print_table(
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    names: int = 1,
    markdown: bool = False,
) -> None:
    """Columns of names, of which the first is folded where there is little room, then numbers."""
    from rich.box import MARKDOWN, SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", title_style="bold", pad_edge=markdown,
        box=MARKDOWN if markdown else SIMPLE_HEAD, padding=(0, 1) if markdown else (0, 1, 0, 0),
    )  # fmt: skip
    table.add_column(headings[0], min_width=12, overflow="fold")
    for k, heading in enumerate(headings[1:], 1):
        table.add_column(heading, justify="left" if k < names else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console().print(table)


@contextlib.contextmanager
def progress_bars(
    unit: str = "", *, apart: bool = False
) -> Iterator[Callable[[str, int, int | None], None]]:
    """Bars by name; gives what to call with a name, how much is done, and the total in ``unit``.

    ``apart``: on standard error.
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

    tasks: dict[str, Any] = {}
    with Progress(
        TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
        TextColumn(unit), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        console=Console(stderr=apart),
    ) as progress:  # fmt: skip

        def show(name: str, done: int, total: int | None) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total)
            progress.update(tasks[name], completed=done, total=total)

        yield show


@contextlib.contextmanager
def progress_bar(
    title: str, total: int, done: int = 0, **options: Any
) -> Iterator[Callable[..., None]]:
    """One bar; gives what to call, with anything, at each step.  Options as of `progress_bars`."""
    steps = count(done)
    with progress_bars(**options) as show:

        def advance(*_: object) -> None:
            show(title, next(steps), total)

        if done < total:
            advance()
        yield advance


class FileLines:
    """Prints a line for each finished file of a data set: see `OnFile`.

    ``done`` and ``total`` are simulations that are there and that were asked for.
    """

    def __init__(self) -> None:
        self._started = time.monotonic()
        self.done = self.total = 0

    def begin(self, done: int, total: int, damaged: Sequence[str]) -> None:
        """Say what is computed: see `OnBegin`."""
        self._started = time.monotonic()
        self.done, self.total = done, total
        for name in damaged:
            print(f"{name} is damaged: computed again", flush=True)
        if done < total:
            print(f"{done} of {total} simulations are there, computing {total - done}", flush=True)

    def __call__(self, name: str, done: int, total: int, new: int) -> None:
        self.done, self.total = done, total
        elapsed = time.monotonic() - self._started
        rest = elapsed / new * (total - done)
        left = f"{done} of {total} simulations, about {rest:.0f} s left"
        print(f"{elapsed:.0f} s: {name}, {left}", flush=True)

    def interrupted(self) -> str:
        """What to tell after an interruption."""
        if not self.total:
            return "interrupted before anything was computed; the same command goes on"
        counts = f"{self.done} of {self.total} simulations are there"
        return f"interrupted: {counts}; the same command goes on"
