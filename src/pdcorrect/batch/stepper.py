"""`BatchStepper`: one implicit step of many scenes together."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, check_problems, usable_device
from pdcorrect.batch.first_hessian import BatchHessian, FirstHessian, chosen
from pdcorrect.batch.gpu import one_thread
from pdcorrect.batch.linear_solver import BatchConjugateGradients
from pdcorrect.batch.material import (
    NAMES,
    BatchMaterial,
    by_cell,
    changed,
    check_material,
    own_material,
)
from pdcorrect.batch.minimise import BatchMinimiser, Phase, settle
from pdcorrect.batch.objective import BatchObjective, by_scene
from pdcorrect.batch.retry import SingleRetry
from pdcorrect.batch.states import (
    BatchResult,
    BatchState,
    check_nodal,
    check_state,
    check_states,
    start_times,
    state_of,
    together,
)
from pdcorrect.batch.step_equation import BatchLoads, BatchStaging, BatchStepEquation
from pdcorrect.errors import InputError
from pdcorrect.fem.cell_correction import CellCorrection
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers import schemes
from pdcorrect.solvers.implicit import positive, whole
from pdcorrect.solvers.integrators import integrator as make_integrator
from pdcorrect.solvers.schemes import Scheme
from pdcorrect.state import State, Status

Array = NDArray[np.float64]

_ADJOINT_STEPS = 400
"""Of conjugate gradients."""
_STATUSES = {
    Phase.CONVERGED: Status.CONVERGED,
    Phase.LINE_SEARCH: Status.LINE_SEARCH,
    Phase.NOT_FINITE: Status.NOT_FINITE,
    Phase.LIMIT: Status.ITERATION_LIMIT,
    Phase.RUNNING: Status.ITERATION_LIMIT,
    Phase.WAITING: Status.ITERATION_LIMIT,
}
"""What the loop's phases mean for a step."""


