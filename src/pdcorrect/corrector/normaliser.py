"""`Normaliser`: features and targets to zero mean and unit deviation, and their ranges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pdcorrect.corrector.features import UNSCALED
from pdcorrect.corrector.shapes import SHAPE_MEASURES
from pdcorrect.errors import InputError

_LEAST_DEVIATION = 1e-5
"""Of the largest magnitude; below it a component counts as constant.

Stored positions are rounded to single precision, which alone is 1e-7 of an edge.
"""

_CONSTANT_UNIT = 0.01

_LEAST_SPREAD = 0.1
"""Deviation of bodies' mean inputs, as the network sees them; less counts as this.

Means that symmetry makes vanish in all training bodies would make any other look strange.
"""

_ROUNDING = 1e-5
"""Of logarithms of time steps over cell sizes.

Cell sizes come from positions, of which some are in single precision.
"""

_PARTS = ("mean", "deviation", "low", "high")
"""What is known of each feature, by the names of the buffers."""

EXTREME = 3.5
"""Deviations that the extremes of inputs, and of bodies' means, count as where they are farther.

Some inputs are large in few steps only, as in kicks: their deviation over all steps is little.
"""


class RunningMoments:
    """Mean, deviation and range of values that come in parts.

    Attributes
    ----------
    count : int
    mean, variance, low, high : (k,)
        float64.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = self.variance = torch.zeros(0, dtype=torch.float64)
        self.low = self.high = self.mean

    def add(self, values: Tensor) -> None:
        """Take in values (m, k); those that are not finite are an error of the caller.

        Parts are merged as in Chan, Golub and LeVeque (1979), without cancellation.
        """
        values = values.detach().to("cpu", torch.float64)
        if not len(values):
            return
        mean, low, high = values.mean(dim=0), values.amin(dim=0), values.amax(dim=0)
        variance = (values - mean).square().mean(dim=0)
        if not self.count:
            self.count = len(values)
            self.mean, self.variance, self.low, self.high = mean, variance, low, high
            return
        share = len(values) / (self.count + len(values))
        away = mean - self.mean
        self.mean = self.mean + share * away
        self.variance = (
            (1.0 - share) * self.variance + share * variance + share * (1.0 - share) * away.square()
        )
        self.low, self.high = torch.minimum(self.low, low), torch.maximum(self.high, high)
        self.count += len(values)

    @property
    def square(self) -> Tensor:
        """Mean square, (k,)."""
        return self.variance + self.mean.square()

    @property
    def deviation(self) -> Tensor:
        """Root mean squared distance from the mean, (k,)."""
        return self.variance.sqrt()


class Scale(NamedTuple):
    """Of the components of a feature, (k,) each; the last two are the units of its excess."""

    mean: Tensor
    deviation: Tensor
    low: Tensor
    high: Tensor
    below: Tensor
    above: Tensor


