"""Condense evaluations of a released model into the record that its card and the docs quote.

python models/record.py NAME EVALUATION [--run RUN] [--further FOLDER ...] [--time-error FOLDER]
    [--note TEXT ...] [-o FOLDER]

The folders are written by ``pdcorrect evaluate``: EVALUATION on the split ``evaluation``, those of
``--further`` on other splits, with the default gate and with ``--no-gate``, that of
``--time-error`` on data whose evaluation split has the run that is converged in time.
FOLDER, by default ``models/NAME``, gets ``evaluation.json`` and ``trajectories.csv``;
``python docs/tables.py`` then writes the tables anew.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from program import run_script

from pdcorrect.errors import InputError

MODELS = Path(__file__).resolve().parent
HARM = 1.05
"""Times the RMS error of the base alone: more counts as harm."""
VERSIONS = ("pdcorrect", "python", "numpy", "torch", "torch-geometric")
SPREAD = ("mean", "interval", "median", "q05", "smallest")
Key = tuple[int, int]
"""Mesh and simulation."""


def rounded(value: Any) -> Any:
    """Numbers to six significant digits, in lists and dictionaries, too."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: rounded(item) for key, item in value.items()}
    return [rounded(item) for item in value] if isinstance(value, list) else value


class Evaluation:
    """What ``pdcorrect evaluate`` wrote, and which of its runs is the corrected one."""

    def __init__(self, folder: Path, run: str | None = None) -> None:
        self.summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        self.runs: dict[str, Any] = self.summary["runs"]
        corrected = [name for name in self.runs if name in self.summary["models"]]
        self.run = run if run in self.runs else corrected[0]
        self.base: str = self.runs[self.run]["base"]
        with (folder / "trajectories.csv").open(newline="", encoding="utf-8") as file:
            self._lines = list(csv.DictReader(file))

    @property
    def with_gate(self) -> bool:
        return bool(self.summary["gate"])

    def values(self, run: str, name: str) -> dict[Key, float]:
        """A measure of each trajectory of a run."""
        return {
            (int(line["mesh"]), int(line["simulation"])): float(line[name])
            for line in self._lines
            if line["run"] == run
        }

    def over(self, other: str, name: str = "rms_error") -> list[float]:
        """The corrected run's measure over another run's, by trajectory."""
        own, others = self.values(self.run, name), self.values(other, name)
        return [own[key] / others[key] for key in own]

    def nearer(self, other: str, name: str) -> int:
        """Trajectories in which another run has a smaller error than the corrected one."""
        return sum(ratio > 1.0 for ratio in self.over(other, name))

    def provenance(self) -> dict[str, Any]:
        environment = self.summary["environment"]
        return {
            "date": self.summary["date"],
            "command": self.summary["command"],
            "processor": environment["processor"],
            "device": environment.get("device", "cpu"),
            "versions": {name: environment[name] for name in VERSIONS if name in environment},
            "gate": self.summary["gate"],
            "evaluated_weights_sha256": self.summary["models"][self.run]["weights_sha256"],
        }

    def measures(self, run: str) -> dict[str, Any]:
        """Of one run: Omega and stress error in per cent, RMS error in m."""
        found = self.runs[run]["measures"]
        told = {"omega": {name: found["omega"][name] for name in SPREAD}}
        told |= {"omega_of_own_base": _mean(found, "omega_base", "median")}
        told |= {name: _mean(found, name) for name in ("rms_error", "step_omega", "gate_rate")}
        told |= {"stress_error": 100.0 * found["stress_error"]["mean"]}
        return {name: value for name, value in told.items() if value is not None}


def _mean(found: Mapping[str, Any], name: str, *more: str) -> Any:
    if name not in found:
        return None
    return {key: found[name][key] for key in ("mean", *more)} if more else found[name]["mean"]


def spread(ratios: Sequence[float]) -> dict[str, Any]:
    """Of errors over those of another run."""
    return {
        "median": statistics.median(ratios),
        "largest": max(ratios),
        f"above {HARM}": sum(ratio > HARM for ratio in ratios),
    }


def weights_hash(name: str) -> str | None:
    """Of a released model; None if there is none of the name."""
    path = MODELS / name / "weights.safetensors"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None


