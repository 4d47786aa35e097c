"""Draw the case "growth" of a machine's results: time and memory against nodes.

python benchmarks/plot_growth.py benchmarks/results/MACHINE.json docs/images/growth.png
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

NAMES = {
    "cholesky": "G, Cholesky",
    "amg": "G, multigrid",
    "band": "rest Hessian, band",
    "rest-amg": "rest Hessian, multigrid",
}
BODIES = {"beam": "slender beam", "block": "compact block"}
PANELS = (
    ("step_s", "time of a step, s"),
    ("prepare_s", "preparation, s"),
    ("peak_megabytes", "peak memory, MB"),
)


def main() -> None:
    """A row a body, three panels each; a line a method, with the fitted exponent."""
    source, target = sys.argv[1:]
    results = json.loads(Path(source).read_text())["growth"]["results"]
    layout = ConstrainedLayoutEngine(h_pad=0.12, w_pad=0.08)
    figure, table = plt.subplots(2, 3, figsize=(13, 8.5), layout=layout, sharex=True, sharey="col")
    for body, axes in zip(("beam", "block"), table, strict=True):
        for axis, (key, title) in zip(axes, PANELS, strict=True):
            for marker, (method, name) in zip("os^D", NAMES.items(), strict=True):
                rows = [r for r in results["rows"] if (r["body"], r["method"]) == (body, method)]
                power = results["powers"][body][method][key]
                axis.loglog(
                    [row["nodes"] for row in rows],
                    [row[key] for row in rows],
                    marker=marker,
                    label=rf"{name}: $N^{{{power:.2f}}}$",
                )
            axis.set_title(f"{BODIES[body]}: {title}", fontsize=12)
            axis.grid(visible=True, which="major", alpha=0.3)
            axis.set_xlabel("nodes N")
            axis.tick_params(labelbottom=True)
            plain_ticks(axis, (1.0,) if key != "peak_megabytes" else (1.0, 2.0, 5.0))
            axis.legend(fontsize=9.5, loc="upper left")
    for axis in table[0]:  # rows share their limits
        low, high = axis.get_ylim()
        axis.set_ylim(low, high * (high / low) ** 0.2)  # room for the legend
    figure.savefig(target, dpi=130)
    print(f"wrote {target}")


def plain_ticks(axis: Axes, steps: tuple[float, ...]) -> None:
    """Whole numbers at the chosen multiples of powers of ten, not 2 x 10^2."""
    axis.yaxis.set_major_locator(LogLocator(subs=steps))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())


if __name__ == "__main__":
    main()
