"""Settings from TOML or keywords: number types, strict models, and one text for what is wrong."""

from __future__ import annotations

import functools
import json
import re
import tomllib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self

import tomli_w
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from pdcorrect.errors import InputError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Axis = Literal["x", "y", "z"]
Number = Annotated[float, Field(strict=True, ge=-1e30, le=1e30)]
Count = Annotated[int, Field(strict=True, ge=0, le=10**9)]
PositiveCount = Annotated[int, Field(strict=True, ge=1, le=10**9)]
Positive = Annotated[float, Field(strict=True, gt=0, le=1e30)]
NonNegative = Annotated[float, Field(strict=True, ge=0, le=1e30)]
Poisson = Annotated[float, Field(strict=True, ge=0, lt=0.5)]
Vector = tuple[Number, Number, Number]


def _not_zero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not sum(x * x for x in vector) > 0.0:
        raise ValueError("expected a direction, not the zero vector")
    return vector


def _possible(path: Path) -> Path:
    if not path.name:
        raise ValueError("expected the path of a file")
    if min(str(path)) < " ":
        raise ValueError(f"expected a path without control characters. {NO_BACKSLASHES}")
    return path


FilePath = Annotated[Path, AfterValidator(_possible)]
Direction = Annotated[Vector, AfterValidator(_not_zero)]
Cells = tuple[PositiveCount, PositiveCount, PositiveCount]

NO_BACKSLASHES = "Write paths with / or between single quotes: in double quotes \\ is an escape"
"""Advice on paths of Windows."""

_DEEPEST_NESTING = 100
_LONGEST_INTEGER = 1024  # bits; Python refuses to write out much longer ones
_LONGEST_VALUE = 80  # characters of a value in a message
_MOST_SENTENCES = 8  # of a message

_WORDS = {
    "dict_type": "expected a table of keys",
    "float_type": "expected a number",
    "int_type": "expected an integer",
    "list_type": "expected a list",
    "model_attributes_type": "expected a table of keys",
    "model_type": "expected a table of keys",
    "path_type": "expected a path",
    "string_type": "expected a string",
    "too_long": "expected a list of at most {max_length}, got {actual_length}",
    "too_short": "expected a list of at least {min_length}, got {actual_length}",
    "tuple_type": "expected a list",
    "union_tag_invalid": "expected one of {expected_tags}",
}
"""By the type of pydantic's error, where its own words would tell of Python."""


