"""`CompiledNetwork`: a graph network's answer for one mesh by loops over its nodes, on the CPU.

Nodes are taken in groups of 16 with the edges that they receive from.  A round is one loop
over groups: what a group needs of others is from the round before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor, nn

from pdcorrect.corrector.matrix_products import ROWS, filled_up, product, strips
from pdcorrect.corrector.network import MeshGraphNetwork
from pdcorrect.fem.kernels import PARALLEL, REDUCE

Array = NDArray[Any]

_EPSILON = 1e-5
"""LayerNorm's, as torch has it by default."""

GROUP = 16
"""Nodes that one thread takes at a time; a multiple of `ROWS`."""


class Groups:
    """Nodes and directed edges of a mesh in groups, each with room for a multiple of 8 edges.

    Parameters
    ----------
    edge_index : (2, E) int64
        Ordered by the first row, the receivers.
    nodes : int

    Attributes
    ----------
    nodes, edges : int
        Rows, spare ones included.
    place : (E,) int64
        Row of each edge.
    sender : (edges,) int64
        0 in spare rows.
    first : (nodes + 1,) int64
        Row of the first edge of each receiver.
    last : (nodes,) int64
        The row after its last.
    """

    def __init__(self, edge_index: Array, nodes: int) -> None:
        self.nodes = filled_up(nodes, GROUP)
        counts = np.bincount(edge_index[0], minlength=self.nodes)
        groups = counts.reshape(-1, GROUP).sum(axis=1)
        rooms = -(-groups // ROWS) * ROWS
        moved = np.cumsum(rooms - groups) - (rooms - groups)
        before = np.cumsum(counts) - counts
        self.first = np.append(before + np.repeat(moved, GROUP), rooms.sum())
        self.last = self.first[:-1] + counts
        self.place = np.arange(edge_index.shape[1]) + moved[edge_index[0] // GROUP]
        self.edges = int(rooms.sum())
        self.sender = np.zeros(self.edges, dtype=np.int64)
        self.sender[self.place] = edge_index[1]


class CompiledNetwork:
    """The answer of a `MeshGraphNetwork`, with a copy of its weights, in their precision.

    Parameters
    ----------
    network : MeshGraphNetwork
    groups : Groups

    Attributes
    ----------
    x : (nodes, a), e : (edges, b)
        Features of nodes and edges, to be filled in before a call; zero in spare rows.
    """

    def __init__(self, network: MeshGraphNetwork, groups: Groups) -> None:
        nodes, edges = groups.nodes, groups.edges
        of_nodes, of_edges = _linears(network.node_encoder), _linears(network.edge_encoder)
        self._groups, self._width = groups, of_nodes[0].out_features
        room, dtype = filled_up(self._width), _array(of_nodes[0].weight).dtype
        self.x = np.zeros((nodes, of_nodes[0].in_features), dtype)
        self.e = np.zeros((edges, of_edges[0].in_features), dtype)
        self._values = np.zeros((nodes, 2 * room), dtype)
        self._edges = np.zeros((edges, room), dtype)
        self._to, self._out = (np.zeros((nodes, room), dtype) for _ in range(2))
        self._start = np.zeros((2, nodes, room), dtype)
        self._encoders = (*_maps(network.node_encoder), *_maps(network.edge_encoder))
        self._decoder = _maps(network.decoder, self._width)
        self._outputs = _linears(network.decoder)[-1].out_features
        rounds: list[Any] = list(network.rounds)
        self._order = [i % len(rounds) for i in range(network.count)]
        self._updates = [
            (*_maps([r.of_edge, *r.edge_rest], self._width), *_maps(r.node, self._width))
            for r in rounds
        ]
        self._ends = [_maps([r.of_receiver, r.of_sender], self._width) for r in rounds]

    def __call__(self) -> Array:
        """Outputs (nodes, 3 or more) for `x` and `e`; the next call overwrites them."""
        groups, order = self._groups, self._order
        _encode(
            self.x, self.e, *self._encoders, *self._ends[order[0]], self._width, groups.first,
            self._values, self._edges, self._to, self._start[0],
        )  # fmt: skip
        for i, number in enumerate(order):
            last = i + 1 == len(order)
            after = self._decoder if last else self._ends[order[i + 1]]
            _round(
                *self._updates[number], *after, last, self._width, self._outputs, groups.first,
                groups.last, groups.sender, self._values, self._edges, self._to,
                self._start[i % 2], self._start[(i + 1) % 2], self._out,
            )  # fmt: skip
        return self._out


def _array(x: Tensor) -> Array:
    return x.detach().numpy()


def _linears(network: nn.Sequential) -> list[nn.Linear]:
    return [part for part in network if isinstance(part, nn.Linear)]


def _maps(parts: Any, width: int | None = None) -> tuple[Array, Array, Array, Array]:
    """Linear maps one after another, and a LayerNorm at the end, for loops.

    Parameters
    ----------
    parts : iterable of modules
    width : int, optional
        Where the first map's input comes in parts of this width, each with spare columns.

    Returns
    -------
    head : (w / 16, a, 16)
        The first map's factor, see `strips`.
    tail : (K - 1, w / 16, w, 16)
        Of the others.
    biases : (K, w)
    norm : (2, k)
        LayerNorm's weight and bias; without rows where there is none.
    """
    linears, room = [part for part in parts if isinstance(part, nn.Linear)], 0
    room = max(filled_up(part.out_features) for part in linears)
    factors, biases = [], np.zeros((len(linears), room), _array(linears[0].weight).dtype)
    for number, part in enumerate(linears):
        weight = _array(part.weight).T
        each = part.in_features if number == 0 and width is None else (width or part.in_features)
        blocks = weight.reshape(-1, each, part.out_features)
        rows = each if number == 0 and width is None else room
        whole = np.zeros((len(blocks), rows, room), weight.dtype)
        whole[:, :each, : part.out_features] = blocks
        factors.append(strips(whole.reshape(-1, room)))
        if part.bias is not None:
            biases[number, : part.out_features] = _array(part.bias)
    norms = [part for part in parts if isinstance(part, nn.LayerNorm)]
    norm = np.zeros((0, room), biases.dtype)
    if norms:
        norm = np.stack([_array(norms[-1].weight), _array(norms[-1].bias)])
    return factors[0], np.stack(factors[1:]), biases, norm


@njit(**REDUCE)
def _normalise(x, width, norm):  # type: ignore[no-untyped-def]
    """LayerNorm of rows (m, w) in place, of their first ``width`` numbers."""
    kind = x.dtype.type
    if not norm.shape[0]:
        return
    for row in range(x.shape[0]):
        line = x[row]
        mean, variance = kind(0.0), kind(0.0)
        for k in range(width):
            mean += line[k]
        mean = kind(mean / width)
        for k in range(width):
            variance += (line[k] - mean) * (line[k] - mean)
        scale = kind(1.0 / np.sqrt(variance / width + _EPSILON))
        for k in range(width):
            line[k] = (line[k] - mean) * scale * norm[0, k] + norm[1, k]


@njit(**REDUCE)
def _rest(x, spare, tail, biases, width, norm):  # type: ignore[no-untyped-def]
    """An MLP from its second map on; the result is in x or in the spare array."""
    count = tail.shape[0]
    for k in range(count):
        product(x, tail[k], biases[k + 1], -np.inf if k + 1 == count else 0.0, spare)
        x, spare = spare, x
    _normalise(x, width, norm)
    return x


@njit(**PARALLEL)
def _encode(  # type: ignore[no-untyped-def]
    x, e,
    node_head, node_tail, node_biases, node_norm, edge_head, edge_tail, edge_biases, edge_norm,
    to_head, start_tail, end_biases, end_norm,
    width, first, values, edges, to, start,
):  # fmt: skip
    """Encoders; values of nodes are the first half of ``values``.

    And what the first round adds to an edge for its receiver (``to``) and its sender (``start``).
    """
    room = edges.shape[1]
    for group in prange(x.shape[0] // GROUP):
        a, b = group * GROUP, (group + 1) * GROUP
        i, j = first[a], first[b]
        one, other = np.empty((GROUP, room), x.dtype), np.empty((GROUP, room), x.dtype)
        product(x[a:b], node_head, node_biases[0], 0.0, one)
        values[a:b, :room] = _rest(one, other, node_tail, node_biases, width, node_norm)
        product(values[a:b], to_head, end_biases[0], -np.inf, to[a:b])
        product(values[a:b], start_tail[0], end_biases[1], -np.inf, start[a:b])
        one, other = np.empty((j - i, room), x.dtype), np.empty((j - i, room), x.dtype)
        product(e[i:j], edge_head, edge_biases[0], 0.0, one)
        edges[i:j] = _rest(one, other, edge_tail, edge_biases, width, edge_norm)


@njit(**REDUCE)
def _add_ends(x, begin, first, last, sender, to, start):  # type: ignore[no-untyped-def]
    """ReLU of the first map's three parts, for the edges of some receivers."""
    zero = x.dtype.type(0.0)
    for n in range(len(last)):
        there = to[n]
        for edge in range(first[n], last[n]):
            line, here = x[edge - begin], start[sender[edge]]
            for k in range(line.shape[0]):
                value = line[k] + there[k] + here[k]
                line[k] = zero if value < zero else value


@njit(**REDUCE)
def _add(x, to):  # type: ignore[no-untyped-def]
    for row in range(x.shape[0]):
        line, out = x[row], to[row]
        for k in range(line.shape[0]):
            out[k] += line[k]


@njit(**REDUCE)
def _sum_up(edges, first, last, values):  # type: ignore[no-untyped-def]
    """Sums over the edges of some receivers, to the second half of their values."""
    room = edges.shape[1]
    for n in range(len(last)):
        out = values[n, room:]
        out[:] = 0.0
        for edge in range(first[n], last[n]):
            line = edges[edge]
            for k in range(room):
                out[k] += line[k]


@njit(**PARALLEL)
def _round(  # type: ignore[no-untyped-def]
    edge_head, edge_tail, edge_biases, edge_norm, node_head, node_tail, node_biases, node_norm,
    next_head, next_tail, next_biases, next_norm,
    decodes, width, outputs, first, last, sender, values, edges, to, start, next_start, out,
):  # fmt: skip
    """A round of message passing, then what the next one needs, or the decoder's answer."""
    room = edges.shape[1]
    for group in prange(to.shape[0] // GROUP):
        a, b = group * GROUP, (group + 1) * GROUP
        i, j = first[a], first[b]
        one, other = np.empty((j - i, room), to.dtype), np.empty((j - i, room), to.dtype)
        product(edges[i:j], edge_head, edge_biases[0], -np.inf, one)
        _add_ends(one, i, first[a:b], last[a:b], sender, to[a:b], start)
        _add(_rest(one, other, edge_tail, edge_biases, width, edge_norm), edges[i:j])
        _sum_up(edges, first[a:b], last[a:b], values[a:b])
        one, other = np.empty((GROUP, room), to.dtype), np.empty((GROUP, room), to.dtype)
        product(values[a:b], node_head, node_biases[0], 0.0, one)
        _add(_rest(one, other, node_tail, node_biases, width, node_norm), values[a:b])
        if decodes:
            product(values[a:b], next_head, next_biases[0], 0.0, one)
            out[a:b] = _rest(one, other, next_tail, next_biases, outputs, next_norm)
        else:
            product(values[a:b], next_head, next_biases[0], -np.inf, to[a:b])
            product(values[a:b], next_tail[0], next_biases[1], -np.inf, next_start[a:b])
