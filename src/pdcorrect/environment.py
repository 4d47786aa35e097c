"""What a result was made with: hardware, threads and versions; and `doctor`'s checks."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
from dataclasses import dataclass
from pathlib import Path

import pdcorrect
from pdcorrect import __version__

_PACKAGES = (
    "numpy", "scipy", "scikit-fem", "numba", "cholespy", "pyamg", "meshio", "h5py", "pydantic",
    "pyvista", "vtk", "matplotlib", "torch", "torch-geometric",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Installed version of each package that matters, "missing" where there is none."""
    found = {"pdcorrect": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def processor() -> str:
    """Model name of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def threads() -> int:
    """Threads that the element kernels use."""
    import numba

    return int(numba.get_num_threads())


def environment() -> dict[str, str]:
    """One flat record for results: processor, cores, threads, precision, versions."""
    present = {k: v for k, v in versions().items() if v != "missing"}
    return {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "threads": str(threads()),
        "dtype": "float64",
        "system": f"{platform.system()} {platform.machine()}",
        **present,
    }


@functools.cache
def code_digest() -> str:
    """SHA-256 of the package's own modules, names and contents, in hexadecimal digits.

    Tells two states of the code apart that have the same version number.
    """
    digest = hashlib.sha256()
    root = Path(pdcorrect.__file__).parent
    for path in sorted(root.rglob("*.py")):
        for content in (path.relative_to(root).as_posix().encode(), path.read_bytes()):
            digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()


@dataclass(frozen=True)
class Check:
    """One line of `doctor`: what was looked at, what was found, and whether it works."""

    name: str
    found: str
    ok: bool = True


def doctor() -> list[Check]:
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
    from pdcorrect.figures.offscreen import check_offscreen

    found = check_offscreen()
    return Check("off-screen rendering", found, found.startswith("ok"))
