"""The activation of two muscles with which a strip crawls farthest in one stride.

Unknown are the stretches in both tables of ``crawler.toml``, at five times each.  The adjoint of
all steps, contact and friction included, gives the derivatives of the way by them, and L-BFGS-B
goes uphill between the bounds.

    python examples/crawl.py [FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import minimize

import pdcorrect as pc

Array = NDArray[np.float64]

SCENE = pc.Scene.load(Path(__file__).with_name("crawler.toml"))
TIMES = np.array([row[0] for row in SCENE.actuators[0].activation])
BOUNDS = (0.7, 1.1)
"""Of the stretches at which the fibres rest."""


def with_stretches(stretches: Array) -> pc.Scene:
    """The scene with other tables; ``stretches`` (2, 5) are those after the start."""
    actuators = [
        {
            **one.model_dump(exclude_unset=True),
            "activation": [[0.0, 1.0], *zip(TIMES[1:].tolist(), row.tolist(), strict=True)],
        }
        for one, row in zip(SCENE.actuators, stretches, strict=True)
    ]
    return SCENE.with_changes(actuators=actuators)


def stride(stretches: Array) -> tuple[Array, Array]:
    """Way of the centre of mass along x, (T+1,), m, and the derivatives (2, 5) of the last."""
    stepper = pc.Newton(pc.discretise(with_stretches(stretches)))
    problem = stepper.problem
    states, results = [problem.rest_state()], []
    for _ in range(SCENE.time.frames):
        results.append(stepper(states[-1]))
        states.append(results[-1].state)
    share = problem.mass / problem.mass.sum()
    way = np.array([share @ (s.positions - problem.positions)[:, 0] for s in states])
    by_positions, by_velocities = np.zeros((2, *problem.positions.shape))
    by_positions[:, 0] = share
    by_memory: dict[str, Array] = {}
    slopes = np.zeros((2, len(TIMES)))
    for state, result in zip(states[-2::-1], results[::-1], strict=True):
        found = pc.adjoint(
            stepper, state, result, by_positions, by_velocities, grad_memory=by_memory
        )
        slopes += found.activations
        by_positions, by_velocities, by_memory = found.positions, found.velocities, found.memory
    return way, slopes[:, 1:]


def main(folder: Path = Path(), iterations: int = 8) -> dict[str, float]:
    """Lengthen the stride, print a summary, and draw ``crawl.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    size = SCENE.body.cell_size

    def objective(x: Array) -> tuple[float, Array]:
        way, slopes = stride(x.reshape(2, -1))
        print(f"stride {1e3 * way[-1]:6.2f} mm", flush=True)
        return -way[-1] / size, -slopes.ravel() / size

    start = np.array([[row[1] for row in one.activation[1:]] for one in SCENE.actuators])
    found = minimize(
        objective, start.ravel(), jac=True, method="L-BFGS-B",
        bounds=[BOUNDS] * start.size, options={"maxiter": iterations},
    )  # fmt: skip
    best = found.x.reshape(start.shape)
    ways = {"start": stride(start)[0], "optimised": stride(best)[0]}
    draw({"start": start, "optimised": best}, ways, folder)
    return {name: float(way[-1]) for name, way in ways.items()}


def draw(stretches: dict[str, Array], ways: dict[str, Array], folder: Path) -> None:
    """Tables of both muscles, and the way of the centre of mass."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    panels: tuple[Any, Any] = (left, right)
    for (name, table), colour in zip(stretches.items(), ("#999999", "#d55e00"), strict=True):
        for muscle, row, line in zip(("rear", "front"), table, ("-", "--"), strict=True):
            left.plot(1e3 * TIMES, [1.0, *row], line, color=colour, label=f"{name}, {muscle}")
        times = 1e3 * SCENE.time.step * np.arange(len(ways[name]))
        right.plot(times, 1e3 * ways[name], color=colour, label=name)
    left.set(xlabel="time, ms", ylabel="stretch at which fibres rest")
    right.set(xlabel="time, ms", ylabel="way of the centre of mass, mm")
    for panel in panels:
        panel.legend(
            frameon=False, fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2
        )
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "crawl.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="for the figure")
    main(parser.parse_args().folder)
