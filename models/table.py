"""Print the tables of ``docs/results.md`` from records of evaluations; a test holds them equal.

python models/table.py

The first has a model of each data set on unseen meshes, the second those whose base has the
reference's total mass, beside others on the same simulations.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "validation" / "results"


@dataclass(frozen=True)
class Row:
    """A data set's evaluation.

    Attributes
    ----------
    dataset, record, run : str
        The record is a folder of `RESULTS`; the run is the corrected one.
    thesis : float
        Reported mean Omega of the thesis's own model of this motion, %.
    """

    dataset: str
    record: str
    run: str
    thesis: float


ROWS = (
    Row("impulse-as-published", "impulse-as-published", "model", 95.9),
    Row("stretch-as-published", "stretch-as-published", "stretch-as-published", 99.1),
    Row("torsion-as-published", "torsion-as-published", "through/model", 91.3),
    Row("impulse-exact", "impulse-exact", "impulse-exact", 95.9),
    Row("stretch-exact", "stretch-exact", "stretch-exact", 99.1),
    Row("torsion-exact", "torsion-exact-third", "torsion-exact", 91.3),
)
HEADINGS = (
    "data set", "thesis", "corrected: Ω mean", "95 %", "median", "worst", "RMS error removed, %",
    "own base: Ω", "of own base's error", "total mass: Ω", "intermediate mesh: Ω, worst",
    "RMS, mm", "to converged in time, mm: base, corrected",
)  # fmt: skip


HEAVY = {"stretch-as-published-total-mass": 99.1, "torsion-as-published-total-mass": 91.3}
"""Records of models on the coarse mesh with the reference's total mass; the thesis's own Omega."""
HEAVY_HEADINGS = (
    "model", "simulations", "base", "base alone: Ω mean, median, worst",
    "corrected: Ω mean, median, worst", "thesis", "RMS, mm: plain mesh, corrected",
)  # fmt: skip


def main() -> None:
    """Print them."""
    print(table())
    print()
    print(heavy_table())


def table() -> str:
    """The table in Markdown."""
    head = [_line(HEADINGS), _line(["---", *["---:"] * (len(HEADINGS) - 1)])]
    return "\n".join([*head, *(_line(_cells(row)) for row in ROWS)])


def heavy_table() -> str:
    """The second table in Markdown."""
    head = [_line(HEAVY_HEADINGS), _line(["---", *["---:"] * (len(HEAVY_HEADINGS) - 1)])]
    lines = []
    for name, thesis in HEAVY.items():
        record = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
        for model, omega in record["omega"].items():
            each = record["simulations"]
            left = sum(x["models"][model]["rms_mm_with_gate"] for x in each) / len(each)
            plain = sum(x["rms_mm_plain"] for x in each) / len(each)
            lines.append(_line([
                f"`{model}`", f"{len(each)}", "total mass" if model == name else "plain",
                _three(omega["own_base"]), f"**{_three(omega['with_gate'])}**", f"{thesis:.1f}",
                f"{plain:.1f}, {left:.2f}",
            ]))  # fmt: skip
    return "\n".join([*head, *lines])


def _three(omega: dict[str, float]) -> str:
    return _signed(", ".join(f"{omega[key]:.1f}" for key in ("mean", "median", "least")))


def _cells(row: Row) -> list[str]:
    summary = json.loads((RESULTS / row.record / "summary.json").read_text(encoding="utf-8"))
    runs = summary["runs"]
    found = runs[row.run]["measures"]
    base = runs[row.run]["base"]
    omega = found["omega"]
    low, high = omega["interval"]
    intermediate = runs["intermediate"]["measures"]["omega"]
    heavy = runs.get("total-mass")
    exact = row.dataset.endswith("exact")
    return [
        f"`{row.dataset}`", f"({row.thesis:.1f})" if exact else f"{row.thesis:.1f}",
        f"**{omega['mean']:.1f}**", _signed(f"{low:.1f} – {high:.1f}"), f"{omega['median']:.1f}",
        _signed(f"{omega['smallest']:.1f}"), f"{found['rms_reduction']['mean']:.0f}",
        f"{runs[base]['measures']['omega']['mean']:.1f}",
        f"{found['omega_base']['median']:.1f}",
        f"{heavy['measures']['omega']['mean']:.1f}" if heavy else "",
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
