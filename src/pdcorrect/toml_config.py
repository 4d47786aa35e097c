"""`TomlConfig`: typed settings in TOML files, with errors that name the key."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Self

import tomli_w
from pydantic import ValidationError

from pdcorrect.errors import InputError
from pdcorrect.scene.regions import Strict


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
            return cls(**tomllib.loads(text))
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{source}: not valid TOML: {error}.") from None
        except ValidationError as error:
            raise InputError(f"{source}: {_explain(error)}") from None

    def to_toml(self) -> str:
        """The configuration as TOML, with every default written out."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


def _explain(error: ValidationError) -> str:
    sentences = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"]) or "the configuration"
        if item["type"] == "extra_forbidden":
            sentences.append(f"{key}: unknown key; remove it or check its spelling.")
        elif item["type"] == "missing":
            sentences.append(f"{key}: missing; a value is required.")
        else:
            message = item["msg"].removeprefix("Value error, ")
            sentences.append(f"{key} = {item['input']!r:.80}: {message}.")
    return " ".join(sentences)
