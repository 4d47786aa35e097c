"""The commands ``pdcorrect dataset ...``.  Each imports what it needs when it runs."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from pdcorrect._files import INTERRUPTED, Terminated, make_folder, write_text
from pdcorrect.cli.common import FAILED, FileLines, progress_bar
from pdcorrect.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Generate, check, summarise and convert data sets.")

Folder = Annotated[Path, typer.Argument(help="Folder of the data set.", show_default=False)]


class Layout(StrEnum):
    """Choices of --to."""

    meshgraphnet = "meshgraphnet"
    vtu = "vtu"


@app.command()
def generate(
    config: Annotated[Path, typer.Argument(help="Configuration, TOML.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the data set.")],
    workers: Annotated[
        int, typer.Option(help="Processes on this machine (extra 'cluster' if several).", min=1)
    ] = 1,
    scheduler: Annotated[
        Optional[str], typer.Option(help="Address of a Dask scheduler, to use its workers.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, or cuda (extra 'learn').")] = "cpu",
    batch: Annotated[int, typer.Option(help="Simulations at once on a GPU.", min=1)] = 32,
    split: Annotated[Optional[list[str]], typer.Option(help="Only this split; repeatable.")] = None,
    seconds: Annotated[
        Optional[float],
        typer.Option(
            help="Begin nothing new after so many seconds; the mesh in hand is finished.", min=0
        ),
    ] = None,
) -> None:
    """Compute a data set, or what is missing or damaged of one that was begun.

    The files do not depend on the number of workers.  Exit status 1 if some that were asked for
    are still missing.
    """
    from pdcorrect.data.configuration import DatasetConfig
    from pdcorrect.data.generate import generate as run
    from pdcorrect.data.workers import Workers

    with _simulations() as shown:
        found = run(
            DatasetConfig.load(config), output, Workers(workers, scheduler, device, batch),
            splits=split, seconds=seconds, on_begin=shown.begin, on_file=shown,
        )  # fmt: skip
    typer.echo(f"{output}: {found}")
    if not found:
        raise typer.Exit(FAILED)


@app.command()
def check(
    folder: Folder,
    repeat: Annotated[
        int,
        typer.Option(min=0, help="Steps of each simulation's coarse models to take again."),
    ] = 1,
) -> None:
    """Read every file, compare it with config.toml and the others, print what is wrong.

    Of a generated data set some steps of the coarse models are taken again.

    The exit status is 1 if there are errors; warnings do not count.
    """
    from pdcorrect.data.check import check_dataset
    from pdcorrect.data.folder import all_shards

    count = len(all_shards(folder))
    with progress_bar("checking", count, unit="files", apart=True) as advance:
        findings = check_dataset(folder, advance, repeat)
    for finding in findings:
        typer.echo(str(finding))
    errors = sum(finding.severity == "error" for finding in findings)
    typer.echo(f"{count} files, {errors} errors, {len(findings) - errors} warnings")
    if errors:
        raise typer.Exit(FAILED)


@app.command()
def info(
    folder: Folder,
    json: Annotated[
        Optional[Path], typer.Option(help="Also write all numbers to this file.")
    ] = None,
    skip_damaged: Annotated[
        bool, typer.Option("--skip-damaged", help="Leave out and name files that are damaged.")
    ] = False,
) -> None:
    """Summarise a data set: sizes, materials, motions, errors of the runs, cost."""
    from rich.console import Console

    from pdcorrect.data.folder import all_shards
    from pdcorrect.data.summary import dataset_info

    with progress_bar("reading", len(all_shards(folder)), unit="files", apart=True) as advance:
        found = dataset_info(folder, advance, skip_damaged=skip_damaged)
    console = Console(width=None if sys.stdout.isatty() else 200, markup=False)
    console.print(*found.tables())
    for text in found.damaged.values():
        typer.echo(f"left out: {text}", err=True)
    if json:
        make_folder(json.parent)
        write_text(json, found.to_json() + "\n")
        typer.echo(f"wrote {json}")


@app.command("export")
def export(
    folder: Folder,
    target: Annotated[Path, typer.Argument(help="Folder to write to.", show_default=False)],
    to: Annotated[Layout, typer.Option(help="Layout.")] = Layout.meshgraphnet,
    split: Annotated[
        Optional[str],
        typer.Option(help="The only split; meshgraphnet: all by default; vtu: evaluation."),
    ] = None,
    base: Annotated[
        Optional[str],
        typer.Option(help="meshgraphnet: run whose predictions are given as base_pos; plain."),
    ] = None,
    mesh: Annotated[Optional[int], typer.Option(help="vtu: number of the mesh; 0.", min=0)] = None,
    simulation: Annotated[
        Optional[int], typer.Option(help="vtu: number of the simulation; 0.", min=0)
    ] = None,
    run: Annotated[
        Optional[list[str]],
        typer.Option(help="vtu: run beside the reference; repeatable; plain, if there is one."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files of the same names.")
    ] = False,
) -> None:
    """Write a data set for MeshGraphNet tools (HDF5), or one simulation for ParaView."""
    from pdcorrect.data import export as exports
    from pdcorrect.data.folder import missing_files

    if to is Layout.meshgraphnet:
        _unused(to, {"--mesh": mesh, "--simulation": simulation, "--run": run})
        with contextlib.suppress(InputError):  # of config.toml, which no export needs
            _warn_of_missing(missing_files(folder, split))
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


def _warn_of_missing(paths: Sequence[Path]) -> None:
    if paths:
        typer.echo(
            f"warning: the data set is incomplete: {len(paths)} of the files that its config.toml "
            f"asks for are missing, as {paths[0]}.",
            err=True,
        )


@app.command("import")
def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Reference trajectories on one body (HDF5), or one .npz.", show_default=False
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the data set.")],
    coarse: Annotated[
        Optional[list[Path]],
        typer.Option(help="Coarse trajectory; one for each reference, in order."),
    ] = None,
    split: Annotated[
        str, typer.Option(help="Split: training, validation, evaluation, or a name of your own.")
    ] = "training",
    number: Annotated[int, typer.Option(help="Number of the mesh in the split.", min=0)] = 0,
    best: Annotated[
        bool, typer.Option("--best", help="Also compute the best coarse model's run.")
    ] = False,
) -> None:
    """Add a mesh and its simulations, computed elsewhere, to a data set."""
    from pdcorrect.data.configuration import EVALUATION, TRAINING, VALIDATION
    from pdcorrect.data.import_files import import_trajectories

    if "/" in split or split in ("", ".", ".."):
        raise InputError(f"--split {split!r}: expected a name.")
    path = import_trajectories(
        sources, output, coarse=coarse or (), split=split, number=number, best=best
    )
    typer.echo(f"wrote {path}")
    known = (TRAINING, VALIDATION, EVALUATION)
    if split not in known:
        typer.echo(
            f"note: split {split!r} is one of your own; training reads {TRAINING!r} and "
            f"{VALIDATION!r}, evaluation {EVALUATION!r} unless told otherwise.",
            err=True,
        )


@contextlib.contextmanager
def _simulations() -> Iterator[FileLines]:
    """A line for each file; an interruption ends the program, and says what is there."""
    shown = FileLines()
    try:
        yield shown
    except KeyboardInterrupt:
        typer.echo(shown.interrupted(), err=True)
        raise typer.Exit(INTERRUPTED) from None
    except Terminated:
        typer.echo(shown.interrupted(), err=True)
        raise
