"""Measures of a body at rest, by which a gate tells whether a corrector was trained on such."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from pdcorrect.fem.mesh import boundary_faces

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

SHAPE_MEASURES = (
    "nodes", "largest radius", "middle radius", "smallest radius", "volume to surface",
    "supported", "fixity", "distance", "overhang", "spread",
)  # fmt: skip
"""What `shape_measures` gives, in order."""

_LEAST_RADIUS = 0.1
"""Cell sizes; flatter bodies count as this."""

_LEAST_SHARE = 1e-3
"""Of the nodes; fewer count as this."""


def shape_measures(
    rest: Array,
    free: NDArray[np.bool_],
    edge_index: Numbers,
    cells: Numbers,
    graph: Numbers,
    cell_size: Array,
) -> Array:
    """Size, slenderness and supports of B bodies, (B, 10).

    No measure depends on place, orientation, units or numbering, nor on whether a body is alone
    in its batch.  Supports are nodes with a held component; lengths are in cell sizes:

    - ``nodes``: the logarithm of their number;
    - ``largest radius``, ``middle radius``, ``smallest radius``: logarithms of the principal radii
      of gyration, that is of the nodes' root mean squared distances from their centre along the
      principal axes;
    - ``volume to surface``: the logarithm of the number of cells over that of outer faces;
    - ``supported``: the logarithm of the share of supports among the nodes;
    - ``fixity``: the logarithm of the share of the supports' components that are held;
    - ``distance``: the logarithm of 1 plus the mean length of the shortest paths along edges from
      nodes to a support; where there is none it counts as two for each node of the body, unless
      the body has no support;
    - ``overhang``: the distance between the centres of the supports and of all nodes, over the
      root mean squared distance of all nodes from theirs;
    - ``spread``: the logarithm of 1 plus the root mean squared distance of the supports from their
      centre: small for one clamp, large for supports at several places.

    The last four are 0 for bodies without supports.

    Parameters
    ----------
    rest : (n, 3)
        Positions of all bodies' nodes, m.
    free : (n, 3) bool
        Components that may move.
    edge_index : (2, E) int
        Edges of cells in both directions.
    cells : (c, 8) int
        VTK order.
    graph : (n,) int
        The body of each node.
    cell_size : (B,)
        m.
    """
    bodies = len(cell_size)

    def count(which: Numbers) -> Numbers:
        return np.bincount(which, minlength=bodies).astype(np.int64)

    def means(values: Array, which: Numbers, number: Numbers) -> Array:
        total = np.zeros((bodies, *values.shape[1:]))
        np.add.at(total, which, values)
        return total / np.maximum(number, 1).reshape(-1, *[1] * (values.ndim - 1))

    counts = count(graph)
    x = rest / cell_size[graph][:, None]
    arms = x - means(x, graph, counts)[graph]
    gyration = means(arms[:, :, None] * arms[:, None, :], graph, counts)
    radii = np.sqrt(np.linalg.eigvalsh(gyration).clip(_LEAST_RADIUS**2))[:, ::-1]
    owners = graph[cells[:, 0]]
    faces = count(owners[boundary_faces(cells)[1]])

    held = ~free.all(axis=1)
    at, supports = graph[held], count(graph[held])
    fixity = np.where(supports > 0, means((~free[held]).mean(axis=1), at, supports), 1.0)
    centre = means(arms[held], at, supports)
    apart = means(np.square(arms[held] - centre[at]).sum(axis=1), at, supports)
    overhang = np.linalg.norm(centre, axis=1) / np.sqrt(np.square(radii).sum(axis=1))
    paths = _distances(x, edge_index, np.flatnonzero(held))
    paths = np.where(np.isfinite(paths), paths, 2.0 * counts[graph] * (supports[graph] > 0))
    return np.column_stack([
        np.log(counts),
        np.log(radii),
        np.log(count(owners) / faces),
        np.log((supports / counts).clip(_LEAST_SHARE)),
        np.log(fixity),
        np.log1p(means(paths, graph, counts)),
        overhang,
        np.log1p(np.sqrt(apart)),
    ])  # fmt: skip


def _distances(x: Array, edge_index: Numbers, sources: Numbers) -> Array:
    """Lengths (n,) of the shortest paths from the nearest source; infinite where there is none."""
    if not len(sources):
        return np.full(len(x), np.inf)
    here, there = edge_index
    lengths = np.linalg.norm(x[there] - x[here], axis=1)
    paths = csr_array((lengths, (here, there)), shape=(len(x), len(x)))
    found: Array = dijkstra(paths, indices=sources, min_only=True)
    return found
