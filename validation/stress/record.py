"""What the scripts beside the battery record: their figures, and when and by which command."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pdcorrect.corrector.model_io import model_folder, weights_digest
from pdcorrect.environment import environment
from pdcorrect.replacement import write_text


def digests(models: Mapping[str, str | Path]) -> dict[str, str]:
    """SHA-256 of the weights of models, by what the rows of a record call them.

    Parameters
    ----------
    models : mapping of str to str or path
        Names or folders.
    """
    return {name: weights_digest(model_folder(folder)) for name, folder in models.items()}


def write(path: str | Path, **content: Any) -> None:
    """Write a record of the program that runs, as JSON."""
    script, *arguments = sys.argv
    command = " ".join(["python", f"validation/stress/{Path(script).name}", *arguments])
    origin = {"date": time.strftime("%Y-%m-%d"), "command": command, "environment": environment()}
    write_text(Path(path), json.dumps({**origin, **content}, indent=2) + "\n")
