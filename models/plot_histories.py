"""Draw how trainings went: Omega on the validation split over time.

python models/plot_histories.py HISTORY.csv ... OUTPUT.png

Each line has its file's name, or that of its folder where the file is a `history.csv`.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

from pdcorrect.figures.learning import plot_validations


def main() -> None:
    """Read the histories and draw them."""
    *sources, output = map(Path, sys.argv[1:])
    histories = {(p.parent if p.stem == "history" else p).stem: validations(p) for p in sources}
    print(f"wrote {plot_validations(histories, output)}")


def validations(path: Path) -> tuple[list[float], list[float]]:
    """Seconds and mean Omega of a training's validations."""
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["omega_mean"]]
    return [float(row["seconds"]) for row in rows], [float(row["omega_mean"]) for row in rows]


if __name__ == "__main__":
    main()
