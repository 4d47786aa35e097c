"""What is wrong with the values of a model, in the same words for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError

from pdcorrect.known_keys import advice
from pdcorrect.toml_text import as_toml

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Location = tuple[int | str, ...]

_LONGEST = 80
"""Characters of a value."""

WORDS = {
    "bool_parsing": "expected true or false",
    "bool_type": "expected true or false",
    "dict_type": "expected a table of keys",
    "finite_number": "expected a finite number",
    "float_type": "expected a number",
    "greater_than": "expected more than {gt}",
    "greater_than_equal": "expected at least {ge}",
    "int_type": "expected an integer",
    "less_than": "expected less than {lt}",
    "less_than_equal": "expected at most {le}",
    "list_type": "expected a list",
    "literal_error": "expected {expected}",
    "model_attributes_type": "expected a table of keys",
    "model_type": "expected a table of keys",
    "path_type": "expected a path",
    "string_too_long": "expected at most {max_length} characters",
    "string_type": "expected a string",
    "string_unicode": "expected a text of Unicode characters",
    "too_long": "expected a list of at most {max_length}, got {actual_length}",
    "too_short": "expected a list of at least {min_length}, got {actual_length}",
    "tuple_type": "expected a list",
    "union_tag_invalid": "expected one of {expected_tags}",
}
"""By the type of pydantic's error, with names of what it tells besides."""


def dotted(location: Location) -> str:
    """A key and those that lead to it, entries of lists by their numbers: stages.0.batch."""
    return ".".join(map(str, location))


def explained(
    error: ValidationError,
    model: type[BaseModel],
    name: Callable[[Location], str] = dotted,
) -> str:
    """One paragraph: each wrong key, its value, and what was expected.

    Parameters
    ----------
    error
    model
        That was to be made, whose keys are known.
    name : callable, optional
        How keys are written, by where pydantic says that they are.
    """
    items = error.errors()
    sentences = [_sentence(item, model, name) for item in items if not _counts_wrong(item, items)]
    return " ".join(" ".join(dict.fromkeys(sentences)).split())


def _counts_wrong(item: ErrorDetails, items: Sequence[ErrorDetails]) -> bool:
    """Whether it finds a list too short whose wrong entries it has not counted."""
    place = item["loc"]
    return item["type"] == "too_short" and any(
        other is not item and other["loc"][: len(place)] == place for other in items
    )


def _sentence(item: ErrorDetails, model: type[BaseModel], name: Callable[[Location], str]) -> str:
    kind, key, value = item["type"], name(item["loc"]), item["input"]
    if kind == "extra_forbidden":
        return f"{key}: unknown key; {advice(item['loc'], model)}"
    if kind in ("union_tag_not_found", "union_tag_invalid"):  # wrong is the key that chooses
        chooses = item["ctx"]["discriminator"].strip("'")
        key = f"{key}.{chooses}"
        value = value.get(chooses) if isinstance(value, dict) else item["ctx"].get("tag")
    if kind in ("missing", "union_tag_not_found"):
        return f"{key}: missing; a value is required."
    told = f"{key} = {_shown(value)}: {_in_words(item)}" if key else _in_words(item)
    return told if told.endswith((".", "?")) else f"{told}."


def _shown(value: Any) -> str:
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_none=True)
    text = as_toml(value)
    return text if len(text) < _LONGEST else f"{text[: _LONGEST - 3]}..."


def _in_words(item: ErrorDetails) -> str:
    kind, message, context = item["type"], item["msg"], item.get("ctx", {})
    if kind in WORDS:
        return WORDS[kind].format(**{name: _number(value) for name, value in context.items()})
    if kind == "value_error":
        return message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:]


def _number(value: Any) -> Any:
    return f"{value:g}" if isinstance(value, float) else value
