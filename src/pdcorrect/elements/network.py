"""The network that writes a cell's corrections, in torch, for its training."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from pdcorrect.fem.element_network import EPSILON, SCALARS, STRAINS, halves
from pdcorrect.fem.neighbourhood import NEIGHBOURS, SIZE, permutations


class ElementNetwork(nn.Module):
    """From a graph of cells to symmetric matrices N of stiffness and mass, see `fem.learned`.

    The mean over the cube's symmetries of the answers of a graph network with one relation for
    each of the 27 places of a neighbour (Schlichtkrull et al. 2018), each turned back.

    Parameters
    ----------
    width : int
        Features of a cell.
    rounds : int
        Of messages between neighbours.
    head : int
        Width of the layer before the answers.
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
