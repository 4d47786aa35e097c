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

NAMES = {
    "cholesky": "G, Cholesky",
    "amg": "G, multigrid cycle",
    "band": "rest Hessian, band",
    "rest-amg": "rest Hessian, multigrid cycle",
}
BODIES = {"beam": "slender beam", "block": "compact block"}
PANELS = (
    ("step_s", "time of a step, s"),
    ("prepare_s", "preparation (factorise), s"),
    ("peak_megabytes", "peak memory of the process, MB"),
)


def main() -> None:
    """A row a body, three panels each; a line a method, with the fitted exponent."""
    source, target = sys.argv[1:]
    results = json.loads(Path(source).read_text())["growth"]["results"]
    figure, table = plt.subplots(
        2, 3, figsize=(13, 8), layout="constrained", sharex=True, sharey="col"
    )
    for body, axes in zip(("beam", "block"), table, strict=True):
        for axis, (key, title) in zip(axes, PANELS, strict=True):
            for marker, (method, name) in zip("os^D", NAMES.items(), strict=True):
                rows = [r for r in results["rows"] if (r["body"], r["method"]) == (body, method)]
                power = results["powers"][body][method][key]
                axis.loglog(
                    [row["nodes"] for row in rows],
                    [row[key] for row in rows],
                    marker=marker,
                    label=f"{name}: N^{power:.2f}",
                )
            axis.set_title(f"{BODIES[body]}: {title}", fontsize=10)
            axis.grid(visible=True, which="major", alpha=0.3)
            axis.legend(fontsize=8)
    for axis in table[-1]:
        axis.set_xlabel("nodes N")
    figure.savefig(target, dpi=130)
    print(f"wrote {target}")


if __name__ == "__main__":
    main()
