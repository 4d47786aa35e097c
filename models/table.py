"""Print the tables of ``docs/results.md`` from records of evaluations; a test holds them equal.

python models/table.py

The first has models on unseen meshes of their evaluation splits, the second scenes unlike those
of the training, with the default gate of then and without one, the third bodies of other sizes and
families, the fourth, for the models of the first, errors of single steps beside those of rollouts,
the fifth what needs no network, the sixth the model of all motions beside those of one.
"""

from __future__ import annotations

import csv
import json
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.plan import make_plan

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "validation" / "results"


@dataclass(frozen=True)
class Row:
    """A released model's evaluation on unseen meshes.

    Attributes
    ----------
    model, record, run : str
        The record is a folder of `RESULTS`; the run is the corrected one.
    thesis : float
        Reported mean Omega of the thesis's own model of this motion, %.
    """

    model: str
    record: str
    run: str
    thesis: float


_IMPULSE, _STRETCH, _TORSION = 95.9, 99.1, 91.3
_KICKED = "impulse-as-published-total-mass"
_HEAVY = "torsion-as-published-total-mass"
ROWS = (
    Row("impulse-as-published", "impulse-as-published-fourth", "model", _IMPULSE),
    Row(_KICKED, f"{_KICKED}-fourth", "model", _IMPULSE),
    Row("stretch-as-published", "stretch-as-published-third", "model", _STRETCH),
    Row("stretch-as-published-total-mass", "stretch-as-published-second", "model", _STRETCH),
    Row("torsion-as-published", "torsion-as-published-second", "torsion-as-published", _TORSION),
    Row(_HEAVY, "torsion-as-published-second", _HEAVY, _TORSION),
    Row("impulse-exact", "impulse-exact", "impulse-exact", _IMPULSE),
    Row("stretch-exact", "stretch-exact", "stretch-exact", _STRETCH),
    Row("torsion-exact", "torsion-exact-third", "torsion-exact", _TORSION),
)
HEADINGS = (
    "model", "base", "thesis", "corrected: Ω mean", "95 %", "median", "worst",
    "RMS error removed, %", "base alone: Ω mean, worst", "of the base's error: mean, median",
    "intermediate mesh: Ω mean, worst", "RMS, mm", "to converged in time, mm: base, corrected",
)  # fmt: skip


OTHERS = (
    "other-family", "stiffer", "more-compressible", "stronger", "half-step", "double-step",
    "half-refined",
)  # fmt: skip
"""Splits of the second table, in its order."""
OTHER_HEADINGS = (
    "model", "split", "simulations", "steps refused, %", "base alone: Ω mean",
    "corrected: Ω mean, worst", "error over the base's: median, largest",
    "without a gate: the same",
)  # fmt: skip

BODIES = ("larger", "smaller", "beams", "one-clamp", "other-family")
"""Records of the third table, in its order."""
BODY_HEADINGS = (
    "model", "bodies", "nodes", "simulations", "farthest measure of all", "steps refused, %",
    "base alone: Ω mean", "corrected: Ω mean, worst", "error over the base's: each",
)  # fmt: skip

HARM = 1.05
"""Times the base's RMS error: what is more counts as harm."""
STEP_HEADINGS = (
    "model", "single steps: error over the base's, median, largest", "rollouts: the same",
    f"rollouts above {HARM}", "their single steps: largest",
)  # fmt: skip

PUBLISHED = ("impulse-as-published", "stretch-as-published", "torsion-as-published")
WITHOUT_NETWORK = {
    "consistent mass": "consistent mass",
    "hex8-mean": "element `hex8-mean`",
    "hex8-bubble": "element `hex8-bubble`",
    "hex8-bubble-mean": "element `hex8-bubble-mean`",
    "fitted stiffness": "Young's modulus times {factors}, fitted",
    "total-mass": "the reference's total mass",
    "intermediate": "intermediate mesh",
}
"""Runs of the fifth table, in its order, and what they are called there."""
JOINT_RECORD = "all-as-published"
JOINT_HEADINGS = (
    "data set", "one model for all: Ω mean", "95 %", "median", "worst",
    "model of this motion: Ω mean, worst", "difference", f"rollouts above {HARM}",
    "intermediate mesh: Ω mean", "stress error, %: one model, of this motion, intermediate",
)  # fmt: skip


def main() -> None:
    """Print them."""
    every = (table, others_table, bodies_table, steps_table, baselines_table, together_table)
    print("\n\n".join(make() for make in every))


def table() -> str:
    """The table in Markdown."""
    head = [_line(HEADINGS), _line(["---", "---", *["---:"] * (len(HEADINGS) - 2)])]
    return "\n".join([*head, *(_line(_cells(row)) for row in ROWS)])


