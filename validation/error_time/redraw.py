"""Judge what was measured once more: figures, tables and pictures from the recorded rows.

python validation/error_time/redraw.py

Where only the case's rules or its drawing have changed, nothing need be measured again.  Times,
errors, date and machine of `results/error_time.json` stay as they are.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from rows import Measured, Row
from run import HEADS, MOTIONS, SETTINGS, outcome

from pdcorrect.replacement import write_text
from pdcorrect.validation.cases import find_cases
from pdcorrect.validation.outcome import missing, outside
from pdcorrect.validation.records import Record, save, table_csv
from pdcorrect.validation.running import slug

RESULTS = Path(__file__).parents[1] / "results"


def measured(record: Mapping[str, Any], motion: str, setting: str) -> Measured:
    """The rows of a scene."""
    label = f"{motion}, {setting}"
    (table,) = (t for t in record["tables"] if t["name"] == label)
    assert tuple(table["headings"]) == HEADS, "a record of other tables: measure anew"
    cells = [dict(zip(table["headings"], row, strict=True)) for row in table["rows"]]
    rows = [
        Row(c["method"], c["kind"], int(c["nodes"]), c["ms a frame"], 1e-3 * c["RMS error, mm"])
        for c in cells
    ]
    (reference,) = (row for row in rows if row.name == "reference")
    rows.remove(reference)
    scale = 1e-3 * record["figures"][f"{label}, largest displacement, mm"]
    return Measured(motion, setting, rows, reference, scale)


def main() -> None:
    """Read, judge, draw and write."""
    (case,) = find_cases(["error_time"])
    path = RESULTS / "error_time.json"
    known = json.loads(path.read_text(encoding="utf-8"))
    record = Record(**{**known, "figures": {}, "tables": []})
    for motion in MOTIONS:
        for setting in SETTINGS:
            caption = known["pictures"][f"error_time/{motion}-{setting}.png"]
            found = outcome(measured(known, motion, setting), False, caption)
            record.add(found)
            for picture in found.pictures:
                picture.draw(RESULTS / "error_time" / f"{picture.name}.png")
    record.outside = outside(record.figures, case.expected)
    record.outside += missing(record.figures, case.expected, quick=False)
    for table in record.tables:
        write_text(RESULTS / "error_time" / f"{slug(table['name'])}.csv", table_csv(table))
    save(path, record)
    for name, value in record.figures.items():
        if value != known["figures"].get(name):
            print(f"{name}: {known['figures'].get(name)} -> {value}")
    print(f"outside: {record.outside or 'nothing'}")


if __name__ == "__main__":
    main()
