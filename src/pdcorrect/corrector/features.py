"""What a corrector's network sees: features of nodes and edges, each by name.

*World* features are those of the thesis (sections 4.4 and 5.2), in SI units and the
scene's axes.  *Frame* features are lengths over the cell size, times over the time step,
in each node's own frame (`pdcorrect.corrector.frames`), and those that vanish with the
deformation are divided by its size s.  So they do not change when the scene is turned,
moved, renumbered or written in other units, nor, for small deformations, with its size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import torch
from torch import Tensor

from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.frames import (
    node_gradients,
    polar_rotations,
    product,
    turned_back,
    turns_between,
)
from pdcorrect.errors import InputError

STILL = 1e-9
"""Deformation (dimensionless) below which a body counts as not deformed.

Above the rounding errors of states in float64, but not of those in float32.
"""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A step of the bodies of a graph, as far as it is known when the network is asked.

    Attributes
    ----------
    positions, velocities : (n, 3)
        Before the step, m and m/s.
    proposed : (n, 3)
        After it, as the coarse solver found them, m.
    forces : (n, 3)
        Loads during the step, N.
    correction : (n, 3) or None
        Of the step before, m; None counts as zero.
    """

    positions: Tensor
    velocities: Tensor
    proposed: Tensor
    forces: Tensor
    correction: Tensor | None = None


class FeatureView:
    """A snapshot of bodies, and what features need of it, computed when first asked for.

    Attributes
    ----------
    known : dict of str to tensor
        Features by name (see `values`), which network and gate both look at.
    """

    def __init__(self, bodies: BodyGraph, snapshot: Snapshot) -> None:
        self.bodies, self.snapshot = bodies, snapshot
        self.known: dict[str, Tensor] = {}

    @cached_property
    def size(self) -> Tensor:
        """Cell size at nodes, (n, 1), m."""
        return self.bodies.by_node(self.bodies.cell_size)[:, None]

    @cached_property
    def step(self) -> Tensor:
        """Time step at nodes, (n, 1), s."""
        return self.bodies.by_node(self.bodies.time_step)[:, None]

    @cached_property
    def receiver(self) -> Tensor:
        """Nodes that edges lead to, (E,) int64."""
        return self.bodies.edge_index[0]

    @cached_property
    def sender(self) -> Tensor:
        """Nodes that edges come from, (E,) int64."""
        return self.bodies.edge_index[1]

    @cached_property
    def gradients(self) -> Tensor:
        """Deformation gradients F (n, 3, 3), after the step."""
        bodies = self.bodies
        return node_gradients(
            self.snapshot.proposed, bodies.rest_inverses, bodies.cells, bodies.cell_counts
        )

    @cached_property
    def turns(self) -> Tensor:
        """Rotations R (n, 3, 3) of F = R U."""
        return polar_rotations(self.gradients)

    @cached_property
    def frames(self) -> Tensor:
        """Rotations (n, 3, 3), after the step."""
        return product(self.turns, self.bodies.rest_frames)

    @cached_property
    def receiver_frames(self) -> Tensor:
        """Frames of the edges' receivers, (E, 3, 3)."""
        return self.frames.index_select(0, self.receiver)

    @cached_property
    def strain(self) -> Tensor:
        """U - 1 in the node's frame, (n, 3, 3)."""
        identity = torch.eye(3, dtype=self.gradients.dtype, device=self.gradients.device)
        stretch = product(self.turns.transpose(1, 2), self.gradients) - identity
        return product(
            product(self.bodies.rest_frames.transpose(1, 2), stretch), self.bodies.rest_frames
        )

    @cached_property
    def deformation(self) -> Tensor:
        """Root mean square of the strain over each body, (B,); exactly 0 below `STILL`."""
        squares = self.bodies.body_means(self.strain.square().sum(dim=(1, 2)))
        moved = squares > STILL**2
        return torch.where(moved, torch.where(moved, squares, 1.0).sqrt(), 0.0)

    @cached_property
    def scale(self) -> Tensor:
        """Deformation at nodes, (n, 1), at least `STILL`."""
        return self.bodies.by_node(self.deformation.clamp_min(STILL))[:, None]

    @cached_property
    def unit(self) -> Tensor:
        """Cell size times deformation at nodes, (n, 1), m."""
        return self.size * self.scale

    @cached_property
    def receiver_unit(self) -> Tensor:
        """The same at the edges' receivers, (E, 1), m."""
        return self.unit.index_select(0, self.receiver)

    def edge_change(self, field: Tensor) -> Tensor:
        """Difference of a nodal field (n, 3) along edges, sender minus receiver, (E, 3)."""
        return field.index_select(0, self.sender) - field.index_select(0, self.receiver)

    def in_frame(self, x: Tensor) -> Tensor:
        """Nodal vectors (n, 3) in the node's frame, over cell size and deformation."""
        return turned_back(self.frames, x) / self.unit

    def in_receiver_frame(self, x: Tensor) -> Tensor:
        """Vectors (E, 3) of edges in the receiver's frame, over cell size and deformation."""
        return turned_back(self.receiver_frames, x) / self.receiver_unit


