"""The program ``pdcorrect``.  Each command imports what it needs when it runs."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from pdcorrect import (
    compare_cli,
    dataset_cli,
    evaluation_cli,
    export_cli,
    simulate_cli,
    train_cli,
    validate_cli,
)
from pdcorrect.cli_parts import BAD_INPUT, FAILED, say
from pdcorrect.errors import ConvergenceError, InputError, OutputError, PdcorrectError
from pdcorrect.interruption import INTERRUPTED, TERMINATED, Terminated, terminable

__all__ = ["BAD_INPUT", "FAILED", "INTERRUPTED", "TERMINATED", "app", "main"]

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Coarse-mesh projective dynamics of soft solids, validated against Newton FEM.",
)

app.command()(simulate_cli.simulate)
app.command()(compare_cli.compare)
app.command()(export_cli.export)
app.add_typer(dataset_cli.app, name="dataset")
app.command()(evaluation_cli.evaluate)
app.command()(train_cli.train)
app.command()(validate_cli.validate)


class Colour(StrEnum):
    """Choices of --colour."""

    displacement = "displacement"
    error = "error"
    none = "none"


@app.command()
def render(
    runs: Annotated[list[Path], typer.Argument(help="Trajectory files.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture: .png, .gif or .mp4.")],
    label: Annotated[Optional[list[str]], typer.Option(help="Title of each run, in order.")] = None,
    colour: Annotated[Colour, typer.Option(help="What to colour by.")] = Colour.displacement,
    frame: Annotated[Optional[int], typer.Option(help="Frame of a .png; -1 is the last.")] = None,
    fps: Annotated[float, typer.Option(help="Frames a second of a film.", min=0.1)] = 25.0,
    overlay: Annotated[
        bool,
        typer.Option("--overlay", help="Draw runs over each other in a .png, each in a colour."),
    ] = False,
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


@app.command()
def doctor() -> None:
    """Show versions, threads, factorisations, GPU and whether rendering works."""
    from rich.console import Console
    from rich.table import Table

    from pdcorrect import environment

    checks = environment.doctor()
    table = Table("what", "found", "")
    for check in checks:
        table.add_row(check.name, check.found, "ok" if check.ok else "PROBLEM")
    Console().print(table)
    if not all(check.ok for check in checks):
        raise typer.Exit(FAILED)


def main() -> None:
    """Entry point: one paragraph and an exit status instead of a traceback."""
    try:
        with terminable():
            app()
    except Terminated:
        typer.echo("stopped by SIGTERM", err=True)
        sys.exit(TERMINATED)
    except ConvergenceError as error:
        _stop(str(error), FAILED)
    except OutputError as error:
        _stop(str(error), FAILED)
    except PdcorrectError as error:
        _stop(str(error), BAD_INPUT)
    except MemoryError:
        _stop("not enough memory: use a smaller --refine.", FAILED)


def _stop(message: str, status: int) -> None:
    typer.echo(f"error: {message}", err=True)
    sys.exit(status)


if __name__ == "__main__":
    main()
