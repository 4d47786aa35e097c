"""Run the contestants beside this package, one thread, one after another; write the record.

    python benchmarks/rivals/run.py FOLDER [--only CONTESTANT ...] [--cases CASE ...]

FOLDER/CONTESTANT/bin/python is the environment of each contestant (the docstring of its script says
what to install); those without one are left out.  Earlier rows of other contestants and cases stay.
Errors are RMS distances of the coarse nodes to
the converged motion of the contestant's own material law, over its RMS displacement.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from case import CASES, Case

import pdcorrect as pc

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))

import machine_file  # noqa: E402

CONTESTANTS = (
    "ours", "mujoco_flex", "pbat_fem", "pbat_vbd", "newton_vbd", "genesis_fem", "simkit_fem",
    "torchfea_fem",
)  # fmt: skip
NAME, PREFIX = "rivals", "rivals-"
LIMIT = 150
"""Seconds for a run."""
QUARTERS = 4
"""Parts of the time for which an error is given each."""
ONE = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS", "NUMBA", "TBB", "QD")}


@cache
def truth(case: str, law: str) -> np.ndarray:
    """Converged positions (F+1, N, 3) of the coarse nodes."""
    import ours

    run = pc.converged(ours.scene(Case(case), law))
    return run.positions[:, Case(case).match(run.points)]


def errors(positions: np.ndarray, exact: np.ndarray) -> dict[str, Any]:
    """RMS errors over the RMS displacement, %: of all frames, and of each part of them."""
    if len(positions) < len(exact) or not np.isfinite(positions).all():
        return {"failed": "diverged"}
    moved = np.sqrt(((exact - exact[0]) ** 2).mean())
    squares = ((positions - exact) ** 2)[1:].mean(axis=(1, 2))
    parts = np.sqrt(squares.reshape(QUARTERS, -1).mean(axis=1))
    return {
        "error_percent": 100 * float(np.sqrt(squares.mean()) / moved),
        "error_over_time_percent": [100 * float(x / moved) for x in parts],
    }


def measured(python: Path, name: str, case: str, setting: str, refine: int) -> dict[str, Any]:
    """Errors and times of one run in a process of its own."""
    module = importlib.import_module(name)
    law = module.SETTINGS[setting]["law"]
    row = {
        "contestant": name, "case": case, "law": law, "setting": setting, "refine": refine,
        "recommended": setting in module.RECOMMENDED,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.npz"
        command = ["taskset", "-c", "0", str(python), str(HERE / f"{name}.py")]
        try:
            done = subprocess.run(
                [*command, case, setting, str(refine), str(out)],
                env={**os.environ, **ONE}, cwd=folder, capture_output=True, text=True,
                timeout=LIMIT,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {**row, "failed": f"more than {LIMIT} s"}
        if done.returncode:
            return {**row, "failed": done.stderr.strip().splitlines()[-1][:200]}
        with np.load(out) as found:
            positions, wall, cpu = (found[key] for key in ("positions", "wall", "cpu"))
    return {
        **row,
        **errors(positions, truth(case, law)),
        "ms_a_frame": 1e3 * float(np.mean(wall[1:])),
        "cpu_ms_a_frame": 1e3 * float(np.mean(cpu[1:])),
        "setup_s": float(wall[0]),
    }


def version(python: Path, name: str) -> str:
    package = importlib.import_module(name).PACKAGE
    code = f"import importlib.metadata as m; print(m.version({package!r}))"
    done = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
    return f"{package} {done.stdout.strip()}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Run the contestants.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", default=CONTESTANTS, choices=CONTESTANTS)
    parser.add_argument("--cases", nargs="+", default=CASES, choices=CASES)
    chosen = parser.parse_args()
    record = machine_file.read(NAME, PREFIX)
    rows, versions = record.get("results", []), record.get("versions", {})
    for name, case in itertools.product(chosen.only, chosen.cases):
        python = (
            Path(sys.executable)
            if name == "ours"
            else chosen.folder.absolute() / name / "bin/python"
        )
        if not python.exists():
            print(f"{name}: no {python}, left out")
            continue
        versions[name] = version(python, name)
        rows = [row for row in rows if (row["contestant"], row["case"]) != (name, case)]
        for setting, settings in importlib.import_module(name).SETTINGS.items():
            for refine in settings["refine"]:
                rows.append(measured(python, name, case, setting, refine))
                print(rows[-1], flush=True)
        machine_file.add(NAME, rows, prefix=PREFIX, versions=versions)


if __name__ == "__main__":
    main()
