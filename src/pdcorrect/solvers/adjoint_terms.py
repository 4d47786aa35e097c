"""What damping adds to the derivatives of a step.

Each term is a force on the body, pulled back through its own inputs.  Internal modes of
configurations before y follow the nodes and the material there.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.problem import Problem
from pdcorrect.fem.sensitivities import Following, tangent_slopes, weight_slopes
from pdcorrect.fem.viscosity import Stretches, product, small_strain_stress, stress_slopes
from pdcorrect.solvers.damping import Rayleigh, Viscous

Array = NDArray[np.float64]
Weights = tuple[Array, Array]


def mass_slope(problem: Problem, a: Array, b: Array) -> Array:
    """Derivatives of a . M b by the cells' densities, (C,), for nodal a and b (N, 3)."""
    return cell_products(problem.cells, problem.cell_masses, a, b)


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


class RayleighTerm:
    """- x . d C (y - o), by what the step starts from."""

    def __init__(self, problem: Problem, damping: Rayleigh, y: Array, x: Array) -> None:
        self._problem, self._damping, self._x = problem, damping, x
        self._offset = y - damping.origin
        self._by_origin = damping.times(x)

    @cached_property
    def origin(self) -> Array:
        """By o, with its modes in equilibrium, (N, 3)."""
        if not self._damping.stiffness:
            return self._by_origin[: len(self._problem.positions)]
        return self._at_origin.reduced(self._by_origin)

    @cached_property
    def place(self) -> Array:
        """By where the stiffness is taken, with its modes in equilibrium, (N, 3)."""
        if not self._damping.stiffness:
            return np.zeros_like(self._problem.positions)
        return self._at.reduced(self._by_place)

    @cached_property
    def weights(self) -> Weights:
        """By mu and omega, each (C,)."""
        stiffness = self._damping.stiffness
        if not stiffness:
            nothing = np.zeros(len(self._problem.cells))
            return nothing, nothing
        _, by_mu, by_omega = self._slopes
        more = weight_slopes(self._problem, self._damping.at, -self._at.response(self._by_place))
        modes = -self._at_origin.response(self._by_origin)
        last = weight_slopes(self._problem, self._damping.origin, modes)
        return (
            more[0] + last[0] - stiffness * by_mu,
            more[1] + last[1] - stiffness * by_omega,
        )

    @property
    def density(self) -> Array:
        """By the cells' densities, (C,)."""
        count = len(self._problem.positions)
        slope = mass_slope(self._problem, self._x[:count], self._offset[:count])
        return -self._damping.mass * slope

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
    def _at_origin(self) -> Following:
        return Following(self._problem, self._damping.origin)

    @cached_property
    def _at(self) -> Following:
        return Following(self._problem, self._damping.at)

    @property
    def matrices(self) -> Array | float:
        """By a learned element's matrices, (C, 18, 18)."""
        written = self._damping.stiffness and self._written
        return -self._damping.stiffness * written[1] if written else 0.0

    @cached_property
    def _slopes(self) -> tuple[Array, Array, Array]:
        return tangent_slopes(self._problem, self._damping.at, self._x, self._offset)

    @cached_property
    def _written(self) -> tuple[Array, Array] | None:
        """What a learned element adds, see `CellCorrection.tangent_slopes`."""
        problem, correction = self._problem, self._problem.correction
        if correction is None:
            return None
        u = self._damping.at - problem.extended(problem.positions)
        return correction.tangent_slopes(u, self._x, self._offset)

    @cached_property
    def _by_place(self) -> Array:
        """By the configuration there."""
        slopes = self._slopes[0] if self._written is None else self._slopes[0] + self._written[0]
        return -self._damping.stiffness * slopes


class ViscousTerm:
    """- x . (force of viscosity at y), by what the step starts from."""

    def __init__(self, problem: Problem, damping: Viscous, y: Array, x: Array) -> None:
        self._problem, self._damping = problem, damping
        at_y = Stretches(problem, y)
        self._change, self._rates = damping.change(at_y), at_y.rates(x)
        self._along = damping.rate * small_strain_stress(problem, self._rates)
        self._y, self._x = y, x
        self._following = [Following(problem, place) for place in damping.places]

    @cached_property
    def places(self) -> list[Array]:
        """By each of the earlier positions that stretches are of, (N, 3)."""
        pairs = zip(self._following, self._slopes, strict=True)
        found = [following.reduced(slope) for following, slope in pairs]
        if self._damping.written is None:
            return found
        return [a + b for a, b in zip(found, self._written[0], strict=True)]

    @cached_property
    def weights(self) -> Weights:
        """By mu and omega, each (C,)."""
        by_mu, by_omega = stress_slopes(self._problem, self._change, self._rates)
        total = [-self._damping.rate * by_mu, -self._damping.rate * by_omega]
        places = zip(self._damping.places, self._following, self._slopes, strict=True)
        for place, following, slope in places:
            more = weight_slopes(self._problem, place, -following.response(slope))
            total = [a + b for a, b in zip(total, more, strict=True)]
        return total[0], total[1]

    @property
    def matrices(self) -> Array | float:
        """By a learned element's matrices, (C, 18, 18)."""
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

    @cached_property
    def _slopes(self) -> list[Array]:
        """By the configurations there."""
        return [a * part.forces(self._along) for a, part in self._damping.parts]
