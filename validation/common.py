"""What the cases share: meshes, equilibria, and the parts of an outcome."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from harness import Outcome as Outcome
from harness import Record as Record
from harness import Table as Table
from numpy.typing import NDArray

import pdcorrect as pc
from pdcorrect.fem.mesh import voxel_mesh
from pdcorrect.fem.mesh_files import write_vtu

Array = NDArray[np.float64]
Figures = dict[str, float]

ELEMENT_STYLES = {
    "hex8": ("#000000", "o"),
    "hex8-mean": ("#e69f00", "s"),
    "hex8-bubble": ("#0072b2", "D"),
    "hex8-bubble-mean": ("#d55e00", "^"),
    "hex8-enhanced": ("#cc79a7", "P"),
    "hex27": ("#009e73", "v"),
    "hex8-learned": ("#56b4e9", "X"),
}
"""Colour and mark of each element in pictures."""
ELEMENTS = tuple(ELEMENT_STYLES)
OFF_GRIDS = tuple(name for name in ELEMENTS if name != "hex8-learned")
"""For cells that are no cubes; the learned element is `hex8-enhanced` there."""
STATIC = {"step": 1.0, "frames": 1, "integrator": "quasi-static"}
SMALL = 1e-4
"""Deflection over length at which the geometric nonlinearity is far below 0.1 %."""

_TOLERANCE = 1e-8
"""Of the coarse cell size; Newton's last step is shorter."""


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


COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
MARKS = "osD^vP*"


def panels(
    width: float, height: float, count: int = 1, rows: int = 1, **options: Any
) -> tuple[Any, Any]:
    """A figure of so many inches and its axes, ``count`` side by side: one or an array of them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, count, **options)


def save(figure: Any, path: Path, legend_of: Any = None, columns: int = 5) -> None:
    """Write a figure, with a legend above it, as a PNG of few colours, so that it stays small."""
    from PIL import Image

    if legend_of is not None:
        handles = legend_of.get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper center", ncols=columns, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, format="png")
    with Image.open(buffer) as picture:
        picture.convert("RGB").quantize(
            48, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        ).save(path, optimize=True)


def plain(axis: Any, axes: str = "both") -> None:
    """A grid and no frame."""
    axis.set_axisbelow(True)
    axis.grid(alpha=0.3, which="both", axis=axes)
    axis.spines[["top", "right"]].set_visible(False)


def axis_of_meshes(axis: Any, title: str, label: str, counts: Sequence[int]) -> None:
    """A panel over numbers of cells, each of them a tick, at equal distances where they double."""
    axis.set(xscale="log", title=title, xlabel=label)
    axis.set_xticks(counts, [str(n) for n in counts])
    axis.minorticks_off()
    plain(axis)


def log_axis(axis: Any) -> None:
    """Plain numbers at 1, 2 and 5 of each decade of a logarithmic axis."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "25" else "")
