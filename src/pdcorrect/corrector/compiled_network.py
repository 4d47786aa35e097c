"""`CompiledNetwork`: a graph network's answer for one mesh by loops over its nodes, on the CPU.

Nodes are taken in groups of 16 with the edges that they receive from.  A round is one loop
over groups: what a group needs of others is from the round before.

Products of tall and narrow matrices are taken by vectors of 16 numbers, whose sums stay in
registers: what BLAS does, for callers that are in a parallel loop already, where OpenBLAS may not
be asked.  Loops that numba makes vectors of itself take three times as long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import Tensor, nn

from pdcorrect.corrector.architecture import MeshGraphNetwork
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.fem.kernels import PARALLEL, REDUCE

Array = NDArray[Any]

parts: Any = cgutils

STRIP = 16
"""Columns whose sums are in registers together: one of AVX-512 in single precision."""
ROWS = 8
"""Rows of them: enough sums under way to hide how long a fused multiply-add takes."""


def filled_up(count: int, to: int = STRIP) -> int:
    """The next multiple of ``to``."""
    return -(-count // to) * to


def strips(matrix: Array) -> Array:
    """A factor (a, b) as strips (b / 16, a, 16); b is a multiple of 16."""
    return np.ascontiguousarray(matrix.reshape(len(matrix), -1, STRIP).transpose(1, 0, 2))


@njit(**OPTIONS)
def product(x, factor, bias, least, out):  # type: ignore[no-untyped-def]
    """The larger of ``least`` and x factor + bias.

    A ``least`` of 0 is ReLU, minus infinity leaves all as it is; what is not a number stays so.

    Parameters
    ----------
    x : (m, a or more)
        m is a multiple of 8.
    factor : (b / 16, a, 16)
        See `strips`.
    bias : (b,)
    out : (m, b or more)
    """
    for strip in range(factor.shape[0]):
        for row in range(0, x.shape[0], ROWS):
            _tile(x, row, factor, strip, bias, least, out)  # type: ignore[call-arg]


class _Vectors:
    """Arrays of an intrinsic's arguments, taken by 16 numbers of numba's type ``number``."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any, number: Any) -> None:
        self._context, self._builder, self._number = context, builder, number
        self._signature, self._args = signature, args
        self.kind = ir.VectorType(context.get_value_type(number), STRIP)
        self._size = context.get_abi_sizeof(context.get_value_type(number))

    def array(self, index: int) -> tuple[Any, list[Any]]:
        """Pointer and shape of an argument."""
        kind = self._signature.args[index]
        found = self._context.make_array(kind)(self._context, self._builder, self._args[index])
        return found.data, parts.unpack_tuple(self._builder, found.shape)

    def integer(self, index: int) -> Any:
        """An argument that counts something."""
        given = self._args[index], self._signature.args[index]
        return self._context.cast(self._builder, *given, types.intp)

    def scalar(self, index: int) -> Any:
        """An argument as one of the numbers."""
        given = self._args[index], self._signature.args[index]
        return self._context.cast(self._builder, *given, self._number)

    def count(self, value: int) -> Any:
        """A number of rows or columns."""
        return self._context.get_constant(types.intp, value)

    def _at(self, pointer: Any, offset: Any) -> Any:
        at = self._builder.gep(pointer, [offset])
        return self._builder.bitcast(at, self.kind.as_pointer())

    def load(self, pointer: Any, offset: Any) -> Any:
        """16 numbers from an offset on, wherever they are aligned."""
        return self._builder.load(self._at(pointer, offset), align=self._size)

    def store(self, vector: Any, pointer: Any, offset: Any) -> None:
        """The reverse of `load`."""
        self._builder.store(vector, self._at(pointer, offset), align=self._size)

    def spread(self, value: Any) -> Any:
        """A number 16 times."""
        nothing = ir.Constant(self.kind, ir.Undefined)
        one = self._builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
        same = ir.Constant(ir.VectorType(ir.IntType(32), STRIP), None)
        return self._builder.shuffle_vector(one, nothing, same)


