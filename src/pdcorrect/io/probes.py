"""Displacements of a scene's probes as a table."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from pdcorrect._files import write_text
from pdcorrect.fem.problem import Problem
from pdcorrect.metrics import probes
from pdcorrect.trajectory import Trajectory


def probes_file(output: str | Path) -> Path:
    """``NAME_probes.csv`` beside ``NAME.h5``."""
    output = Path(output)
    return output.with_name(f"{output.stem}_probes.csv")


def write_probes(run: Trajectory, problem: Problem, output: str | Path) -> Path:
    """Write `probes_file` of a run's file: time (s) and displacements (m), a row a frame.

    Columns are ``time``, then ``PROBE.x``, ``PROBE.y``, ``PROBE.z`` for each probe.
    """
    path, found = probes_file(output), probes(run, problem)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["time", *(f"{name}.{axis}" for name in found for axis in "xyz")])
    rows = np.concatenate([run.times[:, None], *found.values()], axis=1)
    writer.writerows([[repr(float(value)) for value in row] for row in rows])
    write_text(path, buffer.getvalue())
    return path
