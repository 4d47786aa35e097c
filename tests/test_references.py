"""Whom the code and the documents cite is on the page of references, and the other way round."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAME = r"[A-Z][a-zü]+(?:[A-Z][a-zü]+)*"
"""Of an author: Taylor, MacNeal, McGreivy."""
JOURNAL = r"(?:[A-Z][A-Za-z]*\.? )+\d+(?: \(\d+\))?, "
"""As "J. Appl. Mech. 33, "."""
CITATION = re.compile(
    rf"\b({NAME})"
    rf"(?: et al\.|(?:, (?:de )?{NAME})*,? (?:and|&) {NAME}|,? \*[^*]+\*,?|, {NAME}[^().,;*]*)?,?"
    rf" \(?(?:{JOURNAL})?(?:PUC-Rio )?((?:19|20)\d\d)\b(?!-\d)"
)
"""An author, others or a title, perhaps a journal, and a year that begins no date."""
PAGE = ROOT / "docs" / "references.md"
SOURCES = [
    ROOT / "README.md",
    *sorted((ROOT / "src").rglob("*.py")),
    *sorted({*(ROOT / "docs").glob("*.md")} - {PAGE}),
    *sorted((ROOT / "validation").rglob("README.md")),
]


def cited(text):
    """Authors and years, lines joined."""
    found = {match.groups() for match in CITATION.finditer(" ".join(text.split()))}
    return {(author.replace("ue", "ü"), year) for author, year in found}


def works(page):
    """First author, year and text of each work on the page; some items have several."""
    items = [" ".join(item.split()) for item in re.split(r"^- ", page, flags=re.M)[1:]]
    for work in (work for item in items for work in re.split(r"; (?=[A-Z]\. )", item)):
        author = re.search(rf"(?:[A-Z]\. )+({NAME}(?: {NAME})?)", work)
        year = re.search(r"(?:19|20)\d\d(?=[ .,;:(]|$)", re.sub(r"\*[^*]+\*", "", work))
        yield author[1].split()[-1].replace("ue", "ü"), year[0], work.replace("ue", "ü")


def known():
    return list(works(PAGE.read_text(encoding="utf-8")))


def test_every_author_cited_is_on_the_page_with_that_year():
    """Taylor 1976 is not Taylor 1973: both have to stand in one work."""
    missing = [
        f"{path.relative_to(ROOT)}: {author} {year}"
        for path in SOURCES
        for author, year in sorted(cited(path.read_text(encoding="utf-8")))
        if not any(author in work and year == of_work for _, of_work, work in known())
    ]
    assert not missing


def test_every_work_on_the_page_is_cited():
    """By author and year, or by its title."""
    texts = [" ".join(path.read_text(encoding="utf-8").split()) for path in SOURCES]
    everything = "\n".join(texts)
    found = set().union(*map(cited, texts))
    assert not [
        f"{author} {year}"
        for author, year, work in known()
        if (author, year) not in found and re.search(r"\*[^*]+\*", work)[0] not in everything
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("(Pfaff et al. 2021), as", ("Pfaff", "2021")),
        ("Taylor, Beresford and\nWilson (1976)", ("Taylor", "1976")),
        ("Smith, de Goes and Kim 2018", ("Smith", "2018")),
        ("MacNeal and Harder (Finite Elem. Anal. Des. 1, 1985)", ("MacNeal", "1985")),
        ("McGreivy & Hakim (2024)", ("McGreivy", "2024")),
        ("(Cowper, J. Appl. Mech. 33, 1966)", ("Cowper", "1966")),
        ("Wriggers and Reese, Comput. Methods Appl. Mech. Eng. 135, 1996", ("Wriggers", "1996")),
        ("Saad, Iterative methods for sparse linear systems (2003)", ("Saad", "2003")),
    ],
)
def test_citations_are_found(text, expected):
    """In the forms that the sources have; a pattern that finds none would let all pass."""
    assert cited(text) == {expected}


def test_works_of_the_page_are_told_apart():
    page = "- A. B. One, C. Two, *In 1999 on*, J. 1, 2001; D. McThree, *X*, J. 2, 2002: both.\n"
    assert [(author, year) for author, year, _ in works(page)] == [
        ("One", "2001"), ("McThree", "2002")
    ]  # fmt: skip
