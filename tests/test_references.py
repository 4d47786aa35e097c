"""Whom the code and the documents cite is on the page of references."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CITATION = re.compile(
    r"\b([A-Z][a-zü]+)"
    r"(?: et al\.|(?:, [A-Za-z ]+)*,? and [A-Z][A-Za-z]+|, [A-Z][^()]*)?,?"
    r" \(?((?:19|20)\d\d)\b"
)
"""An author, others, and a year."""
SOURCES = [
    *sorted((ROOT / "src").rglob("*.py")),
    ROOT / "docs" / "theory.md",
    *sorted((ROOT / "validation").glob("*/README.md")),
]


def cited(text):
    """Authors and years, lines joined."""
    return {found.groups() for found in CITATION.finditer(" ".join(text.split()))}


def entries():
    """The page's items, each on one line."""
    text = (ROOT / "docs" / "references.md").read_text(encoding="utf-8")
    return [" ".join(item.split()) for item in re.split(r"^- ", text, flags=re.M)[1:]]


def test_every_author_cited_in_code_theory_and_cases_is_there_with_that_year():
    """Taylor 1976 is not Taylor 1973: both have to stand in one item."""
    items = entries()
    missing = [
        f"{path.relative_to(ROOT)}: {author} {year}"
        for path in SOURCES
        for author, year in sorted(cited(path.read_text(encoding="utf-8")))
        if not any(author.replace("ue", "ü") in x.replace("ue", "ü") and year in x for x in items)
    ]
    assert not missing


def test_citations_are_found():
    """In the forms that the sources have; a pattern that finds none would let all pass."""
    text = "(Pfaff et al. 2021), Taylor, Beresford and\nWilson (1976), Smith, de Goes and Kim 2018"
    assert cited(text) == {("Pfaff", "2021"), ("Taylor", "1976"), ("Smith", "2018")}
