"""`BatchHybrid` and `HybridLayer`: steps of a `BatchStepper`, corrected by a network.

hybrid = BatchHybrid(pc.BatchStepper(problems, device="cuda"), corrector.to("cuda"))
result = hybrid(state)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from pdcorrect.batch.checks import check_nodal, start_times
from pdcorrect.batch.states import BatchResult, BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_bodies import BatchBodies, check_corrector
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import View
from pdcorrect.corrector.placements import Velocity, check_velocity, moved
from pdcorrect.errors import InputError
from pdcorrect.torch_layer import OnFailure, PDLayer


@dataclass(frozen=True, eq=False)
class BatchHybridResult:
    """Outcome of a corrected step of B scenes with n nodes in all.

    Attributes
    ----------
    state : BatchState
    correction : (n, 3) tensor
        As applied, m: to positions, or, by the placement, as forces or to the first iterate.
        Zero where it was refused.
    coarse : BatchResult
        Of the coarse solver; with placement "force" under the corrected loads.
    refused : (B,) bool tensor
        Whether the plain coarse answer was kept.
    """

    state: BatchState
    correction: Tensor
    coarse: BatchResult
    refused: Tensor


class _Hybrid:
    """What both forms of a hybrid have: its parts, checked."""

    def __init__(self, stepper: BatchStepper, corrector: Corrector, velocity: Velocity) -> None:
        self.nodes = BatchBodies(stepper)
        self.corrector = check_corrector(corrector, stepper.device)
        check_velocity(velocity, stepper.integrator)
        self.stepper, self.velocity = stepper, velocity
        self.placement = corrector.config.placement

    def view(self, before: BatchState, coarse: Tensor | None, previous: Tensor | None) -> View:
        """What the network sees of a step."""
        graph = self.nodes.graph
        if previous is not None and previous.shape != graph.rest.shape:
            raise InputError(
                f"previous: {tuple(previous.shape)}; expected the correction of the step before, "
                f"{tuple(graph.rest.shape)}, or None."
            )
        return View(graph, self.nodes.snapshot(before, coarse, previous))

    def moved(self, before: BatchState, after: BatchState, correction: Tensor) -> BatchState:
        """The state after a step with a correction (n, 3) added."""
        scheme = self.stepper.staging(before).scheme
        shift = self.nodes.padded(correction)
        positions, velocities, memory = moved(scheme, after, shift, self.velocity)
        return replace(after, positions=positions, velocities=velocities, memory=memory)


class BatchHybrid:
    """Steps many scenes and corrects each; no gradients.

    A scene whose correction is exactly zero keeps its coarse step bit for bit, and one whose
    correction has a NaN or infinity too: it counts as refused.

    Parameters
    ----------
    stepper : BatchStepper
    corrector : Corrector
        Fitted, on the stepper's device.
    velocity : {"recomputed", "kept"}
        Of corrected states: what the integrator makes of the corrected positions, by backward
        Euler v = (p - p_before)/h, or the coarse solver's.  For placement "state".

    Raises
    ------
    InputError
        If the parts do not fit each other.
    """

    def __init__(
        self, stepper: BatchStepper, corrector: Corrector, *, velocity: Velocity = "recomputed"
    ) -> None:
        self._hybrid = _Hybrid(stepper, corrector, velocity)
        self.stepper, self.corrector = stepper, corrector

    @property
    def bodies(self) -> BodyGraph:
        """The scenes as the network knows them, float64, on the stepper's device."""
        return self._hybrid.nodes.graph

    def flat(self, x: Tensor) -> Tensor:
        """Nodal values (B, N, ...) of scenes, float64, without padding: (n, ...)."""
        return self._hybrid.nodes.flat(x)

    def padded(self, x: Tensor) -> Tensor:
        """Values (n, ...) as (B, N, ...) in the stepper's type, zero in padding."""
        return self._hybrid.nodes.padded(x)

    @torch.no_grad()
    def __call__(self, state: BatchState, previous: Tensor | None = None) -> BatchHybridResult:
        """Advance all scenes by one step.

        Parameters
        ----------
        state : BatchState
        previous : (n, 3) tensor, optional
            Correction of the step before, m, for networks that ask for it; zero by default.

        Raises
        ------
        InputError
            If the state is not the stepper's, or a tensor has another shape, type or device.
        """
        hybrid, nodes = self._hybrid, self._hybrid.nodes
        if hybrid.placement == "state":
            return self._correct_state(state, previous)
        view = hybrid.view(state, None, previous)
        correction, sound = self._asked(view)
        if hybrid.placement == "force":
            coarse = self.stepper(state, nodes.forces(correction))
        else:
            changed = nodes.graph.by_node(self._changed(correction))[:, None]
            guess = torch.where(changed, view.snapshot.proposed + correction, torch.nan)
            coarse = self.stepper(state, guess=nodes.padded(guess))
        return BatchHybridResult(coarse.state, correction, coarse, ~sound)

    def _correct_state(self, state: BatchState, previous: Tensor | None) -> BatchHybridResult:
        hybrid = self._hybrid
        coarse = self.stepper(state)
        correction, sound = self._asked(hybrid.view(state, coarse.state.positions, previous))
        after = hybrid.moved(state, coarse.state, correction)
        kept = ~self._changed(correction)[:, None, None]
        final = replace(
            after,
            positions=torch.where(kept, coarse.state.positions, after.positions),
            velocities=torch.where(kept, coarse.state.velocities, after.velocities),
            memory={
                name: torch.where(kept, coarse.state.memory[name], x)
                for name, x in after.memory.items()
            },
        )
        return BatchHybridResult(final, correction, coarse, ~sound)

    def _asked(self, view: View) -> tuple[Tensor, Tensor]:
        """The network's correction (n, 3), zero in scenes where it is not finite; which are not."""
        correction = self.corrector.of_view(view)
        sound = self._hybrid.nodes.sound(correction)
        return torch.where(view.bodies.by_node(sound)[:, None], correction, 0.0), sound

    def _changed(self, correction: Tensor) -> Tensor:
        """Whether a scene has a correction that is not zero, (B,)."""
        return self.bodies.node_sums((correction != 0.0).any(dim=1).to(correction.dtype)) > 0.0


