"""Checkpoints: one file that is replaced whole, of tensors and JSON; what models came from.

The format is safetensors; the JSON lies in its metadata, with a SHA-256 over everything
else, so that a damaged file is refused.  Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from pdcorrect._files import part_of_process, replacing
from pdcorrect.corrector.model_io import JOINT, LoadedModel
from pdcorrect.errors import FileFormatError, FileVersionError, OutputError, require_extra
from pdcorrect.training.recipe import TrainingConfig
from pdcorrect.training.recordings import Recording

require_extra("safetensors", "learn")

from safetensors import SafetensorError, safe_open  # noqa: E402
from safetensors import torch as safetensors  # noqa: E402

FORMAT = "pdcorrect-checkpoint"
VERSION = 5


def write_checkpoint(path: Path, content: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Replace a checkpoint.

    Parameters
    ----------
    path : Path
    content : mapping
        JSON; floats keep all their digits.
    tensors : mapping of str to Tensor
        On any device.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    held = {name: t.detach().to("cpu").contiguous().clone() for name, t in tensors.items()}
    text = json.dumps(content, sort_keys=True)
    head = {"format": FORMAT, "version": str(VERSION), "content": text, "hash": _hash(text, held)}
    try:
        with replacing(path, part_of_process(path)) as part:
            part.write_bytes(safetensors.save(held, head))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}).") from None


def read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Content and tensors of a checkpoint, on the CPU.

    Raises
    ------
    FileFormatError
        If it cannot be read, is damaged or something else.
    FileVersionError
        If it was written in another version of the format.
    """
    try:
        with safe_open(path, framework="pt") as file:
            head = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise FileFormatError(f"{path}: there is no checkpoint.") from None
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: damaged or something else ({error}).") from None
    if head.get("format") != FORMAT:
        raise FileFormatError(f"{path}: no checkpoint of a training: expected format {FORMAT!r}.")
    if head.get("version") != str(VERSION):
        raise FileVersionError(
            f"{path}: version {head.get('version')} of its format: expected {VERSION}: another "
            "pdcorrect wrote it, and this one cannot go on with it: train anew, in another folder."
        )
    text = head.get("content", "")
    if head.get("hash") != _hash(text, tensors):
        raise FileFormatError(f"{path}: damaged: its content is not that of its hash.")
    return json.loads(text), tensors


def _hash(text: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        t = tensors[name]
        digest.update(f"{name} {t.dtype} {tuple(t.shape)}\n".encode())
        digest.update(t.reshape(-1).numpy().tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Lineage:
    """Data sets that a model comes from.

    Attributes
    ----------
    data_sets : tuple of (str, str or None)
        Names, and hashes of configurations, of all that its weights were trained on.
    fitted_to : tuple of str
        Names of those that the normaliser's ranges were fitted or widened to.
    """

    data_sets: tuple[tuple[str, str | None], ...]
    fitted_to: tuple[str, ...]

    @property
    def name(self) -> str:
        """All names with plus signs between them."""
        return JOINT.join(dict.fromkeys(name for name, _ in self.data_sets))

    def record(self) -> dict[str, Any]:
        """As JSON, for `ModelRecord.training`."""
        return {
            "data_sets": [{"name": name, "config_hash": x} for name, x in self.data_sets],
            "fitted_to": list(self.fitted_to),
        }


def lineage_of(
    config: TrainingConfig, start: LoadedModel | None, recordings: Sequence[Recording]
) -> Lineage:
    """Of a training's model.

    Parameters
    ----------
    config : TrainingConfig
    start : LoadedModel, optional
        The model that the training goes on with.
    recordings : sequence of Recording
        Of the training's own data sets.
    """
    own = [(one.dataset, one.config_hash) for one in recordings]
    names = [name for name, _ in own]
    if start is None:
        return _without_doubles(own, names)
    if config.fitting.anew:
        fitted_to = names
    elif config.fitting.widen:
        fitted_to = [*start.fitted_to, *names]
    else:
        fitted_to = start.fitted_to
    return _without_doubles([*start.data_sets, *own], fitted_to)


def _without_doubles(
    data_sets: Sequence[tuple[str, str | None]], fitted_to: Sequence[str]
) -> Lineage:
    return Lineage(tuple(dict.fromkeys(data_sets)), tuple(dict.fromkeys(fitted_to)))
