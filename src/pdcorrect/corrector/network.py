"""`MeshGraphNetwork`: encoder, message passing and decoder (Pfaff et al. 2021)."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

Normalisation = Literal["hidden", "all", "none"]


class MLP(nn.Sequential):
    """Linear layers with ReLU between them, and a LayerNorm at the end if asked for."""

    def __init__(self, inputs: int, width: int, outputs: int, layers: int, norm: bool) -> None:
        sizes = [inputs, *[width] * (layers - 1), outputs]
        parts: list[nn.Module] = []
        for before, after in pairwise(sizes):
            parts += [nn.Linear(before, after), nn.ReLU()]
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

    def __init__(self, width: int, layers: int, norm: bool) -> None:
        super().__init__()
        self.of_edge = nn.Linear(width, width)
        self.of_receiver = nn.Linear(width, width, bias=False)
        self.of_sender = nn.Linear(width, width, bias=False)
        self.edge_rest = nn.Sequential(nn.ReLU(), *MLP(width, width, width, layers - 1, norm))
        self.node = MLP(2 * width, width, width, layers, norm)
        bound = (3 * width) ** -0.5  # as one map from all three
        for part in (self.of_edge, self.of_receiver, self.of_sender):
            nn.init.uniform_(part.weight, -bound, bound)
        nn.init.uniform_(self.of_edge.bias, -bound, bound)

    def forward(self, x: Tensor, e: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        """New values of nodes (n, w) and edges (E, w)."""
        receiver, sender = edge_index
        to, start = self.of_receiver(x), self.of_sender(x)
        e = e + self.edge_rest(
            self.of_edge(e) + to.index_select(0, receiver) + start.index_select(0, sender)
        )
        summed = torch.zeros_like(x).index_add(0, receiver, e)
        return x + self.node(torch.cat([x, summed], dim=1)), e


class MeshGraphNetwork(nn.Module):
    """Features of nodes and edges to one vector a node.

    Parameters
    ----------
    node_features, edge_features : int
        Components.
    outputs : int
    layers : int
        Rounds of message passing.
    width : int
        Of all hidden layers.
    mlp_layers : int
        Linear layers of each network.
    norm : {"hidden", "all", "none"}
        LayerNorm on the output of each network but the decoder, also of the decoder, or of none.
    shared : bool
        Whether all rounds have the same weights.

    Attributes
    ----------
    count : int
        Rounds of message passing.
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
        norm: Normalisation = "hidden",
        shared: bool = False,
    ) -> None:
        super().__init__()
        hidden = norm != "none"
        self.node_encoder = MLP(node_features, width, width, mlp_layers, hidden)
        self.edge_encoder = MLP(edge_features, width, width, mlp_layers, hidden)
        count = 1 if shared else layers
        self.rounds = nn.ModuleList(MessageLayer(width, mlp_layers, hidden) for _ in range(count))
        self.decoder = MLP(width, width, outputs, mlp_layers, norm == "all")
        self.count = layers

    def forward(self, x: Tensor, e: Tensor, edge_index: Tensor) -> Tensor:
        """Outputs (n, k) for features (n, a) of nodes and (E, b) of edges.

        The first row of ``edge_index`` (2, E) is the receiver.
        """
        x, e = self.node_encoder(x), self.edge_encoder(e)
        for i in range(self.count):
            x, e = self.rounds[i % len(self.rounds)](x, e, edge_index)
        out: Tensor = self.decoder(x)
        return out
