"""What several commands of the program share."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
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
                typer.echo(
                    "compiling kernels, which takes a few minutes; they are kept on disk for the "
                    "next time",
                    err=True,
                )
            self.done = True

        def on_end(self, event: object) -> None:
            """Nothing to say."""

        done = False

    event.register("numba:compile", Told())  # type: ignore[no-untyped-call]


def check_models(models: Sequence[str], gate: bool) -> None:
    """Refuse options of correctors that cannot be meant, before anything is computed.

    Raises
    ------
    InputError
        If a name is empty, or there is no corrector that could go without a gate.
    MissingExtraError
        If correctors cannot be run here.
    """
    if any(not model.strip() for model in models):
        raise InputError("--model '': expected the name of a model, or the path of its folder.")
    if models:
        require_extra("torch", "learn")
    elif not gate:
        raise InputError("--no-gate without --model: expected --model NAME beside it.")


def progress_bars(unit: str = "", *, hidden: bool = False, apart: bool = False) -> Any:
    """A `rich.progress.Progress`, which counts in ``unit``; ``apart``: on standard error."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
        TextColumn(unit), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        disable=hidden, console=Console(stderr=apart),
    )  # fmt: skip


@contextlib.contextmanager
def progress_bar(
    title: str, total: int, done: int = 0, **options: Any
) -> Iterator[Callable[..., None]]:
    """One bar; gives what to call, with anything, at each step.  Options as of `progress_bars`."""
    with progress_bars(**{"hidden": done >= total, **options}) as progress:
        task = progress.add_task(title, total=total, completed=done)
        yield lambda *_: progress.advance(task)


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
        told = f"{elapsed:.0f} s: {name}, {done} of {total} simulations, about {rest:.0f} s left"
        print(told, flush=True)

    def interrupted(self) -> str:
        """What to tell after an interruption."""
        if not self.total:
            return "interrupted before anything was computed; the same command goes on"
        counts = f"{self.done} of {self.total} simulations are there"
        return f"interrupted: {counts}; the same command goes on"
