"""The report of cases on one page: ten figures, a table of the others, and all judged figures.

python validation/report.py

writes ``validation/report.md`` and ``validation/figures`` anew from the records in
``validation/results``; `pdcorrect validate` writes the same and ``index.html`` into its output.
"""

from __future__ import annotations

import html
import importlib.util
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness

from pdcorrect._files import make_folder, write_bytes, write_text
from pdcorrect.errors import OutputError

HERE = Path(__file__).parent
FIGURES = (
    "error_time", "unlike_families", "easy_to_hard", "four_errors", "time_orders", "energy",
    "stability", "cook", "locking", "turek_hron",
)  # fmt: skip
"""The order of the cases that draw one."""


@dataclass(frozen=True)
class Section:
    """A case in the report.

    ``finding`` is its sentence about the record, and ``figure`` its path in the report's folder;
    "" if there is none.
    """

    case: harness.Case
    record: harness.Record
    finding: str = ""
    figure: str = ""


def section(case: harness.Case, record: harness.Record, folder: Path) -> Section:
    """Find the sentence and draw the figure of a full record.

    An exception of the case's code there, as of a figure that is no number, becomes the record's
    error.

    Raises
    ------
    OutputError
        If the figure cannot be written.
    """
    if record.quick or record.error:
        return Section(case, record)
    try:
        return Section(case, record, finding(case, record), figure(case, record, folder))
    except OutputError:
        raise
    except Exception:  # of the case's own code
        record.error = traceback.format_exc()
        return Section(case, record)


def finding(case: harness.Case, record: harness.Record) -> str:
    """The case's sentence about its record."""
    return str(case.module.finding(record)) if hasattr(case.module, "finding") else ""


def figure(case: harness.Case, record: harness.Record, folder: Path) -> str:
    """Draw a case's figure from its record; its path in the folder, "" if it has none."""
    if not hasattr(case.module, "draw") or importlib.util.find_spec("matplotlib") is None:
        return ""
    place = make_folder(folder / "figures") / f"{case.name}.png"
    with tempfile.TemporaryDirectory() as scratch:  # a figure is there whole or not at all
        case.module.draw(record, Path(scratch) / place.name)
        write_bytes(place, (Path(scratch) / place.name).read_bytes())
    return f"figures/{place.name}"


def write(sections: Sequence[Section], folder: Path, page: bool = True) -> Path:
    """Write ``report.md`` and, if asked for, ``index.html``; gives the last.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    folder = make_folder(folder)
    write_text(folder / "report.md", "\n".join(markdown(sections)))
    if not page:
        return folder / "report.md"
    write_text(folder / "index.html", "\n".join(as_html(sections)))
    return folder / "index.html"


def conditions(sections: Sequence[Section]) -> str:
    """How much was judged."""
    words = [row[-1] for each in sections for row in harness.judged(each.case, each.record)]
    return (
        f"{len(sections)} cases have {len(words)} figures with expectations: "
        f"{words.count('ok')} hold, {words.count('known failure')} are known failures, kept with "
        f"their reasons, {words.count('outside')} came out other than expected. Seeds are in the "
        "cases' scripts."
    )


def measured(record: harness.Record) -> str:
    """When, on what and for how long."""
    told = [record.environment.get(key, "") for key in ("processor", "dtype")]
    threads = f"{record.environment.get('threads', '')} threads".replace("1 threads", "1 thread")
    return ", ".join([record.date, *told, threads, f"{record.seconds / 60:.0f} min"])


def on_page(sections: Sequence[Section]) -> tuple[list[Section], list[Section]]:
    """Those that are told with a figure, in the page's order, and the others."""
    told = [each for each in sections if each.figure]
    told.sort(key=lambda each: (*FIGURES, each.case.name).index(each.case.name))
    return told, [each for each in sections if not each.figure]


def markdown(sections: Sequence[Section]) -> Iterator[str]:
    """A sentence and a figure for each case that has one, and a row for each other."""
    yield from ("# Validation report", "", conditions(sections), "")
    told, others = on_page(sections)
    for number, each in enumerate(told, start=1):
        title = each.case.title
        yield from (f"## {number}. {title}", "", each.finding, "")
        yield from (f"![{title}]({each.figure})", "")
    yield from ("## Judged", "", "|case|verdict|finding|measured|", "|---|---|---|---|")
    for each in (*told, *others):
        finding = "above" if each.figure else " ".join(each.finding.split())
        verdict = harness.verdict(each.case, each.record)
        yield f"|{each.case.title}|{verdict}|{finding}|{measured(each.record)}|"
    for each in others:
        if each.record.error:
            yield from ("", f"{each.case.title}:", "", "```text", each.record.error.rstrip(), "```")
    yield ""


_STYLE = """body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto }
table { border-collapse: collapse; font-size: 0.9rem } th { text-align: left }
th, td { padding: 0.2rem 0.8rem 0.2rem 0; border-bottom: 1px solid #ddd; vertical-align: top }
.fail, .outside { background: #f6d3cd } .known { background: #fbeec9 } img { max-width: 100% }"""


def as_html(sections: Sequence[Section]) -> Iterator[str]:
    """The same with all tables and all figures that were judged, folded up by case."""
    yield f'<!doctype html><html lang="en"><head><meta charset="utf-8"><style>{_STYLE}</style>'
    yield "<title>pdcorrect: validation report</title></head><body><h1>Validation report</h1>"
    yield f"<p>{html.escape(conditions(sections))}</p>"
    told, others = on_page(sections)
    for each in told:
        title = html.escape(each.case.title)
        yield f"<h2>{title}</h2><p>{html.escape(each.finding)}</p>"
        yield f'<p><img src="{each.figure}" alt="{title}"></p>'
    yield "<h2>Judged</h2>"
    for each in (*told, *others):
        case, record = each.case, each.record
        verdict = harness.verdict(case, record)
        yield f"<details{' open' * (not record.passed)}><summary>{html.escape(case.title)}: "
        yield f'<span class="{verdict.split(":")[0]}">{html.escape(verdict)}</span></summary>'
        lines = (case.question, each.finding, f"{measured(record)}: {record.command}")
        yield from (f"<p>{html.escape(line)}</p>" for line in lines)
        yield f"<pre>{html.escape(record.error)}</pre>" if record.error else ""
        for table in record.tables:
            yield f"<h3>{html.escape(table['name'])}</h3>"
            yield from _table(table["headings"], table["rows"])
        yield from _table(harness.JUDGED, harness.judged(case, record))
        yield "</details>"
    yield "</body></html>"


def _table(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> Iterator[str]:
    yield "<table><tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in headings) + "</tr>"
    for row in rows:
        cells = [harness.shown(cell) for cell in row]
        kind = cells[-1].split()[0] if cells[-1] in ("outside", "known failure") else ""
        told = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        yield f'<tr class="{kind}">{told}</tr>'
    yield "</table>"


def main() -> None:
    """Write the report of the records that are kept in the repository."""
    cases = harness.find_cases(folder=HERE)
    records = [harness.load(HERE / "results" / f"{case.name}.json") for case in cases]
    pairs = zip(cases, records, strict=True)
    sections = [section(case, record, HERE) for case, record in pairs if record is not None]
    print(write(sections, HERE, page=False))
    sys.exit(0 if all(each.record.passed for each in sections) else 1)


if __name__ == "__main__":
    main()
