"""Bodies and loads that come twice in a data set, by digests of what makes them unlike others."""

from __future__ import annotations

import hashlib

import numpy as np

from pdcorrect.data.check_file import cell_size
from pdcorrect.data.schema import REFERENCE, Array, Shard, Simulation

_DIGITS = 6
"""Decimals, in cells, to which meshes are compared."""


def body_digests(shard: Shard) -> tuple[str, str]:
    """Equal for equal meshes, and for equal meshes with equal materials.

    Neither the numbering of nodes and cells nor the place in space matters.
    """
    scale = 1.0 / cell_size(shard)
    points = _rounded(scale * (shard.points - shard.points.min(axis=0)))
    centres = points[shard.cells].mean(axis=1)
    shape = _digest(_sorted(points)) + _digest(_sorted(_rounded(centres)))
    material = np.column_stack([shard.young, shard.poisson, shard.density])
    return shape, shape + _digest(_sorted(np.hstack([_rounded(centres), material])))


def load_digest(simulation: Simulation) -> str:
    """Equal for equal forces; of simulations without, for those that start alike."""
    reference = simulation.runs.get(REFERENCE)
    if simulation.forces.any() or reference is None or reference.positions is None:
        return _digest(simulation.forces)
    return _digest(reference.positions[:2])


def _rounded(values: Array) -> Array:
    return np.round(values, _DIGITS) + 0.0  # no minus zero


def _sorted(rows: Array) -> Array:
    return rows[np.lexsort(rows.T)]


def _digest(values: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).data).hexdigest()
