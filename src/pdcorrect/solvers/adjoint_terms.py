"""What damping adds to the derivatives of a step.

Each term is a force on the body, pulled back through its own inputs.  Internal modes of
configurations before y follow the nodes and the material there.  Every energy is linear in its
weights mu and omega, so forces and exact tangents of a cell are too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.assembly import scatter
from pdcorrect.fem.cell_correction import difference
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.energies import elasticity
from pdcorrect.fem.hyperelasticity import model_name
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.viscosity import Stretches, product, small_strain_stress, stress_slopes
from pdcorrect.solvers.damping import Rayleigh, Viscous

Array = NDArray[np.float64]
Weights = tuple[Array, Array]

_STEP = 1e-4
"""Of a deformation gradient's entry, and of Young's modulus for weights, which may be zero:
for differences of fourth order of tangents."""


def cell_products(cells: NDArray[np.int64], masses: Array, a: Array, b: Array) -> Array:
    """A . M_c b of each cell, (C,), for matrices (C, K, K) and nodal fields (N, 3)."""
    return np.einsum("cki,ckl,cli->c", a[cells], masses, b[cells], optimize=True)


def gravity_slope(problem: Problem, x: Array, start: float, end: float) -> Array:
    """Derivatives of x . (nodal masses times acceleration) by the densities, (C,)."""
    out = np.zeros(len(problem.cells))
    rule = "per-node" if problem.mass_rule == "per-node" else "lumped"
    for load in problem.loads:
        if load.acceleration is not None:
            field = np.broadcast_to(load.amplitude.mean(start, end) * load.acceleration, x.shape)
            out += cell_products(problem.cells, problem.space.cell_masses(rule), x, field)
    return out


def follower_slope(problem: Problem, x: Array, positions: Array, start: float, end: float) -> Array:
    """Derivatives of x . (external forces) by the positions they are sampled at, (N, 3)."""
    out = np.zeros_like(positions)
    for load in problem.loads:
        out += load.pulled(start, end, positions, x)
    return out


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


class DampingTerm(ABC):
    """- x . (force of the damping at y), by what the step starts from."""

    def __init__(self, problem: Problem, before: list[Array]) -> None:
        self._problem, self._before = problem, before

    @property
    @abstractmethod
    def slopes(self) -> list[Array]:
        """By each of the configurations before y, (N + B, 3)."""

    @property
    @abstractmethod
    def by_weights(self) -> Weights:
        """By mu and omega with internal modes held, each (C,)."""

    @property
    @abstractmethod
    def matrices(self) -> Array | float:
        """By a learned element's matrices, (C, 18, 18)."""

    @cached_property
    def _following(self) -> list[Condensed]:
        return [self._problem.condensed(place) for place in self._before]

    @property
    def places(self) -> list[Array]:
        """By the nodes of each configuration before y, (N, 3)."""
        pairs = zip(self._following, self.slopes, strict=True)
        return [following.reduced(slope) for following, slope in pairs]

    @property
    def weights(self) -> Weights:
        """By mu and omega, each (C,)."""
        by_mu, by_omega = self.by_weights
        for place, following, slope in zip(self._before, self._following, self.slopes, strict=True):
            more = weight_slopes(self._problem, place, -following.response(slope))
            by_mu, by_omega = by_mu + more[0], by_omega + more[1]
        return by_mu, by_omega


class RayleighTerm(DampingTerm):
    """- x . d C (y - o): the configurations before y are o and where the stiffness is taken."""

    def __init__(self, problem: Problem, damping: Rayleigh, y: Array, x: Array) -> None:
        super().__init__(problem, [damping.origin, damping.at] if damping.stiffness else [])
        self._damping, self._x = damping, x
        self._offset = y - damping.origin

    @property
    def slopes(self) -> list[Array]:
        return [self._damping.times(self._x), self._stiff[0]] if self._before else []

    @property
    def by_weights(self) -> Weights:
        return self._stiff[1], self._stiff[2]

    @property
    def matrices(self) -> Array | float:
        return self._stiff[3]

    @property
    def places(self) -> list[Array]:
        """By o and, if there is any, by where the stiffness is taken, (N, 3)."""
        if self._before:
            return super().places
        return [self._damping.times(self._x)[: len(self._problem.positions)]]

    @property
    def mass_offset(self) -> Array:
        """What the mass matrix is multiplied by, (N, 3), N/kg."""
        return self._damping.mass * self._offset[: len(self._problem.positions)]

    @property
    def by_mass(self) -> float:
        """By d alpha."""
        return -float(np.vdot(self._x, self._problem.mass_times(self._offset)))

    @property
    def by_stiffness(self) -> float:
        """By d beta."""
        return -float(np.vdot(self._x, self._damping.tangent.apply(self._offset)))

    @cached_property
    def _stiff(self) -> tuple[Array, Array, Array, Array | float]:
        """By where the stiffness is taken, mu, omega and matrices of a learned element."""
        problem, damping = self._problem, self._damping
        by_matrices: Array | float = 0.0
        if not damping.stiffness:
            return np.zeros(0), *np.zeros((2, len(problem.cells))), 0.0
        by_place, by_mu, by_omega = tangent_slopes(problem, damping.at, self._x, self._offset)
        if problem.correction is not None:
            u = damping.at - problem.extended(problem.positions)
            more, by_matrices = problem.correction.tangent_slopes(u, self._x, self._offset)
            by_place = by_place + more
        factor = -damping.stiffness
        return factor * by_place, factor * by_mu, factor * by_omega, factor * by_matrices


class ViscousTerm(DampingTerm):
    """The same of viscosity: the configurations before y are those that stretches are of."""

    def __init__(self, problem: Problem, damping: Viscous, y: Array, x: Array) -> None:
        super().__init__(problem, damping.places)
        self._damping, self._y, self._x = damping, y, x
        at_y = Stretches(problem, y)
        self._change, self._rates = damping.change(at_y), at_y.rates(x)
        self._along = damping.rate * small_strain_stress(problem, self._rates)

    @cached_property
    def slopes(self) -> list[Array]:
        found = [a * part.forces(self._along) for a, part in self._damping.parts]
        if self._damping.written is None:
            return found
        written = zip(found, self._written[0], strict=True)
        return [a + self._problem.extended(b) for a, b in written]

    @property
    def by_weights(self) -> Weights:
        by_mu, by_omega = stress_slopes(self._problem, self._change, self._rates)
        return -self._damping.rate * by_mu, -self._damping.rate * by_omega

    @property
    def matrices(self) -> Array | float:
        written = self._damping.written
        return 0.0 if written is None else -0.5 * self._damping.rate * self._written[1]

    @cached_property
    def _written(self) -> tuple[list[Array], Array]:
        """What a learned element adds, see `WrittenViscous.slopes`."""
        assert self._damping.written is not None
        return self._damping.written.slopes(self._y, self._x)

    @property
    def by_rate(self) -> float:
        """By the strain rate's factor times the viscosity."""
        out = -float(product(self._change, self._along).sum()) / self._damping.rate
        written = self._damping.written
        return out if written is None else out - written.along(self._y, self._x)
