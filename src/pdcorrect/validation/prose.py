"""Markdown of cases' READMEs on the report's page."""

from __future__ import annotations

import re

from markdown_it import MarkdownIt

_PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
_LINK = re.compile(r"\[([^\]]+)\]\((?!https?://)[^)]*\)")


def without_links(text: str) -> str:
    """Markdown without pictures, and with the words of links to files in place of the links.

    Paths that begin at a README lead nowhere from a report.
    """
    return _LINK.sub(r"\1", _PICTURE.sub("", text))


def as_html(text: str) -> str:
    """Markdown with tables as HTML; HTML in it is shown, not obeyed."""
    return str(MarkdownIt("commonmark", {"html": False}).enable("table").render(text))