def evaluation_record(name: str, found: Evaluation) -> dict[str, Any]:
    """The record of a model on the evaluation split."""
    data = found.summary["data"]
    others = [run for run in ("plain", "total-mass", "best", "intermediate") if run in found.runs]
    return {
        "model": name,
        **found.provenance(),
        "weights_sha256": weights_hash(name),
        "data": {key: data[key] for key in ("name", "split", "config_hash", "trajectories")}
        | {"meshes": found.runs[found.run]["measures"]["omega"]["meshes"]},
        "base": found.base,
        "runs": {"corrected": found.measures(found.run)}
        | {run: found.measures(run) for run in others},
        "error_over_base": spread(found.over(found.base)),
        "single_step_error_over_base": spread(found.over(found.base, "step_rms_error")),
        "nearer": {run: found.nearer(run, "rms_error") for run in others if run != "plain"},
        "nearer_in_stress": {
            run: found.nearer(run, "stress_error") for run in others if run != "plain"
        },
    }


def further_record(gated: Evaluation, without: Evaluation) -> dict[str, Any]:
    """The record of one further split, with the gate of its day and without one."""
    runs, refused = gated.runs, gated.values(gated.run, "gate_rate")
    ratios = gated.over(gated.base)
    return {
        "split": gated.summary["data"]["split"],
        "date": gated.summary["date"],
        "command": gated.summary["command"],
        "device": gated.summary["environment"].get("device", "cpu"),
        "simulations": len(ratios),
        "refused_steps": refused_steps(gated),
        "corrected_simulations": sum(rate < 100.0 for rate in refused.values()),
        "omega_base": runs[gated.base]["measures"]["omega"]["mean"],
        "omega": {k: runs[gated.run]["measures"]["omega"][k] for k in ("mean", "smallest")},
        "omega_without_gate": without.runs[without.run]["measures"]["omega"]["mean"],
        "error_over_base": spread(ratios),
        "error_over_base_without_gate": spread(without.over(without.base)),
    }


def refused_steps(gated: Evaluation) -> float:
    """Mean per cent of a run's steps."""
    return float(gated.runs[gated.run]["measures"]["gate_rate"]["mean"])


def further_records(folders: Iterable[Path]) -> list[dict[str, Any]]:
    """Of all further splits; where a gate refused nothing it stands for the run without one.

    Raises
    ------
    InputError
        If a gate refused steps, and there is no run without it.
    """
    gated, without = {}, {}
    for folder in folders:
        found = Evaluation(folder)
        (gated if found.with_gate else without)[found.summary["data"]["split"]] = found
    for split, one in gated.items():
        if split not in without and refused_steps(one) != 0.0:
            told = f"the gate refused {refused_steps(one):.3g} % of the steps of {split!r}"
            raise InputError(f"--further: {told}: expected a folder made with --no-gate, too.")
    return [further_record(one, without.get(split, one)) for split, one in gated.items()]


def time_error(found: Evaluation) -> dict[str, Any]:
    """RMS distances in m from the run converged in time."""
    runs = {"corrected": found.run, found.base: found.base, "reference": "reference"}
    distances = {
        label: found.runs[run]["measures"]["converged_rms_error"]["mean"]
        for label, run in runs.items()
    }
    return {"date": found.summary["date"], "rms_error": distances}


def write_trajectories(path: Path, found: Evaluation) -> None:
    """Omega in per cent of each trajectory: corrected, its base alone, the intermediate mesh."""
    runs = [found.values(run, "omega") for run in (found.run, found.base, "intermediate")]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["mesh", "simulation", "omega", "omega_base", "omega_intermediate"])
        for key in sorted(runs[0]):
            writer.writerow([*key, *(f"{values[key]:.4f}" for values in runs)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="of the released model")
    parser.add_argument("evaluation", type=Path)
    parser.add_argument("--run", help="in the evaluation, if it has several models")
    parser.add_argument("--further", type=Path, nargs="*", default=[])
    parser.add_argument("--time-error", type=Path)
    parser.add_argument("--note", nargs="*", default=[])
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    found = Evaluation(options.evaluation, options.run)
    record = evaluation_record(options.name, found)
    if options.further:
        record["further_splits"] = further_records(options.further)
    if options.time_error:
        record["time_error"] = time_error(Evaluation(options.time_error, options.name))
    if options.note:
        record["notes"] = options.note
    folder = options.output or MODELS / options.name
    text = json.dumps(rounded(record), indent=1) + "\n"
    (folder / "evaluation.json").write_text(text, encoding="utf-8")
    write_trajectories(folder / "trajectories.csv", found)
    print(f"wrote {folder / 'evaluation.json'} and trajectories.csv")


if __name__ == "__main__":
    run_script(main)
