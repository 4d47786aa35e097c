"""Run the benchmarks and write one JSON file for this machine."""

from __future__ import annotations

import json
import re
import sys
import time
from pathlib import Path

import cases
import solver_cases

from pdcorrect.environment import environment


def main() -> None:
    """Run the cases named on the command line, or all."""
    known = {**cases.CASES, **solver_cases.CASES}
    names = sys.argv[1:] or list(known)
    unknown = set(names) - set(known)
    if unknown:
        sys.exit(f"unknown: {sorted(unknown)}; expected some of {list(known)}")
    machine = environment()
    folder = Path(__file__).parent / "results"
    folder.mkdir(exist_ok=True)
    slug = re.sub(r"[^a-z0-9]+", "-", machine["processor"].lower()).strip("-")
    path = folder / f"{slug}-{machine['cores']}cores.json"
    record = json.loads(path.read_text()) if path.exists() else {}
    for name in names:
        print(f"{name} ...", flush=True)
        record[name] = {
            "date": time.strftime("%Y-%m-%d"),
            "command": f"python benchmarks/run.py {name}",
            "environment": machine,
            "results": known[name](),
        }
        print(json.dumps(record[name]["results"], indent=2))
        path.write_text(json.dumps(record, indent=2) + "\n")
    print(f"wrote {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}")


if __name__ == "__main__":
    main()
