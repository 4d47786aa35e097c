"""Every command and snippet of README.md and docs/ runs; links lead somewhere; pages build."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pdcorrect import Scene

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(python|sh|toml)\n(.*?)^```", re.S | re.M)
FEW = {"simulate": 2, "compare": 1}
"""Frames that a command is given which names none."""

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder that looks like the checkout, where the pages' relative paths hold."""
    for name in ("examples", "datasets", "models"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "datasets" / "tiny", tmp_path / "tiny")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@each_page
def test_snippets_and_commands_run(page, checkout, program):
    """From top to bottom; the snippets of a page build on each other."""
    pytest.importorskip("torch")
    names = {}
    for language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language == "python":
            exec(compile(text, page.name, "exec"), names)
        elif language == "toml":
            from pdcorrect.data.configuration import DatasetConfig

            (Scene if "[body]" in text else DatasetConfig).from_toml(text)
        else:
            for line in text.splitlines():
                _run(shlex.split(line, comments=True), program)


def _run(words, program):
    if not words or words[0] != "pdcorrect":
        return
    if words[1] in FEW and "--frames" not in words:
        words += ["--frames", str(FEW[words[1]])]
    status, _, err = program(*words[1:])
    assert status == 0 or words[1] == "doctor", (words, err)


def anchors(page):
    """Of its headings, as the documentation and GitHub make them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for heading in re.findall(r"^#+ (.*)$", text, re.M):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


@each_page
def test_links_lead_somewhere_and_files_that_are_named_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for path, anchor in re.findall(r"\]\((?!http)([^)#\s]*)(?:#([^)\s]+))?\)", text):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name} -> {path}"
        assert not anchor or anchor in anchors(target), f"{page.name} -> {path}#{anchor}"
    # paths of the package, the examples and the validation cases in `...`
    places = (ROOT, ROOT / "src" / "pdcorrect")
    for name in re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.(?:py|toml))`", page.read_text("utf-8")):
        assert any((place / name).exists() for place in places), f"{page.name}: {name}"


def test_the_documentation_builds_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", ROOT / "docs", tmp_path]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
