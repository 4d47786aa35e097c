"""The command ``pdcorrect doctor``: what the package can use on this machine."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator

import typer

from pdcorrect._environment import processor, threads, versions
from pdcorrect.cli.common import FAILED, console

_OPTIONAL = {"pyvista", "vtk", "matplotlib", "torch", "torch-geometric", "cholespy", "pyamg"}
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
Check = tuple[str, str, bool]
"""What was looked at, what was found, and whether it works."""


def doctor() -> None:
    """Show versions, threads, factorisations, GPU and whether rendering works."""
    from rich.table import Table

    checks = [*_installed(), *_factorisations(), _gpu(), _rendering()]
    table = Table("what", "found", "")
    for name, found, works in checks:
        state = "optional" if "missing" in found else "ok"
        table.add_row(name, found, state if works else "PROBLEM")
    console().print(table)
    if not all(works for _, _, works in checks):
        raise typer.Exit(FAILED)


def _installed() -> Iterator[Check]:
    import numpy as np

    from pdcorrect.fem.decomposition import OPTIONS

    for name, found in versions().items():
        yield name, found, found != "missing" or name in _OPTIONAL
    yield "processor", f"{processor()}, {os.cpu_count()} cores", True
    yield "kernel threads", f"{threads()} (--threads, or NUMBA_NUM_THREADS)", True
    kept = OPTIONS["cache"]
    yield "compiled kernels", "kept on disk" if kept else "not kept: set NUMBA_CACHE_DIR", kept
    config = np.show_config(mode="dicts")
    blas = config.get("Build Dependencies", {}).get("blas", {}) if config else {}
    name = f"{blas.get('name', 'unknown')} {blas.get('version', '')}".strip()
    limits = [f"{k}={os.environ[k]}" for k in _THREAD_VARIABLES if k in os.environ]
    yield "BLAS", f"{name}; {', '.join(limits) or 'no thread limit set'}", True


def _factorisations() -> Iterator[Check]:
    import numpy as np
    import scipy.sparse as sp

    from pdcorrect.fem.factorisation import choose_backend, factorise

    matrix = sp.csc_matrix(sp.diags_array([[-1.0] * 9, [2.0] * 10, [-1.0] * 9], offsets=[-1, 0, 1]))
    right = np.arange(10.0)
    for backend in ("cholespy", "splu", "amg"):
        try:
            x = factorise(matrix, backend).solve(right)  # type: ignore[arg-type]
            residual = float(np.abs(matrix @ x - right).max())
            yield f"factorisation {backend}", "works", residual < 1e-9
        except ImportError as error:
            remedy = f"missing ({error}); pip install {backend.replace('amg', 'pyamg')}"
            yield f"factorisation {backend}", remedy, backend == "amg"
    direct = choose_backend(10)
    yield "factorisation of G", f"{direct}; amg for large compact meshes", True


def _gpu() -> Check:
    if importlib.util.find_spec("torch") is None:
        return "GPU", "not looked for: torch is not installed (extra 'learn')", True
    import torch

    found = torch.cuda.is_available()
    return "GPU", torch.cuda.get_device_name(0) if found else "none that torch can use", True


def _rendering() -> Check:
    if importlib.util.find_spec("pyvista") is None:
        return "off-screen rendering", "pyvista missing: pip install 'pdcorrect[view]'", True
    from pdcorrect.figures.panels import check_offscreen

    found = check_offscreen()
    return "off-screen rendering", found, found.startswith("ok")
