"""The command ``pdcorrect info``: what a trajectory file holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdcorrect.cli import common

if TYPE_CHECKING:
    from pdcorrect.trajectory import Trajectory


def info(
    run: Annotated[Path, typer.Argument(help="Trajectory file.", show_default=False)],
    scene: Annotated[bool, typer.Option("--scene", help="Print the scene, TOML, alone.")] = False,
) -> None:
    """Say what a trajectory file holds: body, solver, frames, motion, energies."""
    from pdcorrect.io.trajectory import load_trajectory

    loaded = load_trajectory(run, salvage=True)
    if scene:
        typer.echo(loaded.scene_toml, nl=False)
        return
    common.print_table(str(run), ["what", "value"], _rows(loaded))


def _rows(run: Trajectory) -> list[tuple[str, str]]:
    from pdcorrect._config import parse_toml
    from pdcorrect.metrics import largest_displacement

    kind = {8: "8 nodes each", 27: "27 nodes each"}.get(run.cells.shape[1], "")
    rows = [
        ("scene", parse_toml(run.scene_toml).get("name", "") if run.scene_toml else "not told"),
        ("mesh", f"{len(run.points)} nodes, {len(run.cells)} cells of {kind}"),
        (
            "size, m",
            " x ".join(f"{x:.4g}" for x in run.points.max(axis=0) - run.points.min(axis=0)),
        ),
        ("frames", f"{len(run)} to t = {run.times[-1]:g} s"),
        ("largest displacement, m", f"{largest_displacement(run):.4g}"),
        *run.attributes.items(),
    ]
    if len(run) and "status" in run.stats:
        status = list(run.stats["status"])
        counts = ", ".join(f"{status.count(name)} {name.lower()}" for name in dict.fromkeys(status))
        rows.append(("steps", counts))
    for name, values in run.stats.items():
        if values.dtype.kind == "f" and len(values):
            rows.append((f"{name}: first, last, largest", _span(values)))
    return rows


def _span(values: object) -> str:
    import numpy as np

    array = np.asarray(values)
    return ", ".join(f"{x:.4g}" for x in (array[0], array[-1], array.max()))
