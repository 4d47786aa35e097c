"""Errors, invariants and energies of trajectories, as pure functions of arrays.

Positions are (T+1, N, 3) with frame 0 the common initial state; anything with a
``positions`` attribute is taken as well.  All runs of one comparison live on
the same nodes (see `restrict`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.probes import probe_weights
from pdcorrect.solvers.rollout import restrict
from pdcorrect.state import State
from pdcorrect.trajectory import Trajectory

if TYPE_CHECKING:
    from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]


def _positions(run: Any) -> Array:
    return np.asarray(getattr(run, "positions", run), dtype=np.float64)


def _pair(a: Any, b: Any) -> tuple[Array, Array]:
    x, y = _positions(a), _positions(b)
    if x.ndim == y.ndim == 3 and len(x) != len(y) and x.shape[1:] == y.shape[1:]:
        raise InputError(f"{len(x)} and {len(y)} frames: expected as many of both runs.")
    if x.shape != y.shape or x.ndim != 3 or x.shape[-1] != 3:
        raise InputError(
            f"positions of shapes {x.shape} and {y.shape}: expected equal (T+1, N, 3). Bring both "
            "runs onto the same nodes with restrict(run, to=...)."
        )
    return x, y


def mean_squared_error(run: Any, reference: Any) -> float:
    """MSE of eq. 7-1, m2: mean over frames 1..T of the squared distance summed over nodes."""
    x, y = _pair(run, reference)
    return float(((x[1:] - y[1:]) ** 2).sum(axis=(1, 2)).mean())


def error_corrected(model: Any, coarse: Any, reference: Any) -> float:
    """Omega of eq. 7-2 and 7-3, per cent: the share of the coarse error that a model removes.

    100 is the reference itself, 0 the coarse solver, negative is worse.

    Parameters
    ----------
    model, coarse, reference : Trajectory, (T+1, N, 3), or lists of them
        Lists are averaged trajectory by trajectory, as in eq. 7-3.

    Raises
    ------
    InputError
        If shapes or list lengths differ, or the coarse run has no error.
    """
    runs = [list(r) if isinstance(r, (list, tuple)) else [r] for r in (model, coarse, reference)]
    if len({len(r) for r in runs}) != 1:
        raise InputError(
            f"{[len(r) for r in runs]} trajectories of model, coarse and reference: expected as "
            "many of each."
        )
    shares = []
    for one, base, truth in zip(*runs, strict=True):
        base_error = mean_squared_error(base, truth)
        if base_error == 0.0:
            raise InputError("the coarse run equals the reference: its error has no share.")
        shares.append(100.0 * (base_error - mean_squared_error(one, truth)) / base_error)
    return float(np.mean(shares))


def rms_error(run: Any, reference: Any) -> float:
    """Root mean square node distance over frames 1..T, m."""
    x, y = _pair(run, reference)
    return float(np.sqrt(((x[1:] - y[1:]) ** 2).sum(axis=2).mean()))


def relative_error(run: Any, converged: Any) -> float:
    """RMS distance from the converged motion over frames 1..T, over that motion's RMS displacement.

    Parameters
    ----------
    run : Trajectory or (T+1, N, 3)
        A trajectory on a finer mesh is restricted to the nodes of ``converged``.
    converged : Trajectory or (T+1, N, 3)
        As of `pdcorrect.converged`.  Displacements are from its rest positions; of an array,
        from its frame 0.

    Raises
    ------
    InputError
        If shapes differ, or the converged motion is none.
    MeshError
        If the run's mesh lacks a node.
    """
    both = isinstance(run, Trajectory) and isinstance(converged, Trajectory)
    if both and not np.array_equal(run.points, converged.points):
        run = restrict(run, to=converged)
    truth = _positions(converged)
    rest = getattr(converged, "points", truth[0])
    size = rms_error(np.broadcast_to(rest, truth.shape), truth)
    if not size > 0.0:
        raise InputError("the converged motion rests: expected one that an error can be over.")
    return rms_error(run, truth) / size


def error_over_time(run: Any, reference: Any) -> Array:
    """Root mean square node distance of each frame, (T+1,), m."""
    x, y = _pair(run, reference)
    return np.sqrt(((x - y) ** 2).sum(axis=2).mean(axis=1))


def largest_error(run: Any, reference: Any) -> float:
    """Largest node distance of all frames, m."""
    x, y = _pair(run, reference)
    return float(np.sqrt(((x - y) ** 2).sum(axis=2)).max())


def largest_displacement(run: Any, rest: ArrayLike | None = None) -> float:
    """Largest distance of a node from its rest position (frame 0 by default), m."""
    x = _positions(run)
    origin = x[0] if rest is None else np.asarray(rest)
    return float(np.sqrt(((x - origin) ** 2).sum(axis=2)).max())


def linear_momentum(velocities: ArrayLike, mass: ArrayLike) -> Array:
    """Momentum of each frame, (T+1, 3), kg m/s, for velocities (T+1, N, 3) and masses (N,)."""
    return np.einsum("tni,n->ti", np.asarray(velocities), np.asarray(mass))


def angular_momentum(positions: ArrayLike, velocities: ArrayLike, mass: ArrayLike) -> Array:
    """Angular momentum about the origin of each frame, (T+1, 3), kg m2/s."""
    spin = np.cross(np.asarray(positions), np.asarray(velocities))
    return np.einsum("tni,n->ti", spin, np.asarray(mass))


def relative_drift(values: ArrayLike) -> float:
    """Largest change of a conserved quantity from its first value, over its largest size."""
    array = np.asarray(values, dtype=np.float64)
    array = array.reshape(len(array), -1)
    size = np.linalg.norm(array, axis=1).max()
    return float(np.linalg.norm(array - array[0], axis=1).max() / size) if size else 0.0


@dataclass(frozen=True, eq=False)
class EnergyBalance:
    """Energies of each frame, and work and damping loss since frame 0, (T+1,) each, J.

    The work is that of the loads, of moving clamps, of moving obstacles on the body, and of
    actuators that change their activation; ``elastic`` includes the actuators' fibres,
    ``contact`` is the energy of the obstacles' barriers.
    """

    kinetic: Array
    elastic: Array
    external_work: Array
    clamp_work: Array
    damping_loss: Array
    contact: Array | float = 0.0
    obstacle_work: Array | float = 0.0
    friction_loss: Array | float = 0.0
    actuator_work: Array | float = 0.0

    @property
    def total(self) -> Array:
        """Kinetic and elastic energy, and that of contact, (T+1,), J."""
        return self.kinetic + self.elastic + self.contact

    @property
    def dissipation(self) -> Array:
        """What is missing, (T+1,), J: positive where the integrator has lost energy.

        Zero for an exact solution.  It also holds what steps that are not solved
        exactly and work integrated by one point a step leave over.
        """
        put_in = self.external_work + self.clamp_work + self.obstacle_work + self.actuator_work
        put_in = put_in - self.damping_loss - self.friction_loss
        return self.total[0] + put_in - self.total


def energy_balance(run: Trajectory, problem: Problem | None = None) -> EnergyBalance:
    """Where the energy of a run has gone.

    Parameters
    ----------
    run : Trajectory
        With the statistics of `rollout`.
    problem : Problem, optional
        What was stepped, for the energies of frame 0, which statistics do not hold; the
        run's own by default.  A run that starts at rest needs none.

    Returns
    -------
    EnergyBalance

    Raises
    ------
    InputError
        If statistics are missing, or the energies of frame 0 are unknown.
    """
    missing = [name for name in _ENERGIES if name not in run.stats]
    if missing and len(run):
        raise InputError(
            f"the run's statistics lack {', '.join(missing)}: expected those of rollout(...)."
        )
    start = _initial_energies(run, run.problem if problem is None else problem)
    steps = {name: np.asarray(run.stats.get(name, ()), dtype=np.float64) for name in _ENERGIES}
    sums = {name: np.concatenate([[0.0], np.cumsum(steps[name])]) for name in _ENERGIES[2:]}
    for name in ("obstacle_work", "friction_loss", "actuator_work"):
        if name in run.stats:
            sums[name] = np.concatenate([[0.0], np.cumsum(run.stats[name])])
    if "contact_energy" in run.stats:
        sums["contact"] = np.concatenate([[0.0], run.stats["contact_energy"]])
    return EnergyBalance(
        *(np.concatenate([[e], steps[name]]) for e, name in zip(start, _ENERGIES[:2], strict=True)),
        **sums,
    )


_ENERGIES = ("kinetic_energy", "elastic_energy", "external_work", "clamp_work", "damping_loss")
"""Statistics of a step: energies after it, then work and loss in it."""


def energies(problem: Problem, state: State) -> tuple[float, float]:
    """Kinetic and elastic energy of a state, J; rollers and actuators count as elastic."""
    kinetic = 0.5 * float(np.vdot(state.velocities, problem.mass_times(state.velocities)))
    u = state.positions - problem.positions
    attached = sum(one.energy_and_forces(u, state.time)[0] for one in problem.attached)
    return kinetic, problem.energy(state.positions) + attached


def _initial_energies(run: Trajectory, problem: Problem | None) -> tuple[float, float]:
    """Kinetic and elastic energy of frame 0, J."""
    positions, velocities = run.positions[0], run.velocities[0]
    if problem is not None:
        return energies(problem, State(positions, velocities, float(run.times[0])))
    moves = velocities.any() or (positions != run.points).any()
    if moves or "actuator_work" in run.stats:
        raise InputError(
            "the run has no problem, and moves at its start or has actuators, so the energies of "
            "frame 0 are unknown: expected energy_balance(run, problem)."
        )
    return 0.0, 0.0


def probes(run: Trajectory, problem: Problem | None = None) -> dict[str, Array]:
    """Displacements of the scene's probes, by name, (T+1, 3) each, m.

    Parameters
    ----------
    run : Trajectory
    problem : Problem, optional
        What was stepped; the run's own by default.

    Raises
    ------
    InputError
        If the run has no problem and none is given, as of a run that was read from a file.
    """
    problem = run.problem if problem is None else problem
    if problem is None:
        raise InputError("the run has no problem: expected probes(run, problem).")
    weights = probe_weights(problem, problem.scene.probes)
    moved = run.positions - run.points
    return {
        probe.name: np.stack([np.asarray(row @ frame).ravel() for frame in moved])
        for probe, row in zip(problem.scene.probes, weights, strict=True)
    }
