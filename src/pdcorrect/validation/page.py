"""The report of all cases: one HTML page with the pictures in it, Markdown, and CSV."""

from __future__ import annotations

import base64
import csv
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdcorrect._files import make_folder, write_text
from pdcorrect.errors import OutputError
from pdcorrect.validation.cases import ValidationCase
from pdcorrect.validation.outcome import Figure
from pdcorrect.validation.prose import as_html, without_links
from pdcorrect.validation.records import Record

Rows = Sequence[Sequence[str]]
_MARKS = {
    "pass": "pass",
    "slow": "slow",
    "fail": "fail",
    "OUTSIDE": "fail",
    "fails": "slow",
    "ok": "pass",
}
"""Classes of cells that are coloured."""
_OVERVIEW = ("case", "question", "figures judged", "outside", "known to fail", "seconds")
_KNOWN = "fails, known:"
_JUDGED = ("figure", "found", "expected", "source", "")
_TIMES = "Times were taken as they came, whatever else ran."


@dataclass(frozen=True)
class Section:
    """A case with its result."""

    case: ValidationCase
    record: Record

    @property
    def verdict(self) -> str:
        """In words."""
        if self.record.error:
            return "fail: the case ended with an error"
        if self.record.outside:
            return f"fail: {len(self.record.outside)} figures outside"
        known = self._known()
        return f"pass, but for {known} figures that are known to fail" if known else "pass"

    def _known(self) -> int:
        return sum(row[-1].startswith(_KNOWN) for row in self.judged())

    def judged(self) -> list[tuple[str, ...]]:
        """Rows of `_JUDGED`: those outside first."""
        rows = []
        for name, aim in self.case.expected.items():
            if name in self.record.figures or name in self.record.outside:
                found = self.record.figures.get(name)
                mark = "OUTSIDE" if name in self.record.outside else "ok"
                if aim.known_failure:
                    fixed = f"OUTSIDE: is as expected, known to fail: {aim.known_failure}"
                    mark = fixed if mark == "OUTSIDE" else f"{_KNOWN} {aim.known_failure}"
                shown = shown_figure(found) if name in self.record.figures else "missing"
                rows.append((name, shown, aim.describe(), aim.source, mark))
        order = ("OUTSIDE", _KNOWN, "")
        return sorted(
            rows, key=lambda row: [row[-1].startswith(mark) for mark in order].index(True)
        )

    @property
    def made(self) -> str:
        """How, when and beside how much else it was made."""
        record = self.record
        return (
            f"{record.date}, by `{record.command}`, {record.seconds:.0f} s; load at the "
            f"beginning {record.load:.2g}"
        )

    def overview(self) -> tuple[str, ...]:
        """A row of `_OVERVIEW`."""
        judged = self.judged()
        wrong = sum(row[-1].startswith("OUTSIDE") for row in judged)
        outside = "error" if self.record.error else str(wrong)
        return (
            self.case.name, self.case.question or self.case.title, str(len(judged)), outside,
            str(self._known()), f"{self.record.seconds:.0f}",
        )  # fmt: skip


def write_page(sections: Sequence[Section], folder: str | Path, summary: str = "") -> Path:
    """Write ``index.html``, ``report.md`` and ``figures.csv``; pictures are there already.

    Parameters
    ----------
    sections : sequence of Section
    folder : path
    summary : str
        Markdown to begin with.

    Returns
    -------
    Path
        Of the HTML page.

    Raises
    ------
    OutputError
        If a file cannot be written, or a picture is not there.
    """
    folder = make_folder(folder)
    write_text(folder / "figures.csv", to_csv(sections))
    write_text(folder / "report.md", to_markdown(sections, summary))
    write_text(folder / "index.html", to_html(sections, folder, summary))
    return folder / "index.html"


def shown_figure(value: Figure | None) -> str:
    """A figure as text, with four digits."""
    if value is None:
        return "none"
    return value if isinstance(value, str) else f"{value:.4g}"


def conditions(sections: Sequence[Section]) -> str:
    """On what the results were made, in one paragraph for each machine, or state of one."""
    told: dict[tuple[str, bool], list[str]] = {}
    for one in sections:
        made = ", ".join(f"{key} {value}" for key, value in one.record.environment.items())
        told.setdefault((made, one.record.quick), []).append(one.case.name)
    return "\n\n".join(
        f"{', '.join(names)}: {'quick parts only' if quick else 'all parts'}. {made}."
        for (made, quick), names in told.items()
    )


