"""Simulations of a split, and how far a run is from the reference: all that is measured of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.configuration import EVALUATION
from pdcorrect.data.folder import shard_paths
from pdcorrect.data.schema import CONVERGED, PLAIN, REFERENCE, Shard, read_shard
from pdcorrect.data.simulate import rebuilt_problems
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.evaluation.rollouts import Outcome
from pdcorrect.fem.graph import velocities
from pdcorrect.fem.problem import BASES, Problem
from pdcorrect.fem.stress import stress
from pdcorrect.metrics import (
    EnergyBalance,
    angular_momentum,
    error_over_time,
    largest_error,
    linear_momentum,
    mean_squared_error,
    relative_error,
    rms_error,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EvaluationCase:
    """A simulation of a split and what is known of it."""

    # numbers of the mesh in its split and of the simulation on it
    mesh: int
    simulation: int
    problems: Mapping[str, Problem]  # coarse models by the run they made, "plain" among them
    reference: Array  # (T+1, N, 3), m
    # (T+1, N, 3) and (T, N, 3), m: stored rollouts, and single steps from the reference's frames
    runs: Mapping[str, Array]
    predictions: Mapping[str, Array]
    _energies: dict[str, EnergyBalance] = field(default_factory=dict, repr=False)

    def reference_energies(self, base: str) -> EnergyBalance:
        """Of the reference by a coarse model; kept, for all runs are compared with them."""
        if base not in self._energies:
            self._energies[base] = energies(self.problems[base], self.reference)
        return self._energies[base]

    @property
    def steps(self) -> int:
        """T."""
        return len(self.reference) - 1


class SplitCases(NamedTuple):
    """A split's simulations in float64, and its files' content hashes by name."""

    attributes: Mapping[str, str | int | float]
    cases: tuple[EvaluationCase, ...]
    shards: Mapping[str, str]


def read_cases(
    folder: str | Path, split: str = EVALUATION, bases: Iterable[str] = ()
) -> SplitCases:
    """All simulations of a split, and problems of the plain coarse model and of ``bases``."""
    attributes: list[Mapping[str, str | int | float]] = []
    cases: list[EvaluationCase] = []
    shards: dict[str, str] = {}
    for path in shard_paths(folder, split):
        shard = read_shard(path)
        attributes.append(shard.attributes)
        cases += _cases(shard, path, [PLAIN, *bases])
        shards[path.name] = shard.content_hash
    if len({(a["config_hash"], a["time_step"]) for a in attributes}) > 1:
        raise InputError(f"{folder}, {split}: files of several configurations: expected one.")
    return SplitCases(attributes[0], tuple(cases), shards)


def _cases(shard: Shard, path: Path, bases: Sequence[str]) -> list[EvaluationCase]:
    # what is told of a stored run does not depend on the candidates
    stored = [base for base in BASES if base in shard.simulations[0].runs]
    problems = {
        base: rebuilt_problems(shard, path, base) for base in dict.fromkeys([*bases, *stored])
    }
    out = []
    for k, simulation in enumerate(shard.simulations):
        reference = simulation.runs[REFERENCE].positions
        if reference is None:
            raise InputError(f"{path}: simulation {k} has no reference rollout.")
        others = {name: run for name, run in simulation.runs.items() if name != REFERENCE}
        rollouts = {name: run.positions for name, run in others.items()}
        steps = {name: run.predictions for name, run in others.items()}
        out.append(
            EvaluationCase(
                int(shard.attributes["number"]),
                k,
                {base: each[k] for base, each in problems.items()},
                _from_rest(reference, shard.points),
                {n: _from_rest(x, shard.points) for n, x in rollouts.items() if x is not None},
                {n: x.astype(np.float64) for n, x in steps.items() if x is not None},
            )
        )
    return out


def _from_rest(positions: NDArray[np.generic], rest: Array) -> Array:
    """A stored rollout in float64 with the rest shape in frame 0, which storing has rounded."""
    return np.concatenate([rest[None], positions[1:].astype(np.float64)])


_STRESS_FRAMES = 10


def energies(problem: Problem, positions: Array) -> EnergyBalance:
    """Energies of a rollout from rest, and the work of the loads, by a coarse model.

    Velocities are backward differences of the positions, and loads act along the path as in
    the solver: those that follow the body are sampled where a step starts.
    """
    h, speeds = problem.time_step, velocities(positions, problem.time_step)
    work = [
        float(np.vdot(problem.external_forces(t * h, (t + 1) * h, x), y - x))
        for t, (x, y) in enumerate(pairwise(positions))
    ]
    none = np.zeros(len(positions))
    return EnergyBalance(
        kinetic=np.array([0.5 * np.vdot(v, problem.mass_times(v)) for v in speeds]),
        elastic=np.array([problem.energy(x) for x in positions]),
        external_work=np.concatenate([[0.0], np.cumsum(work)]),
        clamp_work=none,
        damping_loss=none,
    )


def stress_error(problem: Problem, positions: Array, reference: Array) -> float | None:
    """Relative RMS difference of Cauchy stress at quadrature points, by rest volume.

    Over about ten frames, evenly spaced, the last one among them.  None if a cell is flat or
    the reference has no stress.
    """
    frames = np.unique(np.linspace(0, len(reference) - 1, _STRESS_FRAMES + 1).round()[1:])
    difference = size = 0.0
    for frame in frames.astype(int):
        ours, truth = (stress(problem, x[frame]) for x in (positions, reference))
        weights = truth.weights[..., None, None]
        difference += float((weights * (ours.cauchy - truth.cauchy) ** 2).sum())
        size += float((weights * truth.cauchy**2).sum())
    return float(np.sqrt(difference / size)) if size and np.isfinite(difference) else None


@dataclass(frozen=True)
class TrajectoryMeasures:
    """Of one run of one case; None where something needed is not there."""

    mesh: int
    simulation: int
    # RMS distance from the time-converged reference over that one's RMS displacement, per cent
    relative_error: float | None = None
    # share of the plain run's squared error that is removed (eq. 7-2), per cent
    omega: float | None = None
    omega_base: float | None = None  # the same of the run's own coarse model
    # RMS and largest distance of nodes over frames 1..T, m
    rms_error: float | None = None
    worst_node: float | None = None
    # as ``omega`` and ``rms_error``, of single steps from the reference's frames
    step_omega: float | None = None
    step_rms_error: float | None = None
    # RMS over frames of the difference of kinetic and elastic energy from the reference's, over the
    # reference's largest
    energy_error: float | None = None
    # energy that is missing at the end (`EnergyBalance.dissipation`), over the largest of the run;
    # negative if it has gained some
    energy_loss: float | None = None
    # RMS over frames of the difference from the reference's, over the reference's largest. Clamps
    # take up momentum, so there is no drift of a conserved quantity to look at
    linear_momentum_error: float | None = None
    angular_momentum_error: float | None = None
    # RMS difference of Cauchy stress at the quadrature points of the plain coarse model from that
    # of the reference's positions, over the RMS of the latter
    stress_error: float | None = None
    # smallest det F at quadrature points of the plain coarse model
    smallest_volume_ratio: float | None = None
    # ``rms_error`` (m) against the time-converged reference
    converged_rms_error: float | None = None
    gate_rate: float | None = None  # share of the steps that a gate left uncorrected, per cent
    failed: int | None = None  # first step that failed


@dataclass(frozen=True, eq=False)
class MeasuredRollout:
    """What was measured of a trajectory."""

    measures: TrajectoryMeasures
    # (T+1,): RMS distance from the reference over time, m
    errors: Array = field(default_factory=lambda: np.zeros(0))
    # (T,) int64: why a gate left its steps uncorrected, see `Outcome`; those until it failed
    reasons: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def measure(case: EvaluationCase, outcome: Outcome) -> MeasuredRollout:
    """Measure a run of a case."""
    found: dict[str, float | None] = {}
    if outcome.predictions is not None:
        found |= _of_steps(case, outcome.predictions)
    errors = np.zeros(0)
    if outcome.positions is not None:
        errors = error_over_time(outcome.positions, case.reference)
        found |= _of_rollout(case, outcome.positions, outcome.base)
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
    reasons = np.zeros(0, dtype=np.int64) if outcome.reasons is None else outcome.reasons
    return MeasuredRollout(measures, errors, reasons[: outcome.failed and outcome.failed - 1])


def omega(positions: Array, coarse: Array | None, reference: Array) -> float | None:
    """Share of a coarse run's squared error that a run removes (eq. 7-2), per cent.

    None where there is no such run, or it has no error.
    """
    error = 0.0 if coarse is None else mean_squared_error(coarse, reference)
    return 100.0 * (1.0 - mean_squared_error(positions, reference) / error) if error else None


def _of_steps(case: EvaluationCase, predictions: Array) -> dict[str, float | None]:
    start = case.reference[:1]
    plain = case.predictions.get(PLAIN)
    steps = np.concatenate([start, predictions])
    coarse = None if plain is None else np.concatenate([start, plain])
    return {
        "step_omega": omega(steps, coarse, case.reference),
        "step_rms_error": rms_error(steps, case.reference),
    }


def _of_rollout(
    case: EvaluationCase, positions: Array, base: str | None
) -> dict[str, float | None]:
    reference, plain = case.reference, case.runs.get(PLAIN)
    found = {
        "omega": omega(positions, plain, reference),
        "omega_base": omega(positions, case.runs.get(base), reference) if base else None,
        "rms_error": rms_error(positions, reference),
        "worst_node": largest_error(positions, reference),
    }
    converged = case.runs.get(CONVERGED)
    if converged is not None:
        found["relative_error"] = 100.0 * relative_error(positions, converged)
        found["converged_rms_error"] = rms_error(positions, converged)
    return found


def _of_physics(
    case: EvaluationCase, positions: Array, base: str | None
) -> dict[str, float | None]:
    own = case.problems[base or PLAIN]
    ours, truth = energies(own, positions), case.reference_energies(base or PLAIN)
    size = float(truth.total.max())
    largest = float(ours.total.max())
    closed = not own.clamps.moving and not any(own.scene.damping.model_dump().values())
    plain = case.problems[PLAIN]
    h = plain.time_step
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