Feature = tuple[int, Callable[[FeatureView], Tensor]]
"""Number of components, and the values (n, k) or (E, k)."""


def _fixed(view: FeatureView) -> Tensor:
    fixed = ~view.bodies.free.all(dim=1)
    return torch.stack([~fixed, fixed], dim=1).to(view.bodies.rest.dtype)


def _acceleration(view: FeatureView) -> Tensor:
    """What the coarse solver adds to the motion by inertia."""
    state = view.snapshot
    return view.in_frame(state.proposed - state.positions - view.step * state.velocities)


def _load(view: FeatureView) -> Tensor:
    return view.in_frame(view.step**2 * view.snapshot.forces / view.bodies.mass[:, None])


def _correction(view: FeatureView) -> Tensor:
    previous = view.snapshot.correction
    if previous is None:
        return torch.zeros_like(view.snapshot.positions)
    return view.in_frame(previous)


def _stiffness(view: FeatureView) -> Tensor:
    """Logarithm of the squared number of cells that a wave crosses in a step."""
    body = view.bodies
    waves = body.young[:, None] * view.step**2 / (body.density[:, None] * view.size**2)
    return torch.log(waves)


def _strain(view: FeatureView) -> Tensor:
    six = _lower_triangle(view.strain.device)
    return view.strain.flatten(1).index_select(1, six) / view.scale


@cache
def _lower_triangle(device: torch.device) -> Tensor:
    """Where xx, yy, zz, yx, zx and zy are in the nine of a matrix."""
    with torch.inference_mode(False):
        return torch.tensor([0, 4, 8, 3, 6, 7], device=device)


def _rest_edge(view: FeatureView) -> Tensor:
    return _with_length(view.bodies.rest_edges / view.size.index_select(0, view.receiver))


def _stretch(view: FeatureView) -> Tensor:
    """Edge in the receiver's frame, minus that at rest in the frame at rest."""
    now = turned_back(view.receiver_frames, view.edge_change(view.snapshot.proposed))
    return (now - view.bodies.rest_edges) / view.receiver_unit


def _motion(view: FeatureView) -> Tensor:
    """Relative motion during the step."""
    state = view.snapshot
    return view.in_receiver_frame(view.edge_change(state.proposed - state.positions))


def _turn(view: FeatureView) -> Tensor:
    """Rotation between the frames of an edge's ends, beyond that at rest."""
    senders = view.frames.index_select(0, view.sender)
    now = turns_between(view.receiver_frames, senders)
    return (now - view.bodies.rest_turns) / view.scale.index_select(0, view.receiver)


def _with_length(x: Tensor) -> Tensor:
    return torch.cat([x, x.norm(dim=1, keepdim=True)], dim=1)


NODE_FEATURES: dict[str, Feature] = {
    "young": (1, lambda view: view.bodies.young[:, None]),
    "poisson": (1, lambda view: view.bodies.poisson[:, None]),
    "density": (1, lambda view: view.bodies.density[:, None]),
    "time-step": (1, lambda view: view.step),
    "velocity": (3, lambda view: (view.snapshot.proposed - view.snapshot.positions) / view.step),
    "force": (3, lambda view: view.snapshot.forces),
    "node-type": (2, _fixed),
    "acceleration": (3, _acceleration),
    "load": (3, _load),
    "previous-correction": (3, _correction),
    "stiffness": (1, _stiffness),
    "strain": (6, _strain),
    "deformation": (1, lambda view: torch.log(view.scale)),
}
"""By name: of the thesis in world axes and SI units (the first seven), then in frames."""

EDGE_FEATURES: dict[str, Feature] = {
    "rest-position": (4, lambda view: _with_length(view.edge_change(view.bodies.rest))),
    "position": (4, lambda view: _with_length(view.edge_change(view.snapshot.proposed))),
    "rest-edge": (4, _rest_edge),
    "stretch": (3, _stretch),
    "motion": (3, _motion),
    "turn": (3, _turn),
}
"""By name: of the thesis (the first two), then in frames."""

UNSCALED = frozenset({"node-type"})
"""Features that are not normalised."""


def width(features: dict[str, Feature], names: Sequence[str]) -> int:
    """Components of some features together; an `InputError` if one is unknown or named twice."""
    for name in names:
        if name not in features:
            raise InputError(f"feature {name!r}: expected one of {', '.join(features)}.")
    if len(set(names)) < len(names):
        raise InputError(f"features {', '.join(names)}: expected each one once.")
    return sum(features[name][0] for name in names)


def values(
    features: dict[str, Feature], names: Sequence[str], view: FeatureView
) -> dict[str, Tensor]:
    """Some features of a view by name, each computed once."""
    for name in names:
        if name not in view.known:
            view.known[name] = features[name][1](view)
    return {name: view.known[name] for name in names}