def others_table() -> str:
    """The second table in Markdown."""
    head = [_line(OTHER_HEADINGS), _line(["---", "---", *["---:"] * (len(OTHER_HEADINGS) - 2)])]
    lines = []
    for dataset in ("impulse-exact", "stretch-exact", "torsion-exact"):
        plans = make_plan(DatasetConfig.load(ROOT / "datasets" / dataset / "config.toml"))
        for split in OTHERS:
            path = RESULTS / "other-scenes" / f"{dataset}-{split}.json"
            if path.exists():
                frames = next(plan.frames for plan in plans if plan.split == split)
                record = json.loads(path.read_text(encoding="utf-8"))
                lines.append(_line(_other_cells(record, dataset, split, frames)))
    return "\n".join([*head, *lines])


def bodies_table() -> str:
    """The third table in Markdown."""
    head = [_line(BODY_HEADINGS), _line(["---", "---", *["---:"] * (len(BODY_HEADINGS) - 2)])]
    lines = []
    for model in ("impulse-exact", "stretch-exact", "torsion-exact"):
        for bodies in BODIES:
            path = RESULTS / "other-bodies" / f"{model}-{bodies}.json"
            if path.exists():
                record = json.loads(path.read_text(encoding="utf-8"))
                name = "weights, one clamp" if bodies == "one-clamp" else bodies
                config = DatasetConfig.load(ROOT / "datasets" / model / "config.toml")
                lines.append(_line(_body_cells(record, model, name, config.frames)))
    return "\n".join([*head, *lines])


def steps_table() -> str:
    """The fourth table in Markdown."""
    head = [_line(STEP_HEADINGS), _line(["---", *["---:"] * (len(STEP_HEADINGS) - 1)])]
    return "\n".join([*head, *(_line(_step_cells(row)) for row in ROWS)])


def baselines_table() -> str:
    """The fifth table in Markdown."""
    folder = RESULTS / "baselines"
    records = [
        json.loads((folder / name / "summary.json").read_text(encoding="utf-8"))
        for name in PUBLISHED
    ]
    headings = ("coarse mesh with", *(name.replace("-", " ") for name in PUBLISHED))
    lines = [_line(headings), _line(["---", *["---:"] * len(PUBLISHED)])]
    for run, name in WITHOUT_NETWORK.items():
        cells = [_baseline_cell(record, run) for record in records]
        factors = ", ".join(f"{record['stiffness_factor']:.2f}" for record in records)
        lines.append(_line([name.format(factors=factors), *cells]))
    return "\n".join(lines)


def together_table() -> str:
    """The sixth table in Markdown."""
    lines = [_line(JOINT_HEADINGS), _line(["---", *["---:"] * (len(JOINT_HEADINGS) - 1)])]
    for name in PUBLISHED:
        own = next(row for row in ROWS if row.model == f"{name}-total-mass")
        row = Row(JOINT_RECORD, f"{JOINT_RECORD}/{name.split('-')[0]}", "model", own.thesis)
        found, alone = (
            json.loads((RESULTS / one.record / "summary.json").read_text(encoding="utf-8"))["runs"]
            for one in (row, own)
        )
        omega, other = (
            runs[one.run]["measures"]["omega"] for runs, one in ((found, row), (alone, own))
        )
        ratios = _over_base(row, found["model"]["base"], "rms_error").values()
        stress = (
            100.0 * runs[run]["measures"]["stress_error"]["mean"]
            for runs, run in ((found, "model"), (alone, own.run), (found, "intermediate"))
        )
        low, high = omega["interval"]
        lines.append(_line([
            f"`{name}`", f"**{omega['mean']:.1f}**", f"{low:.1f} – {high:.1f}",
            f"{omega['median']:.1f}", f"{omega['smallest']:.1f}",
            f"{other['mean']:.1f}, {other['smallest']:.1f}",
            _signed(f"{omega['mean'] - other['mean']:.1f}"),
            f"{sum(x > HARM for x in ratios)} of {len(ratios)}",
            f"{found['intermediate']['measures']['omega']['mean']:.1f}",
            ", ".join(f"{x:.1f}" for x in stress),
        ]))  # fmt: skip
    return "\n".join(lines)


def _baseline_cell(record: dict[str, Any], run: str) -> str:
    omega = record["runs"][run]["measures"]["omega"]
    return _signed(f"{omega['mean']:.1f}, {omega['smallest']:.1f}")


