"""Judge and draw once more from the recorded rows, where only expectations or pictures changed.

python validation/easy_to_hard/redraw.py

Figures, times, date and machine of `results/easy_to_hard.json` stay as they are.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from run import HEADS, Row, caption, common, draw

from pdcorrect.validation.cases import find_cases
from pdcorrect.validation.outcome import missing, outside
from pdcorrect.validation.records import Record, save


def simulations(table: Mapping[str, Any]) -> list[dict[str, Row]]:
    """The rows of a data set's simulations by method, easy ones first."""
    assert tuple(table["headings"]) == HEADS, "a record of other tables: measure anew"
    found: dict[tuple[float, float], dict[str, Row]] = {}
    for cells in table["rows"]:
        _, mesh, simulation, _, name, nodes, milliseconds, error, omega = cells
        row = Row(name, int(nodes), milliseconds, 1e-3 * error, omega)
        found.setdefault((mesh, simulation), {})[name] = row
    return list(found.values())


def main() -> None:
    """Read, judge, draw and write."""
    (case,) = find_cases([Path(__file__).parent.name])
    path = common.RESULTS / f"{case.name}.json"
    record = Record(**json.loads(path.read_text(encoding="utf-8")))
    for table in record.tables:
        picture = f"{case.name}/{table['name']}.png"
        assert picture in record.pictures
        record.pictures[picture] = caption(table["name"])
        draw(common.RESULTS / picture, simulations(table))
    record.outside = outside(record.figures, case.expected)
    record.outside += missing(record.figures, case.expected, quick=False)
    save(path, record)
    print(f"outside: {record.outside or 'nothing'}")


if __name__ == "__main__":
    main()
