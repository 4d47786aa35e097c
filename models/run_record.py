"""What the scripts here record beside their figures: when, by which command, and on what."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from pdcorrect.environment import environment
from pdcorrect.replacement import write_text


def origin() -> dict[str, Any]:
    """Of the program that runs."""
    script = Path(sys.argv[0]).name
    return {
        "date": time.strftime("%Y-%m-%d"),
        "command": " ".join(["python", f"models/{script}", *sys.argv[1:]]),
        "environment": environment(),
    }


def write_record(path: Path, **content: Any) -> None:
    """Write a record as JSON, its origin first."""
    write_text(path, json.dumps({**origin(), **content}, indent=2) + "\n")
