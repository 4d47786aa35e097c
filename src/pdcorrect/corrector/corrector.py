"""`Corrector`: features, network and built-in physics, from a snapshot to a correction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn

from pdcorrect.corrector import features
from pdcorrect.corrector.architecture import CorrectorConfig, MeshGraphNetwork
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, FeatureView, Snapshot
from pdcorrect.corrector.frames import turned, turned_back
from pdcorrect.corrector.normaliser import Envelope, Normaliser
from pdcorrect.errors import InputError


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
