"""Young's modulus and Poisson's ratio of a beam from its motion, by gradients through all steps.

A beam that is held at one end starts with a velocity that stretches and bends it, under
gravity.  Its nodes are measured at every frame with noise of 1e-4 of a cell.  From a start
that is 50 % off in Young's modulus and 0.1 in Poisson's ratio, L-BFGS-B minimises the squared
distance from the measurement; `pc.adjoint` gives the derivatives of each step.

    python examples/recover_material.py [FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import minimize

import pdcorrect as pc

Array = NDArray[np.float64]

CELL, FRAMES = 0.02, 20
TRUE = {"young": 2e5, "poisson": 0.35}
START = {"young": 1e5, "poisson": 0.25}
NOISE = 1e-4
"""Standard deviation of the measurement, of the cell size."""

SCENE = pc.Scene(
    name="recover material",
    body={"shape": "beam", "cells": [6, 2, 2], "cell_size": CELL},
    material={**TRUE, "density": 1e3},
    clamps=[{"region": {"plane": "x", "at": "min"}}],
    loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
    time={"step": 0.005, "frames": FRAMES},
    solver={"tolerance": 1e-7, "element": "hex8-bubble-mean"},
)


def initial_state(problem: pc.Problem) -> pc.State:
    """At rest positions, with a velocity that grows from the clamp to the tip."""
    along = problem.positions[:, :1] / problem.positions[:, 0].max()
    return pc.State(problem.positions, along * np.array([2.0, 0.0, 1.0]))


def simulate(stepper: pc.ProjectiveDynamics) -> tuple[list[pc.State], list[pc.StepResult]]:
    """States at the start of each step, and the steps' results."""
    before, results = [initial_state(stepper.problem)], []
    for _ in range(FRAMES):
        results.append(stepper(before[-1]))
        before.append(results[-1].state)
    return before[:-1], results


def loss_and_gradient(
    problem: pc.Problem, young: float, poisson: float, measured: Array
) -> tuple[float, Array, Array]:
    """Mean squared distance in cells, its derivatives by both parameters, and the positions."""
    stepper = pc.ProjectiveDynamics(problem.with_material(young, poisson))
    before, results = simulate(stepper)
    positions = np.array([result.state.positions for result in results])
    missed = (positions - measured) / CELL
    per_node = FRAMES * len(problem.positions)
    by_frame = 2.0 * missed / (per_node * CELL)

    gradient = np.zeros(2)
    by_positions, by_velocities = np.zeros_like(by_frame[0]), np.zeros_like(by_frame[0])
    for k in reversed(range(FRAMES)):
        found = pc.adjoint(
            stepper, before[k], results[k], by_positions + by_frame[k], by_velocities
        )
        gradient += [found.young.sum(), found.poisson.sum()]
        by_positions, by_velocities = found.positions, found.velocities
    return float((missed**2).sum() / per_node), gradient, positions


def main(folder: Path = Path()) -> dict[str, float]:
    """Recover, print a summary, and draw ``recover_material.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    problem = pc.discretise(SCENE)
    _, results = simulate(pc.ProjectiveDynamics(problem))
    exact = np.array([result.state.positions for result in results])
    measured = exact + NOISE * CELL * np.random.default_rng(0).normal(size=exact.shape)

    tried: list[tuple[float, float, float]] = []
    """Loss, Young's modulus and Poisson's ratio of each evaluation."""

    def objective(u: Array) -> tuple[float, Array]:
        young, poisson = START["young"] * np.exp(u[0]), u[1]
        loss, gradient, _ = loss_and_gradient(problem, young, poisson, measured)
        tried.append((loss, young, poisson))
        return loss, gradient * [young, 1.0]

    found = minimize(
        objective, [0.0, START["poisson"]], jac=True, method="L-BFGS-B",
        bounds=[(-3.0, 3.0), (0.05, 0.48)], options={"ftol": 1e-10, "gtol": 1e-8},
    )  # fmt: skip
    young, poisson = START["young"] * float(np.exp(found.x[0])), float(found.x[1])
    summary = {
        "young": young,
        "poisson": poisson,
        "error of young": abs(young / TRUE["young"] - 1.0),
        "error of poisson": abs(poisson / TRUE["poisson"] - 1.0),
        "evaluations": float(len(tried)),
        "rms cells": float(np.sqrt(found.fun)),
    }
    print(
        f"{len(tried)} simulations of {FRAMES} frames with gradients: E = {young:.4g} Pa "
        f"({100 * summary['error of young']:.3f} % off), nu = {poisson:.4f} "
        f"({100 * summary['error of poisson']:.3f} % off), RMS misfit "
        f"{summary['rms cells']:.1e} cells"
    )
    tip = int(problem.positions.sum(axis=1).argmax())
    _, _, first = loss_and_gradient(problem, **START, measured=measured)
    _, _, last = loss_and_gradient(problem, young, poisson, measured)
    draw(np.array(tried), measured[:, tip], first[:, tip], last[:, tip], folder)
    return summary


def draw(tried: Array, measured: Array, first: Array, last: Array, folder: Path) -> None:
    """Loss, both parameters, and the path of a corner of the tip."""
    figure = Figure(figsize=(12.5, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    loss, parameters, path = figure.subplots(1, 3)
    loss.semilogy(tried[:, 0], "o-", color="#0072b2", markersize=4)
    loss.axhline(3.0 * NOISE**2, color="black", linestyle=":", label="noise")
    loss.set(xlabel="evaluation", ylabel="mean squared distance, cells²", title="Loss")
    loss.legend(frameon=False)
    for column, name, colour in ((1, "young", "#0072b2"), (2, "poisson", "#d55e00")):
        label = {"young": "Young's modulus", "poisson": "Poisson's ratio"}[name]
        ratio = tried[:, column] / TRUE[name]
        parameters.plot(ratio, "o-", color=colour, markersize=4, label=label)
    parameters.axhline(1.0, color="black", linestyle=":")
    parameters.set(xlabel="evaluation", ylabel="over the true value", title="Parameters")
    parameters.legend(frameon=False)
    for points, style, colour, label in (
        (measured, "o", "black", f"measured, noise {1e6 * NOISE * CELL:.0f} µm"),
        (first, "--", "#d55e00", "before"),
        (last, "-", "#009e73", "recovered"),
    ):
        x, z = 1e3 * points[:, 0], 1e3 * points[:, 2]
        path.plot(x, z, style, color=colour, label=label, markersize=4)
    path.plot(x[0], z[0], "k^", markersize=9, fillstyle="none", label="first frame")
    path.set(xlabel="x, mm", ylabel="z, mm", title="A corner of the tip")
    path.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for axis in (loss, parameters):
        axis.xaxis.get_major_locator().set_params(integer=True)
    for axis in (loss, parameters, path):
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "recover_material.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="for the figure")
    main(parser.parse_args().folder)
