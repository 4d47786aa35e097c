"""Draw a machine's batch results: steps a second, and with derivatives, against batch size.

python benchmarks/plot_batches.py benchmarks/results/MACHINE.json docs/images/batches.png
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter


def main() -> None:
    """Two panels, coarse and fine scenes; the CPU solver, one scene at a time, as a level."""
    source, target = sys.argv[1:]
    record = json.loads(Path(source).read_text())
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.8), layout="constrained")
    for axis, mesh, cpu in zip(axes, ("coarse", "fine"), record["one at a time, CPU"], strict=True):
        rows = record[mesh]
        if cpu["nodes"] != rows[0]["nodes"]:
            raise SystemExit(f"{source}: the CPU's scenes are not those of the batch.")
        draw(axis, rows, cpu)
        axis.set_title(f"{rows[0]['nodes']} nodes", fontsize=12)
    axes[0].set_ylabel("scenes a second")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.savefig(target, dpi=130)
    print(f"wrote {target}")


def draw(axis: Axes, rows: list[dict[str, Any]], cpu: dict[str, Any]) -> None:
    """One mesh: both rates on the GPU, and the CPU's."""
    sizes = [row["scenes"] for row in rows]
    both = cpu["step_ms"] + cpu["backward_ms"]
    curves = (
        ("tab:blue", "step", [r["scene_steps_a_second"] for r in rows], 1e3 / cpu["step_ms"]),
        (
            "tab:orange",
            "step and derivative",
            [r["forward_and_backward_a_second"] for r in rows],
            1e3 / both,
        ),
    )
    for colour, name, rates, alone in curves:
        axis.loglog(sizes, rates, color=colour, marker="o", label=f"GPU batch, {name}")
        axis.axhline(alone, color=colour, linestyle=":", label=f"CPU one by one, {name}")
    axis.set_xticks(sizes)
    axis.xaxis.set_minor_formatter(NullFormatter())
    for each in (axis.xaxis, axis.yaxis):
        each.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_xlabel("scenes in the batch")
    axis.grid(visible=True, which="major", alpha=0.3)


if __name__ == "__main__":
    main()
