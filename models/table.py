"""Print the tables of ``docs/results.md`` from records of evaluations; a test holds them equal.

python models/table.py

The first has models on unseen meshes of their evaluation splits, the second further splits as a
whole, the third first loads of scenes unlike those of the training, both with the default gate of
their day and without one, the fourth bodies of other sizes and families, the fifth, for the models
of the first, errors of single steps beside those of rollouts, the sixth what needs no network, the
seventh the model of all motions beside those of one, the eighth other trainings in the exact
setting: seeds, numbers of bodies, the plain base.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from program import run_script
from table_rows import (
    BODIES,
    BODY_HEADINGS,
    HARM,
    HEADINGS,
    JOINT_HEADINGS,
    JOINT_RECORD,
    MEASURED,
    OTHER_HEADINGS,
    OTHER_STEPS,
    OTHER_WEIGHTS,
    OTHERS,
    PUBLISHED,
    ROWS,
    STEP_HEADINGS,
    TRAINING_HEADINGS,
    TRAININGS,
    WITHOUT_NETWORK,
    Row,
)

from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.plan import make_plan

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "validation" / "results"


def main() -> None:
    """Print them, each below the page's heading."""
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    print("\n\n".join(f"**{heading}**\n\n{text}" for heading, text in tables().items()))


def tables() -> dict[str, str]:
    """All tables in Markdown by the headings of the page under which they stand."""
    return {
        "Results": table(),
        "Further splits as a whole": splits_table(),
        "First loads": others_table(),
        "Bodies unlike those of the training": bodies_table(),
        "What single steps do not show": steps_table(),
        "What needs no network": baselines_table(),
        "One model for three motions": together_table(),
        "Other trainings in the exact setting": trainings_table(),
    }


def table() -> str:
    """The table in Markdown."""
    head = [_line(HEADINGS), _line(["---", "---", *["---:"] * (len(HEADINGS) - 2)])]
    return "\n".join([*head, *(_line(_cells(row)) for row in ROWS)])


def others_table() -> str:
    """The third table in Markdown."""
    lines = []
    for dataset in ("impulse-exact", "stretch-exact", "torsion-exact"):
        plans = make_plan(DatasetConfig.load(ROOT / "datasets" / dataset / "config.toml"))
        for split in OTHERS:
            path = RESULTS / "other-scenes" / f"{dataset}-{split}.json"
            if path.exists() and not (RESULTS / _split_record(dataset, split)).is_dir():
                frames = next(plan.frames for plan in plans if plan.split == split)
                record = json.loads(path.read_text(encoding="utf-8"))
                lines.append(_line(_other_cells(record, dataset, split, frames)))
    return "\n".join([*_other_head(), *lines])


def _other_head() -> list[str]:
    return [_line(OTHER_HEADINGS), _line(["---", "---", *["---:"] * (len(OTHER_HEADINGS) - 2)])]


def bodies_table() -> str:
    """The fourth table in Markdown."""
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
    """The fifth table in Markdown."""
    head = [_line(STEP_HEADINGS), _line(["---", *["---:"] * (len(STEP_HEADINGS) - 1)])]
    return "\n".join([*head, *(_line(_step_cells(row)) for row in ROWS)])


def baselines_table() -> str:
    """The sixth table in Markdown."""
    records = [_summary(f"baselines/{name}") for name in MEASURED]
    headings = ("coarse mesh with", *(name.replace("-", " ") for name in MEASURED))
    lines = [_line(headings), _line(["---", *["---:"] * len(MEASURED)])]
    for run, name in WITHOUT_NETWORK.items():
        cells = [_baseline_cell(record, run) for record in records]
        factors = ", ".join(f"{record['stiffness_factor']:.2f}" for record in records)
        lines.append(_line([name.format(factors=factors), *cells]))
    return "\n".join(lines)


def together_table() -> str:
    """The seventh table in Markdown."""
    lines = [_line(JOINT_HEADINGS), _line(["---", *["---:"] * (len(JOINT_HEADINGS) - 1)])]
    for name in PUBLISHED:
        own = next(row for row in ROWS if row.model == f"{name}-total-mass")
        row = Row(JOINT_RECORD, f"{JOINT_RECORD}/{name.split('-')[0]}", "model", own.thesis)
        found, alone = (_summary(one.record)["runs"] for one in (row, own))
        omega, other = (
            runs[one.run]["measures"]["omega"] for runs, one in ((found, row), (alone, own))
        )
        ratios = _over(row.record, row.run, found["model"]["base"], "rms_error").values()
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


def trainings_table() -> str:
    """The eighth table in Markdown."""
    lines = [_line(TRAINING_HEADINGS), _line(["---"] * 3 + ["---:"] * 7)]
    for split, record, run, what in TRAININGS:
        found = _summary(record)["runs"][run]
        omega, base = found["measures"]["omega"], found["base"]
        harmed, nearer = (
            sum(x > bound for x in _over(record, run, other, "rms_error").values())
            for other, bound in ((base, HARM), ("intermediate", 1.0))
        )
        lines.append(_line([
            split, what, base, f"**{omega['mean']:.1f}**",
            _signed("{:.1f} – {:.1f}".format(*omega["interval"])), f"{omega['median']:.1f}",
            _signed(f"{omega['smallest']:.1f}"),
            f"{found['measures']['omega_base']['mean']:.1f}", f"{harmed} of {omega['count']}",
            f"{nearer}",
        ]))  # fmt: skip
    return "\n".join(lines)


