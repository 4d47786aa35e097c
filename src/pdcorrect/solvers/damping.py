"""What damping adds to the function that a step minimises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.cell_correction import CorrectionTangent, without_trace
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.viscosity import Stretches, product, small_strain_stress
from pdcorrect.solvers.integrators import StepEquation

Array = NDArray[np.float64]


class Rayleigh:
    """d/2 (y - o)^T (alpha M + beta K) (y - o).

    ``mass`` and ``stiffness`` are d alpha and d beta.  In o, ``origin`` (N + B, 3), internal modes
    are in equilibrium: their velocity at y, like the nodes', is d times the change since.  K is
    ``tangent``, projected, where y is foreseen to second order (``at``).
    """

    def __init__(self, problem: Problem, stage: StepEquation) -> None:
        damping = problem.scene.damping
        self._problem = problem
        self.mass = stage.rate * damping.mass
        self.stiffness = stage.rate * damping.stiffness
        if not self.stiffness:
            self.origin = problem.extended(stage.origin)
            return
        self.at = problem.relaxed(stage.foreseen)
        self.tangent = problem.linearise(self.at, project=True)
        self.origin = problem.relaxed(stage.origin)

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """J and N."""
        force = self.times(y - self.origin)
        return 0.5 * float(np.vdot(y - self.origin, force)), force

    def loss(self, way: Array, h: float) -> float:
        """D times the energy lost (J) where nodes move by ``way`` (N, 3) in h seconds."""
        problem = self._problem
        out = self.mass * float(np.vdot(way, problem.mass_times(way)))
        if self.stiffness:
            x = problem.lifted(self.at, way)
            out += self.stiffness * float(np.vdot(x, self.tangent.apply(x)))
        return out / h

    def times(self, x: Array) -> Array:
        """The second derivative times x."""
        out = self.mass * self._problem.mass_times(x)
        return out + self.stiffness * self.tangent.apply(x) if self.stiffness else out


class Viscous:
    """r/2 (S(y) - S') : C : (S(y) - S'), summed over points, see `fem.viscosity`.

    And the same with the matrices and strains of a learned element, see `fem.turned_strains`.
    r, ``rate``, is the strain rate's factor times the viscosity; S' is a sum of ``parts``.
    """

    def __init__(self, problem: Problem, stage: StepEquation) -> None:
        self._problem = problem
        self._strain_rate = stage.strain_rate
        self.rate = stage.strain_rate * problem.scene.damping.viscosity
        self.places = [problem.relaxed(x) for _, x in stage.strains]
        factors = [a for a, _ in stage.strains]
        self.parts = [(a, Stretches(problem, x)) for a, x in zip(factors, self.places, strict=True)]
        self._before = sum(a * part.tensor for a, part in self.parts)
        self.written = None
        if problem.correction is not None:
            self.written = WrittenViscous(problem, factors, self.places, self.rate)

    def change(self, stretches: Stretches) -> Array:
        """S(y) - S', (C, 9, Q)."""
        return np.asarray(stretches.tensor - self._before)

    def stress(self, stretches: Stretches) -> Array:
        """R C : (S(y) - S') times the points' volumes, (C, 9, Q), J."""
        return self.rate * small_strain_stress(self._problem, self.change(stretches))

    def loss(self, y: Array, h: float) -> float:
        """Energy lost (J) in h seconds, by the mean rate since the last stretch before y's."""
        since = 1.0 / self._strain_rate if len(self.parts) == 1 else h
        change = Stretches(self._problem, y).tensor - self.parts[0][1].tensor
        power = product(change, small_strain_stress(self._problem, change)).sum()
        if self.written is not None:
            power += self.written.power(y)
        return self._problem.scene.damping.viscosity * h / since**2 * float(power)

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """J and N."""
        stretches = Stretches(self._problem, y)
        stress = self.stress(stretches)
        value = 0.5 * float(np.vdot(self.change(stretches), stress))
        force = stretches.forces(stress)
        if self.written is None:
            return value, force
        more, added = self.written.value_and_gradient(y)
        return value + more, force + added

    def tangent(self, y: Array, project: bool = False) -> ViscousTangent:
        """The second derivative at y; ``project`` makes it positive semi-definite."""
        stretches = Stretches(self._problem, y)
        written = None if self.written is None else self.written.tangent(y, project)
        return ViscousTangent(stretches, self.stress(stretches), self.rate, project, written)