class HybridLayer(nn.Module):
    """One corrected step of many scenes, differentiable by the network's weights.

    Call it again with what it returned for more steps.  The corrector is a submodule.

    Parameters
    ----------
    stepper : BatchStepper
        With an integrator that needs no memory, see `PDLayer`.
    corrector : Corrector
        Fitted, on the stepper's device.
    through_solver : bool
        Whether derivatives go back through the coarse solver, the network's inputs and so
        earlier steps.  If not, the state that a call is given counts as fixed: each step's
        correction has derivatives by the weights through that step alone.
    velocity : {"recomputed", "kept"}
        See `BatchHybrid`.
    on_failure : {"raise", "zero"}
        See `PDLayer`.

    Attributes
    ----------
    steps : PDLayer
        The coarse step; its ``statuses`` are those of the last call.

    Raises
    ------
    InputError
        If the parts do not fit each other.

    Notes
    -----
    With placement "guess" positions and velocities do not depend on the network: only the
    correction does.  Derivatives by forces of the same step, for placement "force", go through
    the solver in any case.
    """

    def __init__(
        self,
        stepper: BatchStepper,
        corrector: Corrector,
        *,
        through_solver: bool,
        velocity: Velocity = "recomputed",
        on_failure: OnFailure = "raise",
    ) -> None:
        super().__init__()
        self._hybrid = _Hybrid(stepper, corrector, velocity)
        self.corrector, self.through_solver = corrector, through_solver
        self.steps = PDLayer(stepper, on_failure=on_failure)

    @property
    def bodies(self) -> BodyGraph:
        """The scenes as the network knows them, float64, on the stepper's device."""
        return self._hybrid.nodes.graph

    def flat(self, x: Tensor) -> Tensor:
        """Nodal values (B, N, ...) of scenes, float64, without padding: (n, ...)."""
        return self._hybrid.nodes.flat(x)

    def padded(self, x: Tensor) -> Tensor:
        """Values (n, ...) as (B, N, ...) in the stepper's type, zero in padding."""
        return self._hybrid.nodes.padded(x)

    def forward(
        self,
        positions: Tensor,
        velocities: Tensor,
        times: Sequence[float] | None = None,
        previous: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Positions and velocities (B, N, 3) after the step, and the correction (n, 3), m.

        Parameters
        ----------
        positions, velocities : (B, N, 3) tensors
            m and m/s.
        times : (B,) floats, optional
            At the start of the step, s; 0 by default.
        previous : (n, 3) tensor, optional
            Correction of the step before, m; zero by default.

        Raises
        ------
        InputError
            If a tensor has another shape, type or device.
        ConvergenceError
            If the coarse step or its derivative fails, unless ``on_failure`` is "zero".
        """
        hybrid, cells = self._hybrid, self._hybrid.stepper.cells
        check_nodal(cells, "positions", positions)
        check_nodal(cells, "velocities", velocities)
        if not self.through_solver:
            positions, velocities = positions.detach(), velocities.detach()
            previous = None if previous is None else previous.detach()
        before = BatchState(positions, velocities, start_times(cells, times))
        if hybrid.placement == "state":
            after = self._step(before, None)
            correction = self.corrector.of_view(hybrid.view(before, after.positions, previous))
            after = hybrid.moved(before, after, correction)
        else:
            correction = self.corrector.of_view(hybrid.view(before, None, previous))
            force = hybrid.placement == "force"
            after = self._step(before, hybrid.nodes.forces(correction) if force else None)
        return after.positions, after.velocities, correction

    def _step(self, before: BatchState, forces: Tensor | None) -> BatchState:
        positions, velocities = self.steps(
            before.positions, before.velocities, forces, times=before.times
        )
        return BatchState(positions, velocities, before.times)
