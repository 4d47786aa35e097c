"""Records that the tables of the documentation quote, and how their numbers are written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "validation" / "results"

Rows = tuple[Sequence[str], Iterable[Sequence[str]]]
"""A table: its header's cells, and the cells of its rows."""


def read(path: str | Path) -> Any:
    """The JSON record at ``path``, relative to the repository's root."""
    return json.loads((ROOT / path).read_text(encoding="utf-8"))


def number(value: float | None, digits: int = 3) -> str:
    """``value`` to ``digits`` significant digits; a dash for none.

    >>> [number(x) for x in (0.9996, 9.996, 99.94, 99.96, 1234.5, None)]
    ['1.00', '10.0', '99.9', '100', '1234', '–']
    >>> [number(x, 2) for x in (9.94, 9.96, 0.0)]
    ['9.9', '10', '0.0']
    """
    if value is None:
        return "–"
    text = f"{value:.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:#.{digits}g}"
    return text.removesuffix(".")  # 9.96 to two digits is "10."


def percent(value: float, digits: int = 1) -> str:
    """``value`` to ``digits`` places after the point, with a true minus sign."""
    return f"{value:.{digits}f}".replace("-", "−")


def interval(ends: Sequence[float], digits: int = 1) -> str:
    """A 95 % interval."""
    return " to ".join(percent(end, digits) for end in ends)
