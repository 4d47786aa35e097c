"""Derivatives of elastic forces by material weights, and of tangents by the shape.

Every energy here is linear in its two weights mu and omega, so forces and exact
tangents of a cell are too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.assembly import scatter
from pdcorrect.fem.cell_correction import difference
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.energies import elasticity
from pdcorrect.fem.hyperelasticity import model_name

Array = NDArray[np.float64]

_STEP = 1e-4
"""Of a deformation gradient's entry, and of Young's modulus for weights, which may be zero:
for differences of fourth order of tangents."""


def weight_slopes(body: ElasticBody, configuration: Array, x: Array) -> tuple[Array, Array]:
    """Derivatives of x . dW/dy by each cell's mu and omega, two (C,), N m/Pa.

    Of the element alone, without what a learned one adds.  ``configuration`` y and x are
    (N + B, 3).
    """
    quadrature, local = body.quadrature, body.space.local
    u = configuration - body.extended(body.positions)
    out = []
    for term, volumes in enumerate((quadrature.weights, quadrature.volume_weights)):
        weights = np.zeros((len(volumes), 2, volumes.shape[1]))
        weights[:, term] = volumes
        _, by_cell, _ = body.element_forces(u, weights)
        out.append(-np.einsum("cki,cki->c", by_cell, x[local]))
    return out[0], out[1]


def tangent_slopes(
    body: ElasticBody, configuration: Array, x: Array, z: Array
) -> tuple[Array, Array, Array]:
    """Derivatives of x . K z, K the projected tangent at y: by y, mu and omega.

    (N + B, 3), N; and two (C,), N m/Pa, for x and z (N + B, 3).  By differences at each
    quadrature point, since projecting is not linear.  Of the element alone, without what a
    learned one adds.
    """
    cells, gradients = body.space.local, body.quadrature.gradients
    u = configuration - body.extended(body.positions)
    F, along, across = (
        np.einsum("cki,cqkj->cqij", field[cells], gradients, optimize=True) for field in (u, x, z)
    )
    F = F + np.eye(3)
    energy = model_name(body.materials.model)
    mu, omega = body.materials.mu, body.materials.volume_weight

    def contracted(F: Array, mu: Array = mu, omega: Array = omega) -> Array:
        shear = mu[:, None] * body.quadrature.weights
        volume = omega[:, None] * body.quadrature.volume_weights
        C = elasticity(F, shear, volume, project=True, energy=energy)
        return np.einsum("cqij,cqijkl,cqkl->cq", along, C, across, optimize=True)

    def along_way(step: Array) -> Array:
        return difference(lambda t: contracted(F + t * step)) / _STEP

    slope = np.empty_like(F)
    for i in range(3):
        for j in range(3):
            step = np.zeros((3, 3))
            step[i, j] = _STEP
            slope[..., i, j] = along_way(step)
    change = _STEP * body.materials.young
    by_mu = difference(lambda t: contracted(F, mu + t * change, omega)).sum(axis=1) / change
    by_omega = difference(lambda t: contracted(F, mu, omega + t * change)).sum(axis=1) / change
    by_cell = np.einsum("cqij,cqkj->cki", slope, gradients, optimize=True)
    return scatter(cells, by_cell, len(x)), by_mu, by_omega
