"""The command ``pdcorrect compare``.  It imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pdcorrect.cli import common
from pdcorrect.errors import ConvergenceError, require_extra

if TYPE_CHECKING:
    from pdcorrect.evaluation.compare import Comparison
    from pdcorrect.scene import Scene
    from pdcorrect.trajectory import Trajectory


@common.naming_scene
def compare(
    scene: common.SceneFile,
    output: common.OutputFolder = Path("comparison"),
    frames: common.Frames = None,
    threads: common.Threads = None,
    model: Annotated[
        Optional[list[str]],
        typer.Option(help="Also a corrector, by name or folder; repeatable (extra 'learn')."),
    ] = None,
    gate: common.Gated = True,
    hex27: Annotated[bool, typer.Option("--hex27", help="Also 27-node elements.")] = False,
    learned: common.Learned = False,
    converged: Annotated[
        bool, typer.Option("--converged", help="Also the error to the converged motion, kept.")
    ] = False,
    converged_error: Annotated[
        bool, typer.Option("--converged-error", help="The same, and how exact that motion is.")
    ] = False,
    estimate_error: common.EstimateError = False,
    vtu: Annotated[
        bool, typer.Option("--vtu", help="Also write all runs, with stress, for ParaView.")
    ] = False,
    figures: common.Figures = True,
    overwrite: common.Overwrite = False,
) -> None:
    """Run coarse, best coarse, intermediate and fine PD and coarse Newton; report error and time.

    With --converged the first error is the relative one to the converged motion, which takes long
    once; learned and 27-node elements and runs by generalised-alpha are added.

    The fine run has the element of the best coarse model; with correctors the one that they
    have learned from, and the coarse models that they correct are compared too.  Exit status 1 if
    a solver failed; the report then has the others, unless it was the fine run.
    """
    from pdcorrect._files import check_new, make_folder
    from pdcorrect.evaluation import compare as evaluate
    from pdcorrect.evaluation import converged as reference
    from pdcorrect.evaluation import report
    from pdcorrect.scene import Scene

    if figures:
        require_extra("pyvista", "view")
        require_extra("matplotlib", "view")
    common.check_models(model or [], gate)
    loaded = Scene.load(scene)
    converged = converged or converged_error
    if converged and loaded.solver.element != evaluate.HEX27.element:
        hex27 = learned = True
    cases = evaluate.cases_for(
        loaded, model or [], gate=gate, hex27=hex27, learned=learned, second_order=converged
    )
    make_folder(output / report.VTU if vtu else output)
    check_new(*(output / name for name in report.FILES), overwrite=overwrite)
    common.tell_of_compiling()
    count = frames or loaded.time.frames
    finer = _finer(loaded, count) if estimate_error else None
    with common.progress_bars() as show:
        truth = None
        if converged:
            truth = reference.converged(
                loaded, count, error=converged_error,
                on_step=lambda name, *at: show(f"converged: {name}", *at),
            )  # fmt: skip
        comparison = evaluate.compare(
            loaded, count, cases, lambda label, frame, _: show(label, frame, count),
            converged=truth, finer=finer,
        )  # fmt: skip
    _print_table(comparison)
    for note in report.notes(comparison):
        common.say("- " + note)
    common.say("drawing the figures ..." if figures else "")
    common.say(f"report: {report.write_report(comparison, output, draw=figures)}")
    if vtu:
        common.say("writing the runs for ParaView ...")
        for path in report.write_series(comparison, output):
            common.say(f"wrote {path}")
    elif any((output / report.VTU).glob("*.pvd")):
        common.say(f"{output / report.VTU} is of an earlier run: --vtu writes it anew")
    if comparison.failures:
        raise typer.Exit(common.FAILED)


def _finer(scene: Scene, count: int) -> Trajectory | None:
    """What estimates errors, with a bar; None, and why, if it fails."""
    from pdcorrect.evaluation.converged import finer_run

    with common.progress_bar("estimate of errors", count) as advance:
        try:
            return finer_run(scene, count, on_step=advance)
        except ConvergenceError as error:
            common.say(f"no estimate of errors: {error}")
            return None


def _print_table(comparison: Comparison) -> None:
    from pdcorrect.evaluation import report

    rows = report.table(comparison)
    cells = [list(row.values()) for row in rows]
    common.print_table(comparison.scene.name, list(rows[0]), cells)
