"""What a gate makes of scenes that a model knows, and of scenes that it does not."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import common
import numpy as np

import pdcorrect as pc

MODEL = "tiny"
FAR = Path(__file__).with_name("far.toml")
SPLITS = ("evaluation", "stronger", "stiffer", "softer", "compressible", "half-step",
          "double-step", "long")  # fmt: skip
HARM = 1.05
"""Times the coarse model's RMS error: what is more counts as harm."""


@dataclass(frozen=True)
class Held:
    """RMS error over that of the coarse model alone, and share of steps refused, a trajectory."""

    errors: np.ndarray
    refused: np.ndarray

    @property
    def harmed(self) -> float:
        """Share of the trajectories, per cent."""
        return 100.0 * float((self.errors > HARM).mean())


def held(data: Path, split: str) -> dict[str, Held]:
    """Free rollouts of a split by gate."""
    from pdcorrect.batch.stepper import BatchStepper
    from pdcorrect.corrector.batch_hybrid import BatchHybrid
    from pdcorrect.corrector.gate import Gate
    from pdcorrect.evaluation.measures import read_cases
    from pdcorrect.evaluation.rollouts import roll_out

    corrector = pc.load_model(MODEL).corrector
    cases = read_cases(data, split, ["best"]).cases
    stepper = BatchStepper([case.problems["best"] for case in cases])
    found = {}
    for name, gate in (("none", None), ("default", Gate())):
        hybrid = BatchHybrid(stepper, corrector, gate=gate)
        runs = roll_out(hybrid, stepper, [case.steps for case in cases])
        errors = [
            pc.metrics.rms_error(run.positions, case.reference)
            / pc.metrics.rms_error(case.runs["best"], case.reference)
            for run, case in zip(runs, cases, strict=True)
        ]
        refused = [(run.reasons > 0).mean() for run in runs]
        found[name] = Held(np.array(errors), np.array(refused))
    return found


def outcome(split: str) -> common.Outcome:
    """One split, generated first."""
    from pdcorrect.data.configuration import DatasetConfig
    from pdcorrect.data.generate import generate

    with tempfile.TemporaryDirectory() as folder:
        generate(DatasetConfig.load(FAR), folder, splits=[split])
        found = held(Path(folder), split)
    chosen = found["default"]
    figures = {f"{split}, harmed, per cent": chosen.harmed}
    if split == SPLITS[0]:
        figures[f"{split}, refused, per cent"] = 100.0 * float(chosen.refused.mean())
    rows = tuple(
        (split, name, float(np.median(one.errors)), float(one.errors.max()), one.harmed,
         100.0 * float(one.refused.mean()))
        for name, one in found.items()
    )  # fmt: skip
    headings = ("split", "gate", "median error", "largest error", "harmed, %", "refused, %")
    title = "RMS error of the hybrid over that of its coarse model alone"
    return common.Outcome(figures, (common.Table(title, headings, rows),))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """The splits; quick runs have only that of familiar scenes."""
    return {split: partial(outcome, split) for split in SPLITS[: 1 if quick else None]}


def finding(record: common.Record) -> str:
    """How many of the splits are harmed."""
    harmed = [split for split in SPLITS if record.figures[f"{split}, harmed, per cent"] > 1.0]
    return (
        f"The gate prevents harm in {len(SPLITS) - len(harmed)} of {len(SPLITS)} splits; not in: "
        f"{', '.join(harmed)} (runs five times longer, where small errors add up unnoticed)."
    )
