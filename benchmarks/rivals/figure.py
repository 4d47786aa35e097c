"""Draw errors against times of all simulators under weight: python figure.py RECORD.json OUT.png"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from pdcorrect.figures.curves import plot_error_against_time

CASE = "weight"


def main() -> None:
    record, out = sys.argv[1:]
    points: dict[str, list[tuple[float, float]]] = {"ours": []}
    for row in json.loads(Path(record).read_text(encoding="utf-8"))["rivals"]["results"]:
        if row["case"] == CASE and "error_percent" in row:
            point = 1e-3 * row["cpu_ms_a_frame"], 1e-2 * row["error_percent"]
            points.setdefault(row["contestant"].split("_")[0], []).append(point)
    named = {name: tuple(np.array(found).T) for name, found in points.items()}
    plot_error_against_time(named, out, relative=True)


if __name__ == "__main__":
    main()