class WrittenViscous:
    """r/2 (z(y) - z') . K (z(y) - z'), summed over the cells of a learned element.

    K has no part in volume, nor in cells whose strains fade where the step begins: their rates
    are not those of the stretch, and could outweigh what the element itself dissipates.  The rest
    of K is less than the element's own.  z' is a sum over ``places``, factors and displacements.
    """

    def __init__(
        self, problem: Problem, factors: list[float], places: list[Array], rate: float
    ) -> None:
        assert problem.correction is not None
        self._rest = problem.positions
        self.places = [(a, self.displacement(x)) for a, x in zip(factors, places, strict=True)]
        self._whole = np.all([problem.correction.whole(u) for _, u in self.places], axis=0)
        self.correction = problem.correction.without_volume().scaled(self._whole)
        self._rated = self.correction.scaled(rate)
        parts = [a * self.correction.strains(u) for a, u in self.places]
        self._before: Array = np.sum(parts, axis=0)
        self._shift = self._rated.stress(self._before)

    def displacement(self, y: Array) -> Array:
        """Of the nodes, (N, 3)."""
        return y[: len(self._rest)] - self._rest

    def change(self, y: Array) -> Array:
        """z(y) - z', (C, 18)."""
        return self.correction.strains(self.displacement(y)) - self._before

    def power(self, y: Array) -> float:
        """Of the change since the last place's strains, over r."""
        _, last = self.places[0]
        change = self.correction.strains(self.displacement(y)) - self.correction.strains(last)
        return float(np.vdot(change, self.correction.stress(change)))

    def value_and_gradient(self, y: Array) -> tuple[float, Array]:
        """J and N, (N + B, 3)."""
        value, forces = self._rated.energy_and_forces(self.displacement(y), self._shift)
        out = np.zeros_like(y)
        out[: len(forces)] = -forces
        return value + 0.5 * float(np.vdot(self._before, self._shift)), out

    def tangent(self, y: Array, project: bool) -> CorrectionTangent:
        """The second derivative."""
        return self._rated.tangent(self.displacement(y), project, self._shift)

    def slopes(self, y: Array, x: Array) -> tuple[list[Array], Array]:
        """Of - x . force at y: by the places (N, 3), and by the matrices (C, 18, 18)."""
        x = x[: len(self._rest)]
        rates = self.correction.rates(self.displacement(y), x)
        stress = self._rated.stress(rates)
        by_places = [a * self.correction.pulled(u, stress) for a, u in self.places]
        rates = self._whole[:, None] * without_trace(rates)
        out = rates[:, :, None] * without_trace(self.change(y))[:, None]
        return by_places, out + np.swapaxes(out, 1, 2)

    def along(self, y: Array, x: Array) -> float:
        """X . force at y, over r."""
        rates = self.correction.rates(self.displacement(y), x[: len(self._rest)])
        return float(np.vdot(rates, self.correction.stress(self.change(y))))


@dataclass(frozen=True, eq=False)
class ViscousTangent:
    """The second derivative of `Viscous` at one configuration."""

    stretches: Stretches
    stress: Array
    rate: float
    project: bool
    written: CorrectionTangent | None = None

    def apply(self, x: Array) -> Array:
        """Times x (N + B, 3)."""
        out = self.stretches.apply(self.stress, self.rate, x, self.project)
        return out if self.written is None else out + self.written.apply(x)

    def blocks(self) -> Array:
        """Of each cell, (C, L, L, 3, 3), N/m."""
        out = self.stretches.blocks(self.stress, self.rate, self.project)
        if self.written is not None:
            self.written.add_to(out)
        return out
