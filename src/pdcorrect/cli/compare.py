"""The command ``pdcorrect compare``.  It imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pdcorrect.cli.common import (
    FAILED,
    Frames,
    SceneFile,
    check_models,
    progress_bar,
    progress_bars,
    say,
    tell_of_compiling,
)
from pdcorrect.errors import ConvergenceError, require_extra

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pdcorrect.evaluation.compare import Comparison
    from pdcorrect.evaluation.comparison_cases import Case
    from pdcorrect.scene import Scene
    from pdcorrect.state import StepResult
    from pdcorrect.trajectory import Trajectory

_WIDE, _NARROW = 200, 12
"""Letters in a line where there is no terminal; in a line of a name at least."""


def compare(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the report.")] = Path(
        "comparison"
    ),
    frames: Frames = None,
    model: Annotated[
        Optional[list[str]],
        typer.Option(
            help="Also a corrector, by name (models/README.md lists them) or "
            "folder; repeatable (extra 'learn'). Those of base 'best' not together with others."
        ),
    ] = None,
    gate: Annotated[
        bool, typer.Option(help="Of correctors: let the default gate refuse doubtful corrections.")
    ] = True,
    hex27: Annotated[
        bool, typer.Option("--hex27", help="Also 27-node elements on the coarse mesh.")
    ] = False,
    learned: Annotated[
        bool, typer.Option("--learned", help="Also the learned element on the coarse mesh.")
    ] = False,
    converged: Annotated[
        bool,
        typer.Option(
            "--converged",
            help="Also the error to the converged motion, which takes long once and is kept on "
            "disk; adds learned and 27-node elements, and runs by generalised-alpha.",
        ),
    ] = False,
    converged_error: Annotated[
        bool,
        typer.Option(
            "--converged-error",
            help="The same, and how exact the converged motion is: several times as long.",
        ),
    ] = False,
    estimate_error: Annotated[
        bool,
        typer.Option(
            "--estimate-error",
            help="Also estimate the errors of runs on the coarse mesh, by a run 10 to 20 times as "
            "long.",
        ),
    ] = False,
    vtu: Annotated[
        bool,
        typer.Option(
            "--vtu", help="Also write all runs as VTU, with stress, and PVD for ParaView."
        ),
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw figures (extra 'view').")] = True,
) -> None:
    """Run coarse, best coarse, intermediate and fine PD and coarse Newton; report error and time.

    With --converged the first error is the relative one to the converged motion.

    The fine run has the element of the best coarse model; with correctors the one that they
    have learned from, and the coarse models that they correct are compared too.  Exit status 1 if
    a solver failed; the report then has the others, unless it was the fine run.
    """
    from pdcorrect._files import make_folder
    from pdcorrect.evaluation import report
    from pdcorrect.evaluation.comparison_cases import HEX27, cases_for
    from pdcorrect.scene import Scene

    if figures:
        require_extra("pyvista", "view")
        require_extra("matplotlib", "view")
    check_models(model or [], gate)
    loaded = Scene.load(scene)
    converged = converged or converged_error
    if converged and loaded.solver.element != HEX27.element:
        hex27 = learned = True
    cases = cases_for(
        loaded, model or [], gate=gate, hex27=hex27, learned=learned, second_order=converged
    )
    make_folder(output / report.VTU if vtu else output)
    tell_of_compiling()
    count = frames or loaded.time.frames
    truth = _converged(loaded, count, converged_error) if converged else None
    finer = _finer(loaded, count) if estimate_error else None
    comparison = _run(loaded, count, cases, truth, finer)
    _print_table(comparison)
    for note in report.notes(comparison):
        say("- " + note)
    say("drawing the figures ..." if figures else "")
    say(f"report: {report.write_report(comparison, output, draw=figures)}")
    if vtu:
        say("writing the runs for ParaView ...")
        for path in report.write_series(comparison, output):
            say(f"wrote {path}")
    elif any((output / report.VTU).glob("*.pvd")):
        say(f"{output / report.VTU} is of an earlier run: --vtu writes it anew")
    if comparison.failures:
        raise typer.Exit(FAILED)


def _converged(scene: Scene, count: int, error: bool) -> Trajectory:
    """The converged motion, with a bar for each run that is not on disk."""
    from pdcorrect.evaluation import converged

    with progress_bars() as progress:
        tasks: dict[str, Any] = {}

        def on_step(name: str, frame: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(f"converged: {name}", total=total)
            progress.update(tasks[name], completed=frame)

        return converged.converged(scene, count, error=error, on_step=on_step)


def _finer(scene: Scene, count: int) -> Trajectory | None:
    """What estimates errors, with a bar; None, and why, if it fails."""
    from pdcorrect.evaluation.converged import finer_run

    with progress_bar("estimate of errors", count) as advance:
        try:
            return finer_run(scene, count, on_step=advance)
        except ConvergenceError as error:
            say(f"no estimate of errors: {error}")
            return None


def _run(
    scene: Scene,
    count: int,
    cases: Sequence[Case],
    converged: Trajectory | None,
    finer: Trajectory | None,
) -> Comparison:
    """The comparison, with a bar for each case."""
    from pdcorrect.evaluation import compare as evaluate

    with progress_bars() as progress:
        tasks: dict[str, Any] = {}

        def on_step(label: str, frame: int, result: StepResult) -> None:
            if label not in tasks:
                tasks[label] = progress.add_task(label, total=count)
            progress.update(tasks[label], completed=frame)

        return evaluate.compare(scene, count, cases, on_step, converged=converged, finer=finer)


def _print_table(comparison: Comparison) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from pdcorrect.evaluation import report

    console = Console(markup=False)
    if not console.is_terminal:  # a file or a pipe, which has no width
        console = Console(width=_WIDE, markup=False)
    rows = report.table(comparison)
    table = Table(
        title=comparison.scene.name, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    widths = [2 + max(map(len, [heading, *(row[heading] for row in rows)])) for heading in rows[0]]
    for heading in rows[0]:
        table.add_column(heading, justify="right", no_wrap=True)
    names = table.columns[0]
    names.justify, names.no_wrap, names.overflow = "left", False, "fold"
    room = console.width - sum(widths[1:])
    for name, *cells in (row.values() for row in rows):
        table.add_row("\n".join(wrap(name, max(room, _NARROW))), *cells)
    console.print(table)
