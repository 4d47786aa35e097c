"""Volumes and energies of a batch's corrected answers, for a `Gate`, on the device."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pdcorrect.batch.objective import dot
from pdcorrect.batch.states import BatchResult, BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.gate import Gate


class BatchAnswer:
    """A coarse step of B scenes beside corrected ones.

    The cells' internal modes stay those of the coarse answer: relaxed again, which a single
    scene's `HybridStepper` does, they would only lower the energy of a corrected answer, so
    the gate is never more lenient here.

    Parameters
    ----------
    stepper : BatchStepper
    before : BatchState
    coarse : BatchResult
    forces : (B, N, 3)
        All loads during the step, N.
    """

    def __init__(
        self, stepper: BatchStepper, before: BatchState, coarse: BatchResult, forces: Tensor
    ) -> None:
        self._stepper, self._coarse, self._forces = stepper, coarse, forces
        self._moved = coarse.state.positions - before.positions

    def judged(
        self, gate: Gate, corrected: Callable[[Tensor], BatchState]
    ) -> tuple[Tensor, Tensor]:
        """See `Gate.judged`; ``corrected`` gives the states for factors (B,) on corrections."""
        stepper = self._stepper

        def measure(factors: Tensor) -> tuple[Tensor, Tensor]:
            state = corrected(factors)
            stored, load = self._energies(state)
            return stepper.cells.smallest_volume_ratios(state.positions), stored + load

        with stepper.alone():
            stored, load = self._energies(self._coarse.state)
            size = stored + dot(self._forces, self._moved).abs()
            cap = stored + load + (gate.energy or 0.0) * size
            return gate.judged(measure, self.volume, cap)

    def judged_as_forced(self, gate: Gate, added: Tensor) -> Tensor:
        """Reasons (B,) to refuse the answer, which loads ``added`` (B, N, 3), N, led to."""
        with self._stepper.alone():
            stored, _ = self._energies(self._coarse.state)
            size = stored + dot(self._forces, self._moved).abs()
            work = dot(added, self._moved)
            below = torch.full_like(self.volume, torch.inf)  # there is no answer without them
            return gate.judged(lambda _: (self.volume, work), below, (gate.energy or 0.0) * size)[1]

    @property
    def volume(self) -> Tensor:
        """Smallest det F of the coarse answers, (B,)."""
        return self._stepper.cells.tensor(self._coarse.smallest_volume_ratios)

    def _energies(self, state: BatchState) -> tuple[Tensor, Tensor]:
        """Kinetic and elastic, and that of the loads, (B,), J."""
        stepper = self._stepper
        nodes = stepper.cells.sizes.nodes
        y = torch.cat([state.positions, self._coarse.y[:, nodes:]], dim=1)
        elastic, _ = stepper.cells.energy_and_forces(y)
        v = stepper.staging.extended(state.velocities)
        kinetic = 0.5 * dot(v, stepper.objective.mass(v))
        return elastic + kinetic, -dot(
            self._forces, state.positions - stepper.cells.rest[:, :nodes]
        )