def _check_arrays(*arrays: Any) -> None:
    """Refuse types of arrays that would be misread: vectors know pointers and one type alone."""
    kinds = {(getattr(a, "layout", None), getattr(a, "dtype", None)) for a in arrays}
    if len(kinds) > 1 or kinds.pop()[0] != "C":
        raise TypingError(f"{arrays}: expected C-contiguous arrays of one type of numbers.")


@intrinsic  # type: ignore[misc]
def _tile(typing, x, row, factor, strip, bias, least, out):  # type: ignore[no-untyped-def]
    """Rows ``row`` to row + 7 of `product` in the columns of one strip."""
    _check_arrays(x, factor, bias, out)
    number = factor.dtype

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        v = _Vectors(context, builder, signature, args, number)
        (xs, (_, x_width)), (ws, (_, depth, _)), (bs, _), (outs, (_, out_width)) = map(
            v.array, (0, 2, 4, 6)
        )
        first, column = v.integer(1), builder.mul(v.integer(3), v.count(STRIP))
        rows = [builder.add(first, v.count(r)) for r in range(ROWS)]
        sums = [parts.alloca_once_value(builder, v.load(bs, column)) for _ in rows]
        starts = [builder.mul(r, x_width) for r in rows]
        with parts.for_range(builder, depth, intp=depth.type) as loop:
            line = builder.add(builder.mul(v.integer(3), depth), loop.index)
            w = v.load(ws, builder.mul(line, v.count(STRIP)))
            for start, total in zip(starts, sums, strict=True):
                value = builder.load(builder.gep(xs, [builder.add(start, loop.index)]))
                by = builder.fmul(v.spread(value), w, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), by, flags=("contract",)), total)
        floor = v.spread(v.scalar(5))
        for r, total in zip(rows, sums, strict=True):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)
            v.store(value, outs, builder.add(builder.mul(r, out_width), column))
        return context.get_dummy_value()

    return types.void(x, row, factor, strip, bias, least, out), generate


# --- the network ---------------------------------------------------------------------------

_EPSILON = 1e-5
"""LayerNorm's, as torch has it by default."""

GROUP = 16
"""Nodes that one thread takes at a time; a multiple of `ROWS`."""


class Groups:
    """Nodes and directed edges of a mesh in groups, each with room for a multiple of 8 edges.

    ``edge_index`` (2, E) is ordered by its first row, the receivers.

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

    Features of nodes x (nodes, a) and edges e (edges, b) are to be filled in before a call; they
    are zero in spare rows.
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
        self._updates = [
            (*_maps([r.of_edge, *r.edge_rest], self._width), *_maps(r.node, self._width))
            for r in rounds
        ]
        self._ends = [_maps([r.of_receiver, r.of_sender], self._width) for r in rounds]

    def __call__(self) -> Array:
        """Outputs (nodes, 3 or more) for `x` and `e`; the next call overwrites them."""
        groups = self._groups
        _encode(
            self.x, self.e, *self._encoders, *self._ends[0], self._width, groups.first,
            self._values, self._edges, self._to, self._start[0],
        )  # fmt: skip
        for i, updates in enumerate(self._updates):
            last = i + 1 == len(self._updates)
            after = self._decoder if last else self._ends[i + 1]
            _round(
                *updates, *after, last, self._width, self._outputs, groups.first,
                groups.last, groups.sender, self._values, self._edges, self._to,
                self._start[i % 2], self._start[(i + 1) % 2], self._out,
            )  # fmt: skip
        return self._out


def _array(x: Tensor) -> Array:
    return x.detach().numpy()


def _linears(network: Any) -> list[nn.Linear]:
    return [part for part in network if isinstance(part, nn.Linear)]


def _maps(parts: Any, width: int | None = None) -> tuple[Array, Array, Array, Array]:
    """Linear maps one after another, and a LayerNorm at the end, for loops.

    With a ``width`` the first map's input comes in parts of it, each with spare columns.

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
    linears = _linears(parts)
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
