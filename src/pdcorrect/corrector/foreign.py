"""What a gate refuses in all steps of a scene: measures of bodies at rest, and the time step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.normaliser import Normaliser
from pdcorrect.corrector.shapes import SHAPE_MEASURES, plain_measures


@dataclass(frozen=True)
class ForeignMeasure:
    """A measure by which bodies at rest are refused.

    Attributes
    ----------
    name : str
        Of `SHAPE_MEASURES`.
    bodies : int
        How many are refused by it.
    least, most : float
        Of these bodies, see `plain_measures`.
    low, high : float
        Its range in training; not numbers where that is not known.
    excess : float
        The largest, as gates count it: dimensionless, of most measures a logarithm.
    bound : float
        `Gate.body`.
    """

    name: str
    bodies: int
    least: float
    most: float
    low: float
    high: float
    excess: float
    bound: float


@dataclass(frozen=True)
class ForeignStep:
    """A time step that is refused.

    Attributes
    ----------
    step : float
        s.
    factor : float
        Time step over cell size, over the nearest one of the training; not a number where that
        is not known.
    trained : str
        See `Normaliser.trained_step`.
    bound : float
        `Gate.time_step`.
    """

    step: float
    factor: float
    trained: str
    bound: float


def foreign_measures(
    gate: Gate | None, normaliser: Normaliser, shapes: Tensor
) -> tuple[ForeignMeasure, ...]:
    """By which measures (B, 10) a gate refuses bodies, the farthest out first."""
    bound = None if gate is None else gate.body
    if bound is None or not len(shapes):
        return ()
    shapes = shapes.cpu()
    excess = normaliser.shape_excess(shapes)
    plain = plain_measures(shapes.numpy())
    ends = normaliser.shape_low, normaliser.shape_high
    ranges = [plain_measures(x.cpu().numpy()) for x in ends]
    found = []
    for k, name in enumerate(SHAPE_MEASURES):
        beyond = excess[:, k] > bound
        if beyond.any():
            own = plain[beyond.numpy(), k]
            low, high = (float(x[k]) for x in ranges)
            found.append(
                ForeignMeasure(
                    name, len(own), float(own.min()), float(own.max()), low, high,
                    float(excess[:, k].max()), bound,
                )
            )  # fmt: skip
    return tuple(sorted(found, key=lambda x: -x.excess))


def foreign_step(
    gate: Gate | None, normaliser: Normaliser, step: float, cell_size: float
) -> ForeignStep | None:
    """A time step, s, that a gate refuses with cells of this size, m; None if it does not."""
    bound = None if gate is None else gate.time_step
    ratio = torch.tensor([step], dtype=torch.float64) / cell_size
    if bound is None or not float(normaliser.time_step_excess(ratio.log())) > bound:
        return None
    low, high = normaliser.time_steps
    known = not math.isnan(low)
    factor = float(ratio) / (high if float(ratio) > high else low) if known else math.nan
    return ForeignStep(step, factor, normaliser.trained_step(cell_size), bound)
