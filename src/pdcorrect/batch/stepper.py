"""`BatchStepper`: one implicit step of many scenes together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.batch.checks import check_problems
from pdcorrect.batch.inverses import BatchHessian, DenseInverse, chosen
from pdcorrect.batch.linear_solver import BatchConjugateGradients
from pdcorrect.batch.loads import BatchLoads
from pdcorrect.batch.memory import expected_bytes
from pdcorrect.batch.minimise import BatchMinimiser, Phase
from pdcorrect.batch.objective import BatchObjective, by_scene
from pdcorrect.batch.retry import OneByOne
from pdcorrect.batch.states import BatchResult, BatchState, apart, together
from pdcorrect.batch.threads import one_thread
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.scene.materials import lame
from pdcorrect.solvers.integrators import integrator as make_integrator
from pdcorrect.solvers.linear import Linear
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
        Of each scene's coarse cell size; the first scene's by default.
    first_hessian : {"auto", "G", "G-scaled", "two-level", "rest"}
        See `DenseInverse`; "auto" is "rest" for small meshes and "two-level" for others
        that are refined.
    max_iterations : int
    time_step, integrator : optional
        The first scene's by default.
    device : str
        "cpu", "cuda", "cuda:1", ...
    dtype : torch.dtype
        Of states, energies and gradients.
    storage : torch.dtype
        Of the inverses.
    recover : bool
        Whether scenes that do not converge are tried again, one at a time, with
        `ProjectiveDynamics` and its fallbacks.

    Attributes
    ----------
    material : tuple of (B, C) tensors
        Young's modulus (Pa), Poisson's ratio and density (kg/m3) of each cell, now.
    """

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
        self.problems = tuple(problems)
        check_problems(self.problems, time_step, integrator)
        first = self.problems[0]
        time = first.scene.time
        self.tolerance = first.scene.solver.tolerance if tolerance is None else float(tolerance)
        self.time_step = first.time_step if time_step is None else float(time_step)
        self.integrator = time.integrator if integrator is None else integrator
        self.integrate = make_integrator(self.integrator, time.spectral_radius)
        self.cells = CellBatch(self.problems, torch.device(device), dtype)
        self.device, self.dtype = self.cells.rest.device, dtype  # "cuda:0" where "cuda" was meant
        self.objective = BatchObjective(self.cells, self.problems)
        self._own: tuple[Tensor, ...] = tuple(
            self.cells.tensor(padded(values, (self.cells.sizes.cells,)))
            for values in zip(
                *(
                    (p.materials.young, p.materials.poisson, p.materials.density)
                    for p in self.problems
                ),
                strict=True,
            )
        )
        self.material = self._own
        self.first_hessian = chosen(first_hessian, self.problems)
        self._storage, self._most, self._recover = storage, max_iterations, recover
        self.loads = BatchLoads(self.cells, self.problems, self.objective.mass)
        self._clamped = self.cells.nodal([p.positions for p in self.problems])
        self._minimiser: BatchMinimiser | None = None
        self._inverse: DenseInverse | None = None
        self._one_by_one = OneByOne(
            self.cells,
            self._problems_now,
            self.tolerance,
            self.time_step,
            self.integrator,
        )

    # --- states -------------------------------------------------------------------------

    def state(self, states: Sequence[State]) -> BatchState:
        """States of the scenes together, see `together`."""
        return together(self.cells, states)

    def rest_state(self) -> BatchState:
        """All scenes at rest at time zero."""
        return self.state([p.rest_state() for p in self.problems])

    def states(self, batch: BatchState) -> list[State]:
        """The scenes' states one by one."""
        return apart(self.cells, batch)

    def extended(self, nodal: Tensor) -> Tensor:
        """(B, N, 3) as configurations (B, U, 3)."""
        n = self.cells.sizes
        if not n.modes:
            return nodal
        return torch.cat([nodal, nodal.new_zeros(n.scenes, n.modes, 3)], dim=1)

    # --- material --------------------------------------------------------------------------

    def set_material(
        self,
        young: Tensor | None = None,
        poisson: Tensor | None = None,
        density: Tensor | None = None,
    ) -> None:
        """Material values from now on, each (B, C) or what broadcasts to it.

        Those that are not given are the problems' own.  First Hessians stay those of the
        problems: they are only preconditioners.
        """
        given = (young, poisson, density)
        if all(m is None for m in given) and self.material is self._own:
            return
        values = tuple(
            own if m is None else m.detach().expand(own.shape).clone()
            for m, own in zip(given, self._own, strict=True)
        )
        mu, lam = lame(values[0], values[1])  # type: ignore[type-var]
        published = self.problems[0].scene.material.volume_weight == "published"
        self.cells.set_weights(mu, lam if published else 3.0 * lam)
        self.objective.mass.set_density(values[2])
        self.material = self._own if all(m is None for m in given) else values

    def _problems_now(self, i: int) -> Problem:
        """A scene with the material that it has now."""
        problem = self.problems[i]
        if self.material is self._own:
            return problem
        count = len(problem.cells)
        young, poisson, density = (
            m[i, :count].to("cpu", torch.float64).numpy() for m in self.material
        )
        return problem.with_material(young, poisson, density)

    # --- a step ---------------------------------------------------------------------------

    def __call__(self, state: BatchState, forces: Tensor | None = None) -> BatchResult:
        """Advance all scenes by one step, with extra nodal forces (B, N, 3), N."""
        with one_thread(self.device):
            result = self._step(state, forces)
        return self._one_by_one(state, forces, result) if self._recover else result

    def _step(self, state: BatchState, forces: Tensor | None) -> BatchResult:
        scheme, known = self.prepare(state, forces)
        minimiser = self._minimiser
        assert minimiser is not None
        start = self._start(scheme, known)
        alive = torch.isfinite(start).all(dim=2).all(dim=1)
        minimiser.run(torch.where(by_scene(alive), start, self.cells.rest), alive)
        y = minimiser.y.clone()  # the next step overwrites it
        phases = minimiser.phase.tolist()
        return BatchResult(
            y,
            [_STATUSES[Phase(p)] for p in phases],
            self._finish(scheme, known, y, state),
            minimiser.iterations.cpu().numpy(),
            minimiser.evaluations.cpu().numpy(),
            minimiser.estimate.to("cpu", torch.float64).numpy() * scheme.gain,
        )

    def prepare(
        self, state: BatchState, forces: Tensor | None = None
    ) -> tuple[Scheme, dict[str, Any]]:
        """Set up the step's objective and first Hessian."""
        h = self.time_step
        scheme = self.integrate.scheme_of(h, bool(state.memory))
        known = self._known(scheme, state)
        free = self.objective.free[:, : self.cells.sizes.nodes] > 0.5

        def split(on_free: Linear, on_clamped: Linear | None) -> Tensor:
            values = on_free(known)
            if on_clamped is not None:
                values = torch.where(free, values, on_clamped(known))
            return values

        objective = self.objective
        alpha = self.problems[0].scene.damping.mass
        factors = (objective.inertia, objective.damping)
        objective.inertia, objective.damping = scheme.inertia, scheme.rate * alpha
        objective.target.copy_(self.extended(split(scheme.target, scheme.clamped_target)))
        if objective.damping:
            objective.origin.copy_(self.extended(split(scheme.origin, scheme.clamped_origin)))
        total = self.loads(self.spans(scheme, state), scheme.loads_at(known))
        if forces is not None:
            total = total + self.extended(forces.to(total))
        objective.forces.copy_(total)
        if self._minimiser is None or factors != (objective.inertia, objective.damping):
            self._inverse = DenseInverse(
                self.cells, self.problems, objective.factors, self.first_hessian, self._storage
            )
            sizes = [self.tolerance * p.cell_size / scheme.gain for p in self.problems]
            tolerance = self.cells.tensor(np.array(sizes))
            self._minimiser = BatchMinimiser(objective, self._inverse, tolerance, self._most)
        return scheme, known

    def spans(self, scheme: Scheme, state: BatchState) -> list[tuple[float, float]]:
        """Time intervals over which each scene's loads act in a step, s."""
        first, last = scheme.loads_over
        return [(t + first * self.time_step, t + last * self.time_step) for t in state.times]

    def _known(self, scheme: Scheme, state: BatchState) -> dict[str, Any]:
        h = self.time_step
        known: dict[str, Any] = {
            "positions": state.positions,
            "velocities": state.velocities,
            "prescribed": self._prescribed([t + h for t in state.times]),
            "time": torch.zeros_like(state.positions)
            + by_scene(state.positions.new_tensor(state.times)),
            **state.memory,
            "clamp_velocity": 0.0,
            "clamp_velocity_at_y": 0.0,
            "clamp_jump": 0.0,
        }
        if "accelerations" in scheme.memory and "accelerations" not in known:
            raise InputError(
                "generalised-alpha in a batch starts from states with accelerations: expected "
                "memory. Take the first step of each scene with ProjectiveDynamics."
            )
        return known

    def _prescribed(self, times: Sequence[float]) -> Tensor:
        if not any(p.clamps.moving for p in self.problems):
            return self._clamped[:, : self.cells.sizes.nodes]
        pairs = zip(self.problems, times, strict=True)
        held = self.cells.nodal([p.clamped_positions(t) for p, t in pairs])
        return held[:, : self.cells.sizes.nodes]

    def _start(self, scheme: Scheme, known: Mapping[str, Any]) -> Tensor:
        nodes = self.cells.sizes.nodes
        free = self.objective.free[:, :nodes] > 0.5
        return self.extended(torch.where(free, scheme.start(known), scheme.clamped(known)))

    def _finish(
        self, scheme: Scheme, known: dict[str, Any], y: Tensor, state: BatchState
    ) -> BatchState:
        nodes = self.cells.sizes.nodes
        free = self.objective.free[:, :nodes] > 0.5
        known = {**known, "y": y[:, :nodes]}

        def split(on_free: Linear, on_clamped: Linear | None) -> Tensor:
            values = on_free(known)
            if isinstance(values, float):
                values = torch.zeros_like(state.positions)
            if on_clamped is not None:
                values = torch.where(free, values, on_clamped(known))
            return values

        memory = {name: split(*rows) for name, rows in scheme.memory.items()}
        velocities = split(scheme.velocities, scheme.clamped_velocities)
        times = tuple(t + self.time_step for t in state.times)
        return BatchState(split(scheme.positions, None), velocities, times, memory)

    def solve_adjoint(
        self, y: Tensor, b: Tensor, which: Tensor, tolerance: float
    ) -> BatchConjugateGradients:
        """H x = b at configurations y, for the step that was prepared last.

        For the scenes where ``which`` (B,) holds; b (B, U, 3) counts on free components.
        """
        assert self._inverse is not None
        assert self._minimiser is not None
        self._inverse.turn(y)
        self._minimiser.forget()
        solver = self._minimiser.linear_solver
        b = torch.where(by_scene(which), b * self.objective.free, 0.0)
        y = torch.where(by_scene(which), y, self.cells.rest)
        solver.solve(
            y, b, None, which, tolerance=math.inf, residual_share=tolerance,
            max_steps=_ADJOINT_STEPS,
        )  # fmt: skip
        return solver

    @property
    def inverse_bytes(self) -> int:
        """Memory of the inverses; 0 before the first step."""
        return 0 if self._inverse is None else self._inverse.bytes

    @property
    def expected_bytes(self) -> int:
        """Expected peak memory on the device, see `expected_bytes`; after the first step."""
        kinds = 0 if self._inverse is None else self._inverse.count
        return expected_bytes(self.cells.sizes, kinds, 3 if self.first_hessian == "rest" else 1)
