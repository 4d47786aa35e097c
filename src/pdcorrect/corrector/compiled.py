"""`CompiledCorrector`: a corrector's answers for one body by compiled loops on the CPU.

The same to rounding as `Corrector` gives by torch, whose single operations take longer than
their arithmetic on meshes of some hundred nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from operator import attrgetter, is_
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.architecture import CorrectorConfig
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.compiled_network import GROUP, CompiledNetwork, Groups
from pdcorrect.corrector.corrector import Corrector, without_momentum
from pdcorrect.corrector.features import (
    EDGE_FEATURES,
    NODE_FEATURES,
    STILL,
    Feature,
    FeatureView,
    Snapshot,
)
from pdcorrect.corrector.frames import EDGE_MEANS, rotations
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.fem.kernels import PARALLEL

Array = NDArray[Any]


class Contents:
    """Modules, weights and normaliser of a corrector as they are now.

    Values that are written to ``.data`` are not noticed, as torch does not count them.
    """

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


class CompiledCorrector:
    """Answers as of a `Corrector`, without derivatives.

    Weights and normaliser are copied, and copied anew when they have changed; not where values
    are written to ``.data``, which torch does not count: see `refresh`.

    For a corrector that `compilable` accepts and one body, float64, on the CPU.  ``features`` write
    to what ``network`` reads.
    """

    def __init__(self, corrector: Corrector, bodies: BodyGraph) -> None:
        self._corrector, self._bodies = corrector, bodies
        self._groups = Groups(bodies.edge_index.numpy(), len(bodies.rest))
        self._free = bodies.free.numpy()
        self.refresh()

    def refresh(self) -> None:
        """Copy the corrector's weights and normaliser."""
        corrector = self._corrector
        self.config: CorrectorConfig = corrector.config
        self._contents = Contents(corrector)
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
        return self._corrector.envelope.rest_score(bodies)

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


# --- features ------------------------------------------------------------------------------

_OF_NODES = {
    "strain": 0, "acceleration": 6, "load": 9, "previous-correction": 12, "deformation": 15,
}  # fmt: skip
_OF_EDGES = {"stretch": 0, "motion": 3, "turn": 6}
"""First of each feature's components among all that change with the state."""
_REST_OF_NODES = ("node-type", "stiffness", "poisson")
_REST_OF_EDGES = ("rest-edge",)
KNOWN_OF_NODES = frozenset([*_OF_NODES, *_REST_OF_NODES])
KNOWN_OF_EDGES = frozenset([*_OF_EDGES, *_REST_OF_EDGES])
"""Names that `CompiledFeatures` can compute."""


