"""The command ``pdcorrect render``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from pdcorrect.cli.common import say
from pdcorrect.errors import InputError

Colour = StrEnum("Colour", ["displacement", "error", "none"])


def render(
    runs: Annotated[list[Path], typer.Argument(help="Trajectory files.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture: .png, .gif or .mp4.")],
    label: Annotated[Optional[list[str]], typer.Option(help="Title of each run, in order.")] = None,
    colour: Annotated[Colour, typer.Option(help="What to colour by.")] = Colour.displacement,
    frame: Annotated[Optional[int], typer.Option(help="Frame of a .png; -1 is the last.")] = None,
    fps: Annotated[float, typer.Option(help="Frames a second of a film.", min=0.1)] = 25.0,
    overlay: Annotated[bool, typer.Option("--overlay", help="Over each other (.png).")] = False,
) -> None:
    """Draw one run or several side by side; errors are against the last run given.

    A .png shows one frame, a .gif or .mp4 all frames that the runs share.
    """
    from pdcorrect import figures
    from pdcorrect.io.trajectory import load_trajectory

    if colour is Colour.error and len(runs) < 2:
        raise InputError("--colour error: expected two runs or more, the last is the reference.")
    if frame is not None and output.suffix.lower() != ".png":
        raise InputError(f"--frame with {output.suffix}: a film shows all frames; leave it out.")
    loaded = [load_trajectory(path) for path in runs]
    by_value: figures.Colour = "error" if colour is Colour.error else "displacement"
    still = output.suffix.lower() == ".png"
    number = -1 if frame is None else frame
    names = label or [path.stem for path in runs]
    if overlay:
        if colour is Colour.error:
            raise InputError(
                "--colour error with --overlay: runs have a colour each; leave it out."
            )
        figures.render_overlay(loaded, output, labels=names, frame=number)
    else:
        figures.render(
            loaded,
            output,
            labels=names,
            colour=None if colour is Colour.none else by_value,
            reference=loaded[-1] if colour is Colour.error else None,
            frame=number if still else None,
            fps=fps,
        )
    say(f"wrote {output}")
