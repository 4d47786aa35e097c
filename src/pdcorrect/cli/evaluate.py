"""The command ``pdcorrect evaluate``.  It imports what it needs when it runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pdcorrect._files import check_new
from pdcorrect.cli import common
from pdcorrect.errors import require_extra

if TYPE_CHECKING:
    from pdcorrect.corrector.gate import Gate
    from pdcorrect.evaluation.evaluation import Evaluation, SavedCandidate

_OVER_TIME, _OMEGA = _FIGURES = "errors.png", "omega.png"


def evaluate(
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="[MODEL]... DATA",
            help="Folders or names of models, then the folder of the data set.",
            show_default=False,
        ),
    ],
    split: Annotated[str, typer.Option(help="Split of the data set.")] = "evaluation",
    device: common.Device = "cpu",
    batch: common.Batch = 32,
    workers: common.Workers = 1,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", help="Folder for tables and figures.")
    ] = None,
    gate: common.Gated = True,
    seed: Annotated[int, typer.Option(help="Of the bootstrap intervals.", min=0)] = 0,
    incomplete: common.Incomplete = False,
    figures: common.Figures = True,
    overwrite: common.Overwrite = False,
) -> None:
    """Measure models, and the stored runs of a data set, against its reference.

    Every simulation of the split is stepped from rest.
    """
    from pdcorrect.evaluation.evaluation import DEFAULT_GATE, saved_candidates
    from pdcorrect.evaluation.evaluation import evaluate as run
    from pdcorrect.evaluation.tables import FILES, write_evaluation

    *models, folder = paths
    if output and figures:
        require_extra("matplotlib", "view")
    if output:
        names = (*FILES, *(_FIGURES if figures else ()))
        check_new(*(output / name for name in names), overwrite=overwrite)
    refuses = DEFAULT_GATE if gate else None
    saved = saved_candidates(models, device, gate=refuses)
    common.tell_of_compiling()
    with common.progress_bars("simulations", apart=True) as show:
        found = run(
            saved, folder, split, device=device, batch=batch,
            workers=workers, incomplete=incomplete,
            on_cases=lambda done, total: show("evaluating", done, total),
        )  # fmt: skip
    notes = _notes(saved, found)
    _print(found, notes, seed)
    if output:
        record = _record(saved, folder, device, batch, refuses, notes)
        written = write_evaluation(found, output, record, notes, seed)
        for path in [*written, *(_draw(found, output) if figures else [])]:
            typer.echo(f"wrote {path}")


def _notes(saved: list[SavedCandidate], found: Evaluation) -> list[str]:
    """What a reader of the numbers has to know."""
    from pdcorrect.evaluation.report import refused_corrections

    notes = []
    if found.missing:
        count = len(found.missing) + len(found.shards)
        notes.append(f"{len(found.missing)} of {count} files of the split are missing.")
    for one in saved:
        notes += one.warnings(found.dataset, found.config_hash, found.split)
    for name, run in found.runs.items():
        failures = run.failures()
        if failures:
            first = failures[0]
            notes.append(
                f"{name}: failed in {len(failures)} of {len(run.trajectories)} trajectories, first "
                f"on mesh {first.mesh}, simulation {first.simulation}, step {first.failed}: held "
                "from there on."
            )
        refused = refused_corrections(run.reasons)
        notes += [f"{name}: {refused}"] if refused else []
    return notes


def _print(found: Evaluation, notes: list[str], seed: int) -> None:
    from pdcorrect.evaluation.tables import tables

    for table in tables(found, seed):
        common.print_table(*table, markdown=True)
    for note in notes:
        typer.echo(f"- {note}")


def _record(
    saved: list[SavedCandidate],
    folder: str,
    device: str,
    batch: int,
    gate: Gate | None,
    notes: list[str],
) -> dict[str, Any]:
    import datetime

    import torch

    from pdcorrect._environment import code_digest, environment

    card = f", {torch.cuda.get_device_name(device)}" if device.startswith("cuda") else ""
    return {
        "date": datetime.date.today().isoformat(),
        "command": " ".join(["pdcorrect", *sys.argv[1:]]),
        "environment": {**environment(), "device": device + card},
        "code_digest": code_digest(),
        "folder": folder,
        "batch": batch,
        "gate": None if gate is None else gate.model_dump(),
        "models": {one.name: one.record() for one in saved},
        "notes": notes,
    }


def _draw(found: Evaluation, folder: Path) -> list[Path]:
    import numpy as np

    from pdcorrect.data.schema import PLAIN, REFERENCE
    from pdcorrect.evaluation.tables import mean_errors
    from pdcorrect.figures.curves import plot_error_over_time, plot_omega

    drawn = []
    errors = mean_errors(found)
    if errors:
        frames = len(next(iter(errors.values())))
        times = np.linspace(0.0, found.time_step * (frames - 1), frames)
        drawn.append(plot_error_over_time(errors, times, folder / _OVER_TIME))
    omegas = {name: run.values("omega")[0] for name, run in found.runs.items()}
    shown = {n: x for n, x in omegas.items() if x and n not in (PLAIN, REFERENCE)}
    if shown:
        drawn.append(plot_omega(shown, folder / _OMEGA))
    return drawn
