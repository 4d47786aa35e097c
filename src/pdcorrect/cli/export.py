"""The command ``pdcorrect export``.  It imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdcorrect.cli.common import OutputFolder, Overwrite, say
from pdcorrect.errors import FileFormatError, InputError

if TYPE_CHECKING:
    from pdcorrect.fem.problem import Problem
    from pdcorrect.trajectory import Trajectory


def export(
    run: Annotated[
        Path, typer.Argument(help="Trajectory file of pdcorrect simulate.", show_default=False)
    ],
    output: OutputFolder,
    every: Annotated[int, typer.Option(help="Write each such frame; frame 0 always.", min=1)] = 1,
    stress: Annotated[
        bool, typer.Option(help="With stresses and volume ratios, where the file allows them.")
    ] = True,
    salvage: Annotated[
        bool, typer.Option("--salvage", help="Of a file that was cut short: what survives of it.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write a run for ParaView: one VTU a frame, and a PVD with the times to open.

    Points have displacement, velocity, stress and von Mises stress, cells von Mises stress and the
    smallest det F.
    """
    from pdcorrect._files import check_new, make_folder
    from pdcorrect.io.vtk import vtu_series, write_vtu_series

    loaded = _loaded(run, salvage)
    make_folder(output)
    check_new(*vtu_series(output, run.stem), overwrite=overwrite)
    problem = _stepped(loaded, run) if stress else None
    say(f"wrote {write_vtu_series(loaded, output, every=every, name=run.stem, stress_of=problem)}")


def _loaded(path: Path, salvage: bool) -> Trajectory:
    """The run, or what survives of it; a refusal offers the option where something does."""
    from pdcorrect.io.trajectory import load_trajectory

    try:
        return load_trajectory(path, salvage=salvage)
    except FileFormatError as error:
        try:
            left = len(load_trajectory(path, salvage=True))
        except FileFormatError:
            raise error from None
        raise FileFormatError(f"{error} export --salvage writes {left} steps of it.") from None


def _stepped(run: Trajectory, path: Path) -> Problem | None:
    """What stresses are computed from; None, and why, if the file does not say."""
    from pdcorrect.io.trajectory_reader import problem_of

    try:
        return problem_of(run)
    except InputError as error:
        say(f"without stresses and volume ratios: {path}: {error}")
        return None
