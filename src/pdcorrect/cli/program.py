"""The program ``pdcorrect``: its commands, and what it makes of errors."""

from __future__ import annotations

import sys
import warnings
from typing import Annotated, Any

import typer

from pdcorrect._files import TERMINATED, Terminated, terminable
from pdcorrect._version import __version__
from pdcorrect.cli.common import BAD_INPUT, FAILED
from pdcorrect.cli.compare import compare
from pdcorrect.cli.dataset import app as dataset
from pdcorrect.cli.doctor import doctor
from pdcorrect.cli.evaluate import evaluate
from pdcorrect.cli.export import export
from pdcorrect.cli.info import info
from pdcorrect.cli.new import new
from pdcorrect.cli.render import render
from pdcorrect.cli.simulate import simulate
from pdcorrect.cli.train import train, train_element, tune_element
from pdcorrect.cli.validate import validate
from pdcorrect.cli.view import view
from pdcorrect.errors import EXTRAS, ConvergenceError, OutputError, PdcorrectError, PdcorrectWarning

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
for command in (
    new, simulate, info, compare, render, view, export, train, train_element, tune_element,
    evaluate, validate, doctor,
):  # fmt: skip
    app.command()(command)
app.add_typer(dataset, name="dataset")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """Coarse-mesh projective dynamics of soft solids, validated against Newton FEM."""


def main() -> None:
    """Entry point: one paragraph and an exit status instead of a traceback."""
    try:
        with terminable(), warnings.catch_warnings():
            _tell_warnings()
            app()
    except Terminated:
        typer.echo("stopped by SIGTERM", err=True)
        sys.exit(TERMINATED)
    except (ConvergenceError, OutputError) as error:
        _stop(str(error), FAILED)
    except PdcorrectError as error:
        _stop(str(error), BAD_INPUT)
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRAS:
            raise
        install = f"pip install 'pdcorrect[{EXTRAS[module]}]'"
        _stop(f"{module} is needed for this and is not installed: {install}", BAD_INPUT)
    except MemoryError:
        _stop("not enough memory: use a smaller --refine.", FAILED)


def _tell_warnings() -> None:
    """Have the package's own warnings printed as one line, each text once."""
    others, told = warnings.showwarning, set[str]()

    def show(message: Warning | str, category: type[Warning], *place: Any, **named: Any) -> None:
        if not issubclass(category, PdcorrectWarning):
            others(message, category, *place, **named)
        elif str(message) not in told:
            told.add(str(message))
            typer.echo(f"warning: {message}", err=True)

    warnings.showwarning = show


def _stop(message: str, status: int) -> None:
    typer.echo(f"error: {message}", err=True)
    sys.exit(status)
