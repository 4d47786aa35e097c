"""`HybridStepper`: a coarse solver's steps, corrected by a network; `hybrid_of` a released one.

stepper = HybridStepper(pc.ProjectiveDynamics(pc.discretise(scene)), corrector)
run = pc.rollout(stepper, frames=60)
"""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.gpu import one_thread
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector, check_corrector
from pdcorrect.corrector.features import FeatureView, Snapshot
from pdcorrect.corrector.gate import (
    Gate,
    GateMeasures,
    Velocity,
    asked,
    check_gate,
    check_velocity,
    corrected_step,
    moved,
)
from pdcorrect.corrector.model_io import LoadedModel, load_model, model_folder, weights_digest
from pdcorrect.errors import InputError, PdcorrectWarning
from pdcorrect.fem.problem import BASES, Problem, coarse_model
from pdcorrect.scene import Scene, check_scene
from pdcorrect.solvers.implicit import ImplicitStepper
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State, Status, StepResult
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
Known = TypeVar("Known", State, Trajectory)
MEMORY = "previous_correction"
"""In `State.memory`, m, where the network asks for the correction of the step before."""


class HybridStepper:
    """A stepper whose steps a network corrects.

    Where the correction is exactly zero, or refused, it is the coarse stepper to the last bit.

    Parameters
    ----------
    coarse_stepper : ImplicitStepper
        `ProjectiveDynamics` or `Newton`, of any element with 8 nodes a cell.
    corrector : Corrector
        Fitted, on the CPU.
    velocity : {"recomputed", "kept"}
        Of corrected states: what the integrator makes of the corrected positions, by
        backward Euler v = (p - p_before)/h, or the coarse solver's own.
    gate : Gate, optional
        What else is refused than corrections that are not finite, and those of steps that
        the coarse solver fails.
    origin : mapping of str to str, optional
        Whence the corrector comes, for `describe` and the files of runs.

    Attributes
    ----------
    remembers : bool
        Whether states carry the correction of the step before, `MEMORY`, for the network.

    Raises
    ------
    InputError
        If the parts do not fit each other.

    Notes
    -----
    ``stats`` of a result are the coarse step's, energies and volume ratio being those of the
    corrected state, and besides: ``correction``, its largest node norm, m; ``refused``, 0 or 1;
    ``gate``, the number of the `Reason` (`pdcorrect.corrector.gate.refusals` counts them);
    ``network_seconds``, wall clock of all but the coarse solver.  Residual and estimated error
    are those of the coarse solver's equation.

    A coarse step that ended with inverted cells counts as converged and is corrected like
    others; the status then says whether the corrected state has some.  One that converged only
    by fallbacks keeps that status, whether cells are inverted or not: see
    ``smallest_volume_ratio``.

    For one thread at a time: threads take a hybrid each.
    """

    def __init__(
        self,
        coarse_stepper: ImplicitStepper,
        corrector: Corrector,
        *,
        velocity: Velocity = "recomputed",
        gate: Gate | None = None,
        origin: Mapping[str, str] | None = None,
    ) -> None:
        if not isinstance(coarse_stepper, ImplicitStepper):
            raise InputError(
                f"coarse_stepper is a {type(coarse_stepper).__name__}: expected "
                "ProjectiveDynamics(problem) or Newton(problem)."
            )
        self.coarse, self.problem = coarse_stepper, coarse_stepper.problem
        _check_fit(self.problem)
        self.corrector = check_corrector(corrector, torch.device("cpu"))
        check_velocity(velocity, coarse_stepper.integrator)
        check_gate(gate)
        self.velocity, self.gate, self.origin = velocity, gate, dict(origin or {})
        h = coarse_stepper.time_step
        self.bodies = BodyGraph.of([self.problem], h, dtype=torch.float64)
        self.remembers = "previous-correction" in corrector.config.node_features

    def __repr__(self) -> str:
        return f"{self.coarse!r}, corrected"

    def prepare(self) -> Self:
        """Factorise and load everything now, so that the first step is like the others."""
        self.coarse.prepare()
        rest = self.problem.rest_state()
        with torch.inference_mode(), one_thread(torch.device("cpu")):
            step = SingleCoarseStep(self.coarse, self.bodies, self.velocity, rest)
            asked(step.view_of(self.problem.positions), self.corrector, self.gate)
        return self

    def describe(self) -> dict[str, str]:
        """The coarse stepper's description, that of network, gate and training, the origin."""
        config = self.corrector.config
        return {
            **self.coarse.describe(),
            "corrector": digest(self.corrector),
            "corrector_size": f"{config.layers} rounds of width {config.width}",
            "corrected_velocity": self.velocity,
            "gate": "none" if self.gate is None else self.gate.model_dump_json(),
            "trained_step": self.trained_step,
            **self.origin,
        }

    @property
    def trained_step(self) -> str:
        """The time step of the training for cells of this body's size, or its range, s."""
        return self.corrector.envelope.trained_step(float(self.bodies.cell_size))

    def restore(self, run: Trajectory) -> None:
        """Tell the coarse stepper about the frames so far."""
        restore = getattr(self.coarse, "restore", None)
        if restore is not None:
            restore(_without(run))

    def __call__(self, state: State, forces: Array | None = None) -> StepResult:
        """Advance ``state`` by one step, with extra nodal forces (N, 3), N.

        Raises
        ------
        InputError
            If shapes are wrong or a number is not finite.
        """
        before, _ = self.coarse.accepted(_without(state), forces, None)
        previous = state.memory.get(MEMORY) if self.remembers else None
        step = SingleCoarseStep(self.coarse, self.bodies, self.velocity, before, forces, previous)
        started = time.perf_counter()
        with torch.inference_mode(), one_thread(torch.device("cpu")):
            found = corrected_step(step, self.corrector, self.gate)
        result, correction, reason = found.answer, found.correction.numpy(), found.reasons.item()
        after = result.state
        if self.remembers:
            after = replace(after, memory={**after.memory, MEMORY: correction})
        stats = {
            **result.stats,
            "correction": float(np.sqrt(np.square(correction).sum(axis=1).max())),
            "refused": float(reason > 0),
            "gate": float(reason),
            "network_seconds": time.perf_counter() - started - step.seconds,
        }
        return replace(result, state=after, stats=stats)


