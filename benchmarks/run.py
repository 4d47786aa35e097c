"""Run the benchmarks and write the record of this machine."""

from __future__ import annotations

import json
import sys

import cases
import solver_cases
from machine_file import add


def main() -> None:
    """Run the cases named on the command line, or all."""
    known = {**cases.CASES, **solver_cases.CASES}
    names = sys.argv[1:] or list(known)
    unknown = set(names) - set(known)
    if unknown:
        sys.exit(f"unknown: {sorted(unknown)}; expected some of {list(known)}")
    for name in names:
        print(f"{name} ...", flush=True)
        results = known[name]()
        print(json.dumps(results, indent=2))
        add(name, results)


if __name__ == "__main__":
    main()
