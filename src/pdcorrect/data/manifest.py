"""``manifest.json``: the hashes of all files of a data set that is complete."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pdcorrect.data.config import DatasetConfig


def manifest_content(config: DatasetConfig, hashes: Mapping[str, str | None]) -> dict[str, Any]:
    """What the manifest says of files by name, with one hash of them all."""
    whole = hashlib.sha256(json.dumps(dict(hashes), sort_keys=True).encode()).hexdigest()
    return {
        "dataset": config.name,
        "config_hash": config.hash(),
        "content_hash": whole,
        "files": dict(hashes),
    }