class SingleCoarseStep:
    """A `CoarseStep` of one scene, on the CPU, from ``state`` under ``forces`` of the caller too.

    ``bodies`` is the scene, in float64; ``previous`` (N, 3) the correction of the step before, m;
    ``seconds`` the wall clock in the coarse solver.
    """

    def __init__(
        self,
        coarse: ImplicitStepper,
        bodies: BodyGraph,
        velocity: Velocity,
        state: State,
        forces: Array | None = None,
        previous: Array | None = None,
    ) -> None:
        self._coarse, self._graph, self._velocity = coarse, bodies, velocity
        self._problem, self._state, self._forces = coarse.problem, state, forces
        self._previous, self.seconds = previous, 0.0
        stage = coarse.integrate(self._problem, state, coarse.time_step)
        loads = self._problem.external_forces(*stage.loads_over, state.positions)
        self._loads: Array = loads if forces is None else loads + forces

    def solved(self) -> StepResult:
        """See `CoarseStep`."""
        started = time.perf_counter()
        answer = self._coarse(self._state, self._forces)
        self.seconds = time.perf_counter() - started
        return answer

    def view(self, answer: StepResult) -> FeatureView:
        """See `CoarseStep`."""
        return self.view_of(answer.state.positions)

    def view_of(self, proposed: Array) -> FeatureView:
        """What the network sees with positions (N, 3) after the step."""
        arrays = self._state.positions, self._state.velocities, proposed, self._loads
        positions, velocities, after, loads = map(_tensor, arrays)
        old = None if self._previous is None else _tensor(self._previous)
        return FeatureView(self._graph, Snapshot(positions, velocities, after, loads, old))

    def ok(self, answer: StepResult) -> Tensor:
        """See `CoarseStep`."""
        return torch.tensor([answer.status.ok])

    def moved(self, answer: StepResult, correction: Tensor) -> StepResult:
        """See `CoarseStep`; statistics are those of the corrected state."""
        problem, shift = self._problem, correction.numpy()
        positions, velocities, memory = moved(
            self._coarse.integrate.scheme(self._state, self._coarse.time_step),
            answer.state, shift, self._velocity, lambda x: problem.mass_times(x) * problem.free,
        )  # fmt: skip
        ratios = problem.volume_ratios(positions)
        status = answer.status
        if status in (Status.CONVERGED, Status.INVERTED):  # how else it was found stays
            status = Status.INVERTED if ratios.min() <= 0.0 else Status.CONVERGED
        stats = {
            **answer.stats,
            "elastic_energy": problem.energy(positions, answer.modes),
            "kinetic_energy": 0.5 * float(np.vdot(velocities, problem.mass_times(velocities))),
            "external_work": answer.stats["external_work"] + float(np.vdot(self._loads, shift)),
            "smallest_volume_ratio": float(ratios.min()),
        }
        return replace(
            answer, state=State(positions, velocities, answer.state.time, memory), status=status,
            stats=stats, modes=None, volume_ratios=ratios,
        )  # fmt: skip

    def measured(self, answer: StepResult) -> GateMeasures:
        """See `CoarseStep`."""
        stored = answer.stats["elastic_energy"] + answer.stats["kinetic_energy"]
        positions, ratios = answer.state.positions, answer.volume_ratios
        if ratios is None:
            ratios = self._problem.volume_ratios(positions)
        work = float(np.vdot(self._loads, positions - self._state.positions))
        numbers = torch.tensor([[stored], [work]], dtype=torch.float64)
        return GateMeasures(_tensor(ratios)[None], *numbers)

    def chosen(self, which: Tensor, one: StepResult, other: StepResult) -> StepResult:
        """See `CoarseStep`."""
        return one if which.item() else other


