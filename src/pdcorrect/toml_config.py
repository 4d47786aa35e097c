"""`TomlConfig`: typed settings in TOML files, with errors that name the key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Self

import tomli_w
from pydantic import ValidationError

from pdcorrect.errors import InputError
from pdcorrect.scene.regions import Strict
from pdcorrect.toml_text import parse_toml

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class TomlConfig(Strict):
    """Settings that can be read from TOML; unknown keys are refused."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a configuration from a TOML file.

        Raises
        ------
        InputError
            If the file cannot be read, is not TOML, or a key is wrong.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "not a UTF-8 text file"
            raise InputError(f"{path}: cannot be read ({reason}).") from None
        return cls.from_toml(text, str(path))

    @classmethod
    def from_toml(cls, text: str, source: str = "configuration") -> Self:
        """Read a configuration from TOML text; ``source`` names it in messages."""
        try:
            data = parse_toml(text)
        except ValueError as error:
            raise InputError(f"{source}: not valid TOML: {error}.") from None
        try:
            return cls(**data)
        except ValidationError as error:
            raise InputError(f"{source}: {explained(error)}") from None

    def to_toml(self) -> str:
        """The configuration as TOML, with every default written out."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


def as_toml(value: object) -> str:
    """A value as it would stand in a TOML file, on one line, for messages."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {as_toml(own)}' for key, own in value.items())} }}"
    return str(value)


def explained(error: ValidationError) -> str:
    """Of each wrong key its value and what was expected, in sentences."""
    return " ".join(map(_sentence, error.errors()))


def _sentence(item: ErrorDetails) -> str:
    key, message = ".".join(map(str, item["loc"])), _in_words(item["msg"])
    if item["type"] == "extra_forbidden":
        return f"{key}: unknown key; remove it or check its spelling."
    if item["type"] == "missing":
        return f"{key}: missing; a value is required."
    if item["type"] == "model_type":
        message = "expected a table of keys"
    return f"{key} = {as_toml(item['input']):.80}: {message}." if key else f"{message}."


_WORDS = (
    ("Value error, ", ""),
    ("Input should be greater than or equal to", "expected at least"),
    ("Input should be less than or equal to", "expected at most"),
    ("Input should be greater than", "expected more than"),
    ("Input should be less than", "expected less than"),
    ("Input should be a valid integer", "expected an integer"),
    ("Input should be a valid tuple", "expected a list"),
    ("Input should be a valid", "expected a"),
    ("Input should be", "expected"),
)
"""How pydantic's messages begin, and what stands there in ours."""


def _in_words(message: str) -> str:
    for theirs, ours in _WORDS:
        if message.startswith(theirs):
            return ours + message.removeprefix(theirs)
    return message
