"""The program's commands for data sets, ``pdcorrect dataset``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from pdcorrect.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Data sets for networks that correct coarse runs.")

Folder = Annotated[Path, typer.Argument(help="Folder of the data set.", show_default=False)]


class Layout(StrEnum):
    """Choices of --to."""

    meshgraphnet = "meshgraphnet"
    vtu = "vtu"


@app.command("export")
def export(
    folder: Folder,
    target: Annotated[Path, typer.Argument(help="Folder to write to.", show_default=False)],
    to: Annotated[Layout, typer.Option(help="Layout.")] = Layout.meshgraphnet,
    base: Annotated[
        str, typer.Option(help="meshgraphnet: run whose predictions are given as base_pos.")
    ] = "plain",
    split: Annotated[str, typer.Option(help="vtu: split.")] = "evaluation",
    mesh: Annotated[int, typer.Option(help="vtu: number of the mesh.", min=0)] = 0,
    simulation: Annotated[int, typer.Option(help="vtu: number of the simulation.", min=0)] = 0,
    run: Annotated[
        Optional[list[str]], typer.Option(help="vtu: run beside the reference; repeatable.")
    ] = None,
) -> None:
    """Write a data set for MeshGraphNet tools (HDF5), or one simulation for ParaView."""
    from pdcorrect.data import export as exports

    if to is Layout.meshgraphnet:
        written = exports.export_meshgraphnet(folder, target, base=base)
    else:
        runs = ("plain",) if run is None else tuple(run)
        written = exports.export_vtu(folder, target, split, mesh, simulation, runs)
    for path in written:
        typer.echo(f"wrote {path}")


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
    split: Annotated[str, typer.Option(help="Split.")] = "training",
    number: Annotated[int, typer.Option(help="Number of the mesh in the split.", min=0)] = 0,
    moved: Annotated[bool, typer.Option(help=".npz: frame 0 need not be the rest shape.")] = False,
) -> None:
    """Add a mesh and its simulations, computed elsewhere, to a data set."""
    from pdcorrect.data.importing import import_trajectories

    if "/" in split or split in ("", ".", ".."):
        raise InputError(f"--split {split!r}: expected a name.")
    path = import_trajectories(
        sources, output, coarse=coarse or (), split=split, number=number, starts_at_rest=not moved
    )
    typer.echo(f"wrote {path}")
