"""TOML text to plain values; whatever is wrong with it becomes one sentence.  A value as TOML."""

from __future__ import annotations

import json
import tomllib
from pathlib import PurePath
from typing import Any

_DEEPEST = 100
"""Lists and tables inside each other."""

_LONGEST = 1024
"""Bits of an integer."""


def parse_toml(text: str) -> dict[str, Any]:
    """Read TOML, if it can be worked with.

    Raises
    ------
    ValueError
        If it is not TOML, nested so deeply that reading it overflows the stack, or holds
        integers so long that Python does not write them out.
    """
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_nested()) from None
    level: list[Any] = [data]
    for _ in range(_DEEPEST):
        level = [part for value in level for part in _parts(value)]
    if level:
        raise ValueError(_nested())
    return data


def as_toml(value: object) -> str:
    """A value as it would stand in a TOML file, on one line, for messages."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, PurePath)):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {as_toml(own)}' for key, own in value.items())} }}"
    return str(value)


def _parts(value: Any) -> list[Any]:
    """What a list or table holds; nothing for any other value that is of a usable size."""
    if isinstance(value, int) and value.bit_length() > _LONGEST:
        raise ValueError(f"an integer of more than {_LONGEST} bits")
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


def _nested() -> str:
    return f"lists or tables nested more than {_DEEPEST} deep"
