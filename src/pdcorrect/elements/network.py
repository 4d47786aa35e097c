"""The network that writes a cell's corrections, in torch, for its training."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from pdcorrect.fem.element_network import SCALARS, STRAINS, halves
from pdcorrect.fem.neighbourhood import permutations


class ElementNetwork(nn.Module):
    """From neighbourhoods to symmetric matrices N of stiffness and mass, see `fem.learned`.

    The mean over the cube's symmetries of a perceptron's answers, each turned back.

    Parameters
    ----------
    inputs : int
        Numbers of a neighbourhood.
    width, depth : int
        Of the hidden layers, and how many.
    """

    def __init__(self, inputs: int, width: int = 256, depth: int = 3) -> None:
        super().__init__()
        sizes = [inputs, *[width] * depth]
        layers: list[nn.Module] = []
        for before, after in pairwise(sizes):
            layers += [nn.Linear(before, after), nn.SiLU()]
        last = nn.Linear(width, sum(halves(n).places.shape[1] for n in (STRAINS, SCALARS)))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)

    def forward(self, x: Tensor, symmetries: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """N (C, 18, 18) and (C, 7, 7) for neighbourhoods (C, F), by some of the symmetries."""
        if symmetries is None:
            symmetries = torch.arange(48, device=x.device)
        moved = torch.as_tensor(permutations(), device=x.device)[symmetries]
        found = self.layers(x[:, moved])  # (C, G, .)
        split = halves(STRAINS).places.shape[1]
        return (
            _mean(found[..., :split], STRAINS, symmetries),
            _mean(found[..., split:], SCALARS, symmetries),
        )


def _mean(lower: Tensor, size: int, symmetries: Tensor) -> Tensor:
    """The mean (C, n, n) of symmetric matrices given by lower halves (C, G, h), turned back."""
    half = halves(size)
    places = torch.as_tensor(half.places, device=lower.device)[symmetries]
    signs = torch.as_tensor(half.signs, device=lower.device)[symmetries].to(lower)
    turned = torch.gather(lower, 2, places.expand(len(lower), -1, -1)) * signs
    number = torch.as_tensor(half.number, device=lower.device)
    return turned.mean(dim=1)[:, number]