class Normaliser(nn.Module):
    """Affine maps by feature name, and the scale of the output; buffers, not trained.

    Parameters
    ----------
    nodes, edges : mapping of str to int
        Components of each feature.

    Attributes
    ----------
    output_scale : () tensor
        Root mean square of the training targets, a component.
    average_low, average_high, average_mean, average_deviation : (a,) tensors
        Range, mean and deviation, over the training data, of the means over a body's nodes of
        what the network sees of them; not numbers before `fit_averages`.
    shape_low, shape_high : (10,) tensors
        Range of the measures of training bodies at rest, see `shape_measures`; not numbers before
        `fit_shapes`.
    time_step_low, time_step_high : (1,) tensors
        Range of the logarithm of the training data's time step over cell size, s/m, see
        `BodyGraph.time_steps`; not a number before `fit_time_steps`.
    fitted : bool
        Whether it has seen data.
    """

    output_scale: Tensor
    average_low: Tensor
    average_high: Tensor
    average_mean: Tensor
    average_deviation: Tensor
    shape_low: Tensor
    shape_high: Tensor
    time_step_low: Tensor
    time_step_high: Tensor

    def __init__(self, nodes: Mapping[str, int], edges: Mapping[str, int]) -> None:
        super().__init__()
        self.names = (*nodes, *edges)
        for name, k in {**nodes, **edges}.items():
            for part, value in zip(_PARTS, (0.0, 1.0, 0.0, 0.0), strict=True):
                self.register_buffer(_key(name, part), torch.full((k,), value, dtype=torch.float64))
        self.register_buffer("output_scale", torch.zeros((), dtype=torch.float64))
        for part in _PARTS:
            unknown = torch.full((sum(nodes.values()),), torch.nan, dtype=torch.float64)
            self.register_buffer(f"average_{part}", unknown)
        for name, k in (("shape", len(SHAPE_MEASURES)), ("time_step", 1)):
            for part in ("low", "high"):
                unknown = torch.full((k,), torch.nan, dtype=torch.float64)
                self.register_buffer(f"{name}_{part}", unknown)

    @property
    def fitted(self) -> bool:
        return bool(self.output_scale > 0)

    @property
    def time_steps(self) -> tuple[float, float]:
        """Least and largest time step over cell size of the training data, s/m.

        Not numbers before `fit_time_steps`.
        """
        return float(self.time_step_low.exp()), float(self.time_step_high.exp())

    def trained_step(self, cell_size: float) -> str:
        """The time step of the training, or its range, for cells of this size (m); with unit."""
        if self.time_step_low.isnan().any():
            return "not known"
        steps = dict.fromkeys(f"{cell_size * x:.4g}" for x in self.time_steps)
        return f"{' to '.join(steps)} s"

    def fit(self, features: Mapping[str, RunningMoments], target: RunningMoments) -> None:
        """Take over the moments of features, and of targets (m, 1).

        Raises
        ------
        InputError
            If there are none of a feature or of the targets, or all targets are zero.
        """
        seen = {name: features[name].count for name in self.names if name in features}
        missing = [name for name in self.names if not seen.get(name)]
        if missing:
            raise InputError(f"features {', '.join(missing)}: expected values, got none.")
        if not target.count or not float(target.square.mean()) > 0.0:
            raise InputError("targets: expected values other than zero.")
        for name in self.names:
            moments = features[name]
            largest = torch.maximum(moments.low.abs(), moments.high.abs())
            constant = moments.deviation <= _LEAST_DEVIATION * largest
            deviation = torch.where(constant, largest, moments.deviation)
            deviation = torch.where(deviation > 0.0, deviation, 1.0)
            if name not in UNSCALED:
                self._part(name, "mean").copy_(moments.mean)
                self._part(name, "deviation").copy_(deviation)
            self._part(name, "low").copy_(moments.low)
            self._part(name, "high").copy_(moments.high)
        self.output_scale.copy_(target.square.mean().sqrt())

    def fit_averages(self, averages: RunningMoments) -> None:
        """Take over range, mean and deviation of bodies' mean inputs (m, a), see `joined`."""
        self._fit_range("average_", averages)
        self.average_mean.copy_(averages.mean)
        self.average_deviation.copy_(averages.deviation.clamp_min(_LEAST_SPREAD))

    def fit_shapes(self, shapes: RunningMoments) -> None:
        """Take over the range of bodies' measures at rest (m, 10)."""
        self._fit_range("shape_", shapes)

    def fit_time_steps(self, steps: RunningMoments) -> None:
        """Take over the range of logarithms of time steps over cell sizes, s/m, (m, 1)."""
        self._fit_range("time_step_", steps)

    def _fit_range(self, prefix: str, moments: RunningMoments) -> None:
        for part in ("low", "high"):
            getattr(self, prefix + part).copy_(getattr(moments, part))

    def widen(self, features: Mapping[str, RunningMoments]) -> None:
        """Widen the ranges by those of further values; means and deviations do not change."""
        for name in self.names:
            self._widen(_key(name, ""), features[name])

    def widen_averages(self, averages: RunningMoments) -> None:
        """Widen the ranges of bodies' mean inputs (m, a); as of `widen`."""
        self._widen("average_", averages)

    def widen_shapes(self, shapes: RunningMoments) -> None:
        """Widen the range of bodies' measures at rest (m, 10); as of `widen`."""
        self._widen("shape_", shapes)

    def widen_time_steps(self, steps: RunningMoments) -> None:
        """Widen the range of logarithms of time steps over cell sizes (m, 1); as of `widen`."""
        self._widen("time_step_", steps)

    def _widen(self, prefix: str, moments: RunningMoments) -> None:
        for part, of_both in (("low", torch.minimum), ("high", torch.maximum)):
            own: Tensor = getattr(self, prefix + part)
            own.copy_(of_both(own.cpu(), getattr(moments, part)))

    def joined(self, values: Mapping[str, Tensor], clip: float | None) -> Tensor:
        """Normalised features (m, k1 + k2 + ...), bent towards -clip and clip."""
        x = torch.cat(list(values.values()), dim=1)
        out = (x - self._row(values, "mean", x)) / self._row(values, "deviation", x)
        return out if clip is None else clip * torch.tanh(out / clip)

    def excess(self, values: Mapping[str, Tensor]) -> Tensor:
        """How far components (m, k1 + k2 + ...) lie outside the range seen, at least 0.

        In deviations, of which the farthest value seen on the same side counts as 3.5 at most, or
        where a component was constant in hundredths of its value, or of one.
        """
        x = torch.cat(list(values.values()), dim=1)
        mean, deviation, low, high = (self._row(values, part, x) for part in _PARTS)
        below, above = _units(mean, deviation, low, high)
        return torch.maximum((low - x) / below, (x - high) / above).clamp_min(0.0)

    def strangeness(self, averages: Tensor) -> Tensor:
        """How far bodies' mean inputs (B, a) are from their mean in training.

        In deviations of such means, of which the farthest on the same side counts as 3.5 at most.
        Infinite where it is not a number.
        """
        mean, deviation, low, high = (
            getattr(self, f"average_{part}").to(averages) for part in _PARTS
        )
        farthest = torch.where(averages < mean, mean - low, high - mean)
        found = (averages - mean).abs() / torch.maximum(deviation, farthest / EXTREME)
        return torch.where(found.isnan(), torch.inf, found)

    def shape_excess(self, shapes: Tensor) -> Tensor:
        """How far measures (B, 10) lie outside the range of training bodies, at least 0.

        Infinite where it is not a number.
        """
        return self._beyond("shape_", shapes)

    def time_step_excess(self, steps: Tensor) -> Tensor:
        """How far logarithms of time steps over cell sizes (B,), s/m, lie outside their range.

        At least 0, in double precision; what rounding alone may make of them counts as 0.
        Infinite where it is not a number.
        """
        found = self._beyond("time_step_", steps.double())
        return torch.where(found > _ROUNDING, found, 0.0)

    def _beyond(self, prefix: str, values: Tensor) -> Tensor:
        low, high = (getattr(self, prefix + part).to(values) for part in ("low", "high"))
        found = torch.maximum(low - values, values - high).clamp_min(0.0)
        return found.nan_to_num(nan=torch.inf, posinf=torch.inf)

    def scale(self, name: str) -> Scale:
        """What is known of one feature."""
        mean, deviation, low, high = (self._part(name, part) for part in _PARTS)
        return Scale(mean, deviation, low, high, *_units(mean, deviation, low, high))

    def _row(self, names: Iterable[str], part: str, like: Tensor) -> Tensor:
        """A part of some features side by side, (k1 + k2 + ...,)."""
        return torch.cat([self._part(name, part) for name in names]).to(like)

    def _part(self, name: str, part: str) -> Tensor:
        found: Tensor = getattr(self, _key(name, part))
        return found


def _units(mean: Tensor, deviation: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """In which to count how far values are below and above a range."""
    size = torch.maximum(low.abs(), high.abs())
    constant = high - low <= _LEAST_DEVIATION * size
    least = torch.where(constant, _CONSTANT_UNIT * torch.where(size > 0.0, size, 1.0), deviation)

    def unit(farthest: Tensor) -> Tensor:
        return torch.where(constant, least, torch.maximum(least, farthest / EXTREME))

    return unit(mean - low), unit(high - mean)


def _key(name: str, part: str) -> str:
    return f"{name.replace('-', '_')}__{part}"
