"""What was measured of each method, and which of them count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

FITTED = "fitted stiffness"
"""Fitted to the very scene: shown, but no one's rival."""
NEARER = 0.99
"""Of the error of what is quicker: more is no gain."""
FAMILIES = ("coarse mesh, 8-node elements", "coarse mesh, other elements", "finer mesh",
            "other tolerance", "Newton", "hybrid")  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What a method reached: nodes, ms a frame, RMS error in m on the coarse nodes."""

    name: str
    family: str
    nodes: int
    milliseconds: float
    error: float


@dataclass(frozen=True)
class Measured:
    """What was measured in a scene, of which figures, tables and the picture are made.

    Attributes
    ----------
    motion, setting : str
    rows : sequence of Row
    reference : Row
        The reference's own time and nodes.
    scale : float
        Largest displacement, m.
    """

    motion: str
    setting: str
    rows: Sequence[Row]
    reference: Row
    scale: float


def quickest(rows: Sequence[Row], error: float) -> Row:
    """With at most so much error."""
    return min((r for r in rows if r.error <= error), key=lambda r: r.milliseconds)


def nearest(rows: Sequence[Row], milliseconds: float) -> Row:
    """In at most so much time."""
    return min((r for r in rows if r.milliseconds <= milliseconds), key=lambda r: r.error)


def front(rows: Sequence[Row]) -> list[Row]:
    """Those that nothing quicker is as near as, to `NEARER`, quickest first."""
    out: list[Row] = []
    for row in sorted(rivals(rows), key=lambda r: (r.milliseconds, r.error)):
        if not out or row.error < NEARER * out[-1].error:
            out.append(row)
    return out


def rivals(rows: Sequence[Row]) -> list[Row]:
    """All but what was fitted to the scene."""
    return [row for row in rows if row.name != FITTED]
