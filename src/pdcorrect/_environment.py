"""What a result was made with: hardware, threads, versions and code; where files of ours lie."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import platform
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from pdcorrect._version import __version__
from pdcorrect.errors import InputError

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
def code_digest(*folders: str) -> str:
    """SHA-256 of the package's own modules, names and contents, in hexadecimal digits.

    Tells two states of the code apart that have the same version number; with ``folders`` of
    those of the package only.
    """
    digest = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(x for folder in folders or (".",) for x in (root / folder).rglob("*.py")):
        for content in (path.relative_to(root).as_posix().encode(), path.read_bytes()):
            digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()


HOME = "PDCORRECT_HOME"
"""Environment variable: the folder with ``models`` and ``validation``; the checkout by default.

A wheel has neither, the source archive both."""


def home_folder(name: str, instead: str = "") -> Path:
    """The folder ``name`` of the checkout, or of the folder that the environment names.

    ``instead`` is what a user may give in its place, for the message.
    """
    home = os.environ.get(HOME)
    if home:
        return Path(home) / name
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / "pyproject.toml").is_file():
        raise InputError(
            f"{name}: an installed wheel has none: unpack the source archive "
            f"pdcorrect-{__version__}.tar.gz and set the environment variable {HOME} to its "
            f"folder{instead}."
        )
    return checkout / name


CACHE = "PDCORRECT_CACHE"
"""Environment variable: the folder of what can be computed again."""


def cache_folder(name: str) -> Path:
    """A folder of the user's cache: of `CACHE`, else of the XDG base directories."""
    chosen = os.environ.get(CACHE)
    if chosen:
        return Path(chosen) / name
    above = Path(os.environ.get("XDG_CACHE_HOME", ""))  # which counts only if absolute
    return (above if above.is_absolute() else Path.home() / ".cache") / "pdcorrect" / name


def total_memory(root: Path = Path("/")) -> float:
    """Bytes of the machine, or of a control group that this process is in, if less.

    Not what happens to be free: a run that is resumed has to make the same choices.
    Infinite where the system does not tell.  ``proc`` and ``sys`` are in ``root``.
    """
    limits = [float("inf")]
    with suppress(OSError, ValueError, AttributeError):
        limits.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    for path in _group_limits(root):
        with suppress(OSError, ValueError):  # not there, or "max"
            limits.append(float(path.read_text(encoding="ascii")))
    return min(limit for limit in limits if limit > 0)


def _group_limits(root: Path) -> Iterator[Path]:
    """Files that may limit this process: of its control group and of all above (cgroups(7)).

    A container often sees its own group as the topmost one, whatever ``/proc`` calls it.
    """
    mounted = root / "sys/fs/cgroup"
    groups = [":memory:/", "0::/"]
    with suppress(OSError, ValueError):
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
        groups += [line for line in lines if line.count(":") >= 2]
    for group in groups:
        _, controllers, path = group.split(":", 2)
        if not controllers:
            folder, name = mounted, "memory.max"
        elif "memory" in controllers.split(","):
            folder, name = mounted / "memory", "memory.limit_in_bytes"
        else:
            continue
        here = Path(path.lstrip("/"))
        yield from (folder / above / name for above in (here, *here.parents))