def _step_cells(row: Row) -> list[str]:
    summary = json.loads((RESULTS / row.record / "summary.json").read_text(encoding="utf-8"))
    base = summary["runs"][row.run]["base"]
    single, rolled = (_over_base(row, base, name) for name in ("step_rms_error", "rms_error"))
    harmed = [key for key, ratio in rolled.items() if ratio > HARM]
    spread = (
        f"{statistics.median(found.values()):.2f}, {max(found.values()):.2f}"
        for found in (single, rolled)
    )
    return [
        f"`{row.model}`", *spread, f"{len(harmed)} of {len(rolled)}",
        f"{max(single[key] for key in harmed):.2f}" if harmed else "",
    ]  # fmt: skip


def _over_base(row: Row, base: str, name: str) -> dict[tuple[str, str], float]:
    """A measure of the corrected run over that of its base, by mesh and simulation."""
    found: dict[str, dict[tuple[str, str], float]] = {row.run: {}, base: {}}
    path = RESULTS / row.record / "trajectories.csv"
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if line["run"] in found:
                found[line["run"]][line["mesh"], line["simulation"]] = float(line[name])
    return {key: x / found[base][key] for key, x in found[row.run].items()}


def _body_cells(record: dict[str, Any], model: str, bodies: str, frames: int) -> list[str]:
    simulations = record["simulations"]
    each = [row["models"][model] for row in simulations]
    nodes = [row["nodes"] for row in simulations]
    beyond = ((x, name) for row in each for name, x in row["body_beyond"].items())
    farthest = max(beyond, default=(0.0, "none"))
    refused = sum(len(row["refused"]) for row in each) / (frames * len(each))
    omega = record["omega"][model]
    span = " – ".join(map(str, sorted({min(nodes), max(nodes)})))
    ratios = sorted(row["rms_mm_with_gate"] / row["rms_mm_own_base"] for row in each)
    return [
        f"`{model}`", bodies.replace("-", " "), span, f"{len(each)}",
        f"{farthest[0]:.2f} ({farthest[1]})", f"{100 * refused:.0f}",
        _signed(f"{omega['own_base']['mean']:.1f}"),
        _signed(f"{omega['with_gate']['mean']:.1f}, {omega['with_gate']['least']:.1f}"),
        ", ".join(f"{ratio:.2f}" for ratio in ratios),
    ]  # fmt: skip


def _other_cells(record: dict[str, Any], model: str, split: str, frames: int) -> list[str]:
    each = [row["models"][model] for row in record["simulations"]]
    omega, harm = record["omega"][model], record["error_over_base"][model]
    refused = sum(len(row["refused"]) for row in each) / (frames * len(each))
    return [
        f"`{model}`", split.replace("-", " "), f"{len(each)}", f"{100 * refused:.0f}",
        _signed(f"{omega['own_base']['mean']:.1f}"),
        _signed(f"{omega['with_gate']['mean']:.1f}, {omega['with_gate']['least']:.1f}"),
        *("{median:.2f}, {largest:.2f}".format(**harm[x]) for x in ("with_gate", "without")),
    ]  # fmt: skip


def _cells(row: Row) -> list[str]:
    summary = json.loads((RESULTS / row.record / "summary.json").read_text(encoding="utf-8"))
    runs = summary["runs"]
    found, base = runs[row.run]["measures"], runs[row.run]["base"]
    omega = found["omega"]
    low, high = omega["interval"]
    alone, intermediate = (runs[name]["measures"]["omega"] for name in (base, "intermediate"))
    exact = row.model.endswith("exact")
    return [
        f"`{row.model}`", base.replace("-", " "),
        f"({row.thesis:.1f})" if exact else f"{row.thesis:.1f}",
        f"**{omega['mean']:.1f}**", _signed(f"{low:.1f} – {high:.1f}"), f"{omega['median']:.1f}",
        _signed(f"{omega['smallest']:.1f}"), f"{found['rms_reduction']['mean']:.0f}",
        _signed(f"{alone['mean']:.1f}, {alone['smallest']:.1f}"),
        "{mean:.1f}, {median:.1f}".format(**found["omega_base"]),
        f"{intermediate['mean']:.1f}, {intermediate['smallest']:.1f}",
        f"{1e3 * found['rms_error']['mean']:.2f}", _converged(runs, base, row.run),
    ]  # fmt: skip


def _converged(runs: dict[str, Any], base: str, run: str) -> str:
    """Mean RMS distances from the run that is converged in time, mm."""
    each = [runs[name]["measures"].get("converged_rms_error") for name in (base, run)]
    return "" if None in each else ", ".join(f"{1e3 * one['mean']:.1f}" for one in each)


def _signed(text: str) -> str:
    return text.replace("-", "−")


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
