"""``model.json``: what the weights beside it belong to, checked when it is read.

Under ``checksum`` it has the SHA-256 of all its other content, in every version so far.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, JsonValue, ValidationError

from pdcorrect._config import Strict
from pdcorrect._environment import code_digest
from pdcorrect._version import __version__
from pdcorrect.corrector.architecture import CorrectorConfig
from pdcorrect.errors import FileFormatError, FileVersionError

FORMAT = "pdcorrect-model"
VERSION = 5
WEIGHTS, DESCRIPTION = "weights.safetensors", "model.json"

_CHECKSUM = "checksum"


class ModelRecord(Strict):
    """Where a model comes from.

    Attributes
    ----------
    dataset, dataset_hash
        Name of the data set, or names of several with a plus sign between them; and the hash of
        the configuration or content of what its last training learned.
    training, metrics
        Settings of the training, and what the model achieved; any JSON with finite numbers.
    code_version, code_digest
        Of the code that made it, see `pdcorrect._environment.code_digest`.
    """

    dataset: str
    dataset_hash: str
    training: dict[str, JsonValue] = Field(default_factory=dict)
    metrics: dict[str, JsonValue] = Field(default_factory=dict)
    code_version: str = __version__
    code_digest: str = Field(default_factory=code_digest)


class Description(Strict):
    """``model.json`` without its checksum; all versions of the format since 2 have these keys."""

    format: Literal["pdcorrect-model"] = "pdcorrect-model"
    version: int = VERSION
    architecture: CorrectorConfig
    parameters: int
    dtype: Literal["float32"] = "float32"
    normalisation: dict[str, list[float] | float]
    record: ModelRecord
    weights_sha256: str

    def to_json(self) -> str:
        """The file's text.

        Raises
        ------
        ValueError
            If a number is not finite.
        """
        content = self.model_dump(mode="json")
        whole = {**content, _CHECKSUM: content_digest(content)}
        return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def content_digest(content: dict[str, Any]) -> str:
    """SHA-256 of JSON content, however it is laid out."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_file(path: Path) -> bytes:
    """One of a model's two files.

    Raises
    ------
    FileFormatError
        If it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror or error}).") from None


def read_description(folder: Path) -> Description:
    """What ``model.json`` in a folder says, if it is whole.

    Raises
    ------
    FileFormatError
        If it is damaged.
    FileVersionError
        If it was written in another version of the format.
    """
    path = folder / DESCRIPTION
    content, whole = _content(path)
    _check_version(path, content.get("version"), whole)
    try:
        return Description.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise FileFormatError(f"{path}: {place}: {first['msg']}.") from None


def _content(path: Path) -> tuple[dict[str, Any], bool]:
    """What the file holds but its checksum, and whether that one is right."""
    data = read_file(path)
    try:
        content = json.loads(data.decode("utf-8"))
        digest = content_digest({k: v for k, v in content.items() if k != _CHECKSUM})
    except (ValueError, AttributeError, RecursionError) as error:
        reason = "expected keys and values" if isinstance(error, AttributeError) else error
        raise FileFormatError(f"{path}: damaged: not JSON of a model ({reason}).") from None
    if content.get("format") != FORMAT:
        raise FileFormatError(f"{path}: expected format {FORMAT!r}: damaged or something else.")
    return content, content.pop(_CHECKSUM, None) == digest


def _check_version(path: Path, version: object, whole: bool) -> None:
    """Refuse altered files and other versions of the format.

    A newer version is refused as such, for its checksum may be another one.
    """
    newer = type(version) is int and version > VERSION
    if not whole and not newer:
        raise FileFormatError(
            f"{path}: damaged: its checksum is not that of its content; copy or save it again."
        )
    if type(version) is not int or version != VERSION:
        remedy = "update pdcorrect" if newer else "train the model anew"
        raise FileVersionError(f"{path}: format version {version!r}: expected {VERSION}: {remedy}.")
