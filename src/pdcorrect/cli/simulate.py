"""The command ``pdcorrect simulate``.  It imports what it needs when it runs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pdcorrect._files import INTERRUPTED, TERMINATED, Terminated
from pdcorrect.cli import common
from pdcorrect.errors import InputError, require_extra

if TYPE_CHECKING:
    from pdcorrect.scene import Scene
    from pdcorrect.solvers.rollout import StepLog
    from pdcorrect.trajectory import Stepper, Trajectory


SolverName = StrEnum("SolverName", ["pd", "newton"])


@common.naming_scene
def simulate(
    scene: common.SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Trajectory file (HDF5).")],
    refine: Annotated[int, typer.Option(help="Cut each coarse cell into REFINE^3.", min=1)] = 1,
    solver: Annotated[SolverName, typer.Option(help="Method.")] = SolverName.pd,
    model: Annotated[
        Optional[str], typer.Option(help="Corrector, by name or folder (extra 'learn').")
    ] = None,
    gate: common.Gated = True,
    learned: common.Learned = False,
    estimate_error: common.EstimateError = False,
    frames: common.Frames = None,
    threads: common.Threads = None,
    vtu: Annotated[
        Optional[Path], typer.Option(help="Folder for the run, with stress, for ParaView.")
    ] = None,
    allow_inverted: Annotated[
        bool, typer.Option("--allow-inverted", help="Exit status 0 also with inverted cells.")
    ] = False,
    report: Annotated[
        Optional[Path], typer.Option(help="Folder for a page with pictures (extra 'view').")
    ] = None,
    overwrite: common.Overwrite = False,
    resume: Annotated[
        bool, typer.Option(help="Continue an existing output file after its last complete frame.")
    ] = False,
) -> None:
    """Run one scene and write its trajectory, frame by frame.

    Exit status 1 if frames ended with inverted cells, which are written all the same.
    """
    from pdcorrect.evaluation.run_report import summary, write_run_report
    from pdcorrect.io.trajectory import load_trajectory
    from pdcorrect.scene import Scene
    from pdcorrect.solvers.rollout import inverted_frames

    if resume and overwrite:
        raise InputError("--resume with --overwrite: expected one of them; resume keeps the file.")
    common.check_models([] if model is None else [model], gate)
    if model is not None and (learned or refine != 1 or solver is not SolverName.pd):
        raise InputError(
            f"--model {model} with --refine {refine} --solver {solver}{' --learned' * learned}: a "
            "corrector is for projective dynamics on the coarse mesh and model that it was trained "
            "on: expected --refine 1, --solver pd and no --learned."
        )
    loaded = Scene.load(scene)
    if report:
        require_extra("pyvista", "view")
        require_extra("matplotlib", "view")
    if output.exists() and output.samefile(scene):
        raise InputError(f"{output}: is the scene: expected another name for the run.")
    _check_outputs(loaded, output, vtu, report, overwrite, resume)
    common.tell_of_compiling()
    stepper = _make_stepper(loaded, solver, refine, learned, model, gate)
    origin = getattr(stepper, "origin", None)
    if origin:
        told = "model {model} on the base {base}, trained on {dataset} with {trained_integrator}"
        common.say(told.format(**origin))
    count = frames or loaded.time.frames
    earlier = _frames_so_far(output, stepper, count) if resume else None
    before = 0 if earlier is None else len(earlier)
    if earlier is None or before < count:
        stats = _run(stepper, count, output, earlier, overwrite).arrays()
        for sentence in summary(stats, stepper, before):
            common.say(sentence)
        common.say(f"wrote {output}")
    else:
        stats = dict(earlier.stats)
    inverted = inverted_frames(stats, loaded.time.step)
    if loaded.probes:
        from pdcorrect.io.probes import write_probes

        common.say(f"wrote {write_probes(load_trajectory(output), stepper.problem, output)}")
    if vtu:
        from pdcorrect.io.vtk import write_vtu_series

        series = write_vtu_series(
            load_trajectory(output), vtu, name=output.stem, stress_of=stepper.problem
        )
        common.say(f"wrote {series}")
    estimated = _estimated(load_trajectory(output)) if estimate_error else ""
    common.say(estimated)
    if report:
        more = (estimated,) if estimated else ()
        page = write_run_report(load_trajectory(output), stepper, report, more)
        common.say(f"report: {page}")
    if inverted and not allow_inverted:
        raise typer.Exit(common.FAILED)


def _check_outputs(
    scene: Scene, output: Path, vtu: Path | None, report: Path | None, overwrite: bool, resume: bool
) -> None:
    """Refuse what cannot be written, before the run."""
    from pdcorrect._files import check_new, make_folder
    from pdcorrect.evaluation.page import PAGE
    from pdcorrect.io.probes import probes_file
    from pdcorrect.io.vtk import vtu_series

    for folder in filter(None, (vtu, report)):
        make_folder(folder)
    beside = [] if resume else [output]
    beside += [probes_file(output)] if scene.probes else []
    beside += vtu_series(vtu, output.stem) if vtu else []
    beside += [report / PAGE] if report else []
    check_new(*beside, overwrite=overwrite or resume)


def _make_stepper(
    scene: Scene, solver: SolverName, refine: int, learned: bool, model: str | None, gate: bool
) -> Stepper:
    if model is not None:
        from pdcorrect.corrector.hybrid import hybrid_of

        return hybrid_of(scene, model, gate=gate).prepare()
    from pdcorrect.evaluation.compare import make_stepper, with_learned
    from pdcorrect.fem.problem import discretise

    problem = discretise(with_learned(scene) if learned else scene, refine=refine)
    return make_stepper(problem, solver.value)


def _frames_so_far(output: Path, stepper: Stepper, count: int) -> Trajectory | None:
    """What a file holds of the run to ``count`` frames, under the scene that is now run."""
    from dataclasses import replace

    from pdcorrect.io.trajectory import load_trajectory
    from pdcorrect.solvers.rollout import check_same_run

    if not output.exists():
        common.say(f"{output} does not exist yet: starting from the beginning")
        return None
    run = load_trajectory(output, salvage=True)
    check_same_run(stepper, run, str(output))
    if len(run) < count:
        common.say(f"{output} holds {len(run)} of {count} frames: continuing")
        return replace(run, scene_toml=stepper.problem.scene.to_toml())
    common.say(f"{output} holds {len(run)} frames already, {count} wanted: nothing to do")
    return run


def _run(
    stepper: Stepper, count: int, output: Path, earlier: Trajectory | None, overwrite: bool
) -> StepLog:
    """Step to frame ``count`` and write each frame; an interruption ends the program."""
    from pdcorrect.io.trajectory import TrajectoryWriter
    from pdcorrect.solvers.rollout import StepLog, continue_from, march, run_attributes

    problem = stepper.problem
    if earlier is None:
        state, done, log = problem.initial_state(), 0, StepLog()
        writer = TrajectoryWriter(
            output, problem.positions, problem.cells, state, overwrite=overwrite,
            scene_toml=problem.scene.to_toml(), attributes=run_attributes(stepper),
        )  # fmt: skip
    else:
        state, done, log = continue_from(stepper, earlier), len(earlier), StepLog(earlier.stats)
        writer = TrajectoryWriter.resume(output, earlier)
    with writer, common.progress_bar(problem.scene.name, count, done) as advance:
        try:
            for result, elapsed in march(stepper, count - done, state=state):
                writer.append(result, elapsed)
                log.add(result, elapsed)
                advance()
        except (KeyboardInterrupt, Terminated) as stop:
            typer.echo(
                f"stopped: {writer.steps} of {count} frames are in {output}; --resume continues",
                err=True,
            )
            ended = TERMINATED if isinstance(stop, Terminated) else INTERRUPTED
            raise typer.Exit(ended) from None
    return log


def _estimated(run: Trajectory) -> str:
    """The estimated error of a run, over all nodes and frames."""
    import numpy as np

    from pdcorrect.evaluation.converged import error_estimate
    from pdcorrect.metrics import rms_error

    with common.progress_bar("finer run", len(run)) as advance:
        found = error_estimate(run, on_step=advance)
    rest = np.broadcast_to(run.points, run.positions.shape)
    error, size = 1e3 * np.sqrt((found[1:] ** 2).mean()), 1e3 * rms_error(run, rest)
    return f"estimated error {error:.3g} mm of {size:.3g} mm (RMS over nodes and frames)"
