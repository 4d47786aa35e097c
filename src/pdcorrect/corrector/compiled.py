"""`CompiledCorrector`: a corrector's answers for one body by compiled loops on the CPU.

The same to rounding as `Corrector` gives by torch, whose single operations take longer than
their arithmetic on meshes of some hundred nodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from operator import attrgetter, is_
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.architecture import CorrectorConfig
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.compiled_features import (
    KNOWN_OF_EDGES,
    KNOWN_OF_NODES,
    CompiledFeatures,
)
from pdcorrect.corrector.compiled_network import CompiledNetwork, Groups
from pdcorrect.corrector.corrector import Corrector, without_momentum
from pdcorrect.corrector.features import FeatureView
from pdcorrect.fem.decomposition import OPTIONS


class Contents:
    """Modules, weights and normaliser of a corrector as they are now.

    Values that are written to ``.data`` are not noticed, as torch does not count them.

    Attributes
    ----------
    config : CorrectorConfig
    """

    config: CorrectorConfig

    def __init__(self, corrector: Corrector) -> None:
        self._corrector, self.config = corrector, corrector.config
        tables = [*_tables(corrector)]
        self._tables = [table for table in tables if table]
        self._empty = [table for table in tables if not table]
        self._names, self._parts = [*chain.from_iterable(self._tables)], [*self._there()]
        self._tensors = [part for part in self._parts if isinstance(part, Tensor)]
        # of inference tensors torch does not count how often they are written
        self._counted = [tensor for tensor in self._tensors if not tensor.is_inference()]
        self._places, self._writes = self._where(), self._written()

    @property
    def replaced(self) -> bool:
        """Whether there are other modules, tensors or storage than there were."""
        if self._corrector.config is not self.config or self._where() != self._places:
            return True
        if any(self._empty) or [*chain.from_iterable(self._tables)] != self._names:
            return True
        return not all(map(is_, self._there(), self._parts))

    @property
    def changed(self) -> bool:
        """Whether they are replaced, or a tensor was written."""
        return self._written() != self._writes or self.replaced

    def _where(self) -> list[int]:
        return [*map(Tensor.data_ptr, self._tensors)]

    def _written(self) -> list[int]:
        return [*map(_VERSION, self._counted)]

    def _there(self) -> Iterator[Any]:
        return chain.from_iterable(map(dict.values, self._tables))


_VERSION = attrgetter("_version")


def _tables(corrector: Corrector) -> Iterator[dict[str, Any]]:
    """Where its modules keep what they are made of."""
    for module in corrector.modules():
        yield from (module._parameters, module._buffers, module._modules)


Array = NDArray[Any]


class CompiledCorrector:
    """Answers as of a `Corrector`, without derivatives.

    Weights and normaliser are copied, and copied anew when they have changed; not where values
    are written to ``.data``, which torch does not count: see `refresh`.

    Parameters
    ----------
    corrector : Corrector
        One that `compilable` accepts.
    bodies : BodyGraph
        One, float64, on the CPU.

    Attributes
    ----------
    config : CorrectorConfig
    features : CompiledFeatures
    network : CompiledNetwork
        What the features are written to.
    """

    config: CorrectorConfig

    def __init__(self, corrector: Corrector, bodies: BodyGraph) -> None:
        self._corrector, self._bodies = corrector, bodies
        self._groups = Groups(bodies.edge_index.numpy(), len(bodies.rest))
        self._free = bodies.free.numpy()
        self.refresh()

    def refresh(self) -> None:
        """Copy the corrector's weights and normaliser."""
        corrector = self._corrector
        self.config, self._contents = corrector.config, Contents(corrector)
        self.network = CompiledNetwork(corrector.network, self._groups)
        self.features = CompiledFeatures(
            corrector, self._bodies, self._groups, self.network.x, self.network.e
        )
        self._output_scale = float(corrector.normaliser.output_scale)
        self._view: FeatureView | None = None

    def of_view(self, view: FeatureView) -> Tensor:
        """The correction (n, 3), m."""
        self._follow()
        features = self._seen(view)
        answer = np.empty_like(features.frames[:, 0])
        size = float(self._bodies.cell_size) * features.deformation
        _in_metres(self.network(), self._output_scale, size, features.frames, self._free, answer)
        found = torch.from_numpy(answer)
        return without_momentum(view, found) if self.config.momentum_neutral else found

    def rest_score(self, bodies: BodyGraph) -> Tensor:
        """See `Corrector.rest_score`."""
        return self._corrector.rest_score(bodies)

    def score(self, view: FeatureView) -> Tensor:
        """See `Corrector.score`."""
        if view is not self._view:
            self._follow()
        features = self._seen(view)
        averages = torch.from_numpy(features.averages)[None]
        excess = torch.from_numpy(features.excess)
        return self._corrector.envelope.score(self._bodies, excess, averages)

    def _follow(self) -> None:
        if self._contents.changed:
            self.refresh()

    def _seen(self, view: FeatureView) -> CompiledFeatures:
        """The features of a view, computed when it is first seen."""
        if view is not self._view:
            self.features(view.snapshot)
            self._view = view
        return self.features


def compilable(corrector: Corrector, bodies: BodyGraph) -> bool:
    """Whether `CompiledCorrector` can take the place of a corrector.

    That takes features and output in node frames, one body in float64, and a network of the very
    modules that its configuration leads to, without hooks, in single or double precision.
    """
    config = corrector.config
    known = KNOWN_OF_NODES.issuperset(config.node_features) and KNOWN_OF_EDGES.issuperset(
        config.edge_features
    )
    plain = type(corrector) is Corrector and usual(corrector)
    dtypes = {weight.dtype for weight in corrector.network.parameters()}
    return (
        known and plain and config.output == "frame" and bodies.bodies == 1
        and bodies.rest.dtype == torch.float64 and bodies.rest.device.type == "cpu"
        and len(dtypes) == 1 and dtypes <= {torch.float32, torch.float64}
    )  # fmt: skip


def usual(corrector: Corrector) -> bool:
    """Whether its network is as it was made, weights apart, and without hooks."""
    with torch.device("meta"):
        new = Corrector(corrector.config)
    mine, made = (list(each.network.modules()) for each in (corrector, new))
    return len(mine) == len(made) and all(
        type(one) is type(other)
        and one.extra_repr() == other.extra_repr()
        and not (one._forward_hooks or one._forward_pre_hooks)
        for one, other in zip(mine, made, strict=True)
    )


@njit(**OPTIONS)
def _in_metres(x, scale, size, frames, free, out):  # type: ignore[no-untyped-def]
    """`Corrector.in_metres` of outputs in frames; ``size`` is cell size times deformation."""
    for n in range(out.shape[0]):
        for i in range(3):
            turned = 0.0
            for j in range(3):
                turned += frames[n, i, j] * (x[n, j] * scale)
            out[n, i] = size * turned if free[n, i] else 0.0
