"""What a mesh file holds, before it becomes a `HexMesh`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import MeshError

Integers = NDArray[np.int64]


class Block(NamedTuple):
    """Elements (n, K) of one kind, by meshio's name for it, and their dimension."""

    kind: str
    dimension: int
    nodes: Integers


class Content(NamedTuple):
    """Points (P, 3) in the file's unit, elements, and groups by name.

    Blocks name points by their place in ``points``, in VTK order; groups of elements name these
    by their place in all blocks, one after the other.
    """

    points: NDArray[np.float64]
    blocks: list[Block]
    element_groups: dict[str, Integers]
    node_groups: dict[str, Integers]


def chosen(blocks: list[Block], elements: Integers) -> list[Block]:
    """What the blocks hold of some elements, which are counted through all blocks."""
    out, start = [], 0
    for block in blocks:
        own = elements[(elements >= start) & (elements < start + len(block.nodes))]
        if len(own):
            out.append(block._replace(nodes=block.nodes[own - start]))
        start += len(block.nodes)
    return out


def nodes_of(blocks: list[Block], elements: Integers) -> Integers:
    """Nodes (k,) of some elements, which are counted through all blocks."""
    nodes = [block.nodes.ravel() for block in chosen(blocks, elements)]
    return np.concatenate([np.zeros(0, np.int64), *nodes])


def check_once(numbers: Integers, what: str) -> None:
    """Refuse numbers that come twice; ``what`` names the file and the kind."""
    found, counts = np.unique(numbers, return_counts=True)
    if counts.max(initial=1) > 1:
        raise MeshError(f"{what} {found[counts.argmax()]} comes twice: expected it once.")


def places(numbers: Integers, wanted: list[Integers], what: str) -> list[Integers]:
    """Where each of ``wanted`` stands in ``numbers``, which may be sparse and in any order.

    Raises
    ------
    MeshError
        If one is missing, or stands there twice; ``what`` names the file.
    """
    check_once(numbers, f"{what}: node")
    order = np.argsort(numbers)
    ordered = numbers[order]
    every = np.concatenate([np.zeros(0, np.int64), *(part.ravel() for part in wanted)])
    place = np.searchsorted(ordered, every)
    missing = np.append(ordered, -1)[place] != every
    if missing.any():
        raise MeshError(
            f"{what}: its elements refer to nodes that the file does not hold, such as "
            f"{every[missing][0]}: expected every node of an element in the file."
        )
    ends = np.cumsum([part.size for part in wanted])
    found = np.split(order[place], ends[:-1])
    return [own.reshape(part.shape) for own, part in zip(found, wanted, strict=False)]