def _tensor(array: Array) -> Tensor:
    """Of the same memory, which nobody writes to, or of a copy where torch would warn of that."""
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def digest(corrector: Corrector) -> str:
    """Some letters that tell correctors with other weights, normalisation or layout apart."""
    found = hashlib.sha256(corrector.config.model_dump_json().encode())
    for name, tensor in corrector.state_dict().items():
        found.update(name.encode())
        found.update(tensor.detach().cpu().numpy().tobytes())
    return found.hexdigest()[:16]


def _without(known: Known) -> Known:
    """A state or run without what a hybrid remembers."""
    if MEMORY not in getattr(known, "memory", {}):
        return known
    memory = {name: x for name, x in known.memory.items() if name != MEMORY}
    return replace(known, memory=memory)


def hybrid_of(
    scene: Scene, model: str | Path | LoadedModel, *, gate: bool | Gate | None = True
) -> HybridStepper:
    """Projective dynamics on the coarse model that a corrector was trained for, corrected.

    Parameters
    ----------
    scene : Scene
        Another time integrator than that of the model's training is warned of, and refused
        where it is quasi-static.
    model : str, path or LoadedModel
        Name or folder, see `load_model`, or one that is loaded.
    gate : bool, Gate or None
        True: the default `Gate`; None and False: none.

    Raises
    ------
    FileFormatError, InputError
        If there is no such model, it is damaged, it corrects an unknown coarse model, it does not
        fit the scene, the scene is quasi-static and the model's training was not, or ``gate`` is
        something else.
    """
    check_scene(scene)
    loaded = model if isinstance(model, LoadedModel) else load_model(model)
    name = "the model" if isinstance(model, LoadedModel) else model_folder(model).name
    if loaded.base not in BASES:
        raise InputError(f"{name}: corrects {loaded.base!r}: expected one of {', '.join(BASES)}.")
    problem = coarse_model(scene, loaded.base)
    _check_fit(problem, name, loaded.integrator)
    chosen: Gate | None = None if gate is False else Gate() if gate is True else gate
    return HybridStepper(
        ProjectiveDynamics(problem),
        loaded.corrector,
        velocity=loaded.velocity,
        gate=chosen,
        origin=None if isinstance(model, LoadedModel) else about_model(model, loaded),
    )


def about_model(model: str | Path, loaded: LoadedModel | None = None) -> dict[str, str]:
    """Which model that is, for `HybridStepper.describe`; ``loaded`` where it is already."""
    loaded, folder = loaded or load_model(model), model_folder(model)
    return {
        "model": folder.name, "base": loaded.base, "dataset": loaded.record.dataset,
        "trained_integrator": loaded.integrator, "weights_sha256": weights_digest(folder),
    }  # fmt: skip


def _check_fit(problem: Problem, name: str = "corrector", trained: str | None = None) -> None:
    """Refuse a scene that no model fits, with all reasons; ``trained`` is the model's integrator.

    Another one is refused where it is quasi-static, or else warned of.
    """
    time, nodes = problem.scene.time, problem.cells.shape[1]
    by, other = f"time.integrator = {time.integrator!r}", trained not in (None, time.integrator)
    parts = {
        "obstacles": problem.contact, "actuators": problem.fibres,
        "oblique rollers": problem.rollers,
    }  # fmt: skip
    wrong = [f"{what}: expected none" for what, part in parts.items() if part is not None]
    if nodes != 8:
        wrong.append(f"cells with {nodes} nodes: expected 8, their corners")
    if time.substeps > 1:
        wrong.append(f"time.substeps = {time.substeps}: expected 1, as frames are corrected whole")
    if other and time.integrator == "quasi-static":
        wrong.append(f"{by}, which has no inertia: expected {trained!r}")
    if wrong:
        raise InputError(
            f"{name}: the scene has {'; '.join(wrong)}. Change it, or leave the model out."
        )
    if other:
        warnings.warn(
            f"{name}: trained on steps by {trained}, and the scene has {by}: it may be of no use; "
            f'set integrator = "{trained}" in [time], or leave the model out',
            PdcorrectWarning,
            stacklevel=3,
        )
