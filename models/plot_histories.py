"""Draw how trainings went: Omega on the validation split over time.

python models/plot_histories.py HISTORY.csv ... OUTPUT.png

Each line has its file's name, or that of its folder where the file is a `history.csv`.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from program import run_script

from pdcorrect.errors import InputError
from pdcorrect.figures.learning import plot_validations


def main() -> None:
    """Read the histories and draw them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sources", type=Path, nargs="+", metavar="HISTORY.csv")
    parser.add_argument("output", type=Path, metavar="OUTPUT.png")
    options = parser.parse_args()
    histories = {
        (p.parent if p.stem == "history" else p).stem: validations(p) for p in options.sources
    }
    print(f"wrote {plot_validations(histories, options.output)}")


def validations(path: Path) -> tuple[list[float], list[float]]:
    """Seconds and mean Omega of a training's validations.

    Raises
    ------
    InputError
        If it is no history of a training.
    """
    try:
        with path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["omega_mean"]]
        return [float(row["seconds"]) for row in rows], [float(row["omega_mean"]) for row in rows]
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: expected the history.csv of a training ({error}).") from None


if __name__ == "__main__":
    run_script(main)
