"""`unknown_inputs`: which of a network's inputs a gate refuses, by name and by how much."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pdcorrect.corrector import features
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, Feature, FeatureView
from pdcorrect.corrector.gate import Gate


@dataclass(frozen=True)
class UnknownInput:
    """An input that is unlike those of the training, by its component that is so the most.

    Attributes
    ----------
    name : str
        Of `pdcorrect.corrector.features.NODE_FEATURES` or ``EDGE_FEATURES``.
    component : int
        From 0.
    mean : bool
        Whether it is the mean over the body's nodes that is refused (`Gate.average`), or values at
        nodes or edges (`Gate.margin`).
    excess : float
        Of a mean its distance from that of the training, of values the largest one from their
        range there; both in the deviations that gates count.  Infinite where it is not a number.
    bound : float
        The gate's, of this.
    share : float
        Of the nodes with such a value, or with an edge that has one; 1 of a mean.
    value, low, high : float
        The one of that excess, and the range in training, in the unit of the feature; of a mean as
        the network sees it, in deviations.
    """

    name: str
    component: int
    mean: bool
    excess: float
    bound: float
    share: float
    value: float
    low: float
    high: float


def unknown_inputs(
    gate: Gate | None, corrector: Corrector, view: FeatureView
) -> list[UnknownInput]:
    """The inputs for which `Gate.unknown` refuses a step; empty if it does not, or without a gate.

    Values at nodes and edges before means, and those at most nodes first.

    Parameters
    ----------
    gate : Gate or None
    corrector : Corrector
    view : FeatureView
        Of one body with n nodes.
    """
    found: list[UnknownInput] = []
    if gate is None:
        return found
    if gate.margin is not None and bool(corrector.outside(view, gate.margin) > gate.share):
        found += _values(corrector, view, gate.margin)
    if gate.average is not None and bool(corrector.unlike(view) > gate.average):
        found += _means(corrector, view, gate.average)
    return sorted(found, key=lambda x: (x.mean, -x.share, -x.excess))


def _values(corrector: Corrector, view: FeatureView, margin: float) -> list[UnknownInput]:
    config = corrector.config
    nodes = torch.arange(len(view.bodies.rest), device=view.receiver.device)
    return [
        *_of_rows(corrector, view, margin, NODE_FEATURES, config.node_features, nodes),
        *_of_rows(corrector, view, margin, EDGE_FEATURES, config.edge_features, view.receiver),
    ]


def _of_rows(
    corrector: Corrector, view: FeatureView, margin: float, table: dict[str, Feature],
    names: tuple[str, ...], at: Tensor,
) -> list[UnknownInput]:  # fmt: skip
    """Of nodes or edges; ``at`` (m,) are the nodes at which they count."""
    found = []
    for name, values in features.values(table, names, view).items():
        excess = corrector.normaliser.excess({name: values})
        excess = torch.where(excess.isnan(), torch.inf, excess)
        beyond = (excess > margin).any(dim=1)
        if not beyond.any():
            continue
        share = len(set(at[beyond].tolist())) / len(view.bodies.rest)
        row, k = divmod(int(excess.argmax()), excess.shape[1])
        scale = corrector.normaliser.scale(name)
        low, high = float(scale.low[k]), float(scale.high[k])
        largest, value = float(excess[row, k]), float(values[row, k])
        found.append(UnknownInput(name, k, False, largest, margin, share, value, low, high))
    return found


def _means(corrector: Corrector, view: FeatureView, bound: float) -> list[UnknownInput]:
    config, normaliser = corrector.config, corrector.normaliser
    values = features.values(NODE_FEATURES, config.node_features, view)
    means = view.bodies.body_means(normaliser.joined(values, config.clip))
    far = normaliser.strangeness(means)[0]
    found, first = [], 0
    for name in config.node_features:
        width = NODE_FEATURES[name][0]
        k = int(far[first : first + width].argmax())
        column = first + k
        first += width
        if not float(far[column]) > bound:
            continue
        low, high = (float(x[column]) for x in (normaliser.average_low, normaliser.average_high))
        value = float(means[0, column])
        found.append(UnknownInput(name, k, True, float(far[column]), bound, 1.0, value, low, high))
    return found
