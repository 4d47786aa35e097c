"""The command ``pdcorrect export``.  It imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdcorrect.cli_parts import say
from pdcorrect.errors import InputError

if TYPE_CHECKING:
    from pdcorrect.fem.problem import Problem
    from pdcorrect.state import Trajectory


def export(
    run: Annotated[
        Path, typer.Argument(help="Trajectory file of pdcorrect simulate.", show_default=False)
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the files.")],
    every: Annotated[int, typer.Option(help="Write each such frame; frame 0 always.", min=1)] = 1,
    stress: Annotated[
        bool, typer.Option(help="With stresses and volume ratios, where the file allows them.")
    ] = True,
) -> None:
    """Write a run for ParaView: one VTU a frame, and a PVD with the times to open.

    Points have displacement, velocity, stress and von Mises stress, cells von Mises stress and the
    smallest det F.  An older series of the same run in the folder is replaced.
    """
    from pdcorrect.io.trajectory import load_trajectory
    from pdcorrect.io.vtk import write_vtu_series
    from pdcorrect.replacement import make_folder

    loaded = load_trajectory(run)
    make_folder(output)
    problem = _stepped(loaded, run) if stress else None
    say(f"wrote {write_vtu_series(loaded, output, every=every, name=run.stem, stress_of=problem)}")


def _stepped(run: Trajectory, path: Path) -> Problem | None:
    """What stresses are computed from; None, and why, if the file does not say."""
    from pdcorrect.io.stored_problem import problem_of

    try:
        return problem_of(run)
    except InputError as error:
        say(f"without stresses and volume ratios: {path}: {error}")
        return None
