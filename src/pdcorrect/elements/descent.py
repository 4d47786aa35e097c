"""How the weights of the network are moved: Muon and AdamW, a rate that rises and falls."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from pdcorrect.elements.network import ElementNetwork

_MUON_DECAY, _ADAM_DECAY = 1e-2, 1e-4
_ADAM = 0.2
"""AdamW's learning rate over Muon's."""
_WARM_UP = 0.01
"""Of the iterations, over which the learning rate rises."""


class Descent:
    """Muon (Jordan et al. 2024) for the matrices inside, AdamW for the other weights.

    Parameters
    ----------
    network : ElementNetwork
    rate : float
        Largest learning rate of Muon; it falls as a cosine.
    iterations : int
        When it is 0.
    """

    def __init__(self, network: ElementNetwork, rate: float, iterations: int) -> None:
        self._network, self._rate, self._iterations = network, rate, iterations
        inside = [p for p in network.parameters() if p.ndim == 2 and p is not network.last.weight]
        known = {id(p) for p in inside}
        others = [p for p in network.parameters() if id(p) not in known]
        self._optimisers = {
            1.0: torch.optim.Muon(inside, lr=rate, weight_decay=_MUON_DECAY),
            _ADAM: torch.optim.AdamW(others, lr=_ADAM * rate, weight_decay=_ADAM_DECAY),
        }

    def step(self, iteration: int) -> None:
        """Move the weights against the derivatives that they have."""
        fall = 0.5 + 0.5 * np.cos(np.pi * iteration / self._iterations)
        rise = min(1.0, (iteration + 1) / (_WARM_UP * self._iterations))
        for share, optimiser in self._optimisers.items():
            for group in optimiser.param_groups:
                group["lr"] = float(share * self._rate * rise * fall)
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        for optimiser in self._optimisers.values():
            optimiser.step()

    def state(self) -> list[dict[str, Any]]:
        """What a checkpoint keeps."""
        return [optimiser.state_dict() for optimiser in self._optimisers.values()]

    def restore(self, state: list[dict[str, Any]]) -> None:
        """Take up a checkpoint's."""
        for optimiser, kept in zip(self._optimisers.values(), state, strict=True):
            optimiser.load_state_dict(kept)
