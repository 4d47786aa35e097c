"""One record a machine, ``results/MACHINE.json``: each case with when and how it ran."""

from __future__ import annotations

import json
import re
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from pdcorrect._environment import environment
from pdcorrect._files import write_text

RESULTS = Path(__file__).parent / "results"
DIGITS = 5
"""Significant digits that are kept."""


def add(name: str, results: Any, device: str | None = None, prefix: str = "", **more: Any) -> None:
    """Put a case's results into the machine's record in place of its earlier ones.

    Parameters
    ----------
    name : str
        Of the case.
    results : list or dict
        Rows, or rows by name.
    device : str, optional
        The GPU that was measured, after which the record is called; else it is the processor.
    prefix : str
        Of the record's name.
    **more
        Written beside the results.
    """
    machine, path = environment(), _path(device, prefix)
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    record[name] = {
        "date": time.strftime("%Y-%m-%d"),
        "command": command(),
        "environment": machine | ({} if device is None else {"device": device}),
        **more,
        "results": results,
    }
    RESULTS.mkdir(exist_ok=True)
    write_text(path, text(record))
    print(f"wrote {path}")


def command() -> str:
    """What this process was called by, without folders of this machine."""
    script = Path(sys.argv[0]).resolve().relative_to(RESULTS.parents[1]).as_posix()
    asked = [Path(x).name if Path(x).is_absolute() else x for x in sys.argv[1:]]
    return shlex.join(["python", script, *asked])


def read(name: str, prefix: str = "") -> dict[str, Any]:
    """What this machine's record has of a case; empty if nothing."""
    path = _path(None, prefix)
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return dict(record.get(name, {}))


def _path(device: str | None, prefix: str) -> Path:
    machine = environment()
    label = device or f"{machine['processor']} {machine['cores']}cores"
    return RESULTS / f"{prefix}{re.sub('[^a-z0-9]+', '-', label.lower()).strip('-')}.json"


def text(record: Any, depth: int = 0) -> str:
    """JSON with a row on a line, numbers rounded."""
    record = _rounded(record)
    end = "\n" if depth == 0 else ""
    inside, outside = " " * (depth + 1), " " * depth
    if depth < 3 and isinstance(record, dict) and any(_holds(x) for x in record.values()):
        items = [f"{inside}{json.dumps(k)}: {text(x, depth + 1)}" for k, x in record.items()]
        return "{\n" + ",\n".join(items) + f"\n{outside}}}{end}"
    if depth < 4 and isinstance(record, list) and any(_holds(x) for x in record):
        rows = [f"{inside}{json.dumps(row)}" for row in record]
        return "[\n" + ",\n".join(rows) + f"\n{outside}]{end}"
    return json.dumps(record) + end


def _holds(value: Any) -> bool:
    return isinstance(value, (dict, list))


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, (list, tuple)) else value
