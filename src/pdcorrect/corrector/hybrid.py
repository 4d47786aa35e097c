"""`HybridStepper`: a coarse solver's steps, corrected by a network.

stepper = HybridStepper(pc.ProjectiveDynamics(pc.discretise(scene)), corrector)
run = pc.rollout(stepper, frames=60)
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.threads import one_thread
from pdcorrect.corrector.batch_bodies import check_corrector
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import Snapshot, View
from pdcorrect.corrector.gate import Gate, Reason, check_gate
from pdcorrect.corrector.placements import Velocity, as_forces, ballistic, check_velocity, moved
from pdcorrect.errors import InputError
from pdcorrect.solvers.implicit import ImplicitStepper
from pdcorrect.state import State, Status, StepResult, Trajectory

Array = NDArray[np.float64]

MEMORY = "previous_correction"
"""In `State.memory`, m, where the network asks for the correction of the step before."""


@dataclass
class _Asked:
    """The network's answer in one step and what became of it.

    Attributes
    ----------
    correction : (N, 3)
        As applied, m.
    reason : Reason
    factor : float
        On what the network gave.
    seconds : float
        In the network, features and gate.
    """

    correction: Array
    reason: Reason
    factor: float
    seconds: float

    @property
    def applies(self) -> bool:
        """Whether there is anything to apply."""
        return self.reason is Reason.NONE and bool(self.correction.any())

    def refuse(self, reason: Reason) -> None:
        """Take the correction back."""
        self.correction, self.reason = np.zeros_like(self.correction), reason


class HybridStepper:
    """A stepper whose steps a network corrects.

    Where the correction is exactly zero, or refused, it is the coarse stepper to the last bit.

    Parameters
    ----------
    coarse_stepper : ImplicitStepper
        `ProjectiveDynamics` or `Newton`, of any element with 8 nodes a cell.
    corrector : Corrector
        Fitted, on the CPU.  Its placement says what is corrected: the answer ("state"), the
        loads ("force": m delta/h2 is added, with the row sums of the mass matrix, and the
        converged answer to that is the result), or only the first iterate ("guess").
    velocity : {"recomputed", "kept"}
        Of corrected answers: what the integrator makes of the corrected positions, by
        backward Euler v = (p - p_before)/h, or the coarse solver's own.
    gate : Gate, optional
        What else is refused than corrections that are not finite, and those of steps that
        the coarse solver fails.

    Raises
    ------
    InputError
        If the parts do not fit each other.

    Notes
    -----
    ``stats`` of a result are the coarse step's, energies and volume ratio being those of the
    corrected state, and besides: ``correction``, its largest node norm, m; ``correction_factor``,
    below 1 where the gate limited it; ``refused``, 0 or 1; ``gate``, the number of the `Reason`
    (`pdcorrect.corrector.gate.refusals` counts them); ``network_seconds``, wall clock of
    features, network and gate.  Residual and estimated error are those of the coarse
    solver's equation.
    """

    def __init__(
        self,
        coarse_stepper: ImplicitStepper,
        corrector: Corrector,
        *,
        velocity: Velocity = "recomputed",
        gate: Gate | None = None,
    ) -> None:
        if not isinstance(coarse_stepper, ImplicitStepper):
            raise InputError(
                f"coarse_stepper is a {type(coarse_stepper).__name__}: expected "
                "ProjectiveDynamics(problem) or Newton(problem)."
            )
        self.coarse, self.problem = coarse_stepper, coarse_stepper.problem
        self.corrector = check_corrector(corrector, torch.device("cpu"))
        check_velocity(velocity, coarse_stepper.integrator)
        check_gate(gate, corrector)
        self.velocity, self.gate = velocity, gate
        self.placement = corrector.config.placement
        h = coarse_stepper.time_step
        self.bodies = BodyGraph.of([self.problem], h, dtype=torch.float64)
        self._remembers = "previous-correction" in corrector.config.node_features

    def __repr__(self) -> str:
        return f"{self.coarse!r}, corrected ({self.placement})"

    def prepare(self) -> Self:
        """Factorise and load everything now, so that the first step is like the others."""
        self.coarse.prepare()
        rest = self.problem.rest_state()
        self._ask(rest, rest.positions, np.zeros_like(rest.positions), None)
        return self

    def describe(self) -> dict[str, str]:
        """The coarse stepper's description, the network's with a digest, and the gate."""
        config = self.corrector.config
        return {
            **self.coarse.describe(),
            "corrector": digest(self.corrector),
            "corrector_size": f"{config.layers} rounds of width {config.width}",
            "placement": self.placement,
            "corrected_velocity": self.velocity,
            "gate": "none" if self.gate is None else self.gate.model_dump_json(),
        }

    def restore(self, run: Trajectory) -> None:
        """Tell the coarse stepper about the frames so far."""
        restore = getattr(self.coarse, "restore", None)
        if restore is not None:
            memory = {name: x for name, x in run.memory.items() if name != MEMORY}
            restore(replace(run, memory=memory))

    def __call__(self, state: State, forces: Array | None = None) -> StepResult:
        """Advance ``state`` by one step, with extra nodal forces (N, 3), N.

        Raises
        ------
        InputError
            If shapes are wrong or a number is not finite.
        """
        before, _ = self.coarse.accepted(_without(state), forces, None)
        previous = state.memory.get(MEMORY) if self._remembers else None
        correct = {"state": self._state, "force": self._force, "guess": self._guess}
        result, asked = correct[self.placement](before, forces, previous)
        after = result.state
        if self._remembers:
            memory = {**after.memory, MEMORY: asked.correction}
            after = replace(after, memory=memory)
        return replace(result, state=after, stats={**result.stats, **_told(asked)})

    # --- placements -------------------------------------------------------------------------

    def _state(
        self, before: State, forces: Array | None, previous: Array | None
    ) -> tuple[StepResult, _Asked]:
        coarse = self.coarse(before, forces)
        loads = self._loads(before, forces)
        if not coarse.status.ok:
            return coarse, _Asked(np.zeros_like(loads), Reason.SOLVER, 1.0, 0.0)
        asked = self._ask(before, coarse.state.positions, loads, previous)
        if not asked.applies:
            return coarse, asked
        started = time.perf_counter()
        if self.gate is not None and self.gate.judges:
            self._judge(self.gate, before, coarse, loads, asked)
        asked.seconds += time.perf_counter() - started
        return (self._corrected(before, coarse, loads, asked) if asked.applies else coarse), asked

    def _force(
        self, before: State, forces: Array | None, previous: Array | None
    ) -> tuple[StepResult, _Asked]:
        loads = self._loads(before, forces)
        asked = self._ask(before, None, loads, previous)
        if not asked.applies:
            return self.coarse(before, forces), asked
        added = as_forces(asked.correction, self.coarse.time_step, self.problem.mass)
        result = self.coarse(before, added if forces is None else forces + added)
        reason = Reason.NONE if result.status.ok else Reason.SOLVER
        if reason is Reason.NONE and self.gate is not None and self.gate.judges:
            stats = result.stats
            way = result.state.positions - before.positions
            stored = stats["elastic_energy"] + stats["kinetic_energy"]
            cap = (self.gate.energy or 0.0) * (stored + abs(np.vdot(loads, way)))
            found = _numbers(stats["smallest_volume_ratio"]), _numbers(np.vdot(added, way))
            _, reasons = self.gate.judged(lambda _: found, _numbers(np.inf), _numbers(cap))
            reason = Reason(int(reasons))
        if reason is Reason.NONE:
            return result, asked
        asked.refuse(reason)
        return self.coarse(before, forces), asked

    def _guess(
        self, before: State, forces: Array | None, previous: Array | None
    ) -> tuple[StepResult, _Asked]:
        loads = self._loads(before, forces)
        asked = self._ask(before, None, loads, previous)
        if not asked.applies:
            return self.coarse(before, forces), asked
        guess = self._ballistic(before, loads) + asked.correction
        return self.coarse(before, forces, guess=guess), asked

    def _corrected(
        self, before: State, coarse: StepResult, loads: Array, asked: _Asked
    ) -> StepResult:
        """The coarse result with the correction in its state and statistics."""
        state = self._moved(before, coarse.state, asked.correction)
        ratio = float(self.problem.volume_ratios(state.positions).min())
        stats = {
            **coarse.stats,
            "elastic_energy": self.problem.energy(state.positions),
            "kinetic_energy": self._kinetic(state),
            "external_work": coarse.stats["external_work"]
            + float(np.vdot(loads, asked.correction)),
            "smallest_volume_ratio": ratio,
        }
        status = coarse.status
        if status in (Status.CONVERGED, Status.INVERTED):
            status = Status.INVERTED if ratio <= 0.0 else Status.CONVERGED
        return replace(coarse, state=state, status=status, stats=stats)

    # --- parts ------------------------------------------------------------------------------

    def _ask(
        self, before: State, coarse: Array | None, loads: Array, previous: Array | None
    ) -> _Asked:
        """The network about a step, with the coarse answer (N, 3) if there is one."""
        started = time.perf_counter()
        proposed = self._ballistic(before, loads) if coarse is None else coarse
        positions, velocities, after, f = map(
            torch.tensor, (before.positions, before.velocities, proposed, loads)
        )
        old = None if previous is None else torch.tensor(previous)
        with torch.no_grad(), one_thread(torch.device("cpu")):
            view = View(self.bodies, Snapshot(positions, velocities, after, f, old))
            correction = self.corrector.of_view(view).numpy()
            asked = _Asked(correction, Reason.NONE, 1.0, 0.0)
            if not np.isfinite(correction).all():
                asked.refuse(Reason.NOT_FINITE)
            elif self.gate is not None and self.gate.unknown(self.corrector, view).any():
                asked.refuse(Reason.FEATURES)
        asked.seconds = time.perf_counter() - started
        return asked

    def _judge(
        self, gate: Gate, before: State, coarse: StepResult, loads: Array, asked: _Asked
    ) -> None:
        """Refuse or limit the correction by what it does to volumes and energy."""
        stored = coarse.stats["elastic_energy"] + coarse.stats["kinetic_energy"]
        size = stored + abs(np.vdot(loads, coarse.state.positions - before.positions))
        cap = stored + (gate.energy or 0.0) * size

        def measure(factors: Tensor) -> tuple[Tensor, Tensor]:
            correction = float(factors) * asked.correction
            state = self._moved(before, coarse.state, correction)
            energy = self.problem.energy(state.positions) + self._kinetic(state)
            ratio = self.problem.volume_ratios(state.positions).min()
            return _numbers(ratio), _numbers(energy - np.vdot(loads, correction))

        volume = coarse.stats["smallest_volume_ratio"]
        factors, reasons = gate.judged(measure, _numbers(volume), _numbers(cap))
        asked.factor = float(factors)
        asked.correction = asked.factor * asked.correction
        if reasons:
            asked.refuse(Reason(int(reasons)))

    def _loads(self, before: State, forces: Array | None) -> Array:
        """All external forces of the step, (N, 3), N."""
        coarse, h = self.coarse, self.coarse.time_step
        stage = coarse.integrate(self.problem, before, h, forces)
        loads = self.problem.external_forces(*stage.loads_over, stage.loads_at)
        return loads if forces is None else loads + forces

    def _ballistic(self, before: State, loads: Array) -> Array:
        problem = self.problem
        found: Array = ballistic(before, self.coarse.time_step, loads, problem.mass, problem.free)
        return found

    def _moved(self, before: State, after: State, correction: Array) -> State:
        scheme = self.coarse.integrate.scheme(before, self.coarse.time_step)
        positions, velocities, memory = moved(scheme, after, correction, self.velocity)
        return State(positions, velocities, after.time, memory)

    def _kinetic(self, state: State) -> float:
        return 0.5 * float(np.vdot(state.velocities, self.problem.mass_times(state.velocities)))


def digest(corrector: Corrector) -> str:
    """Some letters that tell correctors with other weights, normalisation or layout apart."""
    found = hashlib.sha256(corrector.config.model_dump_json().encode())
    for name, tensor in corrector.state_dict().items():
        found.update(name.encode())
        found.update(tensor.detach().cpu().numpy().tobytes())
    return found.hexdigest()[:16]


def _without(state: State) -> State:
    """The state without the memory of a correction."""
    if not isinstance(state, State) or MEMORY not in state.memory:
        return state
    memory = {name: x for name, x in state.memory.items() if name != MEMORY}
    return replace(state, memory=memory)


def _numbers(value: float | np.floating[Any]) -> Tensor:
    return torch.tensor([float(value)], dtype=torch.float64)


def _told(asked: _Asked) -> Mapping[str, float]:
    return {
        "correction": float(np.sqrt(np.square(asked.correction).sum(axis=1).max())),
        "correction_factor": asked.factor,
        "refused": float(asked.reason is not Reason.NONE),
        "gate": float(asked.reason),
        "network_seconds": asked.seconds,
    }
