"""What several commands of the program share."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Optional

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
                    "compiling kernels, which takes up to a minute or two; they are kept on disk "
                    "for the next time",
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
        raise InputError(
            "--model '': an empty name: expected the name of a folder in models, or a path."
        )
    if models:
        require_extra("torch", "learn")
    elif not gate:
        raise InputError(
            "--no-gate without --model: there is no corrector whose gate could be left out: "
            "expected --model NAME beside it; leave --no-gate out."
        )
