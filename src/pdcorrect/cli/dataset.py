"""The commands ``pdcorrect dataset ...``.  Each imports what it needs when it runs."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from pdcorrect._files import INTERRUPTED, Terminated, check_new, make_folder, write_text
from pdcorrect.cli import common
from pdcorrect.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Generate, check, summarise and convert data sets.")

Folder = Annotated[Path, typer.Argument(help="Folder of the data set.", show_default=False)]


Layout = StrEnum("Layout", ["meshgraphnet", "vtu"])


@app.command()
def generate(
    config: common.ConfigFile,
    output: common.OutputFolder,
    workers: common.Workers = 1,
    scheduler: Annotated[Optional[str], typer.Option(help="Address of a Dask scheduler.")] = None,
    device: common.Device = "cpu",
    batch: common.Batch = 32,
    split: Annotated[Optional[list[str]], typer.Option(help="Only this split; repeatable.")] = None,
    seconds: common.Seconds = None,
) -> None:
    """Compute a data set, or what is missing or damaged of one that was begun.

    The files do not depend on the number of workers.  Exit status 1 if some that were asked for
    are still missing.
    """
    from pdcorrect.data.configuration import DatasetConfig
    from pdcorrect.data.generate import generate as run
    from pdcorrect.data.workers import Workers

    shown = common.FileLines()
    try:
        found = run(
            DatasetConfig.load(config), output, Workers(workers, scheduler, device, batch),
            splits=split, seconds=seconds, on_begin=shown.begin, on_file=shown,
        )  # fmt: skip
    except (KeyboardInterrupt, Terminated) as stop:
        typer.echo(shown.interrupted(), err=True)
        if isinstance(stop, Terminated):
            raise
        raise typer.Exit(INTERRUPTED) from None
    typer.echo(f"{output}: {found}")
    if not found:
        raise typer.Exit(common.FAILED)


@app.command()
def check(
    folder: Folder,
    repeat: Annotated[int, typer.Option(min=0, help="Steps of coarse models to repeat.")] = 1,
) -> None:
    """Read every file, compare it with config.toml and the others, print what is wrong.

    Of a generated data set some steps of the coarse models are taken again.

    The exit status is 1 if there are errors; warnings do not count.
    """
    from pdcorrect.data.check import check_dataset
    from pdcorrect.data.folder import all_shards

    count = len(all_shards(folder))
    with common.progress_bar("checking", count, unit="files", apart=True) as advance:
        findings = check_dataset(folder, advance, repeat)
    for finding in findings:
        typer.echo(str(finding))
    errors = sum(finding.severity == "error" for finding in findings)
    typer.echo(f"{count} files, {errors} errors, {len(findings) - errors} warnings")
    if errors:
        raise typer.Exit(common.FAILED)


@app.command()
def info(
    folder: Folder,
    json: Annotated[Optional[Path], typer.Option(help="File for all numbers.")] = None,
    skip_damaged: common.SkipDamaged = False,
    overwrite: common.Overwrite = False,
) -> None:
    """Summarise a data set: sizes, materials, motions, errors of the runs, cost."""
    from pdcorrect.data.folder import all_shards
    from pdcorrect.data.summary import dataset_info

    if json:
        make_folder(json.parent)
        check_new(json, overwrite=overwrite)
    count = len(all_shards(folder))
    with common.progress_bar("reading", count, unit="files", apart=True) as advance:
        found = dataset_info(folder, advance, skip_damaged=skip_damaged)
    for table in found.tables():
        common.print_table(*table)
    for text in found.damaged.values():
        typer.echo(f"left out: {text}", err=True)
    if json:
        write_text(json, found.to_json() + "\n")
        typer.echo(f"wrote {json}")


@app.command("export")
def export(
    folder: Folder,
    target: Annotated[Path, typer.Argument(help="Folder to write to.", show_default=False)],
    to: Annotated[Layout, typer.Option(help="Layout.")] = Layout.meshgraphnet,
    split: Annotated[Optional[str], typer.Option(help="All by default; vtu: evaluation.")] = None,
    base: Annotated[Optional[str], typer.Option(help="meshgraphnet: run of base_pos.")] = None,
    mesh: Annotated[Optional[int], typer.Option(help="vtu: number of the mesh; 0.", min=0)] = None,
    simulation: Annotated[Optional[int], typer.Option(help="vtu: its number; 0.", min=0)] = None,
    run: Annotated[Optional[list[str]], typer.Option(help="vtu: runs shown with it.")] = None,
    overwrite: common.Overwrite = False,
) -> None:
    """Write a data set for MeshGraphNet tools (HDF5), or one simulation for ParaView."""
    from pdcorrect.data import export as exports

    if to is Layout.meshgraphnet:
        _unused(to, {"--mesh": mesh, "--simulation": simulation, "--run": run})
        written = exports.export_meshgraphnet(
            folder, target, base=base or "plain", split=split, overwrite=overwrite
        )
    else:
        _unused(to, {"--base": base})
        written = exports.export_vtu(
            folder, target, split or "evaluation", mesh or 0, simulation or 0, run,
            overwrite=overwrite,
        )  # fmt: skip
    for path in written:
        typer.echo(f"wrote {path}")


def _unused(to: Layout, options: Mapping[str, object]) -> None:
    """Refuse options that do nothing in a layout."""
    for name, value in options.items():
        if value is not None and value != []:
            raise InputError(f"{name} with --to {to}: it has no use there; leave it out.")


@app.command("import")
def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Reference trajectories on one body (HDF5), or one .npz.", show_default=False
        ),
    ],
    output: common.OutputFolder,
    coarse: Annotated[Optional[list[Path]], typer.Option(help="One for each reference.")] = None,
    split: Annotated[str, typer.Option(help="training, validation, evaluation, any.")] = "training",
    number: Annotated[int, typer.Option(help="Number of the mesh in the split.", min=0)] = 0,
    best: Annotated[bool, typer.Option("--best", help="Also run the best coarse model.")] = False,
) -> None:
    """Add a mesh and its simulations, computed elsewhere, to a data set."""
    from pdcorrect.data.import_files import import_trajectories

    path = import_trajectories(
        sources, output, coarse=coarse or (), split=split, number=number, best=best
    )
    typer.echo(f"wrote {path}")
