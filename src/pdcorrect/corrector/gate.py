"""`Gate`: corrections that are better not applied.

A refused correction counts as zero: the step is the plain coarse one.  Corrections that are
not finite, and those of steps that the coarse solver failed, are refused without a gate too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, View
from pdcorrect.errors import InputError
from pdcorrect.scene.regions import NonNegative, Number, Strict

_HALVINGS = 6
"""How often a limited correction is halved before it is refused."""


class Reason(IntEnum):
    """Why a correction was refused; 0 where it was not."""

    NONE = 0
    NOT_FINITE = 1
    FEATURES = 2
    INVERSION = 3
    ENERGY = 4
    SOLVER = 5


Measure = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From factors on the corrections of B scenes to smallest det F and energy, J, each (B,)."""


class Gate(Strict):
    """When a correction is refused; None switches a test off.

    The network's inputs are tested before any placement.  Volumes and energy are tested on
    corrected answers (placement "state") and on those under corrected loads ("force"); where
    only the first iterate is corrected ("guess"), the answer is the coarse solver's anyway.

    Attributes
    ----------
    margin, share
        Refused if more than this share of a body's nodes has inputs, or an edge with inputs,
        that lie more than ``margin`` deviations outside the range of the training data.
    volume
        Refused if the smallest det F at the quadrature points, of the nodes' displacements, is
        not above this bound, unless it is no smaller than the coarse answer's.
    energy
        Refused if kinetic and elastic energy less the work of the loads is higher than after
        the coarse step by more than this multiple of the step's energy: kinetic and elastic
        energy after the coarse step and the magnitude of the loads' work in it.  For placement
        "force", where there is no other answer to compare with, the work of the added forces
        takes the place of the rise.
    limit
        Whether a correction that fails by volume or energy is halved, up to six times, until it
        passes, and refused only then; for placement "state".
    """

    margin: NonNegative | None = 3.0
    share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.05
    volume: Number | None = 0.0
    energy: NonNegative | None = 1.0
    limit: bool = False

    def unknown(self, corrector: Corrector, view: View) -> Tensor:
        """Whether the network's inputs are too far from its training data, (B,) bool."""
        bodies, config = view.bodies, corrector.config
        margin = self.margin
        if margin is None:
            return torch.zeros(bodies.bodies, dtype=torch.bool, device=bodies.rest.device)

        def outside(name: str, values: Tensor) -> Tensor:
            return ~(corrector.normaliser.excess(name, values) <= margin).all(dim=1)

        nodes = torch.zeros_like(bodies.graph, dtype=torch.bool)
        for name in config.node_features:
            nodes |= outside(name, NODE_FEATURES[name][1](view))
        edges = torch.zeros_like(view.receiver, dtype=torch.bool)
        for name in config.edge_features:
            edges |= outside(name, EDGE_FEATURES[name][1](view))
        counts = torch.zeros_like(bodies.mass).index_add(0, view.receiver, edges.to(bodies.mass))
        nodes |= counts > 0.0
        return bodies.body_means(nodes.to(bodies.mass)) > self.share

    def judged(self, measure: Measure, volume: Tensor, cap: Tensor) -> tuple[Tensor, Tensor]:
        """Factors on corrections, and reasons to refuse them, both (B,).

        Parameters
        ----------
        measure : callable
        volume : (B,)
            Smallest det F of the coarse answers.
        cap : (B,)
            Largest energy that is accepted, J.
        """
        factors = torch.ones_like(cap)
        reasons = self._reasons(*measure(factors), volume, cap)
        for _ in range(_HALVINGS if self.limit else 0):
            failed = reasons > 0
            if not failed.any():
                break
            factors = torch.where(failed, 0.5 * factors, factors)
            reasons = self._reasons(*measure(factors), volume, cap)
        return factors, reasons

    def _reasons(self, ratios: Tensor, energies: Tensor, volume: Tensor, cap: Tensor) -> Tensor:
        reasons = torch.zeros(len(cap), dtype=torch.int64, device=cap.device)
        if self.energy is not None:
            reasons = torch.where(energies <= cap, reasons, int(Reason.ENERGY))
        if self.volume is not None:
            whole = (ratios > self.volume) | (ratios >= volume)
            reasons = torch.where(whole, reasons, int(Reason.INVERSION))
        return reasons

    @property
    def judges(self) -> bool:
        """Whether it looks at the answers."""
        return self.volume is not None or self.energy is not None


def check_gate(gate: object, corrector: Corrector) -> None:
    """Refuse what is no gate, and limits where there is nothing to scale.

    Raises
    ------
    InputError
    """
    if gate is None:
        return
    if not isinstance(gate, Gate):
        raise InputError(f"gate is a {type(gate).__name__}: expected a Gate(...) or None.")
    placement = corrector.config.placement
    if gate.limit and placement != "state":
        raise InputError(
            f"gate.limit with placement {placement!r}: expected placement 'state', whose answers "
            "can be scaled back without solving again."
        )


def refusals(reasons: Iterable[float]) -> dict[str, int]:
    """How often corrections were refused, by reason: of ``run.stats["gate"]``, for example."""
    counts = {reason.name.lower().replace("_", " "): 0 for reason in Reason if reason}
    for number in reasons:
        if number:
            counts[Reason(int(number)).name.lower().replace("_", " ")] += 1
    return counts
