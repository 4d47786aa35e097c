"""The wheel, in a clean environment far from the checkout, does what the quick start says."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from pdcorrect import __version__

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "pdcorrect"
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```", re.S | re.M)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with wheel and source archive, and a Python that has the former, with pictures."""
    folder = tmp_path_factory.mktemp("built")

    def environment(name, *packages):
        subprocess.run([sys.executable, "-m", "venv", folder / name], check=True)
        python = folder / name / "bin" / "python"
        command = [python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", *packages]
        subprocess.run(command, check=True)
        return python

    builder = environment("builder", "build")
    subprocess.run([builder, "-m", "build", "-o", folder, ROOT], check=True)
    wheel = next(folder.glob("*.whl"))
    return folder, environment("clean", f"{wheel}[view]")


def alone():
    """Environment variables without those that lead back to the checkout."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PDCORRECT_HOME")}


@pytest.mark.slow
def test_the_wheel_has_the_package_and_nothing_else(built):
    folder, _ = built
    names = zipfile.ZipFile(folder / f"pdcorrect-{__version__}-py3-none-any.whl").namelist()
    kinds = (".py", ".json", ".safetensors", ".typed")
    expected = {
        path.relative_to(PACKAGE.parent).as_posix()
        for path in PACKAGE.rglob("*")
        if path.suffix in kinds or path.name == "py.typed"
    }
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert {"pdcorrect/py.typed", "pdcorrect/fem/hex8_learned.safetensors"} <= expected


@pytest.mark.slow
def test_the_quick_start_runs_without_a_checkout_and_with_the_source_archive(built, tmp_path):
    folder, python = built
    page = (ROOT / "docs" / "quickstart.md").read_text("utf-8")
    anywhere, with_source = page.split("## With the source\n")
    program = f"{python.parent}/pdcorrect"

    def run(part, where, **variables):
        snippets = ""
        for language, text in BLOCK.findall(part):
            if language == "python":
                snippets += text
                continue
            script = f'set -e\npdcorrect() {{ {program} "$@"; }}\n{text}'
            subprocess.run(["bash", "-c", script], check=True, cwd=where, env=alone() | variables)
        subprocess.run([python, "-c", snippets], check=True, cwd=where, env=alone() | variables)

    run(anywhere, tmp_path)
    refused = subprocess.run(
        [program, "validate", "--list"], env=alone(), cwd=tmp_path, capture_output=True, text=True
    )
    assert refused.returncode == 2
    assert "PDCORRECT_HOME" in refused.stderr

    name = f"pdcorrect-{__version__}"
    with tarfile.open(folder / f"{name}.tar.gz") as archive:
        archive.extractall(folder, filter="data")
    without_models = re.sub(r"^.*--model.*$", "", with_source, flags=re.M)  # those need torch
    run(without_models, folder / name, PDCORRECT_HOME=str(folder / name))
