"""The command ``pdcorrect validate``.  It imports what it needs when it runs."""

from __future__ import annotations

import importlib
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from pdcorrect.cli.common import FAILED, OutputFolder, tell_of_compiling


def validate(
    cases: Annotated[
        Optional[list[str]], typer.Argument(metavar="CASE", help="Names of cases; all by default.")
    ] = None,
    output: OutputFolder = Path("report"),
    quick: Annotated[bool, typer.Option("--quick", help="Only the quick parts.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Also what has not changed.")] = False,
    known: Annotated[bool, typer.Option("--list", help="Only list the cases.")] = False,
) -> None:
    """Run the validation cases, judge them by figures written down before, and report.

    Cases are in the folder `validation` of the checkout, or of PDCORRECT_HOME, as of the unpacked
    source archive.  Results in OUTPUT are kept if neither code, expectations nor inputs have
    changed.  Exit status 1 if a figure is not as expected.
    """
    harness = _harness()
    found = harness.find_cases(cases or ())
    if known:
        for case in found:
            typer.echo(f"{case.name}: {case.title}{' (quick)' * case.has_quick_part}")
        return
    tell_of_compiling()
    chosen = [case for case in found if case.has_quick_part or not quick]
    command = shlex.join(["pdcorrect", *sys.argv[1:]])
    if not harness.run(chosen, output, quick, again, command, typer.echo):
        raise typer.Exit(FAILED)


def _harness() -> Any:
    from pdcorrect._environment import home_folder
    from pdcorrect.errors import InputError

    folder = home_folder("validation")
    if not (folder / "harness.py").is_file():
        raise InputError(f"{folder}: no validation cases: expected harness.py in it.")
    sys.path.insert(0, str(folder))
    return importlib.import_module("harness")
