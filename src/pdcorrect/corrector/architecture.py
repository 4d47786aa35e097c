"""`CorrectorConfig`: everything that determines a corrector but its weights; its network.

`MeshGraphNetwork` has an encoder, message passing and a decoder (Pfaff et al. 2021).
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal

import torch
from pydantic import Field, ValidationError, field_validator
from torch import Tensor, nn

from pdcorrect._config import Positive, PositiveCount, Strict, explained
from pdcorrect.corrector import features
from pdcorrect.errors import InputError


class CorrectorConfig(Strict):
    """A corrector's architecture.

    Attributes
    ----------
    node_features, edge_features
        Names from `pdcorrect.corrector.features`.
    layers, width, mlp_layers
        See `MeshGraphNetwork`.
    output
        "world": a vector in the scene's axes, in units of the training targets' deviation.
        "frame": in the node's frame, in units of that times cell size and deformation: it
        vanishes at rest and under rigid motion, and turns with the scene.
    clip
        Normalised inputs bend towards this bound; None leaves them as they are.
    momentum_neutral
        Whether the rigid motion that has the same sums of m delta and r x m delta over the
        wholly free nodes of a body, at the proposed positions, is taken out of theirs: then
        linear momentum stays exactly, angular momentum to first order in delta.  Nodes with a
        held component keep what they have.
    norm, shared, placement
        LayerNorm on the output of each network but the decoder; whether all rounds have the same
        weights; what is corrected, the coarse solver's answer.  Model files name them.
    """

    node_features: tuple[str, ...]
    edge_features: tuple[str, ...]
    layers: PositiveCount
    width: PositiveCount
    mlp_layers: Annotated[int, Field(strict=True, ge=2)]
    norm: Literal["hidden"] = "hidden"
    shared: Literal[False] = False
    output: Literal["world", "frame"] = "frame"
    clip: Positive | None = 10.0
    momentum_neutral: bool = False
    placement: Literal["state"] = "state"

    @field_validator("node_features")
    @classmethod
    def _known_nodes(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known(features.NODE_FEATURES, names)

    @field_validator("edge_features")
    @classmethod
    def _known_edges(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known(features.EDGE_FEATURES, names)


def _known(there: dict[str, features.Feature], names: tuple[str, ...]) -> tuple[str, ...]:
    try:
        features.width(there, names)
    except InputError as error:
        raise ValueError(str(error)) from None
    return names


_FRAME_NODES = (
    "node-type", "stiffness", "poisson", "deformation", "strain", "acceleration", "load",
)  # fmt: skip
_FRAME_EDGES = ("rest-edge", "stretch", "motion", "turn")

PRESETS: dict[str, CorrectorConfig] = {
    "thesis": CorrectorConfig(
        node_features=("young", "poisson", "velocity", "force", "node-type"),
        edge_features=("rest-position", "position"),
        layers=15, width=128, mlp_layers=4, output="world", clip=None,
    ),
    "equivariant": CorrectorConfig(
        node_features=_FRAME_NODES, edge_features=_FRAME_EDGES, layers=10, width=128, mlp_layers=3,
    ),
    "compact": CorrectorConfig(
        node_features=_FRAME_NODES, edge_features=_FRAME_EDGES, layers=4, width=48, mlp_layers=2,
    ),
}  # fmt: skip
"""Architectures by name."""


def preset(name: str, **changes: object) -> CorrectorConfig:
    """A preset, some of its values changed.

    Raises
    ------
    InputError
        If there is no such preset, or a value is wrong.
    """
    if name not in PRESETS:
        raise InputError(f"preset {name!r}: expected one of {', '.join(PRESETS)}.")
    try:
        return changed(name, changes)
    except ValidationError as error:
        raise InputError(f"preset {name!r}: {explained(error, CorrectorConfig)}") from None


def changed(name: str, changes: Mapping[str, object]) -> CorrectorConfig:
    """A preset that there is, some of its values changed; wrong ones are a ValidationError."""
    return CorrectorConfig(**{**PRESETS[name].model_dump(), **changes})


# --- the network -------------------------------------------------------------------------


class MLP(nn.Sequential):
    """Linear layers with ReLU between them, and a LayerNorm at the end if asked for."""

    def __init__(self, inputs: int, width: int, outputs: int, layers: int, norm: bool) -> None:
        sizes = [inputs, *[width] * (layers - 1), outputs]
        parts: list[nn.Module] = []
        for before, after in pairwise(sizes):
            parts += [nn.Linear(before, after), nn.ReLU(inplace=True)]
        parts.pop()
        if norm:
            parts.append(nn.LayerNorm(outputs))
        super().__init__(*parts)


class MessageLayer(nn.Module):
    """One round: edges from their ends, then nodes from the sums of their edges; residual.

    The first linear map of the edges' network is applied to nodes and edges apart and
    added up, which is the same as applying it to all three side by side, and cheaper as
    there are more edges than nodes.
    """

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        self.of_edge = nn.Linear(width, width)
        self.of_receiver = nn.Linear(width, width, bias=False)
        self.of_sender = nn.Linear(width, width, bias=False)
        rest = MLP(width, width, width, layers - 1, True)
        self.edge_rest = nn.Sequential(nn.ReLU(inplace=True), *rest)
        self.node = MLP(2 * width, width, width, layers, True)
        bound = (3 * width) ** -0.5  # as one map from all three
        for part in (self.of_edge, self.of_receiver, self.of_sender):
            nn.init.uniform_(part.weight, -bound, bound)
        nn.init.uniform_(self.of_edge.bias, -bound, bound)

    def forward(self, x: Tensor, e: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        """New values of nodes (n, w) and edges (E, w)."""
        receiver, sender = edge_index
        to, start = self.of_receiver(x), self.of_sender(x)
        both = self.of_edge(e).add_(to.index_select(0, receiver))
        e = self.edge_rest(both.add_(start.index_select(0, sender))).add_(e)
        summed = torch.zeros_like(x).index_add_(0, receiver, e)
        return self.node(torch.cat([x, summed], dim=1)).add_(x), e


class MeshGraphNetwork(nn.Module):
    """Features of nodes and edges, so many components each, to one vector a node.

    Parameters
    ----------
    layers : int
        Rounds of message passing.
    width : int
        Of all hidden layers.
    mlp_layers : int
        Linear layers of each network.
    """

    def __init__(
        self,
        node_features: int,
        edge_features: int,
        outputs: int = 3,
        *,
        layers: int,
        width: int,
        mlp_layers: int,
    ) -> None:
        super().__init__()
        self.node_encoder = MLP(node_features, width, width, mlp_layers, True)
        self.edge_encoder = MLP(edge_features, width, width, mlp_layers, True)
        self.rounds = nn.ModuleList(MessageLayer(width, mlp_layers) for _ in range(layers))
        self.decoder = MLP(width, width, outputs, mlp_layers, False)

    def forward(self, x: Tensor, e: Tensor, edge_index: Tensor) -> Tensor:
        """Outputs (n, k) for features (n, a) of nodes and (E, b) of edges.

        The first row of ``edge_index`` (2, E) is the receiver.
        """
        x, e = self.node_encoder(x), self.edge_encoder(e)
        for each in self.rounds:
            x, e = each(x, e, edge_index)
        out: Tensor = self.decoder(x)
        return out