def to_csv(sections: Sequence[Section]) -> str:
    """All figures of all cases, one line each, with what was expected."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["case", "figure", "found", *_AIM, "status", "source", "as expected"])
    for one in sections:
        for name, found in one.record.figures.items():
            aim = one.case.expected.get(name)
            told = [""] * (len(_AIM) + 3)
            if aim:
                numbers = [_number(getattr(aim, key)) for key in _AIM]
                good = "no" if name in one.record.outside else "yes"
                told = [*numbers, " or ".join(aim.status or ()), aim.source, good]
            writer.writerow([one.case.name, name, found, *told])
    return buffer.getvalue()


_AIM = ("value", "tolerance", "at_least", "at_most")
"""Numbers of an expectation."""


def _number(value: float | None) -> str:
    return "" if value is None else repr(value)


# --- Markdown --------------------------------------------------------------------------------


def to_markdown(sections: Sequence[Section], summary: str = "") -> str:
    """The report; pictures are links."""
    lines = ["# Validation report", "", *_paragraphs(summary)]
    lines += _markdown_table(_OVERVIEW, [one.overview() for one in sections])
    lines += ["", *_paragraphs(conditions(sections)), _TIMES]
    for one in sections:
        lines += ["", f"## {one.case.title}", "", f"Case `{one.case.name}`: {one.verdict}."]
        lines += [f"Made {one.made}.", "", one.case.question, ""]
        if one.record.error:
            lines += ["```", one.record.error.rstrip(), "```", ""]
        lines += _paragraphs(one.case.findings)
        for name, caption in one.record.pictures.items():
            lines += [f"![{caption}]({name})", "", caption, ""]
        for table in one.record.tables:
            lines += [f"**{table['name']}**", ""]
            lines += [*_markdown_table(table["headings"], _texts(table)), ""]
        lines += _paragraphs(one.case.method)
        judged = one.judged()
        if judged:
            lines += ["**Figures with an expectation**", "", *_markdown_table(_JUDGED, judged)]
    return "\n".join(lines).rstrip() + "\n"


def _paragraphs(text: str) -> list[str]:
    return [without_links(text).strip(), ""] if text else []


def _markdown_table(headings: Sequence[str], rows: Rows) -> list[str]:
    lines = [_markdown_row(headings), "|" + "---|" * len(headings)]
    return lines + [_markdown_row(row) for row in rows]


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _texts(table: Mapping[str, Any]) -> list[list[str]]:
    return [[shown_figure(cell) for cell in row] for row in table["rows"]]


# --- HTML ------------------------------------------------------------------------------------


def to_html(sections: Sequence[Section], folder: Path, summary: str = "") -> str:
    """The report on one page, pictures in it."""
    body = ["<h1>Validation report</h1>", _prose(summary)]
    links = [[f"#{one.case.name}"] for one in sections]
    body.append(_html_table(_OVERVIEW, [one.overview() for one in sections], links))
    body.append(f"<div class=made>{_prose(conditions(sections))}<p>{_TIMES}</p></div>")
    for one in sections:
        body.append(f'<section id="{_text(one.case.name)}"><h2>{_text(one.case.title)}</h2>')
        body.append(f"<p>{_text(one.case.question)}</p>")
        body.append(f"<p class={one.verdict[:4]}>{_text(one.verdict)}</p>")
        if one.record.error:
            body.append(f"<pre>{_text(one.record.error)}</pre>")
        body.append(_prose(one.case.findings))
        body += [_picture(folder / n, text) for n, text in one.record.pictures.items()]
        for table in one.record.tables:
            body.append(f"<h3>{_text(table['name'])}</h3>")
            body.append(_html_table(table["headings"], _texts(table)))
        if one.case.method:
            body.append("<details><summary>How it was done, and limits</summary>")
            body.append(_prose(one.case.method) + "</details>")
        judged = one.judged()
        if judged:
            opened = " open" if one.record.outside else ""
            body.append(f"<details{opened}><summary>{len(judged)} figures judged</summary>")
            body.append(_html_table(_JUDGED, judged) + "</details>")
        body.append(f"<p class=made>Made {_text(one.made)}.</p></section>")
    return _PAGE.format(style=_STYLE, body="\n".join(filter(None, body)))


def _prose(text: str) -> str:
    return f"<div class=wide>{as_html(without_links(text))}</div>" if text else ""


def _text(text: str) -> str:
    return html.escape(text.replace("`", ""))


def _picture(path: Path, caption: str) -> str:
    try:
        data = base64.b64encode(path.read_bytes()).decode()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read ({error.strerror or error}).") from None
    source = f"data:image/png;base64,{data}"
    words = _text(caption)
    return f'<figure><img src="{source}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def _html_table(headings: Sequence[str], rows: Rows, links: Rows | None = None) -> str:
    lines = ["<div class=wide><table><thead><tr>"]
    lines += [f"<th>{_text(heading)}</th>" for heading in headings] + ["</tr></thead><tbody>"]
    for number, row in enumerate(rows):
        cells = [_html_cell(cell) for cell in row]
        if links:
            cells[0] = f'<td><a href="{_text(links[number][0])}">{_text(row[0])}</a></td>'
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return "\n".join([*lines, "</tbody></table></div>"])


def _html_cell(cell: str) -> str:
    mark = _MARKS.get(cell.split(" ")[0].rstrip(",:"))
    number = cell[:1].isdigit() or cell[:2].lstrip("-")[:1].isdigit()
    kind = mark or ("number" if number else "")
    return f"<td class={kind}>{_text(cell)}</td>" if kind else f"<td>{_text(cell)}</td>"


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>pdcorrect: validation report</title>
<style>{style}</style></head>
<body>
{body}
</body></html>
"""
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 72rem; margin: 2rem auto;
  padding: 0 1.5rem }
h1, h2, h3 { line-height: 1.2 }
h2 { margin-top: 3rem; border-top: 1px solid #ccc; padding-top: 1rem }
.wide { overflow-x: auto }
table { border-collapse: collapse; font-size: 0.88rem; margin: 0.6rem 0 }
th { text-align: left; border-bottom: 2px solid #888 } td { border-bottom: 1px solid #ddd }
th, td { padding: 0.2rem 0.7rem 0.2rem 0; vertical-align: top }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap }
td.pass, td.slow, td.fail { padding-left: 0.5rem }
td.pass, p.pass { background: #dcefe4 } td.slow { background: #fbeec9 }
td.fail, p.fail { background: #f6d3cd }
p.pass, p.fail { padding: 0.2rem 0.6rem; display: inline-block }
figure { margin: 1.2rem 0 } img { max-width: 100% }
figcaption, .made { color: #555; font-size: 0.9rem }
pre { overflow-x: auto; background: #f5f5f5; padding: 0.6rem }
"""
