"""Keys that the tables of a model know, and what an unknown one was probably meant for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel

_ALIKE = 0.65
"""How alike a key of the same table has to be, of 1."""

_ALIKE_ELSEWHERE = 0.8
"""How alike a key of another table has to be."""


@dataclass(frozen=True)
class Table:
    """Where a table is and which keys it may have.

    Attributes
    ----------
    place
        Keys that lead to it, and the kind that was chosen where there are several.
    header
        As in TOML; empty for the top.
    choice
        What makes it one of several kinds of tables under one header, such as 'shape = "beam"'.
    keys
    """

    place: tuple[str, ...]
    header: str
    choice: str
    keys: frozenset[str]


def advice(location: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """What to do about an unknown key of a model: half a sentence with its full stop.

    Parameters
    ----------
    location
        As pydantic tells it, the key last.
    model
        Of the whole.
    """
    name = str(location[-1])
    place = tuple(part for part in location[:-1] if isinstance(part, str))
    tables = tables_of(model)
    own = next((table for table in tables if table.place == place), None)
    others = [table for table in tables if table is not own]
    same = _nearest([table for table in others if name in table.keys], place)
    if same:
        return f"it {_belonging(same, own)}."
    close = _closest(name, own.keys, _ALIKE) if own else None
    if close:
        return f"did you mean {close}?"
    close = _closest(name, {key for table in others for key in table.keys}, _ALIKE_ELSEWHERE)
    if close:
        same = _nearest([table for table in others if close in table.keys], place)
        return f"did you mean {close}, which {_belonging(same, own)}?"
    return "remove it or check its spelling."


def tables_of(model: type[BaseModel]) -> tuple[Table, ...]:
    """All tables of a model, the top first."""
    schema = model.model_json_schema()
    return tuple(_tables(schema, schema.get("$defs", {}), (), ()))


def _tables(
    node: Mapping[str, Any],
    definitions: Mapping[str, Any],
    place: tuple[str, ...],
    names: tuple[str, ...],
    several: bool = False,
    choice: str = "",
) -> Iterator[Table]:
    """Tables of a part of a JSON schema; ``names`` is ``place`` without the kinds chosen."""
    if "$ref" in node:
        node = definitions[node["$ref"].rsplit("/", 1)[1]]
    if "discriminator" in node:
        key, kinds = node["discriminator"]["propertyName"], node["discriminator"]["mapping"]
        for kind, target in kinds.items():
            one = {"$ref": target}
            told = f'{key} = "{kind}"'
            yield from _tables(one, definitions, (*place, kind), names, several, told)
        return
    for part in (*node.get("anyOf", ()), *node.get("allOf", ())):
        yield from _tables(part, definitions, place, names, several, choice)
    if "items" in node:
        yield from _tables(node["items"], definitions, place, names, several=True)
    if "properties" in node:
        header = f"[{'.'.join(names)}]" if names else ""
        header = f"[{header}]" if several else header
        yield Table(place, header, choice, frozenset(node["properties"]))
        for name, part in node["properties"].items():
            yield from _tables(part, definitions, (*place, name), (*names, name))


def _nearest(tables: list[Table], place: tuple[str, ...]) -> list[Table]:
    """Those above or below a place, or all if none is."""
    near = [t for t in tables if all(a == b for a, b in zip(t.place, place, strict=False))]
    return near or tables


def _belonging(tables: list[Table], own: Table | None) -> str:
    """To which tables a key belongs, one of them at least."""
    kinds = [t.choice for t in tables if own and t.header == own.header and t.choice]
    if kinds:
        return f"goes with {_either(kinds)}"
    headers = dict.fromkeys(table.header for table in tables)
    return f"belongs {_either(f'to {h}' if h else 'to the top, above all tables' for h in headers)}"


def _either(texts: Iterable[str]) -> str:
    *first, last = texts
    return f"{', '.join(first)} or {last}" if first else last


def _closest(name: str, keys: Iterable[str], alike: float) -> str | None:
    """The key that is spelled much like a name, or the only one that has it as a part."""
    close = get_close_matches(name, sorted(keys), n=1, cutoff=alike)
    having = [key for key in keys if name in key.split("_")]
    return close[0] if close else having[0] if len(having) == 1 else None
