"""What a corrector's network costs: its operations for a graph."""

from __future__ import annotations

from itertools import pairwise

from pdcorrect.corrector import features
from pdcorrect.corrector.corrector import CorrectorConfig

OUTPUTS = 3
"""Components of the network's output."""


def flops(config: CorrectorConfig, nodes: int, edges: int) -> int:
    """Operations of one call for n nodes and E directed edges: twice the multiply-adds.

    Those of the linear maps; their biases, ReLU, LayerNorm, sums over edges, and the
    features are left out.
    """
    width, layers = config.width, config.mlp_layers
    of_node, of_edge = _inputs(config)
    square = width * width
    encoders = nodes * _maps(of_node, width, width, layers)
    encoders += edges * _maps(of_edge, width, width, layers)
    # the first map of the edges' network is applied to nodes and edges apart
    one = edges * layers * square + 2 * nodes * square
    one += nodes * _maps(2 * width, width, width, layers)
    decoder = nodes * _maps(width, width, OUTPUTS, layers)
    return 2 * (encoders + config.layers * one + decoder)


def _inputs(config: CorrectorConfig) -> tuple[int, int]:
    return (
        features.width(features.NODE_FEATURES, config.node_features),
        features.width(features.EDGE_FEATURES, config.edge_features),
    )


def _maps(inputs: int, width: int, outputs: int, layers: int) -> int:
    """Multiply-adds of an MLP for one row."""
    return sum(a * b for a, b in pairwise([inputs, *[width] * (layers - 1), outputs]))