class CompiledFeatures:
    """Normalised features of one body, float64, and how far they are from what was seen.

    The same as `pdcorrect.corrector.features` and the corrector's normaliser give, to rounding;
    what does not change with the state is computed once.  They are written to x (nodes, a) and
    e (edges, b), in rows of ``groups``.

    Attributes
    ----------
    excess : (n,)
        Largest `Envelope.excess` of a node's features and of those of the edges that it receives
        from; infinite where one is not a number.
    deformation : float
    frames : (n, 3, 3)
        See `FeatureView`.
    """

    def __init__(
        self, corrector: Corrector, bodies: BodyGraph, groups: Groups, x: Array, e: Array
    ) -> None:
        self._groups, self._x, self._e = groups, x, e
        n, place = len(bodies.rest), groups.place
        self.deformation, self.excess = 0.0, np.zeros(n)
        self.frames = np.zeros((n, 3, 3))
        self._rest_frames = bodies.rest_frames.numpy()
        self._inverses, self._cells = bodies.rest_inverses.numpy(), bodies.cells.numpy()
        corners = self._cells.ravel()
        self._touching = np.argsort(corners, kind="stable") // self._cells.shape[1]
        self._touched = np.searchsorted(np.sort(corners), np.arange(n + 1))
        self._mass, self._size = bodies.mass.numpy(), float(bodies.cell_size)
        self._step = float(bodies.time_step)
        self._rest_edges, self._rest_turns = np.zeros((2, groups.edges, 3))
        self._rest_edges[place] = bodies.rest_edges.numpy()
        self._rest_turns[place] = bodies.rest_turns.numpy()
        self._gradients = np.zeros((len(self._cells), 3, 3))
        self._turns = np.zeros((n, 3, 3))
        self._strain, self._squares = np.zeros((n, 3, 3)), np.zeros(n)
        self._still = np.zeros((n, 3))
        self._clip = math.inf if corrector.config.clip is None else corrector.config.clip
        still = FeatureView(bodies, Snapshot(*[torch.zeros_like(bodies.rest)] * 4))
        config = corrector.config
        *self._of_nodes, nodes, node_excess = _split(
            corrector, NODE_FEATURES, config.node_features, _OF_NODES, still
        )
        *self._of_edges, edges, edge_excess = _split(
            corrector, EDGE_FEATURES, config.edge_features, _OF_EDGES, still
        )
        for columns, values in nodes:
            x[:n, columns] = values
        for columns, values in edges:
            e[place[:, None], columns] = values
        self._rest_excess = node_excess.expand(n).numpy().astype(float)
        np.maximum.at(self._rest_excess, bodies.edge_index[0].numpy(), edge_excess.numpy())

    def __call__(self, snapshot: Snapshot) -> None:
        """Fill in the features of a snapshot."""
        old = snapshot.correction
        before, velocities, after, loads = (
            part.contiguous().numpy()
            for part in (
                snapshot.positions, snapshot.velocities, snapshot.proposed, snapshot.forces,
            )
        )  # fmt: skip
        correction = self._still if old is None else old.contiguous().numpy()
        _deform(
            after, self._cells, EDGE_MEANS, self._inverses, self._touched, self._touching,
            self._rest_frames, self._gradients, self._turns, self.frames, self._strain,
            self._squares,
        )  # fmt: skip
        square = float(self._squares.sum()) / len(self._squares)
        # as `FeatureView.deformation`: what is not a number counts as not deformed
        self.deformation = math.sqrt(square) if square > STILL**2 else 0.0
        _features(
            before, velocities, after, loads, correction, self._step, self._mass, self._size,
            max(self.deformation, STILL), self.frames, self._strain, self._rest_edges,
            self._rest_turns, self._groups.first, self._groups.last, self._groups.sender,
            self._clip, *self._of_nodes, *self._of_edges, self._rest_excess, self._x, self._e,
            self.excess,
        )  # fmt: skip

    @property
    def averages(self) -> Array:
        """Means (a,) over the nodes of what the network sees of them."""
        found: Array = self._x[: len(self.excess)].mean(axis=0, dtype=np.float64)
        return found


def _split(
    corrector: Corrector,
    table: dict[str, Feature],
    names: tuple[str, ...],
    moving: dict[str, int],
    view: FeatureView,
) -> tuple[Array, Array, list[tuple[Array, Array]], Tensor]:
    """What is known of some features before a body moves.

    Of the components that change: number among all and column (k, 2), and rows (k, 6) of mean,
    deviation, range and the units of what is below and above it.  Of the others: columns and
    normalised values, and their largest excess.
    """
    scales = corrector.normaliser.rows(names)
    rows = torch.stack([*scales, *corrector.envelope.limits(names, *scales)], dim=1).numpy()
    places, rest, excess, column = [], [], torch.zeros(()), 0
    for name in names:
        width, function = table[name]
        columns = np.arange(column, column + width)
        column += width
        if name in moving:
            places += list(zip(moving[name] + np.arange(width), columns, strict=True))
            continue
        values = {name: function(view)}
        normalised = corrector.normaliser.joined(values, corrector.config.clip)
        rest.append((columns, normalised.numpy()))
        excess = torch.maximum(excess, corrector.excess(values))
    found = np.array(places, dtype=np.int64).reshape(-1, 2)
    return found, rows[found[:, 1]], rest, excess


