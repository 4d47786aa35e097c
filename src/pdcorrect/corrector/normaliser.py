"""What a corrector's training held, and what is made of it.

`Normaliser` brings features and targets to zero mean and unit deviation; `Envelope` tells how far
bodies and steps lie outside of the training.  Both are fitted to `RunningMoments`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

from pdcorrect.corrector.bodies import SHAPE_MEASURES, BodyGraph
from pdcorrect.corrector.features import UNSCALED
from pdcorrect.errors import InputError

LEAST_DEVIATION = 1e-5
"""Of the largest magnitude; below it a component counts as constant.

Stored positions are rounded to single precision, which alone is 1e-7 of an edge.
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


class Normaliser(nn.Module):
    """Affine maps by feature name, and the scale of the output; buffers, not trained.

    Nodes' and edges' features are given with their components.  ``output_scale`` is the root mean
    square of the training targets, a component.
    """

    output_scale: Tensor

    def __init__(self, nodes: Mapping[str, int], edges: Mapping[str, int]) -> None:
        super().__init__()
        self.names = (*nodes, *edges)
        for name, k in {**nodes, **edges}.items():
            for part, value in (("mean", 0.0), ("deviation", 1.0)):
                self.register_buffer(_key(name, part), torch.full((k,), value, dtype=torch.float64))
        self.register_buffer("output_scale", torch.zeros((), dtype=torch.float64))

    @property
    def fitted(self) -> bool:
        """Whether it has seen data."""
        return bool(self.output_scale > 0)

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
            if name in UNSCALED:
                continue
            moments = features[name]
            largest = torch.maximum(moments.low.abs(), moments.high.abs())
            constant = moments.deviation <= LEAST_DEVIATION * largest
            deviation = torch.where(constant, largest, moments.deviation)
            getattr(self, _key(name, "mean")).copy_(moments.mean)
            getattr(self, _key(name, "deviation")).copy_(
                torch.where(deviation > 0.0, deviation, 1.0)
            )
        self.output_scale.copy_(target.square.mean().sqrt())

    def joined(self, values: Mapping[str, Tensor], clip: float | None) -> Tensor:
        """Normalised features (m, k1 + k2 + ...), bent towards -clip and clip."""
        x = torch.cat(list(values.values()), dim=1)
        mean, deviation = self.rows(values)
        out = (x - mean.to(x)) / deviation.to(x)
        return out if clip is None else clip * torch.tanh(out / clip)

    def rows(self, names: Iterable[str]) -> tuple[Tensor, Tensor]:
        """Means and deviations of some features side by side, (k1 + k2 + ...,)."""
        mean, deviation = (
            torch.cat([getattr(self, _key(name, part)) for name in names])
            for part in ("mean", "deviation")
        )
        return mean, deviation


def _key(name: str, part: str) -> str:
    return f"{name.replace('-', '_')}__{part}"


# --- out of the distribution ---------------------------------------------------------------

BODY, TIME_STEP, AVERAGE = 0.3, 0.1, 4.5
"""What counts as 1: logarithms, of factors of 1.35 and 1.1, and deviations."""

_PASSES = 20
"""One node of so many may lie farther outside than the score tells."""

_CONSTANT_UNIT = 0.01

_LEAST_SPREAD = 0.1
"""Deviation of bodies' mean inputs, as the network sees them; less counts as this.

Means that symmetry makes vanish in all training bodies would make any other look strange.
"""

_ROUNDING = 1e-5
"""Of logarithms of time steps over cell sizes.

Cell sizes come from positions, of which some are in single precision.
"""

_EXTREME = 3.5
"""Deviations that the extremes of inputs, and of bodies' means, count as where they are farther.

Some inputs are large in few steps only, as in kicks: their deviation over all steps is little.
"""