class Strict(BaseModel):
    """Base of all settings: unknown keys, infinite and NaN numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Checked(Strict):
    """Settings whose constructor answers wrong values with the package's own ``error``."""

    source: ClassVar[str] = "configuration"
    error: ClassVar[type[InputError]] = InputError

    def __init__(self, /, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise self.error(f"{self.source}: {explained(error, type(self))}") from None


class TomlConfig(Checked):
    """Checked settings that can be read from TOML and written to it."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read settings from a TOML file; the class's ``error`` says what is wrong with it."""
        if not isinstance(path, (str, Path)) or not str(path).strip() or "\n" in str(path):
            raise cls.error(f"path is {_shown(path)}: expected the path of a TOML file.")
        try:
            text = Path(path).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            kind = "UTF-16" if error.object[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "not UTF-8"
            raise cls.error(f"{path}: cannot be read ({kind}): save it as UTF-8.") from None
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise cls.error(f"{path}: cannot be read ({reason}).") from None
        return cls.from_toml(text, str(path))

    @classmethod
    def from_toml(cls, text: str, source: str = "") -> Self:
        """Read settings from TOML text; ``source`` names it in messages."""
        source = source or cls.source
        try:
            data = parse_toml(text)
        except ValueError as error:
            raise cls.error(
                f"{source}: not valid TOML: {error}.{_advice_on(error, text)}"
            ) from None
        if data and not set(data) & set(cls.model_fields):
            found, expected = _listed(data), _listed(cls.model_fields)
            raise cls.error(f"{source}: has {found}: expected a {cls.source}, with {expected}.")
        try:
            return cls(**data)
        except InputError as error:
            raise cls.error(str(error).replace(f"{cls.source}:", f"{source}:", 1)) from None

    def to_toml(self) -> str:
        """The settings as TOML, with every default written out."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True, by_alias=True))


def parse_toml(text: str) -> dict[str, Any]:
    """Read TOML; `ValueError` also where Python could not show or nest what it holds."""
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"nested more than {_DEEPEST_NESTING} deep") from None
    level: list[Any] = [data]
    for _ in range(_DEEPEST_NESTING):
        level = [part for value in level for part in _parts(value)]
    if level:
        raise ValueError(f"nested more than {_DEEPEST_NESTING} deep")
    return data


def _advice_on(error: ValueError, text: str) -> str:
    """What to do if the line that an error names has a backslash, as of a path of Windows."""
    place = re.search(r"at line (\d+)", str(error))
    line = text.split("\n")[int(place[1]) - 1] if place else ""
    return f" {NO_BACKSLASHES}." if "\\" in line else ""


def _parts(value: Any) -> list[Any]:
    """What a list or table holds; nothing for any other value of a usable size."""
    if isinstance(value, int) and value.bit_length() > _LONGEST_INTEGER:
        raise ValueError(f"an integer of more than {_LONGEST_INTEGER} bits")
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


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


def explained(error: ValidationError, model: type[BaseModel]) -> str:
    """One paragraph: each wrong key, its value, and what was expected."""
    tables = _tables_of(model)
    items = sorted(error.errors(), key=lambda x: x["type"] != "extra_forbidden")
    nested = {item["loc"][:k] for item in items for k in range(len(item["loc"]))}
    every: dict[str, list[str]] = {}
    for item in items:
        if item["loc"] not in nested:
            key, told = _sentence(item, tables)
            every.setdefault(key, []).append(told)
    sentences = [_joined(*one) for one in list(every.items())[:_MOST_SENTENCES]]
    if len(every) > len(sentences):
        sentences.append(f"And {len(every) - len(sentences)} more.")
    return " ".join(" ".join(sentences).split())


class _Table(NamedTuple):
    """Its dotted place, how a message names it ("" for the top), whether a key chooses its kind."""

    place: str
    name: str
    tagged: bool
    keys: frozenset[str]


def _joined(key: str, told: Sequence[str]) -> str:
    """One sentence of what is wrong with a key: one thing, or the members of a union."""
    first, *others = dict.fromkeys(told)
    others = [text.removeprefix("expected ") for text in others]
    text = ", or ".join([first, *others])
    text = f"{key}: {text}" if key else text
    return text if text.endswith((".", "?")) else f"{text}."


def _sentence(item: ErrorDetails, tables: Sequence[_Table]) -> tuple[str, str]:
    """A key, with its value, and what is wrong with it."""
    kind, location, value = item["type"], item["loc"], item["input"]
    context = item.get("ctx", {})
    key = _key(location, tables, kind == "extra_forbidden")
    if kind == "extra_forbidden":
        return key, f"unknown key; {_advice(key, tables)}"
    if kind in ("union_tag_not_found", "union_tag_invalid"):  # wrong is the key that chooses
        chooses = str(context["discriminator"]).strip("'")
        key, value = f"{key}.{chooses}", value.get(chooses) if isinstance(value, dict) else value
    if kind in ("missing", "union_tag_not_found"):
        return key, "missing; a value is required."
    told = item["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
    told = _WORDS[kind].format(**context) if kind in _WORDS else told
    if kind in ("list_type", "tuple_type") and isinstance(value, dict):
        told += f": begin the table with [[{key}]]"
    if key and (value is not None or kind != "value_error"):
        key = f"{key} = {_shown(value)}"
    return key, f"{told[:1].lower()}{told[1:]}" if key else told


def _key(location: tuple[int | str, ...], tables: Sequence[_Table], unknown: bool) -> str:
    """A key as the user wrote it, ``loads[0].force``: pydantic also names union members."""
    known = frozenset().union(*(table.keys for table in tables))
    tagged = {table.place for table in tables if table.tagged}
    text, place, tag_is_next = "", "", False
    for number, part in enumerate(location, 1):
        if isinstance(part, int):
            text += f"[{part}]"
        elif tag_is_next:
            tag_is_next = False
        elif part in known or (unknown and number == len(location)):
            text += f".{part}"
            place = f"{place}.{part}".lstrip(".")
            tag_is_next = place in tagged
    return _cut(text.lstrip("."))


def _shown(value: Any) -> str:
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_none=True)
    return _cut(as_toml(value))


def _cut(text: str) -> str:
    return text if len(text) < _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _listed(names: Iterable[str]) -> str:
    return _cut(", ".join(names))


def _advice(key: str, tables: Sequence[_Table]) -> str:
    """Where an unknown key belongs, or which one was probably meant."""
    *above, name = key.split(".")
    homes = [table.name or "the top" for table in tables if name in table.keys]
    if homes:
        return f"it belongs to {' or '.join(dict.fromkeys(homes))}."
    place = ".".join(part.partition("[")[0] for part in above)
    here = [table for table in tables if table.place == place]
    for group, cutoff in ((here, 0.65), (tables, 0.8)):
        known = sorted({key for table in group for key in table.keys})
        close = get_close_matches(name, known, n=1, cutoff=cutoff)
        close = close or [key for key in known if name in key.split("_")][:1]
        if close:
            (own, *_) = (table.name for table in group if close[0] in table.keys)
            return f"did you mean {close[0]}{own and f' of {own}'}?"
    return "remove it or check its spelling."


@functools.cache
def _tables_of(model: type[BaseModel]) -> tuple[_Table, ...]:
    return tuple(_tables(model.model_json_schema()))


def _tables(schema: Mapping[str, Any]) -> Iterator[_Table]:
    """All tables of a model's JSON schema, the top first."""
    definitions = schema.get("$defs", {})

    def walk(
        node: Mapping[str, Any], place: tuple[str, ...], several: bool, chosen: str
    ) -> Iterator[_Table]:
        if "$ref" in node:
            node = definitions[node["$ref"].rsplit("/", 1)[1]]
        if "discriminator" in node:
            key = node["discriminator"]["propertyName"]
            for kind, target in node["discriminator"]["mapping"].items():
                yield from walk({"$ref": target}, place, several, f' with {key} = "{kind}"')
            return
        for part in (*node.get("anyOf", ()), *node.get("allOf", ())):
            yield from walk(part, place, several, chosen)
        if "items" in node:
            yield from walk(node["items"], place, True, "")
        if "properties" in node:
            dotted = ".".join(place)
            header = f"[[{dotted}]]" if several else f"[{dotted}]" if dotted else ""
            yield _Table(dotted, header + chosen, bool(chosen), frozenset(node["properties"]))
            for name, part in node["properties"].items():
                yield from walk(part, (*place, name), False, "")

    return walk(schema, (), False, "")