def splits_table() -> str:
    """The second table in Markdown."""
    names = [
        (row.model, split) for row in ROWS for split in OTHERS
        if (RESULTS / _split_record(row.model, split)).is_dir()
    ]  # fmt: skip
    return "\n".join([*_other_head(), *(_line(_split_cells(*name)) for name in names)])


def _split_record(model: str, split: str) -> str:
    return f"other-splits/{model}-{split}"


def _split_cells(model: str, split: str) -> list[str]:
    record = _split_record(model, split)
    runs = _summary(record)["runs"]
    run = next(name for name, found in runs.items() if "gate_rate" in found["measures"])
    found, ratios = runs[run], []
    without = record if _lets_all_pass(found) else f"{record}-no-gate"
    for one in (record, without):
        each = _over(one, run, found["base"], "rms_error")
        ratios.append(f"{statistics.median(each.values()):.2f}, {max(each.values()):.2f}")
    omega, base = (x["measures"]["omega"] for x in (found, runs[found["base"]]))
    return [
        _model(model, split), split.replace("-", " "), f"{omega['count']}",
        f"{found['measures']['gate_rate']['mean']:.0f}", _signed(f"{base['mean']:.1f}"),
        _signed(f"{omega['mean']:.1f}, {omega['smallest']:.1f}"), *ratios,
    ]  # fmt: skip


def _lets_all_pass(run: dict[str, Any]) -> bool:
    """Whether a gate refused no step of any rollout, so that it is the run without one."""
    return bool(run["measures"]["gate_rate"]["largest"] == 0.0)


def _model(model: str, split: str) -> str:
    """The model, and whether the record is of another gate, or other weights, than now."""
    parts = ["gate"] if split in OTHER_STEPS else []
    parts += ["weights"] if f"{model}-{split}" in OTHER_WEIGHTS else []
    return f"`{model}`" + (f", {' and '.join(parts)} before" if parts else "")


def _baseline_cell(record: dict[str, Any], run: str) -> str:
    if run not in record["runs"]:  # total mass as published only, best coarse model in exact only
        return ""
    omega = record["runs"][run]["measures"]["omega"]
    return _signed(f"{omega['mean']:.1f}, {omega['smallest']:.1f}")


def _step_cells(row: Row) -> list[str]:
    summary = _summary(row.record)
    base = summary["runs"][row.run]["base"]
    single, rolled = (
        _over(row.record, row.run, base, name) for name in ("step_rms_error", "rms_error")
    )
    harmed = [key for key, ratio in rolled.items() if ratio > HARM]
    spread = (
        f"{statistics.median(found.values()):.2f}, {max(found.values()):.2f}"
        for found in (single, rolled)
    )
    return [
        f"`{row.model}`", *spread, f"{len(harmed)} of {len(rolled)}",
        f"{max(single[key] for key in harmed):.2f}" if harmed else "",
    ]  # fmt: skip


def _over(record: str, run: str, base: str, name: str) -> dict[tuple[str, str], float]:
    """A measure of the corrected run over that of its base, by mesh and simulation."""
    found: dict[str, dict[tuple[str, str], float]] = {run: {}, base: {}}
    path = RESULTS / record / "trajectories.csv"
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if line["run"] in found:
                found[line["run"]][line["mesh"], line["simulation"]] = float(line[name])
    return {key: x / found[base][key] for key, x in found[run].items()}


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
        _model(model, split), split.replace("-", " "), f"{len(each)}", f"{100 * refused:.0f}",
        _signed(f"{omega['own_base']['mean']:.1f}"),
        _signed(f"{omega['with_gate']['mean']:.1f}, {omega['with_gate']['least']:.1f}"),
        *("{median:.2f}, {largest:.2f}".format(**harm[x]) for x in ("with_gate", "without")),
    ]  # fmt: skip


def _cells(row: Row) -> list[str]:
    runs = _summary(row.record)["runs"]
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
        f"{1e3 * found['rms_error']['mean']:.2f}", _converged(row, runs, base),
    ]  # fmt: skip


def _converged(row: Row, runs: dict[str, Any], base: str) -> str:
    """Mean RMS distances from the run converged in time, mm; starred if of another record."""
    run, star = row.run, ""
    if row.converged is not None:
        runs, run, star = _summary(row.converged)["runs"], row.model, "*"
    each = [runs[name]["measures"].get("converged_rms_error") for name in (base, run)]
    return "" if None in each else ", ".join(f"{1e3 * one['mean']:.1f}" for one in each) + star


def _summary(record: str) -> dict[str, Any]:
    """What `pdcorrect evaluate` wrote there."""
    path = RESULTS / record / "summary.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def _signed(text: str) -> str:
    return text.replace("-", "−")


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    run_script(main)
