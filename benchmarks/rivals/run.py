"""Run the contestants beside this package, on one core, one after another; write the record.

    python benchmarks/rivals/run.py FOLDER [--only CONTESTANT ...] [--cases CASE ...] [--seconds S]

FOLDER/CONTESTANT/bin/python is the environment of each contestant (the docstring of its script
says what to install); those without one are left out.  Runs in the record are replaced by new ones
of the same kind; each says by which call of this script it was made.  Calls, with the code's
digest, are under `runs`.  Errors are RMS distances of the coarse nodes to the converged motion of
the contestant's own material law, over its RMS displacement.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import cases
import numpy as np
from case import MESHES, Case

import pdcorrect as pc
from pdcorrect._environment import code_digest
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
BUSY = 1.1
"""Wall over CPU time above which a run is repeated, once."""
LAST = (
    ("torchfea_fem", "C3D10, 10 ms"), ("newton_vbd", "1.67 ms, 10 iterations"),
    ("pbat_fem", "10 nodes, 2.5 ms"),
)  # fmt: skip
"""The dearest settings, in scenes but the beam run after all others."""
SAME = "contestant", "case", "setting", "refine"
"""What runs of the same kind share."""
ONE = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS", "NUMBA", "TBB", "QD")}
SCENES = cases.scenes()

Row = dict[str, Any]


@cache
def truth(case: str, law: str) -> np.ndarray:
    """Converged positions (F+1, N, 3) of the coarse nodes."""
    return pc.converged(SCENES[case].with_changes(material={"energy": law})).positions


def errors(positions: np.ndarray, exact: np.ndarray) -> Row:
    """Relative errors, %: of all frames, and of each part of them over the whole's displacement."""
    if len(positions) < len(exact) or not np.isfinite(positions).all():
        return {"failed": "diverged"}
    moved = pc.metrics.rms_error(np.broadcast_to(exact[0], exact.shape), exact)
    squares = ((positions - exact) ** 2)[1:].sum(axis=2).mean(axis=1)
    parts = [np.sqrt(part.mean()) for part in np.array_split(squares, QUARTERS)]
    return {
        "error_percent": 100 * pc.metrics.relative_error(positions, exact),
        "error_over_time_percent": [100 * float(x / moved) for x in parts],
    }


