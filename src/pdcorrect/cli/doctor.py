"""The command ``pdcorrect doctor``: what the package can use on this machine."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass

import typer

from pdcorrect._environment import processor, threads, versions
from pdcorrect.cli.common import FAILED


def doctor() -> None:
    """Show versions, threads, factorisations, GPU and whether rendering works."""
    from rich.console import Console
    from rich.table import Table

    checks = look()
    table = Table("what", "found", "")
    for check in checks:
        state = "optional" if "missing" in check.found else "ok"
        table.add_row(check.name, check.found, state if check.ok else "PROBLEM")
    Console(markup=False).print(table)
    if not all(check.ok for check in checks):
        raise typer.Exit(FAILED)


@dataclass(frozen=True)
class Check:
    """One line of `doctor`: what was looked at, what was found, and whether it works."""

    name: str
    found: str
    ok: bool = True


def look() -> list[Check]:
    """Look at everything that the package can use on this machine."""
    checks = [Check(name, found, _fine(name, found)) for name, found in versions().items()]
    checks.append(Check("processor", f"{processor()}, {os.cpu_count()} cores"))
    checks.append(Check("kernel threads", f"{threads()} (set NUMBA_NUM_THREADS)"))
    checks += [_blas(), *_factorisations(), _gpu(), _rendering()]
    return checks


def _fine(name: str, found: str) -> bool:
    optional = {"pyvista", "vtk", "matplotlib", "torch", "torch-geometric", "cholespy", "pyamg"}
    return found != "missing" or name in optional


def _blas() -> Check:
    import numpy as np

    config = np.show_config(mode="dicts")
    blas = config.get("Build Dependencies", {}).get("blas", {}) if config else {}
    name = f"{blas.get('name', 'unknown')} {blas.get('version', '')}".strip()
    limits = [f"{k}={os.environ[k]}" for k in _THREAD_VARIABLES if k in os.environ]
    return Check("BLAS", f"{name}; {', '.join(limits) or 'no thread limit set'}")


_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _factorisations() -> list[Check]:
    import numpy as np
    import scipy.sparse as sp

    from pdcorrect.fem.factorisation import choose_backend, factorise

    matrix = sp.csc_matrix(sp.diags_array([[-1.0] * 9, [2.0] * 10, [-1.0] * 9], offsets=[-1, 0, 1]))
    right = np.arange(10.0)
    checks = []
    for backend in ("cholespy", "splu", "amg"):
        try:
            x = factorise(matrix, backend).solve(right)  # type: ignore[arg-type]
            residual = float(np.abs(matrix @ x - right).max())
            checks.append(Check(f"factorisation {backend}", "works", residual < 1e-9))
        except ImportError as error:
            remedy = f"missing ({error}); pip install {backend.replace('amg', 'pyamg')}"
            checks.append(Check(f"factorisation {backend}", remedy, backend == "amg"))
    direct = choose_backend(10)
    checks.append(Check("factorisation of G", f"{direct}; amg for large compact meshes"))
    return checks


def _gpu() -> Check:
    if importlib.util.find_spec("torch") is None:
        return Check("GPU", "not looked for: torch is not installed (extra 'learn')")
    import torch

    if torch.cuda.is_available():
        return Check("GPU", torch.cuda.get_device_name(0))
    return Check("GPU", "none that torch can use")


def _rendering() -> Check:
    if importlib.util.find_spec("pyvista") is None:
        return Check("off-screen rendering", "pyvista missing: pip install 'pdcorrect[view]'")
    from pdcorrect.figures.panels import check_offscreen

    found = check_offscreen()
    return Check("off-screen rendering", found, found.startswith("ok"))
