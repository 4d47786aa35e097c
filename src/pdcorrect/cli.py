"""The program ``pdcorrect``.  Each command imports what it needs when it runs."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pdcorrect import dataset_cli, evaluation_cli, train_cli, validate_cli
from pdcorrect.errors import ConvergenceError, InputError, OutputError, PdcorrectError
from pdcorrect.interruption import INTERRUPTED, TERMINATED, Terminated, terminable

if TYPE_CHECKING:
    from pdcorrect.scene import Scene
    from pdcorrect.solvers.rollout import StepLog
    from pdcorrect.state import Stepper, StepResult, Trajectory

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Coarse-mesh projective dynamics of soft solids, validated against Newton FEM.",
)

app.add_typer(dataset_cli.app, name="dataset")
app.command()(evaluation_cli.evaluate)
app.command()(train_cli.train)
app.command()(validate_cli.validate)

FAILED, BAD_INPUT = 1, 2


class SolverName(StrEnum):
    """Choices of --solver."""

    pd = "pd"
    newton = "newton"


class Colour(StrEnum):
    """Choices of --colour."""

    displacement = "displacement"
    error = "error"
    none = "none"


SceneFile = Annotated[Path, typer.Argument(help="Scene in TOML.", show_default=False)]
Frames = Annotated[
    Optional[int], typer.Option(help="Frames to run; the scene's by default.", min=1)
]


@app.command()
def simulate(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Trajectory file (HDF5).")],
    refine: Annotated[int, typer.Option(help="Cut each coarse cell into REFINE^3.", min=1)] = 1,
    solver: Annotated[SolverName, typer.Option(help="Method.")] = SolverName.pd,
    frames: Frames = None,
    vtu: Annotated[
        Optional[Path],
        typer.Option(help="Also write VTU files, with stress, and a PVD into this folder."),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing output file.")] = False,
    resume: Annotated[
        bool, typer.Option(help="Continue an existing output file after its last complete frame.")
    ] = False,
) -> None:
    """Run one scene and write its trajectory, frame by frame."""
    from pdcorrect.io.trajectory import load_trajectory
    from pdcorrect.replacement import make_folder
    from pdcorrect.scene import Scene

    if resume and overwrite:
        raise InputError("--resume with --overwrite: expected one of them; resume keeps the file.")
    loaded = Scene.load(scene)
    if vtu:
        make_folder(vtu)
    stepper = _make_stepper(loaded, solver, refine)
    count = frames or loaded.time.frames
    earlier = _frames_so_far(output, stepper, count) if resume else None
    log = _run(stepper, count, output, earlier, overwrite)
    before = 0 if earlier is None else len(earlier)
    if before < count:
        _summary(log.arrays(), stepper, before)
        _say(f"wrote {output}")
    if vtu:
        from pdcorrect.io.vtk import write_vtu_series

        series = write_vtu_series(load_trajectory(output), vtu, stress_of=stepper.problem)
        _say(f"wrote {series}")


@app.command()
def compare(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the report.")] = Path(
        "comparison"
    ),
    frames: Frames = None,
    model: Annotated[
        Optional[list[str]],
        typer.Option(
            help="Also a corrector, by name or folder; repeatable (extra 'learn'). Those of base "
            "'best' not together with others."
        ),
    ] = None,
    gate: Annotated[
        bool, typer.Option(help="Of correctors: let the default gate refuse doubtful corrections.")
    ] = True,
    figures: Annotated[bool, typer.Option(help="Draw figures (extra 'view').")] = True,
) -> None:
    """Run coarse, intermediate and fine PD and Newton; report error and run time.

    With correctors, the coarse models that they correct are compared too; with those of the best
    coarse model, the fine run has that model's element.  Exit status 1 if a solver failed; the
    report then has the others, unless it was the fine run.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from pdcorrect import evaluate, report
    from pdcorrect.errors import require_extra
    from pdcorrect.progress import progress_bar
    from pdcorrect.replacement import make_folder
    from pdcorrect.scene import Scene

    if figures:
        require_extra("pyvista", "view")
        require_extra("matplotlib", "view")
    if model:
        require_extra("torch", "learn")
    loaded = Scene.load(scene)
    cases = evaluate.cases_with(model or [], gate=gate)
    count = frames or loaded.time.frames
    make_folder(output)
    with progress_bar() as progress:
        tasks = {c.label: progress.add_task(c.label, total=count, start=False) for c in cases[::-1]}

        begun: list[str] = []

        def on_step(label: str, frame: int, result: StepResult) -> None:
            if frame == 1:
                for earlier in begun[-1:]:  # which may have failed
                    progress.stop_task(tasks[earlier])
                begun.append(label)
                progress.start_task(tasks[label])
            progress.update(tasks[label], completed=frame)

        comparison = evaluate.compare(loaded, count, cases, on_step)

    table = Table(title=loaded.name, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in report.HEADINGS:
        table.add_column(heading, justify="right", no_wrap=True)
    table.columns[0].justify, table.columns[0].no_wrap = "left", False
    for row in report.table(comparison):
        table.add_row(*row)
    Console().print(table)
    for note in report.notes(comparison):
        _say("- " + note)
    _say("drawing the figures ..." if figures else "")
    _say(f"report: {report.write_report(comparison, output, draw=figures)}")
    if comparison.failures:
        raise typer.Exit(FAILED)


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
    _say(f"wrote {output}")


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


def _make_stepper(scene: Scene, solver: SolverName, refine: int) -> Stepper:
    from pdcorrect.evaluate import make_stepper

    return make_stepper(scene, solver.value, refine)


def _frames_so_far(output: Path, stepper: Stepper, count: int) -> Trajectory | None:
    """What a file holds of the run to ``count`` frames, under the scene that is now run."""
    from dataclasses import replace

    from pdcorrect.io.trajectory import load_trajectory
    from pdcorrect.solvers.resume import check_same_run

    if not output.exists():
        _say(f"{output} does not exist yet: starting from the beginning")
        return None
    run = load_trajectory(output, salvage=True)
    check_same_run(stepper, run, str(output))
    if len(run) < count:
        _say(f"{output} holds {len(run)} of {count} frames: continuing")
        return replace(run, scene_toml=stepper.problem.scene.to_toml())
    _say(f"{output} holds {len(run)} frames already, {count} wanted: nothing to do")
    return run


def _run(
    stepper: Stepper, count: int, output: Path, earlier: Trajectory | None, overwrite: bool
) -> StepLog:
    """Step to frame ``count`` and write each frame; an interruption ends the program."""
    from pdcorrect.io.trajectory import TrajectoryWriter
    from pdcorrect.progress import progress_bar
    from pdcorrect.solvers.resume import continue_from
    from pdcorrect.solvers.rollout import StepLog, march, run_attributes

    problem = stepper.problem
    if earlier is None:
        state, done, log = problem.rest_state(), 0, StepLog()
        writer = TrajectoryWriter(
            output, problem.positions, problem.cells, state, overwrite=overwrite,
            scene_toml=problem.scene.to_toml(), attributes=run_attributes(stepper),
        )  # fmt: skip
    else:
        state, done, log = continue_from(stepper, earlier), len(earlier), StepLog(earlier.stats)
        writer = TrajectoryWriter.resume(output, earlier)
    with writer, progress_bar(hidden=done >= count) as progress:
        task = progress.add_task(problem.scene.name, total=count, completed=done)
        try:
            for result, elapsed in march(stepper, max(0, count - done), state=state):
                writer.append(result, elapsed)
                log.add(result, elapsed)
                progress.advance(task)
        except (KeyboardInterrupt, Terminated) as stop:
            typer.echo(
                f"stopped: {writer.steps} of {count} frames are in {output}; --resume continues",
                err=True,
            )
            ended = TERMINATED if isinstance(stop, Terminated) else INTERRUPTED
            raise typer.Exit(ended) from None
    return log


def _summary(stats: dict[str, Any], stepper: Stepper, resumed: int) -> None:
    """Frames, time, iterations, residual, energy, inverted cells, and what solved them."""
    from pdcorrect.report import inverted_frames

    count, seconds = len(stats["seconds"]), stats["seconds"].sum()
    problem, status = stepper.problem, stats["status"].tolist()
    ends = ", ".join(f"{status.count(name)} {name.lower()}" for name in dict.fromkeys(status))
    ran = f"{count} frames ({resumed} resumed)" if resumed else f"{count} frames"
    _say(
        f"{ran} of {stepper.describe()['time_step']} s on {len(problem.positions)} nodes "
        f"and {len(problem.cells)} cells ({problem.element}, {problem.mass_rule} mass) in "
        f"{seconds:.2f} s: {1e3 * seconds / count:.3g} ms a frame"
    )
    _say(", ".join(f"{k}: {v}" for k, v in stepper.describe().items()))
    _say(
        f"iterations a frame: mean {stats['iterations'].mean():.1f}, most "
        f"{stats['iterations'].max()}; frames: {ends}"
    )
    _say(
        f"worst residual {stats['residual'].max():.2g} N, worst estimated distance from the step's "
        f"solution {stats['error_estimate'].max():.2g} m"
    )
    _say(
        f"energy at the end: elastic {stats['elastic_energy'][-1]:.4g} J, kinetic "
        f"{stats['kinetic_energy'][-1]:.4g} J; work of the loads "
        f"over the run {stats['external_work'].sum():.4g} J{_other_work(stats)}"
    )
    _say(inverted_frames(stats, problem.time_step) or "")


def _other_work(stats: dict[str, Any]) -> str:
    """Work of moving clamps and loss to damping over a run, where there is any."""
    named = {"clamp_work": "work of the clamps", "damping_loss": "lost to damping"}
    sums = {text: stats[name].sum() for name, text in named.items() if stats[name].any()}
    return "".join(f", {text} {total:.4g} J" for text, total in sums.items())


def _say(text: str) -> None:
    if text:
        typer.echo(text)


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