def measured(python: Path, row: Row, folder: Path) -> Row:
    """A run in a process of its own: its errors and times, or why there are none."""
    path, out = folder / f"{row['case']} {row['refine']}.npz", folder / "run.npz"
    command = [python, HERE / f"{row['contestant']}.py", path, row["setting"], out]
    try:
        done = subprocess.run(
            [str(part) for part in command], env={**os.environ, **ONE}, cwd=folder,
            capture_output=True, text=True, timeout=LIMIT,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {**row, "failed": f"more than {LIMIT} s"}
    if done.returncode:
        return {**row, "failed": done.stderr.strip().splitlines()[-1][:200]}
    with np.load(out) as found:
        if "refused" in found:
            return {**row, "refused": str(found["refused"])}
        positions, wall, cpu = (found[key] for key in ("positions", "wall", "cpu"))
    return {
        **row,
        **errors(positions, truth(row["case"], row["law"])),
        "ms_a_frame": 1e3 * float(np.mean(wall[1:])),
        "cpu_ms_a_frame": 1e3 * float(np.mean(cpu[1:])),
        "setup_s": float(wall[0]),
    }


def undisturbed(python: Path, row: Row, folder: Path) -> Row:
    """`measured`, once more if the processor did something else; then ``repeated`` is true."""
    found = measured(python, row, folder)
    if found.get("ms_a_frame", 0.0) > BUSY * found.get("cpu_ms_a_frame", 1.0):
        return measured(python, {**row, "repeated": True}, folder)
    return found


def asked(name: str, case: str, frame: float) -> Iterator[Row]:
    """What to run of a contestant in a case with frames of so many seconds."""
    module, seen = importlib.import_module(name), []
    for setting, chosen in module.SETTINGS.items():
        for refine in chosen["refine" if case == cases.NAME else "scenes"]:
            kind = {key: value for key, value in chosen.items() if key not in MESHES}
            kind["longest"] = min(kind.get("longest", frame), frame)
            if (kind, refine) in seen:  # the frame is no longer than either's step
                continue
            seen.append((kind, refine))
            yield {
                "contestant": name, "case": case, "law": chosen["law"], "setting": setting,
                "refine": refine, "recommended": setting in module.RECOMMENDED,
            }  # fmt: skip


def order(row: Row) -> int:
    """Later for the dearest settings, but on the beam."""
    key = row["contestant"], row["setting"]
    return 1 + LAST.index(key) if key in LAST and row["case"] != cases.NAME else 0


def version(python: Path, name: str) -> str:
    package = importlib.import_module(name).PACKAGE
    code = f"import importlib.metadata as m; print(m.version({package!r}))"
    done = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
    return f"{package} {done.stdout.strip()}"


def keep(rows: list[Row], run: Mapping[str, Any], missing: list[Row], **more: Any) -> None:
    """Put rows into the record, beside those of other kinds and the calls that made them."""

    def kind(row: Row) -> tuple[Any, ...]:
        return tuple(row[key] for key in SAME)

    record, new = machine_file.read(NAME, PREFIX), {kind(row) for row in rows}
    results = [row for row in record.get("results", []) if kind(row) not in new] + rows
    runs = record.get("runs", {}) | {rows[0]["run"]: run}
    runs = {key: value for key, value in runs.items() if any(x["run"] == key for x in results)}
    there = {kind(row) for row in results}
    missing = [row for row in missing if kind(row) not in there]
    machine_file.add(NAME, results, prefix=PREFIX, runs=runs, missing=missing, **more)


def main() -> None:
    parser = argparse.ArgumentParser(description="Run the contestants.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", default=CONTESTANTS, choices=CONTESTANTS)
    parser.add_argument("--cases", nargs="+", default=SCENES, choices=SCENES)
    parser.add_argument("--seconds", type=float, default=np.inf, help="start no run after so many")
    chosen, begin = parser.parse_args(), time.monotonic()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    warnings.simplefilter("ignore", PdcorrectWarning)
    pythons = {name: chosen.folder.absolute() / name / "bin/python" for name in chosen.only}
    pythons = {name: python for name, python in pythons.items() if python.exists()}
    if "ours" in chosen.only:
        pythons["ours"] = Path(sys.executable)
    print("left out:", *sorted({*chosen.only} - {*pythons}))
    began = time.strftime("%Y-%m-%d %H:%M:%S")
    run = {
        "command": machine_file.command(), "code": code_digest(),
        "versions": {name: version(python, name) for name, python in pythons.items()},
    }  # fmt: skip
    refused = {name: cases.refusal(scene) for name, scene in SCENES.items()}
    refused = {name: reason for name, reason in refused.items() if reason}
    with tempfile.TemporaryDirectory() as place:
        folder, rows = Path(place), []
        for case in (case for case in chosen.cases if case not in refused):
            for refine in REFINE:
                cases.write(SCENES[case], refine, folder / f"{case} {refine}.npz")
            frame = Case(folder / f"{case} 1.npz").step
            rows += [row for name in pythons for row in asked(name, case, frame)]
        rows.sort(key=order)
        left = list(rows)
        for _, group in itertools.groupby(rows, lambda x: (order(x), x["case"])):
            done = []
            for row in group:
                if time.monotonic() - begin > chosen.seconds:
                    break
                python = pythons[row["contestant"]]
                done.append({**undisturbed(python, row, folder), "run": began})
                left.remove(row)
                print(done[-1], flush=True)
            if done:
                keep(done, run, left, refused=refused)
        print(len(left), "runs are missing")


if __name__ == "__main__":
    main()
