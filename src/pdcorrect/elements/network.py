"""The network that writes a cell's corrections, in torch, for its training."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pdcorrect.fem.cube_symmetry import on_scalars, on_strains
from pdcorrect.fem.learned import SCALARS, STRAINS
from pdcorrect.fem.neighbourhood import permutations

_STIFF, _HEAVY = np.tril_indices(STRAINS), np.tril_indices(SCALARS)


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
        outputs = len(_STIFF[0]) + len(_HEAVY[0])
        sizes = [inputs, *[width] * depth]
        layers: list[nn.Module] = []
        for before, after in pairwise(sizes):
            layers += [nn.Linear(before, after), nn.SiLU()]
        self.layers = nn.Sequential(*layers, nn.Linear(width, outputs))
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)
        self.register_buffer("inputs", torch.as_tensor(permutations()), persistent=False)
        for name, moves in (("stiff", on_strains()), ("heavy", on_scalars())):
            n = moves.places.shape[1]
            places = moves.places[:, :, None] * n + moves.places[:, None, :]
            signs = moves.signs[:, :, None] * moves.signs[:, None, :]
            flat = torch.as_tensor(places.reshape(48, -1))
            self.register_buffer(f"{name}_places", flat, persistent=False)
            self.register_buffer(
                f"{name}_signs", torch.as_tensor(signs.reshape(48, -1), dtype=torch.float32),
                persistent=False,
            )  # fmt: skip

    def forward(self, x: Tensor, symmetries: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """N (C, 18, 18) and (C, 7, 7) for neighbourhoods (C, F), by some of the symmetries."""
        if symmetries is None:
            symmetries = torch.arange(48, device=x.device)
        turned = x[:, self.inputs[symmetries]]  # (C, G, F)
        found = self.layers(turned)
        split = len(_STIFF[0])
        stiff = self._mean(found[..., :split], _STIFF, STRAINS, "stiff", symmetries)
        heavy = self._mean(found[..., split:], _HEAVY, SCALARS, "heavy", symmetries)
        return stiff, heavy

    def _mean(self, lower: Tensor, index: Any, size: int, name: str, symmetries: Tensor) -> Tensor:
        """The mean of symmetric matrices given by their lower halves, each turned back."""
        places = torch.empty((size, size), dtype=torch.long, device=lower.device)
        numbers = torch.arange(len(index[0]), device=lower.device)
        places[index[0], index[1]] = places[index[1], index[0]] = numbers
        entry = places.flatten()  # where each entry of a full matrix is in the lower half
        moved = getattr(self, f"{name}_places")[symmetries]  # y = s x[places]; here backwards
        signs = getattr(self, f"{name}_signs")[symmetries]
        total = 0.0
        full = lower[..., entry]  # (C, G, size^2): N(g x) in the turned cell's coordinates
        back = torch.empty_like(moved)
        back.scatter_(1, moved, torch.arange(size * size, device=moved.device).expand_as(moved))
        turned = torch.gather(full * signs, 2, back.expand(len(full), -1, -1))
        total = turned.mean(dim=1)
        return total.reshape(-1, size, size)
