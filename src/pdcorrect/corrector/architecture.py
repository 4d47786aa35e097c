"""`CorrectorConfig`: everything that determines a corrector but its weights; presets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, ValidationError, field_validator

from pdcorrect._config import Positive, PositiveCount, Strict, explained
from pdcorrect.corrector import features
from pdcorrect.errors import InputError

Placement = Literal["state", "force", "guess"]


class CorrectorConfig(Strict):
    """A corrector's architecture.

    Attributes
    ----------
    node_features, edge_features
        Names from `pdcorrect.corrector.features`.
    layers, width, mlp_layers, norm, shared
        See `pdcorrect.corrector.network.MeshGraphNetwork`.
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
    placement
        What is corrected: the coarse solver's answer.  Model files name it.
    """

    node_features: tuple[str, ...]
    edge_features: tuple[str, ...]
    layers: PositiveCount
    width: PositiveCount
    mlp_layers: Annotated[int, Field(strict=True, ge=2)]
    norm: Literal["hidden", "all", "none"] = "hidden"
    shared: bool = False
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
