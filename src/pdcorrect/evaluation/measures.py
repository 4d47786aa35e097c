"""How far a run of a simulation is from the reference: everything measured of one trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.gate import Reason
from pdcorrect.data.schema import CONVERGED, PLAIN
from pdcorrect.errors import ConvergenceError
from pdcorrect.evaluation.cases import Case
from pdcorrect.evaluation.physics import energies, stress_error
from pdcorrect.fem.graph import velocities
from pdcorrect.metrics import (
    angular_momentum,
    error_over_time,
    largest_displacement,
    largest_error,
    linear_momentum,
    mean_squared_error,
    rms_error,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a run makes of a case.

    Attributes
    ----------
    positions : (T+1, N, 3) or None
        Free rollout, m.
    predictions : (T, N, 3) or None
        Single steps from the reference's frames, m.
    base : str or None
        Coarse model that was stepped, with a corrector or without; None for other models.
    reasons : (T,) int64 or None
        Why a gate left steps of the rollout uncorrected, numbers of `Reason`; 0 where it did not.
    failed : int or None
        First step of the rollout that failed; the body is held from there on.
    """

    positions: Array | None = None
    predictions: Array | None = None
    base: str | None = None
    reasons: NDArray[np.int64] | None = None
    failed: int | None = None


@dataclass(frozen=True)
class TrajectoryMeasures:
    """Of one run of one case; None where something needed is not there.

    Attributes
    ----------
    mesh, simulation : int
    omega : float
        Share of the plain run's squared error that is removed (eq. 7-2), per cent.
    omega_base : float
        The same of the run's own coarse model.
    rms_reduction : float
        Share of the plain run's RMS error that is removed, per cent.
    rms_error, worst_node : float
        RMS and largest distance of nodes over frames 1..T, m.
    step_omega, step_rms_error : float
        As ``omega`` and ``rms_error``, of single steps from the reference's frames.
    within_1, within_2, within_5 : float
        Time until the RMS distance exceeds 1, 2, 5 % of the reference's largest
        displacement, s; the duration if it never does.
    energy_error : float
        RMS over frames of the difference of kinetic and elastic energy from the
        reference's, over the reference's largest.
    energy_loss : float
        Energy that is missing at the end (`EnergyBalance.dissipation`), over the largest of
        the run; negative if it has gained some.
    linear_momentum_error, angular_momentum_error : float
        RMS over frames of the difference from the reference's, over the reference's largest.
        Clamps take up momentum, so there is no drift of a conserved quantity to look at.
    stress_error : float
        RMS difference of Cauchy stress at the quadrature points of the plain coarse model
        from that of the reference's positions, over the RMS of the latter.
    smallest_volume_ratio : float
        Smallest det F at quadrature points of the plain coarse model.
    converged_omega, converged_rms_error : float
        ``omega`` and ``rms_error`` (m) against the time-converged reference.
    gate_rate : float
        Share of the steps that a gate left uncorrected, per cent.
    failed : int
        First step that failed.
    """

    mesh: int
    simulation: int
    omega: float | None = None
    omega_base: float | None = None
    rms_reduction: float | None = None
    rms_error: float | None = None
    worst_node: float | None = None
    step_omega: float | None = None
    step_rms_error: float | None = None
    within_1: float | None = None
    within_2: float | None = None
    within_5: float | None = None
    energy_error: float | None = None
    energy_loss: float | None = None
    linear_momentum_error: float | None = None
    angular_momentum_error: float | None = None
    stress_error: float | None = None
    smallest_volume_ratio: float | None = None
    converged_omega: float | None = None
    converged_rms_error: float | None = None
    gate_rate: float | None = None
    failed: int | None = None


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured of a trajectory.

    Attributes
    ----------
    measures : TrajectoryMeasures
    errors : (T+1,)
        RMS distance from the reference over time, m.
    reasons : (T,) int64
        Why a gate left its steps uncorrected, numbers of `Reason`; those until it failed.
    shape : (10,)
        Measures of its body at rest, see `pdcorrect.corrector.shapes.shape_measures`, if a gate
        refused it by them; else (0,).
    """

    measures: TrajectoryMeasures
    errors: Array = field(default_factory=lambda: np.zeros(0))
    reasons: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    shape: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def refused_by(self) -> int:
        """Number of the `Reason` by which a gate refused the whole of it; 0 if it did not.

        That is the body at rest or the time step.  What is refused by one of these is so in all
        steps, so the first one tells.
        """
        first = int(self.reasons[0]) if len(self.reasons) else 0
        return first if first in (Reason.BODY, Reason.TIME_STEP) else 0


def measure(case: Case, outcome: Outcome) -> Measured:
    """Measure a run of a case.

    Raises
    ------
    ConvergenceError
        If the run is so far away that a measure is not finite: means cannot leave it out.
    """
    found: dict[str, float | None] = {}
    if outcome.predictions is not None:
        found |= _of_steps(case, outcome.predictions)
    errors = np.zeros(0)
    if outcome.positions is not None:
        errors = error_over_time(outcome.positions, case.reference)
        found |= _of_rollout(case, outcome.positions, outcome.base, errors)
        found |= _of_physics(case, outcome.positions, outcome.base)
    if outcome.reasons is not None:
        found["gate_rate"] = 100.0 * float((outcome.reasons > 0).mean())
    numbers = {name: x for name, x in found.items() if x is not None}
    wild = next((name for name, x in numbers.items() if not np.isfinite(x)), None)
    if wild is not None:
        raise ConvergenceError(
            f"mesh {case.mesh}, simulation {case.simulation}: {wild} is {numbers[wild]}: expected "
            "a run whose errors can be measured."
        )
    measures = TrajectoryMeasures(case.mesh, case.simulation, failed=outcome.failed, **numbers)  # type: ignore[arg-type]
    if outcome.reasons is None:
        return Measured(measures, errors)
    steps = None if outcome.failed is None else outcome.failed - 1
    found_by = Measured(measures, errors, outcome.reasons[:steps])
    if found_by.refused_by != Reason.BODY:
        return found_by
    body = BodyGraph.of([case.problems[outcome.base or PLAIN]], dtype=torch.float64)
    return replace(found_by, shape=body.shapes[0].numpy())


def omega(positions: Array, coarse: Array | None, reference: Array) -> float | None:
    """Share of a coarse run's squared error that a run removes (eq. 7-2), per cent.

    None where there is no such run, or it has no error.
    """
    error = 0.0 if coarse is None else mean_squared_error(coarse, reference)
    return 100.0 * (1.0 - mean_squared_error(positions, reference) / error) if error else None


def time_within(errors: Array, limit: float, time_step: float) -> float:
    """Time of the first frame whose error exceeds a limit, s; that of the last one if none."""
    beyond = np.flatnonzero(errors > limit)
    return time_step * float(beyond[0] if len(beyond) else len(errors) - 1)


def _of_steps(case: Case, predictions: Array) -> dict[str, float | None]:
    start = case.reference[:1]
    plain = case.predictions.get(PLAIN)
    steps = np.concatenate([start, predictions])
    coarse = None if plain is None else np.concatenate([start, plain])
    return {
        "step_omega": omega(steps, coarse, case.reference),
        "step_rms_error": rms_error(steps, case.reference),
    }


def _of_rollout(
    case: Case, positions: Array, base: str | None, errors: Array
) -> dict[str, float | None]:
    reference, plain = case.reference, case.runs.get(PLAIN)
    rms = rms_error(positions, reference)
    plain_rms = 0.0 if plain is None else rms_error(plain, reference)
    size = largest_displacement(reference)
    converged = case.runs.get(CONVERGED)
    found = {
        "omega": omega(positions, plain, reference),
        "omega_base": omega(positions, case.runs.get(base), reference) if base else None,
        "rms_reduction": 100.0 * (1.0 - rms / plain_rms) if plain_rms else None,
        "rms_error": rms,
        "worst_node": largest_error(positions, reference),
        **{
            f"within_{share}": time_within(errors, share / 100 * size, case.time_step)
            for share in (1, 2, 5)
        },
    }
    if converged is not None:
        found["converged_omega"] = omega(positions, plain, converged)
        found["converged_rms_error"] = rms_error(positions, converged)
    return found


def _of_physics(case: Case, positions: Array, base: str | None) -> dict[str, float | None]:
    own = case.problems[base or PLAIN]
    ours, truth = energies(own, positions), case.reference_energies(base or PLAIN)
    size = float(truth.total.max())
    largest = float(ours.total.max())
    closed = not own.clamps.moving and not any(own.scene.damping.model_dump().values())
    plain, h = case.problems[PLAIN], case.time_step
    momenta = {
        name: [of(x, velocities(x, h), plain.mass) for x in (positions, case.reference)]
        for name, of in (
            ("linear_momentum_error", lambda _, v, m: linear_momentum(v, m)),
            ("angular_momentum_error", angular_momentum),
        )
    }
    return {
        "energy_error": _rms(ours.total - truth.total) / size if size else None,
        "energy_loss": float(ours.dissipation[-1]) / largest if closed and largest else None,
        **{name: _relative(a, b) for name, (a, b) in momenta.items()},
        "stress_error": stress_error(plain, positions, case.reference),
        "smallest_volume_ratio": min(float(plain.volume_ratios(x).min()) for x in positions),
    }


def _rms(values: Array) -> float:
    """Root mean square over frames of vectors or numbers."""
    return float(np.sqrt((values**2).reshape(len(values), -1).sum(axis=1).mean()))


def _relative(values: Array, truth: Array) -> float | None:
    size = float(np.linalg.norm(truth, axis=1).max())
    return _rms(values - truth) / size if size else None
