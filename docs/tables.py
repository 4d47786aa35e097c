"""Write the tables of the documentation from the records they quote.

A table stands in a Markdown file between `<!-- table: NAME -->` and `<!-- end -->`.  This script
writes what `TABLES[NAME]` gives between the two lines, in every Markdown file of the repository:

    python docs/tables.py           # rewrite
    python docs/tables.py --check   # exit 1 if a page would change

A table is a function without arguments that returns the header's cells and the rows' cells; those
of models are in `model_tables`, those of other simulators in `rivals_tables`, those of pages in
`page_tables`, those of cases about time in `time_tables` and `break_even_tables`, and what all use
in `records`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import benchmark_tables
import break_even_tables
import model_tables
import page_tables
import rivals_tables
import time_tables
from records import ROOT, Rows

_BLOCK = re.compile(r"(<!-- table: ([a-z0-9-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
_SKIPPED = {".git", ".venv", "node_modules", "_build"}


# --- the tables ------------------------------------------------------------------------------


TABLES: dict[str, Callable[[], Rows]] = {
    **dict(model_tables.tables()),
    **dict(benchmark_tables.tables()),
    **dict(rivals_tables.tables()),
    **dict(page_tables.tables()),
    **dict(time_tables.tables()),
    **dict(break_even_tables.tables()),
}


# --- writing them ----------------------------------------------------------------------------


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column to the left, the others to the right."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "".join(f"|{'|'.join(row)}|\n" for row in (header, rule, *rows))


def filled(text: str) -> str:
    """``text`` with all its tables written anew."""

    def block(match: re.Match[str]) -> str:
        if match[2] not in TABLES:
            raise KeyError(f"no table {match[2]!r}: expected one of {', '.join(TABLES)}")
        return match[1] + "\n" + markdown(*TABLES[match[2]]()) + "\n" + match[3]

    return _BLOCK.sub(block, text)


def pages() -> list[Path]:
    found = (page for page in ROOT.rglob("*.md") if not _SKIPPED & set(page.parts))
    return sorted(page for page in found if "<!-- table: " in page.read_text(encoding="utf-8"))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Write the tables of the documentation.")
    parser.add_argument("--check", action="store_true", help="change nothing; exit 1 if needed")
    check = parser.parse_args(arguments).check
    changed = failed = False
    for page in pages():
        old = page.read_text(encoding="utf-8")
        try:
            new = filled(old)
        except KeyError as error:
            print(f"{page.relative_to(ROOT)}: {error.args[0]}", file=sys.stderr)
            failed = True
            continue
        if new != old:
            changed = True
            print(f"{'out of date' if check else 'written'}: {page.relative_to(ROOT)}")
            if not check:
                page.write_text(new, encoding="utf-8")
    return 1 if failed or (check and changed) else 0


if __name__ == "__main__":
    sys.exit(main())
