"""Run the contestants beside this package, on one core, one after another; write the record.

    python benchmarks/rivals/run.py FOLDER [--only CONTESTANT ...] [--cases CASE ...]

FOLDER/CONTESTANT/bin/python is the environment of each contestant (the docstring of its script
says what to install); those without one are left out.  Earlier rows of other contestants and cases
stay.  Errors are RMS distances of the coarse nodes to the converged motion of the contestant's own
material law, over its RMS displacement.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import cases
import numpy as np

import pdcorrect as pc
from pdcorrect.errors import PdcorrectWarning

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))

import machine_file  # noqa: E402

CONTESTANTS = (
    "ours", "dolfinx_fem", "mujoco_flex", "pbat_fem", "pbat_vbd", "newton_vbd", "genesis_fem",
    "simkit_fem", "torchfea_fem",
)  # fmt: skip
NAME, PREFIX = "rivals", "rivals-"
LIMIT = 240
"""Seconds for a run."""
REFINE = (1, 2)
QUARTERS = 4
"""Parts of the time for which an error is given each."""
ONE = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS", "NUMBA", "TBB", "QD")}
SCENES = cases.scenes()


@cache
def truth(case: str, law: str) -> np.ndarray:
    """Converged positions (F+1, N, 3) of the coarse nodes."""
    return pc.converged(SCENES[case].with_changes(material={"energy": law})).positions


def errors(positions: np.ndarray, exact: np.ndarray) -> dict[str, Any]:
    """RMS errors over the RMS displacement, %: of all frames, and of each part of them."""
    if len(positions) < len(exact) or not np.isfinite(positions).all():
        return {"failed": "diverged"}
    moved = np.sqrt(((exact - exact[0]) ** 2).mean())
    squares = ((positions - exact) ** 2)[1:].mean(axis=(1, 2))
    parts = [np.sqrt(part.mean()) for part in np.array_split(squares, QUARTERS)]
    return {
        "error_percent": 100 * float(np.sqrt(squares.mean()) / moved),
        "error_over_time_percent": [100 * float(x / moved) for x in parts],
    }


def measured(
    python: Path, name: str, case: str, setting: str, refine: int, folder: Path
) -> dict[str, Any]:
    """Errors and times of one run in a process of its own."""
    module = importlib.import_module(name)
    law = module.SETTINGS[setting]["law"]
    row = {
        "contestant": name, "case": case, "law": law, "setting": setting, "refine": refine,
        "recommended": setting in module.RECOMMENDED,
    }  # fmt: skip
    out = folder / "run.npz"
    command = [str(python), str(HERE / f"{name}.py"), str(folder / f"{refine}.npz"), setting, out]
    try:
        done = subprocess.run(
            command, env={**os.environ, **ONE}, cwd=folder, capture_output=True, text=True,
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
    parser.add_argument("--cases", nargs="+", default=SCENES, choices=SCENES)
    chosen = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    warnings.simplefilter("ignore", PdcorrectWarning)
    pythons = {name: chosen.folder.absolute() / name / "bin/python" for name in chosen.only}
    pythons = {name: python for name, python in pythons.items() if python.exists()}
    if "ours" in chosen.only:
        pythons["ours"] = Path(sys.executable)
    print("left out:", *sorted({*chosen.only} - {*pythons}))
    versions = {name: version(python, name) for name, python in pythons.items()}
    refused = {name: cases.refusal(scene) for name, scene in SCENES.items()}
    refused = {name: reason for name, reason in refused.items() if reason}
    for case in chosen.cases:
        if case in refused:
            continue
        found = []
        with tempfile.TemporaryDirectory() as folder:
            for refine in REFINE:
                cases.write(SCENES[case], refine, Path(folder) / f"{refine}.npz")
            for name, python in pythons.items():
                for setting, settings in importlib.import_module(name).SETTINGS.items():
                    key = "refine" if case == cases.NAME else "scenes"
                    for refine in settings[key]:
                        found.append(measured(python, name, case, setting, refine, Path(folder)))
                        print(found[-1], flush=True)
        record = machine_file.read(NAME, PREFIX)  # another run may have added to it
        rows = [
            row
            for row in record.get("results", [])
            if row["contestant"] not in pythons or row["case"] != case
        ]
        versions = record.get("versions", {}) | versions
        more = {"versions": versions, "refused": refused}
        machine_file.add(NAME, rows + found, prefix=PREFIX, **more)


if __name__ == "__main__":
    main()
