"""The cases in a folder: one folder each with README.md, run.py and expected.json."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pdcorrect._environment import code_digest, home_folder
from pdcorrect.errors import InputError
from pdcorrect.validation.outcome import Expectations, Outcome, read_expectations

CODE, EXPECTED, README, INPUTS = "run.py", "expected.json", "README.md", "inputs.txt"
SUMMARY = "summary.md"
Parts = Mapping[str, Callable[[], Outcome]]


@dataclass(frozen=True)
class ValidationCase:
    """A folder with ``run.py``, which defines one of two functions.

    ``case(quick)`` gives the `Outcome`; ``parts(quick)`` gives functions by name, each of
    which gives the outcome of a part.  A run that was ended goes on with the first part that
    is not done.
    """

    folder: Path

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.folder.name

    @cached_property
    def expected(self) -> Expectations:
        """What its figures have to be."""
        return read_expectations(self.folder / EXPECTED)

    @property
    def has_quick_part(self) -> bool:
        """Whether a quick run has figures that are judged."""
        return any(aim.quick for aim in self.expected.values())

    @cached_property
    def title(self) -> str:
        """The first heading of its README."""
        found = re.search(r"^# (.+)$", self._readme, re.M)
        return found.group(1).strip() if found else self.name

    @cached_property
    def question(self) -> str:
        """The paragraph of its README that begins with **Question.**"""
        found = re.search(r"\*\*Question\.\*\*\s*(.+?)(?:\n\s*\n|\Z)", self._readme, re.S)
        return " ".join(found.group(1).split()) if found else ""

    @cached_property
    def findings(self) -> str:
        """What its README says of the results: what begins with **What ...**, as Markdown."""
        return "\n\n".join(text for head, text in self._marked if head.startswith("What "))

    @cached_property
    def method(self) -> str:
        """The rest of its README below the title, without the question, as Markdown."""
        rest = [t for head, t in self._marked if not head.startswith(("What ", "Question"))]
        return "\n\n".join(rest)

    @cached_property
    def _marked(self) -> list[tuple[str, str]]:
        """Parts of the README that begin with **Words.**, each with its words.

        Those that follow the question without such words have none.
        """
        body = re.sub(r"\A\s*# .+\n", "", self._readme)
        found = []
        for text in re.split(r"\n\s*\n(?=\*\*)", body.strip()):
            head = re.match(r"\*\*(.+?)\.?\*\*", text)
            words = head.group(1) if head else ""
            if words == "Question":  # one paragraph
                question, _, rest = text.partition("\n\n")
                found += [(words, question), ("", rest.strip())]
            else:
                found.append((words, text))
        return [(words, text) for words, text in found if text]

    @cached_property
    def _readme(self) -> str:
        path = self.folder / README
        return path.read_text(encoding="utf-8") if path.is_file() else ""

    def inputs(self) -> dict[str, str]:
        """SHA-256 of models and data that its code reads, by path.

        `INPUTS` in the case's folder names files and folders, whose READMEs do not count, one a
        line, from the folder that has the cases' folder in it.

        Raises
        ------
        InputError
            If one is not there.
        """
        listed, root = self.folder / INPUTS, self.folder.parents[1]
        if not listed.is_file():
            return {}
        found = {}
        for line in filter(None, map(str.strip, listed.read_text(encoding="utf-8").splitlines())):
            if not (root / line).exists():
                raise InputError(f"{listed}: {line!r} is neither a file nor a folder of {root}.")
            for path in _files(root / line):
                content = path.read_bytes()
                found[path.relative_to(root).as_posix()] = hashlib.sha256(content).hexdigest()
        return found

    def digest(self) -> str:
        """SHA-256 of what its result depends on.

        The package's code, the case's modules and expectations, the modules that cases share,
        and its `inputs`.

        Raises
        ------
        InputError
            If an input is not there.
        """
        found = hashlib.sha256(code_digest().encode())
        paths = [*self.folder.parent.glob("*.py"), *self.folder.rglob("*.py")]
        for path in [*sorted(paths), self.folder / EXPECTED]:
            found.update(path.relative_to(self.folder.parent).as_posix().encode())
            found.update(path.read_bytes())
        found.update(json.dumps(self.inputs()).encode())
        return found.hexdigest()

    def parts(self, quick: bool) -> Parts:
        """What there is to run, by name; a case without parts has one without a name.

        Raises
        ------
        InputError
            If the module has neither function.
        """
        module = self._module()
        if hasattr(module, "parts"):
            found: Parts = module.parts(quick)
            return found
        if not hasattr(module, "case"):
            raise InputError(f"{self.folder / CODE}: expected a function case or parts of (quick).")
        return {"": lambda: module.case(quick)}

    def _module(self) -> object:
        name = f"validation_case_{self.name}"
        spec = importlib.util.spec_from_file_location(name, self.folder / CODE)
        if spec is None or spec.loader is None:
            raise InputError(f"{self.folder / CODE}: is no Python module.")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module


def _files(path: Path) -> list[Path]:
    """A file, or those of a folder but its README."""
    if path.is_file():
        return [path]
    return sorted(p for p in path.rglob("*") if p.is_file() and p.name != README)


def read_summary(folder: str | Path | None = None) -> str:
    """What the report begins with, Markdown: ``summary.md`` beside the cases, if it is there."""
    path = (home_folder("validation") if folder is None else Path(folder)) / SUMMARY
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def find_cases(names: Sequence[str] = (), folder: str | Path | None = None) -> list[ValidationCase]:
    """Cases by name, all by default, in the folder ``validation`` of `home_folder`.

    Raises
    ------
    InputError
        If there is no such folder or case.
    """
    folder = home_folder("validation") if folder is None else Path(folder)
    known = {p.parent.name: p.parent for p in sorted(folder.glob(f"*/{CODE}"))}
    if not known:
        raise InputError(f"{folder}: no validation cases: expected folders with {CODE}.")
    for name in names:
        if name not in known:
            raise InputError(
                f"validation case {name!r}: not in {folder}: expected one of {', '.join(known)}."
            )
    return [ValidationCase(known[name]) for name in dict.fromkeys(names or known)]