@njit(**PARALLEL)
def _deform(  # type: ignore[no-untyped-def]
    positions, cells, means, inverses, touched, touching, rest_frames, gradients, turns, frames,
    strain, squares,
):  # fmt: skip
    """Frames of nodes, the strain in them, and its squared norm, see `FeatureView`."""
    for chunk in prange((len(cells) + GROUP - 1) // GROUP):
        axes = np.empty((3, 3))
        for c in range(chunk * GROUP, min(len(cells), (chunk + 1) * GROUP)):
            axes[:] = 0.0
            for k in range(8):
                for i in range(3):
                    for j in range(3):
                        axes[i, j] += positions[cells[c, k], i] * means[k, j]
            _times(axes, inverses[c], gradients[c])
    count = len(touched) - 1
    for chunk in prange((count + GROUP - 1) // GROUP):
        first, last = chunk * GROUP, min(count, (chunk + 1) * GROUP)
        F, stretch, half = np.empty((GROUP, 3, 3)), np.empty((3, 3)), np.empty((3, 3))
        for n in range(first, last):
            mean = F[n - first]
            mean[:] = 0.0
            for c in touching[touched[n] : touched[n + 1]]:
                for i in range(3):
                    for j in range(3):
                        mean[i, j] += gradients[c, i, j]
            for i in range(3):
                for j in range(3):
                    mean[i, j] /= touched[n + 1] - touched[n]
        rotations(F[: last - first], turns[first:last])
        for n in range(first, last):
            _times(turns[n], rest_frames[n], frames[n])
            _back_times(turns[n], F[n - first], stretch)
            for i in range(3):
                stretch[i, i] -= 1.0
            _back_times(rest_frames[n], stretch, half)
            _times(half, rest_frames[n], strain[n])
            squares[n] = 0.0
            for i in range(3):
                for j in range(3):
                    squares[n] += strain[n, i, j] * strain[n, i, j]


@njit(**PARALLEL)
def _features(  # type: ignore[no-untyped-def]
    before, velocities, after, loads, correction, step, mass, size, scale, frames, strain,
    rest_edges, rest_turns, first, last, sender, clip, node_places, node_scales, edge_places,
    edge_scales, rest_excess, x, e, excess,
):  # fmt: skip
    """Normalised features of nodes and edges, and the largest excess at each node."""
    count, unit = len(before), size * scale
    for chunk in prange((count + GROUP - 1) // GROUP):
        of_node, of_edge = np.empty(16), np.empty(9)
        for n in range(chunk * GROUP, min(count, (chunk + 1) * GROUP)):
            R, S = frames[n], strain[n]
            of_node[0], of_node[1], of_node[2] = S[0, 0] / scale, S[1, 1] / scale, S[2, 2] / scale
            of_node[3], of_node[4], of_node[5] = S[1, 0] / scale, S[2, 0] / scale, S[2, 1] / scale
            for j in range(3):
                acceleration, load, old = 0.0, 0.0, 0.0
                for i in range(3):
                    way = after[n, i] - before[n, i] - step * velocities[n, i]
                    acceleration += R[i, j] * way
                    load += R[i, j] * (step * step * loads[n, i] / mass[n])
                    old += R[i, j] * correction[n, i]
                of_node[6 + j], of_node[9 + j] = acceleration / unit, load / unit
                of_node[12 + j] = old / unit
            of_node[15] = math.log(scale)
            worst = max(rest_excess[n], _write(of_node, node_places, node_scales, clip, x[n]))
            for edge in range(first[n], last[n]):
                m = sender[edge]
                Q = frames[m]
                for j in range(3):
                    stretch, motion = 0.0, 0.0
                    for i in range(3):
                        stretch += R[i, j] * (after[m, i] - after[n, i])
                        there, here = after[m, i] - before[m, i], after[n, i] - before[n, i]
                        motion += R[i, j] * (there - here)
                    of_edge[j] = (stretch - rest_edges[edge, j]) / unit
                    of_edge[3 + j] = motion / unit
                    k, l, turn = (j + 1) % 3, (j + 2) % 3, 0.0
                    for i in range(3):
                        turn += Q[i, k] * R[i, l] - Q[i, l] * R[i, k]
                    of_edge[6 + j] = (0.5 * turn - rest_turns[edge, j]) / scale
                worst = max(worst, _write(of_edge, edge_places, edge_scales, clip, e[edge]))
            excess[n] = worst


@njit(inline="always", **OPTIONS)
def _write(values, places, scales, clip, out):  # type: ignore[no-untyped-def]
    """Normalised components in their columns; returns their largest excess."""
    worst = 0.0
    for k in range(len(places)):
        value = values[places[k, 0]]
        outside = max((scales[k, 2] - value) / scales[k, 4], (value - scales[k, 3]) / scales[k, 5])
        if not outside <= 0.0:
            worst = max(worst, outside) if outside == outside else np.inf
        value = (value - scales[k, 0]) / scales[k, 1]
        out[places[k, 1]] = value if clip == np.inf else clip * _tanh(value / clip)
    return worst


@njit(inline="always", **OPTIONS)
def _tanh(x):  # type: ignore[no-untyped-def]
    """Lambert's continued fraction to its seventh part where that is exact to rounding."""
    if not abs(x) < 0.5:
        return math.tanh(x)
    s = x * x
    above = 135135.0 + s * (17325.0 + s * (378.0 + s))
    return x * above / (135135.0 + s * (62370.0 + s * (3150.0 + s * 28.0)))


@njit(inline="always", **OPTIONS)
def _times(A, B, out):  # type: ignore[no-untyped-def]
    """A B of 3x3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(inline="always", **OPTIONS)
def _back_times(A, B, out):  # type: ignore[no-untyped-def]
    """A^T B."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]
