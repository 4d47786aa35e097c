"""Faults in the programs, damaged inputs handed to them, and the time of the quick validation.

    python benchmarks/robustness.py [results.json] [--without-slow]

Runs `tests/test_faults.py`, `tests/test_fuzz.py` and `tests/test_fuzz_learning.py` with their slow
tests, and ``pdcorrect validate --quick``, and counts from pytest's report.  A fault hits where it
ends the program or makes it fail; nothing is lost where the same command, called again, ends with
what a run without faults leaves.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from pdcorrect.environment import environment

ROOT = Path(__file__).parents[1]
TESTS = ("tests/test_faults.py", "tests/test_fuzz.py", "tests/test_fuzz_learning.py")


def tested(slow: bool) -> list[dict[str, Any]]:
    """Name, outcome, seconds and properties of each test."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        chosen = [] if slow else ["-m", "not slow"]
        command = [sys.executable, "-m", "pytest", "-q", *TESTS, *chosen, f"--junitxml={report}"]
        command += ["-o", "junit_family=xunit1"]  # the one that has properties
        subprocess.run(command, cwd=ROOT, check=False)  # failures are in the report
        cases = ElementTree.parse(report).getroot().iter("testcase")
        return [_row(case) for case in cases]


def _row(case: ElementTree.Element) -> dict[str, Any]:
    ends = [tag for tag in ("failure", "error", "skipped") if case.find(tag) is not None]
    told = {p.get("name"): p.get("value") for p in case.iter("property")}
    return {
        "test": f"{case.get('classname')}::{case.get('name')}",
        "outcome": ends[0] if ends else "passed",
        "seconds": float(case.get("time") or 0.0),
        **{k: int(v) if v and v.isdigit() else v for k, v in told.items() if k},
    }


def faults(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By program and fault: how many were injected, hit, and lost something."""
    found = []
    for row in rows:
        if "fault" in row:
            keys = ("program", "fault", "injected", "hits")
            lost = row.get("lost", f"not known: {row['outcome']}")
            found.append({**{key: row[key] for key in keys}, "lost": lost})
    return found


def quick_validation() -> dict[str, Any]:
    """Wall-clock seconds and exit status of the quick mode."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        command = [sys.executable, "-m", "pdcorrect.cli", "validate", "--quick", "-o", folder]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        seconds = round(time.perf_counter() - started, 1)
    said = [line for line in ran.stdout.splitlines() if not line.startswith("report:")]
    return {"seconds": seconds, "status": ran.returncode, "said": said}


def main() -> None:
    """Run all and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", nargs="?", type=Path)
    parser.add_argument("--without-slow", action="store_true")
    given = parser.parse_args()
    rows = tested(slow=not given.without_slow)
    fuzzed = [row for row in rows if row.get("inputs")]
    record = {
        "command": " ".join(["python", *sys.argv]),
        "date": time.strftime("%Y-%m-%d"),
        "environment": environment(),
        "quick_validation": quick_validation(),
        "faults": faults(rows),
        "inputs": {
            "tried": sum(row["inputs"] for row in fuzzed),
            "tests": len(fuzzed),
            "tests_failed": [r["test"] for r in fuzzed if r["outcome"] != "passed"],
        },
        "skipped": [row["test"] for row in rows if row["outcome"] == "skipped"],
        "tests": rows,
    }
    text = json.dumps(record, indent=1)
    print(json.dumps({k: v for k, v in record.items() if k != "tests"}, indent=1))
    if given.results:
        given.results.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