class Envelope(nn.Module):
    """Ranges of the training data, and the out-of-distribution score of what is not within them.

    The score is dimensionless, and 1 is the bound of a default `Gate`.  It is the largest of

    - of the body at rest: how far one of its `shape_measures` lies outside its range, over 0.3;
      most are logarithms, so 1 is a factor of 1.35;
    - of the time step over the cell size, h/c in s/m: how far its logarithm lies outside its
      range, over 0.1, so 1 is a factor of 1.1;
    - of the inputs of nodes and edges: the `excess` that more than 5 % of the nodes have, each
      with the edges that it receives from;
    - of the means of inputs over the body's nodes: the distance from their mean in training in
      deviations of such means there, of which the farthest counts as 3.5 at most, over 4.5.

    Ranges are separate: what is unlike by a combination of them, or by where a body branches, has
    a low score.  Networks of frame features see stiffness as E h²/(rho c²) and loads as
    f h²/(m c), so that a stiffer material with a shorter step may be a known body to them, and
    has a high score all the same.  For inputs that are large in few steps, as in kicks, the last
    is a test of their range.  What is not a number is infinitely far.

    Nodes' and edges' features are given with their components.

    Attributes
    ----------
    average_low, average_high, average_mean, average_deviation : (a,) tensors
        Of the means over a body's nodes of what the network sees of them, as all that follows
        not numbers before `fit`.
    shape_low, shape_high : (10,) tensors
        Of the measures of bodies at rest, see `shape_measures`.
    time_step_low, time_step_high : (1,) tensors
        Of the logarithm of the time step over cell size, s/m, see `BodyGraph.time_steps`.
    """

    average_mean: Tensor
    average_deviation: Tensor
    time_step_low: Tensor
    time_step_high: Tensor

    def __init__(self, nodes: Mapping[str, int], edges: Mapping[str, int]) -> None:
        super().__init__()
        self.names = (*nodes, *edges)
        for name, k in {**nodes, **edges}.items():
            for part in ("low", "high"):
                self.register_buffer(_key(name, part), torch.zeros(k, dtype=torch.float64))
        a = sum(nodes.values())
        for name, k in (("average", a), ("shape", len(SHAPE_MEASURES)), ("time_step", 1)):
            parts = ("mean", "deviation", "low", "high") if name == "average" else ("low", "high")
            for part in parts:
                unknown = torch.full((k,), torch.nan, dtype=torch.float64)
                self.register_buffer(f"{name}_{part}", unknown)

    def fit(self, seen: Mapping[str, RunningMoments]) -> None:
        """Take over ranges of features by name, and those called average, shape and time_step.

        The last three are of bodies' mean inputs (m, a), measures at rest (m, 10) and logarithms of
        time steps over cell sizes (m, 1).  What is not there stays as it is.
        """
        for name, moments in seen.items():
            for part in ("low", "high"):
                self._part(name, part).copy_(getattr(moments, part))
        if "average" in seen:
            self.average_mean.copy_(seen["average"].mean)
            self.average_deviation.copy_(seen["average"].deviation.clamp_min(_LEAST_SPREAD))

    def widen(self, seen: Mapping[str, RunningMoments]) -> None:
        """Widen ranges by those of further values; mean and deviation do not change."""
        for name, moments in seen.items():
            for part, of_both in (("low", torch.minimum), ("high", torch.maximum)):
                own = self._part(name, part)
                own.copy_(of_both(own, getattr(moments, part).to(own)))

    # --- what is outside -------------------------------------------------------------------

    def rest_score(self, bodies: BodyGraph) -> Tensor:
        """The score (B,) of bodies at rest and their time steps, which steps do not change."""
        shape = self.shape_excess(bodies.shapes).amax(dim=1) / BODY
        return torch.maximum(shape, self.time_step_excess(bodies.time_steps).to(shape) / TIME_STEP)

    def score(self, bodies: BodyGraph, excess: Tensor, averages: Tensor) -> Tensor:
        """The out-of-distribution score of a step of each body, (B,).

        ``excess`` (n,) is the largest of a node's inputs and those of its edges, ``averages``
        (B, a) are bodies' mean inputs.
        """
        average = self.average_excess(averages).amax(dim=1) / AVERAGE
        inputs = torch.maximum(_exceeded(bodies, excess), average)
        return torch.maximum(self.rest_score(bodies), inputs)

    def excess(self, names: tuple[str, ...], x: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
        """How far features (m, k1 + k2 + ...) side by side lie outside their ranges, at least 0.

        In deviations, of which the farthest value seen on the same side counts as 3.5 at most, or
        where a component was constant in hundredths of its value, or of one.
        """
        low, high, below, above = self.limits(names, mean, deviation)
        return _known(torch.maximum((low - x) / below, (x - high) / above))

    def limits(
        self, names: tuple[str, ...], mean: Tensor, deviation: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Ranges of features side by side, and the units of what is below and above."""
        low, high = (
            torch.cat([self._part(name, part) for name in names]).to(mean)
            for part in ("low", "high")
        )
        size = torch.maximum(low.abs(), high.abs())
        constant = high - low <= LEAST_DEVIATION * size
        least = _CONSTANT_UNIT * torch.where(size > 0.0, size, 1.0)
        below, above = (
            torch.where(constant, least, torch.maximum(deviation, farthest / _EXTREME))
            for farthest in (mean - low, high - mean)
        )
        return low, high, below, above

    def average_excess(self, averages: Tensor) -> Tensor:
        """How far bodies' mean inputs (B, a) are from their mean in training.

        In deviations of such means, of which the farthest on the same side counts as 3.5 at most.
        """
        mean, deviation, low, high = (
            self._part("average", part).to(averages)
            for part in ("mean", "deviation", "low", "high")
        )
        farthest = torch.where(averages < mean, mean - low, high - mean)
        return _known((averages - mean).abs() / torch.maximum(deviation, farthest / _EXTREME))

    def shape_excess(self, shapes: Tensor) -> Tensor:
        """How far measures (B, 10) lie outside the range of training bodies, at least 0."""
        return self._beyond("shape", shapes)

    def time_step_excess(self, steps: Tensor) -> Tensor:
        """How far logarithms of time steps over cell sizes (B,), s/m, lie outside their range.

        At least 0, in double precision; what rounding alone may make of them counts as 0.
        """
        found = self._beyond("time_step", steps.double())
        return torch.where(found > _ROUNDING, found, 0.0)

    def _beyond(self, name: str, values: Tensor) -> Tensor:
        low, high = (self._part(name, part).to(values) for part in ("low", "high"))
        return _known(torch.maximum(low - values, values - high))

    # --- for readers -----------------------------------------------------------------------

    @property
    def time_steps(self) -> tuple[float, float]:
        """Least and largest time step over cell size of the training, s/m."""
        return float(self.time_step_low.exp()), float(self.time_step_high.exp())

    def trained_step(self, cell_size: float) -> str:
        """The time step of the training, or its range, for cells of this size (m); with unit."""
        if self.time_step_low.isnan().any():
            return "not known"
        steps = dict.fromkeys(f"{cell_size * x:.4g}" for x in self.time_steps)
        return f"{' to '.join(steps)} s"

    def _part(self, name: str, part: str) -> Tensor:
        key = _key(name, part) if name in self.names else f"{name}_{part}"
        found: Tensor = getattr(self, key)
        return found


def _known(excess: Tensor) -> Tensor:
    """At least 0, and infinite where it is not a number."""
    return excess.clamp_min(0.0).nan_to_num(nan=torch.inf, posinf=torch.inf)


def _exceeded(bodies: BodyGraph, excess: Tensor) -> Tensor:
    """The largest number that more than 5 % of the nodes (n,) of each body exceed or have, (B,)."""
    far = excess.argsort(descending=True)
    order = far[bodies.graph[far].argsort(stable=True)]  # body by body, the farthest first
    counts = bodies.node_counts.long()
    return excess[order[counts.cumsum(0) - counts + counts // _PASSES]]
