"""`Normaliser`: features and targets to zero mean and unit deviation; `RunningMoments`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

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

    Parameters
    ----------
    nodes, edges : mapping of str to int
        Components of each feature.

    Attributes
    ----------
    names : tuple of str
        Of the features.
    output_scale : () tensor
        Root mean square of the training targets, a component.
    fitted : bool
        Whether it has seen data.
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
