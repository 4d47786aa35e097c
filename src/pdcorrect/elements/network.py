"""The network that writes a cell's corrections, in torch, and how its weights are moved."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from pdcorrect.fem.element_network import EPSILON, SCALARS, STRAINS, halves
from pdcorrect.fem.neighbourhood import NEIGHBOURS, SIZE, permutations

_MUON_DECAY, _ADAM_DECAY = 1e-2, 1e-4
_ADAM = 0.2
"""AdamW's learning rate over Muon's."""
_WARM_UP = 0.01
"""Of the iterations, over which the learning rate rises."""


class ElementNetwork(nn.Module):
    """From a graph of cells to symmetric matrices N of stiffness and mass, see `fem.learned`.

    The mean over the cube's symmetries of the answers of a graph network with one relation for
    each of the 27 places of a neighbour (Schlichtkrull et al. 2018), each turned back.

    ``width`` is the number of a cell's features, ``rounds`` those of messages between neighbours,
    ``head`` the width of the layer before the answers.
    """

    own: Tensor
    around: Tensor

    def __init__(self, width: int = 96, rounds: int = 3, head: int = 128) -> None:
        super().__init__()
        self.first = nn.Linear(SIZE, width)
        self.rounds = nn.ModuleList(nn.Linear(NEIGHBOURS * width, width) for _ in range(rounds))
        self.norms = nn.ModuleList(nn.RMSNorm(width, eps=EPSILON) for _ in range(rounds))
        self.hidden = nn.Linear(2 * width, head)
        self._lengths = [halves(size).places.shape[1] for size in (STRAINS, SCALARS)]
        self.last = nn.Linear(head, sum(self._lengths))
        own, around = permutations()
        tables = {"own": own, "around": around}
        for size in (STRAINS, SCALARS):
            tables |= {f"{name}{size}": x for name, x in halves(size)._asdict().items()}
        for name, table in tables.items():
            self.register_buffer(name, torch.as_tensor(table), persistent=False)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(
        self, numbers: Tensor, neighbours: Tensor, symmetries: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """N (C, 18, 18) and (C, 7, 7) for cells' numbers (C, 37), by some of the symmetries.

        ``neighbours`` (C, 27) has C where there is none.
        """
        if symmetries is None:
            symmetries = torch.arange(48, device=numbers.device)
        first = silu(self.first(numbers[:, self.own[symmetries]]))  # (C, G, width)
        table = neighbours[:, self.around[symmetries]]
        orientation = torch.arange(len(symmetries), device=numbers.device)[:, None]
        place = (table * len(symmetries) + orientation).flatten()
        x = first
        for convolution, norm in zip(self.rounds, self.norms, strict=True):
            padded = nn.functional.pad(norm(x), (0, 0, 0, 0, 0, 1))
            around = padded.flatten(0, 1).index_select(0, place)
            x = x + silu(convolution(around.reshape(*x.shape[:2], -1)))
        found = self.last(silu(self.hidden(torch.cat([x, first], dim=2))))
        lower = zip(found.split(self._lengths, dim=2), (STRAINS, SCALARS), strict=True)
        N, H = (self._mean(answers, size, symmetries) for answers, size in lower)
        return N, H

    def _mean(self, lower: Tensor, size: int, symmetries: Tensor) -> Tensor:
        """The mean (C, n, n) of symmetric matrices given by lower halves (C, G, h), turned back."""
        places, signs, number = (
            self.get_buffer(f"{name}{size}") for name in ("places", "signs", "number")
        )
        turned = torch.gather(lower, 2, places[symmetries].expand(len(lower), -1, -1))
        mean = (turned * signs[symmetries].to(lower)).mean(dim=1)
        return mean.index_select(1, number.flatten()).reshape(-1, size, size)


class Descent:
    """Muon (Jordan et al. 2024) for the matrices inside, AdamW for the other weights.

    ``rate`` is the largest learning rate of Muon; it falls as a cosine to 0 after ``iterations``.
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
