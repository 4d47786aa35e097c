"""One page of HTML with a table, sentences and pictures; it needs no other file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template

from pdcorrect._environment import environment
from pdcorrect._files import write_text

_PAGE = Template("""\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 74rem; margin: 2rem auto; padding: 0 1rem }
.wide { overflow-x: auto }
table { border-collapse: collapse; white-space: nowrap; font-variant-numeric: tabular-nums }
th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid #ddd }
th:first-child, td:first-child { text-align: left; padding-left: 0 }
th { border-bottom: 2px solid #999 }
figure { margin: 2.5rem 0 }
img { max-width: 100%; display: block; margin: auto }
figcaption, footer { color: #555; font-size: .9rem }
</style>
<h1>$title</h1>
<div class="wide">
<table>
$table
</table>
</div>
<ul>
$sentences
</ul>
$figures
<footer>Measured on: $environment.</footer>
</html>
""")
PAGE = "index.html"
"""Usual name."""
_TYPES = {".png": "image/png", ".gif": "image/gif"}


def write_page(
    path: Path,
    title: str,
    rows: Sequence[Mapping[str, str]],
    sentences: Iterable[str],
    pictures: Mapping[str, str],
) -> Path:
    """Write a page; ``pictures`` are captions by names of files beside it, which go into it."""
    folder = path.parent
    text = _PAGE.substitute(
        title=escape(title),
        table="\n".join([_row(rows[0], "th"), *(_row(row.values(), "td") for row in rows)]),
        sentences="\n".join(f"<li>{escape(sentence)}</li>" for sentence in sentences),
        figures="\n".join(_figure(folder / name, text) for name, text in pictures.items()),
        environment=escape(", ".join(f"{name} {value}" for name, value in environment().items())),
    )
    write_text(path, text)
    return path


def _row(cells: Iterable[str], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _figure(picture: Path, caption: str) -> str:
    data = base64.b64encode(picture.read_bytes()).decode("ascii")
    source = f"data:{_TYPES[picture.suffix]};base64,{data}"
    return (
        f'<figure id="{escape(picture.stem)}"><img src="{source}" alt="{escape(caption)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
