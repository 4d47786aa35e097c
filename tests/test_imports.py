"""The package's shape: imports point one way, heavy modules stay out until needed."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "pdcorrect"
TINY = ROOT / "datasets" / "tiny"
LAYERS = [
    "_version", "errors", "_config", "_files", "_environment", "state", "scene", "fem",
    "trajectory", "solvers", "metrics", "io", "figures", "batch", "corrector", "data", "elements",
    "evaluation", "training", "cli", "__main__",
]  # fmt: skip
"""From the ground up: a folder, or module beside the folders, imports from those before it."""


def module_name(path):
    parts = list(path.relative_to(SOURCE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in SOURCE.rglob("*.py")}


def imported(path):
    """Package modules that a file imports anywhere, for types too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pdcorrect":
            base = node.module.removeprefix("pdcorrect").lstrip(".")
            names = [f"{base}.{alias.name}".lstrip(".") for alias in node.names]
            yield from (name if name in MODULES else base for name in names)
        elif isinstance(node, ast.Import):
            yield from (
                alias.name.removeprefix("pdcorrect").lstrip(".")
                for alias in node.names
                if alias.name.split(".")[0] == "pdcorrect"
            )


@pytest.fixture(scope="module")
def graph():
    """Without the package itself, which loads what it offers when that is first used."""
    return {name: set(imported(path)) for name, path in MODULES.items() if name}


def test_imports_run_down_and_every_folder_has_its_layer(graph):
    assert {name.split(".")[0] for name in graph} == set(LAYERS)
    for name, others in graph.items():
        here = name.split(".")[0]
        for other in others - {""}:
            there = other.split(".")[0]
            assert there == here or LAYERS.index(there) < LAYERS.index(here), f"{name} uses {other}"
    assert [name for name, path in MODULES.items() if "skfem" in path.read_text()] == [
        "fem.operators"
    ]


def test_no_modules_import_each_other(graph):
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def loaded_after(*codes):
    """Packages that are loaded after each of these programs, one after another."""
    tell = "import sys; print('loaded', *{m.split('.')[0] for m in sys.modules})"
    script = "\n".join(f"{code}\n{tell}" for code in codes)
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return [set(line.split()) for line in out.stdout.splitlines() if line.startswith("loaded")]


HEAVY = {"torch", "pyvista", "vtk", "vtkmodules", "h5py", "meshio", "matplotlib"}


LIBRARIES = HEAVY | {"numpy", "scipy", "numba", "skfem"}
HELP = """
import sys
sys.argv = ["pdcorrect", "--help"]
from pdcorrect.cli.program import app
try:
    app()
except SystemExit:
    pass
"""
CHECK = f"""
import sys
sys.modules["torch"] = None
sys.argv = ["pdcorrect", "dataset", "check", {str(TINY)!r}]
from pdcorrect.cli import main
try:
    main()
except SystemExit as end:
    assert not end.code
"""
STEPS = """
import pdcorrect as pc
body = {"shape": "beam", "cells": [2, 1, 1], "cell_size": 0.1}
material = {"young": 1e5, "poisson": 0.3, "density": 1e3}
scene = pc.Scene(body=body, material=material, time={"step": 0.01, "frames": 1})
pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
pc.rollout(pc.Newton(pc.discretise(scene)))
"""
WITHOUT_TORCH = (
    "data.check", "data.generate", "data.import_files", "data.summary", "io.trajectory",
    "evaluation.compare", "evaluation.report", "figures", "cli.program",
)  # fmt: skip


def test_heavy_modules_are_not_loaded_until_needed():
    helped, stepped = loaded_after(HELP, STEPS)
    assert not helped & LIBRARIES
    assert not stepped & HEAVY


def test_torch_is_not_loaded_by_what_does_without_it():
    """Nor needed, where it is missing, by the check of a data set."""
    loaded, _ = loaded_after(f"import {', '.join(f'pdcorrect.{x}' for x in WITHOUT_TORCH)}", CHECK)
    assert "torch" not in loaded


def test_public_names_exist():
    import pdcorrect as pc

    for name in pc.__all__:
        assert getattr(pc, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        pc.nothing  # noqa: B018
