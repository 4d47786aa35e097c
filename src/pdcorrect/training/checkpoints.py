"""Checkpoints: one file that is replaced whole, of tensors and JSON.

The format is safetensors; the JSON lies in its metadata, with a SHA-256 over everything
else, so that a damaged file is refused.  Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from pdcorrect._files import part_of_process, replacing
from pdcorrect.errors import FileFormatError, FileVersionError, OutputError, require_extra

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
