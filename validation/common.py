"""What the cases share: meshes, equilibria, and figures compared with expected ones."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdcorrect as pc
from pdcorrect.environment import environment
from pdcorrect.fem.mesh import voxel_mesh
from pdcorrect.fem.mesh_files import write_vtu

Array = NDArray[np.float64]
Figures = dict[str, float]

ELEMENTS = ("hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex27")
STATIC = {"step": 1.0, "frames": 1, "integrator": "quasi-static"}
SMALL = 1e-4
"""Deflection over length at which the geometric nonlinearity is far below 0.1 %."""

_TOLERANCE = 1e-8
"""Of the coarse cell size; Newton's last step is shorter."""

RESULTS = Path(__file__).parent / "results"


def mapped_block(
    cells: tuple[int, int, int],
    place: Callable[[Array], Array],
    element: str = "hex8",
    **settings: Any,
) -> pc.Problem:
    """A block of cells whose nodes are moved by ``place`` from the unit cube, (N, 3) -> (N, 3) m.

    ``settings`` are the scene's other sections.
    """
    mesh = voxel_mesh(np.ones(cells, dtype=bool), (0, 0, 0), 1.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "block.vtu"
        write_vtu(path, place(mesh.positions / np.array(cells)), mesh.cells)
        body = {"shape": "file", "path": path}
        return pc.discretise(pc.Scene(body=body, **settings), element=element)


def equilibrium(problem: pc.Problem, steps: int = 1) -> Array:
    """Positions (N, 3), m, under the loads after ``steps`` time steps, by Newton's method.

    Raises
    ------
    RuntimeError
        If a step needs a fallback.
    """
    newton = pc.Newton(problem, _TOLERANCE, integrator="quasi-static", recover=False)
    state = problem.rest_state()
    for _ in range(steps):
        result = newton(state)
        if result.status is not pc.Status.CONVERGED:
            raise RuntimeError(f"{problem!r}: {result.status.name} after {result.iterations}")
        state = result.state
    return state.positions


def on(problem: pc.Problem, axis: str, at: float) -> NDArray[np.int64]:
    """Numbers of the nodes whose rest coordinate ``axis`` is ``at`` (m)."""
    distance = np.abs(problem.positions[:, "xyz".index(axis)] - at)
    return np.flatnonzero(distance < 1e-6 * problem.cell_size)


def nearest(problem: pc.Problem, point: tuple[float, float, float]) -> int:
    """The node nearest to a rest point (m)."""
    return int(np.linalg.norm(problem.positions - np.array(point), axis=1).argmin())


def expected(folder: Path) -> dict[str, dict[str, Any]]:
    """Figures and tolerances of a case, by name."""
    return json.loads((folder / "expected.json").read_text(encoding="utf-8"))


def outside(figures: Mapping[str, float], wanted: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Names of the figures that differ from the expected ones by more than the tolerance."""
    return [
        name
        for name, value in figures.items()
        if name in wanted and not abs(value - wanted[name]["value"]) <= wanted[name]["tolerance"]
    ]


def finish(folder: Path, figures: Figures, arguments: str = "") -> int:
    """Print the figures, write ``results/<case>.json``; 1 if one is outside or missing."""
    wanted = expected(folder)
    wrong = outside(figures, wanted) + sorted(set(wanted) - set(figures))
    width = max(map(len, figures))
    for name, value in figures.items():
        aim = wanted.get(name)
        goal = f"{aim['value']:>9g} ± {aim['tolerance']:g}  {aim['source']}" if aim else ""
        mark = "  OUTSIDE" if name in wrong else ""
        print(f"{name:<{width}}  {value:>9.5g}  {goal}{mark}")
    record = {
        "command": f"python validation/{folder.name}/run.py {arguments}".strip(),
        "date": time.strftime("%Y-%m-%d"),
        "seed": None,  # nothing is random
        "outside": wrong,
        "figures": {name: value if value == value else None for name, value in figures.items()},
        "environment": environment(),
    }
    text = json.dumps(record, indent=2, allow_nan=False) + "\n"
    (RESULTS / f"{folder.name}.json").write_text(text, encoding="utf-8")
    for name in wrong:
        print(f"outside the tolerance or missing: {name}")
    return 1 if wrong else 0
