"""`Corrector`: features, network and built-in physics, from a snapshot to a correction.

Its `CorrectorConfig` determines everything but the weights.  `MeshGraphNetwork` has an encoder,
message passing and a decoder (Pfaff et al. 2021).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Annotated, Literal, Protocol

import torch
from pydantic import Field, ValidationError, field_validator
from torch import Tensor, nn

from pdcorrect._config import Positive, PositiveCount, Strict, explained
from pdcorrect.corrector import features
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, FeatureView, Snapshot
from pdcorrect.corrector.frames import turned, turned_back
from pdcorrect.corrector.normaliser import Envelope, Normaliser
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
    """

    node_features: tuple[str, ...]
    edge_features: tuple[str, ...]
    layers: PositiveCount
    width: PositiveCount
    mlp_layers: Annotated[int, Field(strict=True, ge=2)]
    output: Literal["world", "frame"] = "frame"
    clip: Positive | None = 10.0
    momentum_neutral: bool = False

    @field_validator("node_features")
    @classmethod
    def _known_nodes(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known(NODE_FEATURES, names)

    @field_validator("edge_features")
    @classmethod
    def _known_edges(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return _known(EDGE_FEATURES, names)


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


# --- the corrector -----------------------------------------------------------------------


class Answers(Protocol):
    """What gives corrections: a `Corrector`, or the same in other code."""

    @property
    def config(self) -> CorrectorConfig:
        """Of the corrector."""

    def of_view(self, view: FeatureView) -> Tensor:
        """Corrections (n, 3), m."""

    def rest_score(self, bodies: BodyGraph) -> Tensor:
        """See `pdcorrect.corrector.normaliser.Envelope.rest_score`, (B,)."""

    def score(self, view: FeatureView) -> Tensor:
        """Out-of-distribution score of a step of each body, (B,)."""


class Corrector(nn.Module):
    """Displacements (n, 3), m, that are to be added to a coarse step.

    Clamped components get none.  With output "frame" it is exactly zero where the body is
    not deformed, however it has moved.  ``normaliser`` and ``envelope`` are to be fitted before the
    first call; see `pdcorrect.training.fitting`.
    """

    def __init__(self, config: CorrectorConfig) -> None:
        super().__init__()
        self.config = config
        nodes = {name: NODE_FEATURES[name][0] for name in config.node_features}
        edges = {name: EDGE_FEATURES[name][0] for name in config.edge_features}
        self.normaliser, self.envelope = Normaliser(nodes, edges), Envelope(nodes, edges)
        self.network = MeshGraphNetwork(
            sum(nodes.values()), sum(edges.values()), layers=config.layers, width=config.width,
            mlp_layers=config.mlp_layers,
        )  # fmt: skip

    def forward(self, bodies: BodyGraph, snapshot: Snapshot) -> Tensor:
        """The correction in the snapshot's precision; the network works in its own."""
        return self.of_view(FeatureView(bodies, snapshot))

    def of_view(self, view: FeatureView, network: Callable[..., Tensor] | None = None) -> Tensor:
        """The same for a view that exists already; ``network`` may be its own, compiled."""
        nodes, edges = self.inputs(view)
        weight = self.network.decoder[0].weight
        assert isinstance(weight, Tensor)
        answer = self.network if network is None else network
        x = answer(nodes.to(weight.dtype), edges.to(weight.dtype), view.bodies.edge_index)
        return self.in_metres(view, x.to(view.bodies.rest.dtype))

    def inputs(self, view: FeatureView) -> tuple[Tensor, Tensor]:
        """Normalised features of nodes (n, a) and edges (E, b)."""
        config = self.config
        nodes = features.values(NODE_FEATURES, config.node_features, view)
        edges = features.values(EDGE_FEATURES, config.edge_features, view)
        joined = self.normaliser.joined
        return joined(nodes, config.clip), joined(edges, config.clip)

    def rest_score(self, bodies: BodyGraph) -> Tensor:
        """Out-of-distribution score of bodies at rest and their time steps, (B,)."""
        return self.envelope.rest_score(bodies)

    def score(self, view: FeatureView) -> Tensor:
        """Out-of-distribution score of a step of each body, (B,), see `Envelope`."""
        config, bodies = self.config, view.bodies
        found = features.values(EDGE_FEATURES, config.edge_features, view)
        edges, receiver = self.excess(found), view.receiver
        found = features.values(NODE_FEATURES, config.node_features, view)
        excess = self.excess(found).scatter_reduce(0, receiver, edges, "amax")
        averages = bodies.body_means(self.normaliser.joined(found, config.clip))
        return self.envelope.score(bodies, excess, averages)

    def excess(self, found: dict[str, Tensor]) -> Tensor:
        """How far some features (m, k) are outside, (m,): the largest of `Envelope.excess`."""
        x, names = torch.cat(list(found.values()), dim=1), tuple(found)
        scales = (row.to(x) for row in self.normaliser.rows(names))
        return self.envelope.excess(names, x, *scales).amax(dim=1)

    def in_metres(self, view: FeatureView, x: Tensor) -> Tensor:
        """The network's output (n, 3) as a correction."""
        x = x * self.normaliser.output_scale.to(x)
        if self.config.output == "frame":
            size = view.size * view.bodies.by_node(view.deformation)[:, None]
            x = size * turned(view.frames, x)
        x = torch.where(view.bodies.free, x, 0.0)
        return without_momentum(view, x) if self.config.momentum_neutral else x

    def target(self, view: FeatureView, correction: Tensor) -> Tensor:
        """What the network should give, before the output's scale, for a correction (n, 3)."""
        if self.config.output == "world":
            return correction
        return turned_back(view.frames, correction) / (view.size * view.scale)


def check_corrector(corrector: object, device: torch.device) -> Corrector:
    """A corrector that can be asked on a device; others are refused with an `InputError`."""
    if not isinstance(corrector, Corrector):
        raise InputError(f"corrector is a {type(corrector).__name__}: expected a Corrector.")
    if not corrector.normaliser.fitted:
        raise InputError(
            "corrector: its normaliser has seen no data, so its inputs and output have no "
            "scale. Expected one that was trained or loaded."
        )
    found = corrector.normaliser.output_scale.device
    if found != device:
        raise InputError(
            f"corrector: on {found}, expected {device} as the coarse solver: move it there "
            f"with corrector.to({str(device)!r})."
        )
    return corrector


def without_momentum(view: FeatureView, correction: Tensor) -> Tensor:
    """The correction less the rigid motion of the wholly free nodes that has their momenta.

    Nodes with a held component keep theirs: clamps take up what they have.
    """
    bodies = view.bodies
    carries = bodies.free.all(dim=1, keepdim=True)
    mass = bodies.mass[:, None] * carries.to(correction.dtype)
    total = bodies.node_sums(mass)
    share = mass / bodies.by_node(torch.where(total > 0.0, total, 1.0))  # exactly 1 of one node
    centre = bodies.node_sums(share * view.snapshot.proposed)
    r = view.snapshot.proposed - bodies.by_node(centre)
    mean = bodies.node_sums(share * correction)
    spin = bodies.node_sums(torch.linalg.cross(r, mass * correction))
    identity = torch.eye(3, dtype=r.dtype, device=r.device)
    outer = r[:, :, None] * r[:, None, :]
    moments = (r.square().sum(dim=1)[:, None, None] * identity - outer) * mass[..., None]
    inertia = bodies.node_sums(moments)
    trace = inertia.diagonal(dim1=1, dim2=2).sum(dim=1)
    least = torch.where(trace > 0.0, _LEAST_INERTIA * trace, 1.0)
    # regular by construction; unlike `solve` this does not wait for the device to say so
    turn, _ = torch.linalg.solve_ex(inertia + least[:, None, None] * identity, spin)
    motion = bodies.by_node(mean) + torch.linalg.cross(bodies.by_node(turn), r)
    return torch.where(carries, correction - motion, correction)


_LEAST_INERTIA = 1e-12
"""Of the trace, added so that nodes on a line or at a point can be solved for."""
