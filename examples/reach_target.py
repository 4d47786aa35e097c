"""The initial velocity, or the forces of six actuators, that bring a beam's tip to a target.

The tip has to be at the target after 25 frames.  One search has three unknowns, the velocity of
the tip at the start (it falls to zero towards the clamp, linearly); the other has six,
constant forces along x, y and z on an inner and on the last section.  Both are solved by
Gauss-Newton: the adjoint of all steps gives the derivatives of the tip's three coordinates.

    python examples/reach_target.py [FOLDER]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

import pdcorrect as pc

Array = NDArray[np.float64]

CELL, FRAMES = 0.02, 25
MOVE = np.array([0.4, 0.9, 0.7])
"""Of the tip, from rest to the target, in cells."""

SCENE = pc.Scene(
    name="reach target",
    body={"shape": "beam", "cells": [5, 2, 2], "cell_size": CELL},
    material={"young": 3e4, "poisson": 0.4, "density": 1e3},
    clamps=[{"region": {"plane": "x", "at": "min"}}],
    loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
    time={"step": 0.002, "frames": FRAMES, "integrator": "midpoint"},
    solver={"tolerance": 1e-6, "element": "hex8-bubble-mean"},
)


@dataclass(frozen=True, eq=False)
class Control:
    """What u (P,) changes: the initial velocities and the nodal forces, linearly.

    Attributes
    ----------
    velocities, forces : (P, N, 3)
        Of one unit of each unknown.
    """

    velocities: Array
    forces: Array


def controls(problem: pc.Problem) -> dict[str, Control]:
    """The initial velocity (m/s at the tip) and the actuators (N)."""
    x = problem.positions[:, 0] / problem.positions[:, 0].max()
    axes = np.eye(3)
    linear = np.einsum("n,pi->pni", x, axes)
    sections = [np.isclose(x, at) / np.isclose(x, at).sum() for at in (0.6, 1.0)]
    spread = np.einsum("sn,pi->spni", sections, axes).reshape(6, -1, 3)
    return {
        "initial velocity": Control(linear, np.zeros_like(linear)),
        "six actuators": Control(np.zeros_like(spread), spread),
    }


def tip_path(
    stepper: pc.ProjectiveDynamics, control: Control, u: Array, tip: int, slopes: bool = False
) -> tuple[Array, Array]:
    """The tip's positions (T+1, 3), and the derivatives (3, P) of the last one by u."""
    problem = stepper.problem
    forces = np.tensordot(u, control.forces, 1)
    before = [pc.State(problem.positions, np.tensordot(u, control.velocities, 1))]
    results = []
    for _ in range(FRAMES):
        results.append(stepper(before[-1], forces))
        before.append(results[-1].state)
    path = np.array([state.positions[tip] for state in before])
    jacobian = np.zeros((3, len(u)))
    for row in range(3 if slopes else 0):
        by_positions, by_velocities = np.zeros_like(forces), np.zeros_like(forces)
        by_positions[tip, row] = 1.0
        for k in reversed(range(FRAMES)):
            found = pc.adjoint(
                stepper, before[k], results[k], by_positions, by_velocities, forces=forces
            )
            jacobian[row] += np.tensordot(control.forces, found.forces, 2)
            by_positions, by_velocities = found.positions, found.velocities
        jacobian[row] += np.tensordot(control.velocities, by_velocities, 2)
    return path, jacobian


def reach(
    stepper: pc.ProjectiveDynamics, control: Control, tip: int, target: Array, most: int = 8
) -> tuple[Array, list[Array]]:
    """The unknowns, and the tip's path in each iteration."""
    u = np.zeros(len(control.forces))
    path, jacobian = tip_path(stepper, control, u, tip, slopes=True)
    paths = [path]
    for _ in range(most):
        missed = target - path[-1]
        if np.linalg.norm(missed) < 1e-4 * CELL:
            break
        step = np.linalg.lstsq(jacobian, missed)[0]  # the shortest of all that would do
        for _ in range(10):
            path, jacobian = tip_path(stepper, control, u + step, tip, slopes=True)
            if np.linalg.norm(target - path[-1]) < np.linalg.norm(missed):
                break
            step = 0.5 * step
        u = u + step
        paths.append(path)
    return u, paths


def main(folder: Path = Path()) -> dict[str, float]:
    """Reach the target in both ways, print a summary, and draw ``reach_target.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    problem = pc.discretise(SCENE)
    stepper = pc.ProjectiveDynamics(problem)
    length, width = problem.positions[:, 0].max(), problem.positions[:, 1].max()
    middle = np.array([length, width / 2, width / 2])
    tip = int(np.linalg.norm(problem.positions - middle, axis=1).argmin())
    target = problem.positions[tip] + CELL * MOVE
    summary, drawn = {}, {}
    for name, control in controls(problem).items():
        u, paths = reach(stepper, control, tip, target)
        distance = float(np.linalg.norm(paths[-1][-1] - target)) / CELL
        summary[name], drawn[name] = distance, paths
        unit = "m/s" if name == "initial velocity" else "N"
        print(
            f"{name}: {np.array2string(u, precision=3)} {unit}; after {len(paths) - 1} iterations "
            f"the tip is {distance:.1e} cells from the target"
        )
    draw(drawn, target, folder)
    return summary


def draw(drawn: dict[str, list[Array]], target: Array, folder: Path) -> None:
    """Paths of the tip in two views, a row for each search."""
    figure = Figure(figsize=(9.5, 7.4), layout="constrained")
    FigureCanvasAgg(figure)
    rows: Any = figure.subplots(2, 2)
    shades = ("#bbbbbb", "#56b4e9", "#e69f00", "#cc79a7", "#d55e00", "#0072b2")
    for row, (name, paths) in zip(rows, drawn.items(), strict=True):
        for axis, (across, up) in zip(row, ((0, 2), (1, 2)), strict=True):
            for i, path in enumerate(paths):
                last = i == len(paths) - 1
                colour = "#009e73" if last else shades[min(i, len(shades) - 1)]
                mm = 1e3 * path
                axis.plot(mm[:, across], mm[:, up], "-", color=colour, label=f"iteration {i}",
                          linewidth=2.2 if last else 1.3)  # fmt: skip
                axis.plot(mm[-1, across], mm[-1, up], "o", color=colour, markersize=5)
            axis.plot(1e3 * target[across], 1e3 * target[up], "kx", markersize=11,
                      markeredgewidth=2, label="target")  # fmt: skip
            axis.set(xlabel=f"{'xyz'[across]}, mm", ylabel=f"{'xyz'[up]}, mm")
            axis.set_title(f"Tip, {name}", fontsize=11)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        row[1].legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(folder / "reach_target.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="for the figure")
    main(parser.parse_args().folder)
