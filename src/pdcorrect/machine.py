"""What this machine has."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def total_memory(root: Path = Path("/")) -> float:
    """Bytes of the machine, or of a control group that this process is in, if less.

    Not what happens to be free: a run that is resumed has to make the same choices.
    Infinite where the system does not tell.

    Parameters
    ----------
    root : path
        Where ``proc`` and ``sys`` are.
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
