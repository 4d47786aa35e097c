"""Probes of a scene as weights on nodes."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import SceneError
from pdcorrect.fem.clamps import Selector
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.locate import locate
from pdcorrect.fem.operators import Space
from pdcorrect.scene import Probe

Array = NDArray[np.float64]

_OUTSIDE = 1e-3
"""Of the coarse cell size: how far a point may lie outside the body."""


def probe_weights(body: ElasticBody, probes: tuple[Probe, ...]) -> sp.csr_matrix:
    """Nodal fields to their values at a scene's probes, (P, N).

    Raises
    ------
    SceneError
        If a point is outside the body, or a region contains nothing.
    """
    selector = Selector(body.mesh, body.space, body.cell_size)
    rows = [
        _at_point(body, np.array(probe.point), f"probes[{i}]")
        if probe.point is not None
        else _over_region(body.space, selector, probe, f"probes[{i}].region")
        for i, probe in enumerate(probes)
    ]
    return sp.csr_matrix(np.array(rows).reshape(-1, len(body.positions)))


def _at_point(body: ElasticBody, point: Array, key: str) -> Array:
    cells, local, distances = locate(body.mesh.positions, body.mesh.cells, point[None])
    if distances[0] > _OUTSIDE * body.cell_size:
        raise SceneError(
            f"{key}.point = {point.tolist()} is {distances[0]:.3g} m outside the body: expected a "
            "point of the body at rest."
        )
    out = np.zeros(len(body.positions))
    out[body.cells[cells[0]]] = body.space.shape_functions(local)[0]
    return out


def _over_region(space: Space, selector: Selector, probe: Probe, key: str) -> Array:
    region, out = probe.region, np.zeros(len(space.positions))
    assert region is not None
    if region.nodes is not None:
        out[selector.nodes(region, key)] = 1.0
    elif selector.is_surface(region, key):
        face = space.face_quadrature(selector.faces(region, key))
        shares = np.einsum("nq,nqk->nk", face.weights, face.values)
        np.add.at(out, space.cells[face.cells], shares)
    else:
        cells = selector.cells(region, key)
        shares = space.cell_masses("consistent")[cells].sum(axis=2)
        np.add.at(out, space.cells[cells], shares)
    return out / out.sum()
