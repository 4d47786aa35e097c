"""What the cases share: meshes, equilibria, and the parts of an outcome."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdcorrect as pc
from pdcorrect.fem.mesh import voxel_mesh
from pdcorrect.fem.mesh_files import write_vtu
from pdcorrect.validation.cases import ValidationCase
from pdcorrect.validation.outcome import Outcome as Outcome
from pdcorrect.validation.outcome import Picture as Picture
from pdcorrect.validation.outcome import Table as Table
from pdcorrect.validation.page import shown_figure
from pdcorrect.validation.running import run_case

Array = NDArray[np.float64]
Figures = dict[str, float]

ELEMENT_STYLES = {
    "hex8": ("#000000", "o"),
    "hex8-mean": ("#e69f00", "s"),
    "hex8-bubble": ("#0072b2", "D"),
    "hex8-bubble-mean": ("#d55e00", "^"),
    "hex27": ("#009e73", "v"),
}
"""Colour and mark of each element in pictures."""
ELEMENTS = tuple(ELEMENT_STYLES)
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


COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


def plot(
    path: Path,
    curves: Mapping[str, tuple[Sequence[float] | Array, Sequence[float] | Array]],
    labels: tuple[str, str],
    scales: tuple[str, str] = ("linear", "linear"),
    marks: bool = False,
) -> None:
    """Curves (x, y) by name in one plot with a legend above; ``scales`` linear or log."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    for k, (name, (x, y)) in enumerate(curves.items()):
        style = {"color": COLOURS[k % len(COLOURS)], "linestyle": ("-", "--", "-.", ":")[k % 4]}
        axis.plot(x, y, label=name, marker="o" if marks else "", linewidth=1.8, **style)
    axis.set(xlabel=labels[0], ylabel=labels[1], xscale=scales[0], yscale=scales[1])
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    columns = {"ncols": min(3, len(curves)), "frameon": False, "fontsize": 9}
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", **columns)
    figure.savefig(path, dpi=150)


def axis_of_meshes(axis: Any, title: str, label: str, counts: Sequence[int]) -> None:
    """A panel over numbers of cells, each of them a tick, at equal distances where they double."""
    axis.set(xscale="log", title=title, xlabel=label)
    axis.set_xticks(counts, [str(n) for n in counts])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def plain_log_axes(axis: Any, labels: tuple[str, str]) -> None:
    """Logarithmic axes with plain numbers at 1, 2 and 5 of each decade, a grid and no frame."""
    axis.set(xscale="log", yscale="log", xlabel=labels[0], ylabel=labels[1])
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "25" else "")
    axis.grid(alpha=0.3, which="both")
    axis.spines[["top", "right"]].set_visible(False)


def main(file: str) -> int:
    """Run the case of a file in full, write its result to `RESULTS`; 1 if a figure is outside."""
    case = ValidationCase(Path(file).resolve().parent)
    command = f"python validation/{case.name}/run.py"
    record = run_case(case, RESULTS, again=True, command=command)
    for name, value in record.figures.items():
        aim = case.expected.get(name)
        goal = f"{aim.describe()}  {aim.source}" if aim else ""
        mark = "  OUTSIDE" if name in record.outside else ""
        print(f"{name}  {shown_figure(value)}  {goal}{mark}")
    for name in record.outside:
        print(f"outside the tolerance or missing: {name}")
    print(record.error, end="")
    return 0 if record.passed else 1
