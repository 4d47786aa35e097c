"""The command ``pdcorrect validate``.  It imports what it needs when it runs."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pdcorrect.cli.common import tell_of_compiling

if TYPE_CHECKING:
    from pdcorrect.validation.cases import ValidationCase
    from pdcorrect.validation.page import Section

_OUTSIDE = 1
"""Exit status if a figure is not as expected."""


def validate(
    cases: Annotated[
        Optional[list[str]],
        typer.Argument(metavar="[CASE]...", help="Names of cases; all by default."),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for results and the report.")
    ] = Path("report"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Only the quick parts, some minutes in all.")
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Run also what is done and has not changed since.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw figures (extra 'view').")] = True,
    known: Annotated[bool, typer.Option("--list", help="Only list the cases.")] = False,
) -> None:
    """Run the validation cases, judge them by figures written down before, and report.

    Cases are those in `validation` of the checkout, or of the folder PDCORRECT_HOME.  Results
    that are in OUTPUT already are kept if neither code, expectations nor inputs have changed.  Exit
    status 1 if a figure is not as expected.
    """
    from pdcorrect.errors import require_extra
    from pdcorrect.validation.cases import find_cases, read_summary
    from pdcorrect.validation.page import write_page

    found = find_cases(cases or ())
    if known:
        for case in found:
            typer.echo(
                f"{case.name}: {case.title}{'' if case.has_quick_part else ' (no quick part)'}"
            )
        return
    if figures:
        require_extra("pyvista", "view")
        require_extra("matplotlib", "view")
    chosen = [case for case in found if case.has_quick_part or not quick]
    tell_of_compiling()
    sections = _run(chosen, output, quick, again, figures)
    for section in sections:
        _tell(section)
    typer.echo(f"report: {write_page(sections, output, read_summary())}")
    if not all(section.record.passed for section in sections):
        raise typer.Exit(_OUTSIDE)


def _run(
    cases: list[ValidationCase], output: Path, quick: bool, again: bool, draw: bool
) -> list[Section]:
    from pdcorrect.cli.common import progress_bar
    from pdcorrect.validation.page import Section
    from pdcorrect.validation.running import run_case

    command = shlex.join(["pdcorrect", *sys.argv[1:]])
    sections = []
    with progress_bar(apart=True) as progress:
        for case in cases:
            task = progress.add_task(case.name, total=1)

            def on_part(name: str, done: int, total: int, case=case, task=task) -> None:  # type: ignore[no-untyped-def]
                shown = f"{case.name}: {name}" if name else case.name
                progress.update(task, description=shown, completed=done, total=total)

            record = run_case(
                case, output, quick=quick, again=again, draw=draw, command=command,
                on_part=on_part,
            )  # fmt: skip
            total = progress.tasks[task].total
            progress.update(task, description=case.name, completed=total)
            sections.append(Section(case, record))
    return sections


def _tell(section: Section) -> None:
    """One line a case, and one for each figure that is not as expected."""
    case, record = section.case, section.record
    typer.echo(f"{case.name}: {section.verdict} ({record.seconds:.0f} s)")
    for name, found, aim, *_ in section.judged()[: len(record.outside)]:
        typer.echo(f"  {name}: {found}, expected {aim}")
    if record.error:
        typer.echo(record.error, err=True)
