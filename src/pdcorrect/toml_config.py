"""`TomlConfig`: typed settings in TOML files, with errors that name the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

import tomli_w
from pydantic import ValidationError

from pdcorrect.errors import InputError
from pdcorrect.explanations import explained
from pdcorrect.scene.regions import Strict
from pdcorrect.toml_files import read_tables, read_text

_SOURCE = "configuration"
"""Names a configuration in messages that does not come from a file."""


class TomlConfig(Strict):
    """Settings that can be read from TOML; unknown keys are refused.

    Attributes
    ----------
    kind
        Which configuration it is, of `pdcorrect.toml_files`.

    Raises
    ------
    InputError
        If a key is wrong.
    """

    kind: ClassVar[str]

    def __init__(self, /, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise InputError(f"{_SOURCE}: {explained(error, type(self))}") from None

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a configuration from a TOML file.

        Raises
        ------
        InputError
            If the file cannot be read, is not TOML, looks like something else, or a key is wrong.
        """
        return cls.from_toml(read_text(path, cls.kind), str(path))

    @classmethod
    def from_toml(cls, text: str, source: str = _SOURCE) -> Self:
        """Read a configuration from TOML text; ``source`` names it in messages."""
        data = read_tables(text, cls.kind, source)
        try:
            return cls(**data)
        except InputError as error:
            raise InputError(str(error).replace(_SOURCE, source, 1)) from None

    def to_toml(self) -> str:
        """The configuration as TOML, with every default written out."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))