class BatchStepper:
    """Steps many scenes by projective dynamics, in torch, on one device.

    The same minimisation as `ProjectiveDynamics`, to the same tolerance; scenes do not
    influence each other.  They may differ in everything except the element, the energy,
    the integrator and the time step.

    Parameters
    ----------
    problems : sequence of Problem
    tolerance : float, optional
        Of each scene's coarse cell size; each scene's own by default.
    first_hessian : {"auto", "G", "G-scaled", "multigrid", "rest"}
        See `FirstHessian`; "auto" is "rest" for small meshes and "multigrid" for others
        that are refined.
    max_iterations : int
        At least 1.
    time_step : float, optional
        s; the first scene's by default.
    integrator : str, optional
        The first scene's by default.
    device : str
        "cpu", "cuda", "cuda:1", ...
    dtype : torch.dtype
        Of states, energies and gradients: ``torch.float64`` or ``torch.float32``.
    storage : torch.dtype
        Of the inverses, which are preconditioners: one of the same.
    recover : bool
        Whether scenes that do not converge are tried again, one at a time, with
        `ProjectiveDynamics` and its fallbacks.

    Attributes
    ----------
    present, own : BatchMaterial
        What the scenes are of now, and as the problems have it.

    Raises
    ------
    InputError
        If scenes cannot step together, or an option has no meaning here.

    Notes
    -----
    One thread at a time steps: others that call the same stepper wait.
    """

    @torch.inference_mode(mode=False)
    def __init__(
        self,
        problems: Sequence[Problem],
        tolerance: float | None = None,
        *,
        first_hessian: BatchHessian = "auto",
        max_iterations: int = 1000,
        time_step: float | None = None,
        integrator: str | None = None,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float64,
        storage: torch.dtype = torch.float32,
        recover: bool = True,
    ) -> None:
        self.problems = check_problems(problems, time_step, integrator)
        for name, kind in (("dtype", dtype), ("storage", storage)):
            if kind not in (torch.float32, torch.float64):
                raise InputError(f"{name} = {kind!r}: expected torch.float32 or torch.float64.")
        first = self.problems[0]
        time = first.scene.time
        self.tolerances = tuple(
            positive("tolerance", p.scene.solver.tolerance if tolerance is None else tolerance)
            for p in self.problems
        )
        self.time_step = positive("time_step", first.time_step if time_step is None else time_step)
        self.integrator = time.integrator if integrator is None else integrator
        damping = first.scene.damping
        self.integrate = make_integrator(
            self.integrator, time.spectral_radius, damping.viscosity > 0.0
        )
        self.first_hessian = chosen(first_hessian, self.problems)
        self._storage, self._recover = storage, recover
        self._most = whole("max_iterations", max_iterations, 1)
        self.cells = CellBatch(self.problems, usable_device(device), dtype)
        self.device, self.dtype = self.cells.rest.device, dtype  # "cuda:0" where "cuda" was meant
        self.objective = BatchObjective(self.cells, damping)
        self.own = self.present = own_material(self.cells)
        self._write(self.own)
        self.loads = BatchLoads(self.cells, self.problems, self.objective.mass)
        self.staging = BatchStaging(self.cells, self.problems, self.integrate, self.time_step)
        self._forget()

    def _forget(self) -> None:
        """Make what is not kept in copies of the stepper, or anew when it is first needed."""
        self._lock = threading.RLock()
        self._one_by_one = SingleRetry(
            self.cells, self.tolerances, time_step=self.time_step, integrator=self.integrator
        )

    def __getstate__(self) -> dict[str, Any]:
        left = ("_lock", "_minimiser", "_one_by_one")
        return {name: value for name, value in self.__dict__.items() if name not in left}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """For work on the stepper's tensors: by one Python thread, and never for autograd."""
        with self._lock, torch.inference_mode(mode=False), torch.no_grad(), one_thread(self.device):
            yield

    # --- states -------------------------------------------------------------------------

    def state(self, states: Sequence[State]) -> BatchState:
        """States of the scenes, one each, together and padded.

        Raises
        ------
        InputError
            If there is not one for each scene, or shapes are wrong.
        """
        return together(self.cells, check_states(self.cells, states))

    def rest_state(self) -> BatchState:
        """All scenes at rest at time zero."""
        positions = self.cells.rest[:, : self.cells.sizes.nodes].clone()
        times = start_times(self.cells, None)
        return BatchState(positions, torch.zeros_like(positions), times)

    def states(
        self, batch: BatchState | tuple[Tensor, Tensor], times: Sequence[float] | None = None
    ) -> list[State]:
        """The scenes' states one by one, without padding.

        Parameters
        ----------
        batch : BatchState or pair of (B, N, 3) tensors
            The pair, positions and velocities, is what `PDLayer` returns; (N, 3) each for a
            stepper of one scene.
        times : (B,) floats, optional
            Of a pair, s; 0 by default.
        """
        if isinstance(batch, (tuple, list)) and len(batch) == 2:
            positions, velocities = map(self.batched, batch)
            batch = BatchState(positions, velocities, start_times(self.cells, times))
        check_state(self.cells, batch)
        return [state_of(self.cells, batch, i) for i in range(len(self.problems))]

    def batched(self, x: Tensor) -> Tensor:
        """A nodal tensor (N, 3) of a stepper of one scene as (1, N, 3); others as they are."""
        lone = len(self.problems) == 1 and isinstance(x, Tensor) and x.ndim == 2
        return x[None] if lone else x

    @property
    def node_counts(self) -> tuple[int, ...]:
        """Nodes of each scene; those from there on are padding."""
        return tuple(self.cells.node_counts)

    @property
    def node_mask(self) -> Tensor:
        """Which nodes (B, N) are a scene's own, bool; the others are padding."""
        return self.cells.present_nodes.clone()

    # --- material --------------------------------------------------------------------------

    @property
    def material(self) -> tuple[Tensor, Tensor, Tensor]:
        """Young's modulus (Pa), Poisson's ratio and density (kg/m3) of each cell now, (B, C)."""
        return self.present.values

    def set_material(
        self,
        young: Tensor | float | None = None,
        poisson: Tensor | float | None = None,
        density: Tensor | float | None = None,
    ) -> None:
        """Material values from now on, each a number or a tensor that broadcasts to (B, C).

        Those that are not given are the problems' own.  First Hessians stay those of the
        problems: they are only preconditioners.

        Raises
        ------
        InputError
            If a tensor has another type or device, does not broadcast, or has a value out of
            its range.  Nothing has changed then.
        """
        pairs = zip(NAMES, (young, poisson, density), strict=True)
        with self.alone():
            given = [by_cell(self.cells, name, value) for name, value in pairs]
            material = self.with_material(given, self.own)
            check_material(self.cells, self.problems, material)
            self._apply(material)

    def with_material(
        self, given: Sequence[Tensor | None], base: BatchMaterial | None = None
    ) -> BatchMaterial:
        """The present material, or another, with other values, each (B, C) or None, for `using`."""
        rule, base = self.problems[0].scene.material, self.present if base is None else base
        with self.alone():
            return changed(self.cells, rule, base, given)

    @contextmanager
    def using(self, material: BatchMaterial) -> Iterator[None]:
        """Work alone and with a material; afterwards the present one is back."""
        with self.alone():
            before = self.present
            self._apply(material)
            try:
                yield
            finally:
                self._apply(before)

    def _apply(self, material: BatchMaterial) -> None:
        if material is not self.present:
            self._write(material)
            self.present = material

    def _write(self, material: BatchMaterial) -> None:
        self.cells.set_weights(material.mu, material.volume_weight)
        if self.cells.correction is not None:
            written = self.corrections(material)
            self.cells.correction.write(written)
            self.objective.mass.write([c.masses for c in written])
        self.objective.mass.set_density(material.density)

    def corrections(self, material: BatchMaterial | None = None) -> list[CellCorrection]:
        """What the scenes' learned elements add with a material, the present one by default."""
        material = self.present if material is None else material
        found = [p.correction for p in self.problems if p.correction is not None]
        if material is self.own:
            return found
        weights = torch.stack([material.mu, material.volume_weight]).to("cpu", torch.float64)
        mu, omega = weights.numpy()
        for i, (correction, sound) in enumerate(zip(found, material.sound.tolist(), strict=True)):
            count = len(correction.cells)
            if sound and correction.writer is not None:
                found[i] = correction.writer.correction(mu[i, :count], omega[i, :count])
        return found

    def problem_now(self, i: int) -> Problem:
        """The problem of a scene with the material that it has now."""
        problem = self.problems[i]
        if self.present is self.own:
            return problem
        count = len(problem.cells)
        values = (m[i, :count].to("cpu", torch.float64).numpy() for m in self.material)
        return problem.with_material(*values)

    def initial_state(self) -> BatchState:
        """All scenes at time zero with their initial velocities."""
        return self.state([p.initial_state() for p in self.problems])

    # --- a step ---------------------------------------------------------------------------

    def __call__(self, state: BatchState, forces: Tensor | None = None) -> BatchResult:
        """Advance all scenes by one step, with extra nodal forces (B, N, 3), N.

        Raises
        ------
        InputError
            If the state is not the stepper's, or a tensor has another shape, type or device.
        """
        with self.alone():
            result = self._step(state, forces)
            if self._recover:
                self._one_by_one(state, forces, result, self.problem_now)
            return result

    def _step(self, state: BatchState, forces: Tensor | None) -> BatchResult:
        stage = self.prepare(state, forces)
        m, start = self._minimiser, self.staging.extended(stage.start)
        alive = torch.isfinite(start).all(dim=2).all(dim=1) & self.present.sound
        m.run(torch.where(by_scene(alive), start, self.cells.rest), alive)
        found = m.y.clone(), m.phase, m.iterations, m.evaluations, m.estimate  # y is overwritten
        if self.loads.follow:
            nodes = self.cells.sizes.nodes
            found = settle(m, alive, lambda y: self._push(stage, forces, y[:, :nodes]))
        y, phase, iterations, evaluations, estimate = found
        after = self.staging.finish(stage, y, state, self._internal(stage, y))
        ratios = (
            self.cells.volume_ratios(after.positions).amin(dim=1).to("cpu", torch.float64).numpy()
        )
        statuses = [_STATUSES[Phase(p)] for p in phase.tolist()]
        return BatchResult(
            y,
            [
                Status.INVERTED if s is Status.CONVERGED and ratio <= 0.0 else s
                for s, ratio in zip(statuses, ratios, strict=True)
            ],
            after,
            iterations.cpu().numpy().copy(),
            evaluations.cpu().numpy().copy(),
            estimate.to("cpu", torch.float64).numpy() * stage.scheme.gain,
            ratios,
        )

    def prepare(
        self, state: BatchState, forces: Tensor | None = None, y: Tensor | None = None
    ) -> BatchStepEquation:
        """Set up the step's objective.

        Loads that follow the body are sampled at ``y`` (B, U, 3), or where the step is expected
        to lead.
        """
        check_state(self.cells, state)
        if forces is not None:
            check_nodal(self.cells, "forces", forces)
        stage, objective = self.staging(state), self.objective
        objective.factors.copy_(self.cells.tensor(np.array(self._factors(stage.scheme))))
        objective.target.copy_(stage.target)
        if objective.rayleigh is not None:
            objective.rayleigh.prepare(stage.origin, stage.foreseen)
        if objective.viscous is not None:
            objective.viscous.prepare(stage.strains)
        self._push(stage, forces, stage.start if y is None else y[:, : self.cells.sizes.nodes])
        return stage

    def _factors(self, scheme: Scheme) -> tuple[float, float, float, float]:
        damping = self.problems[0].scene.damping
        return (
            scheme.inertia,
            scheme.rate * damping.mass,
            scheme.rate * damping.stiffness,
            scheme.strain_rate * damping.viscosity,
        )

    def _push(self, stage: BatchStepEquation, forces: Tensor | None, y: Tensor) -> None:
        total = self.loads(stage.spans, stage.sampled(y))
        if forces is not None:
            total = total + self.staging.extended(forces)
        total = stage.scheme.load_factor * total
        if isinstance(stage.past_forces, Tensor):
            total = total + self.staging.extended(stage.past_forces)
        self.objective.forces.copy_(total)

    def _internal(self, stage: BatchStepEquation, y: Tensor) -> Tensor | None:
        """See `BatchStaging.finish`; of no use where clamped."""
        if "internal_forces" not in stage.scheme.memory:
            return None
        moved = self.objective.mass(y - stage.target)
        out = stage.scheme.inertia * moved - self.objective.forces
        return out[:, : self.cells.sizes.nodes] * self.staging.free

    @cached_property
    def _minimiser(self) -> BatchMinimiser:
        """With the first Hessian of a step that goes on, which serves a run's first steps too."""
        scheme = self.integrate.scheme_of(self.time_step, schemes.WHOLE_MEMORY)
        inertia, drag, stiffness, viscosity = self._factors(scheme)
        factors = inertia + drag, 1.0 + stiffness + viscosity
        inverse = FirstHessian(
            self.cells, self.problems, factors, self.first_hessian, self._storage
        )
        pairs = zip(self.tolerances, self.problems, strict=True)
        half = 0.5 if self.loads.follow else 1.0  # the rest is for loads, see `settle`
        sizes = np.array([half * tolerance * p.cell_size / scheme.gain for tolerance, p in pairs])
        return BatchMinimiser(self.objective, inverse, self.cells.tensor(sizes), self._most)

    def solve_adjoint(
        self, y: Tensor, b: Tensor, which: Tensor, tolerance: float
    ) -> BatchConjugateGradients:
        """H x = b at configurations y, for the step that was prepared last.

        For the scenes where ``which`` (B,) holds; b (B, U, 3) counts on free components.
        """
        self._minimiser.forget(y)
        solver = self._minimiser.linear_solver
        b = torch.where(by_scene(which), b * self.objective.free, 0.0)
        y = torch.where(by_scene(which), y, self.cells.rest)
        solver.solve(
            y, b, None, which, tolerance=math.inf, residual_share=tolerance,
            max_steps=_ADJOINT_STEPS,
        )  # fmt: skip
        return solver
