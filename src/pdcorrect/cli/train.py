"""The command ``pdcorrect train``.  It imports what it needs when it runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pdcorrect.cli import common

if TYPE_CHECKING:
    from pdcorrect.training.progress import Progress

EVALUATION = "evaluation"
"""Folder, inside a training's, of what ``--evaluate`` finds."""


def train(
    config: common.ConfigFile,
    data: Annotated[Path, typer.Option(help="Folder of the data set.")],
    output: common.OutputFolder,
    device: common.Device = "cpu",
    resume: Annotated[bool, typer.Option(help="Go on from the folder's checkpoint.")] = False,
    seconds: Annotated[
        Optional[float],
        typer.Option(help="Stop after about so many seconds; --resume goes on.", min=0),
    ] = None,
    incomplete: common.Incomplete = False,
    evaluate: Annotated[
        Optional[str], typer.Option(help="Split on which the best model is judged at the end.")
    ] = None,
) -> None:
    """Train a corrector; the best model is in OUTPUT/model (extra 'learn').

    Several processes: torchrun --nproc-per-node N -m pdcorrect train ...
    Exit status 1 if time was up before the end.
    """
    import time

    started = time.monotonic()
    from pdcorrect.training.distributed import joined
    from pdcorrect.training.recipe import TrainingConfig
    from pdcorrect.training.training import MODEL, Training

    loaded = TrainingConfig.load(config)
    if evaluate is not None:
        from pdcorrect.data.folder import check_whole, shard_paths

        shard_paths(data, evaluate)  # refused now, not when the training has ended
        if not incomplete:
            check_whole(data, [evaluate])
    common.tell_of_compiling()
    with joined(device) as (world, own):
        training = Training(
            loaded, data, output, device=own, resume=resume, incomplete=incomplete, world=world,
            on_report=_tell,
        )  # fmt: skip
        left = None if seconds is None else max(0.0, seconds - (time.monotonic() - started))
        finished = training.run(left)
        if not world.first:
            return
        metrics = training.progress.metrics
    if not finished:
        typer.echo(f"{output}: not finished after {training.progress.total} iterations; --resume")
        raise typer.Exit(common.FAILED)
    told = ", ".join(f"{name.replace('_', ' ')} {value:.1f}" for name, value in metrics.items())
    typer.echo(f"{output / MODEL}: {told or 'no validation split'}")
    if evaluate is not None:
        from pdcorrect.cli.evaluate import evaluate as judge

        judge(
            [str(output / MODEL), str(data)], split=evaluate, device=own,
            output=output / EVALUATION, incomplete=incomplete, figures=False,
        )  # fmt: skip


def _tell(at: Progress, row: Mapping[str, Any]) -> None:
    numbers = "  ".join(
        f"{name.replace('_', ' ')} {value:.4g}"
        for name, value in row.items()
        if name not in ("stage", "seconds")
    )
    typer.echo(f"{at.seconds:7.1f} s  stage {at.stage}  {at.total:6d}  {numbers}")


def train_element(
    output: common.OutputFolder,
    bodies: Annotated[Optional[int], typer.Option(help="Random bodies.", min=1)] = None,
    iterations: Annotated[
        Optional[int], typer.Option(help="Steps of the optimiser.", min=1)
    ] = None,
    seed: Annotated[int, typer.Option(help="Of bodies, weights and order.", min=0)] = 45,
    device: common.Device = "cpu",
    workers: common.Workers = 1,
    seconds: common.Seconds = None,
) -> None:
    """Train the network that writes the learned element's cells (extra 'learn').

    Random bodies are generated in OUTPUT, and what an earlier call left there is taken up.
    Exit status 1 if time was up before the end.
    """
    from pdcorrect.elements.training import ElementRecipe
    from pdcorrect.elements.training import train as train_network

    given = {"bodies": bodies, "iterations": iterations}
    recipe = ElementRecipe(seed=seed, **{k: v for k, v in given.items() if v is not None})
    common.tell_of_compiling()
    if not train_network(
        recipe, output, device=device, workers=workers, seconds=seconds, report=typer.echo
    ):
        typer.echo(f"{output}: not finished; the same command goes on")
        raise typer.Exit(common.FAILED)


@common.naming_scene
def tune_element(
    scene: common.SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="File of weights, *.safetensors.")],
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="Of loads and order.", min=0)] = 0,
    overwrite: common.Overwrite = False,
) -> None:
    """Tune the learned element to the body of one scene, in a minute (extra 'learn').

    The scene then has the element hex8-learned and the file as weights, both in its table solver.
    """
    from pdcorrect.elements.tuning import tune
    from pdcorrect.fem.problem import discretise
    from pdcorrect.scene import Scene, learned_coarse

    loaded = Scene.load(scene)
    common.tell_of_compiling()
    problem = discretise(learned_coarse(loaded))
    found = tune(
        problem, output, iterations=iterations, seed=seed, report=typer.echo, overwrite=overwrite
    )
    for name in ("displacements", "frequencies"):
        without, before, after = (100.0 * errors[name] for errors in found)
        typer.echo(
            f"{name}: {without:.2f} % off without learning, {before:.2f} % before, "
            f"{after:.2f} % now"
        )
    told = os.path.relpath(output, scene.parent)  # as the scene's paths are
    typer.echo(f'wrote {output}; [solver] element = "hex8-learned", weights = "{told}"')
