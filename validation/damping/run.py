"""A mode's free vibration: its decay and frequency by integrator and damping."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import common
import numpy as np

import pdcorrect as pc

CELL, AMPLITUDE = 0.05, 1e-4
"""Amplitude in cells: the geometric nonlinearity is of that order."""
RATIO = 0.03
"""Of critical damping, by mass, stiffness or viscosity, for the first mode."""
SPECTRAL_RADIUS = 0.8
STEPS, SKIPPED = 60, 10
"""Steps of a run, and those at its beginning that are not used: several-step schemes start."""
SPLITS = (20, 80)
"""Steps a period of the first mode."""
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
DAMPING = ("none", "mass", "stiffness", "viscosity")
STEP = 0.01
"""s; the body is as stiff as the steps a period ask for."""
METHODS = {"PD": pc.ProjectiveDynamics, "Newton": pc.Newton}


def beam(integrator: str, young: float, **damping: float) -> pc.Problem:
    """A cantilever of 8×2×1 cells; ``young`` in Pa."""
    scene = pc.Scene(
        body={"shape": "beam", "cells": [8, 2, 1], "cell_size": CELL},
        material={"young": young, "poisson": 0.3, "density": 1e3},
        clamps=[{"region": {"plane": "x", "at": "min"}}],
        time={"step": STEP, "frames": STEPS, "integrator": integrator,
              "spectral_radius": SPECTRAL_RADIUS},
        damping=damping,
        solver={"tolerance": 1e-10, "element": "hex8-bubble", "mass": "averaged"},
    )  # fmt: skip
    return pc.discretise(scene)


def measured(method: str, problem: pc.Problem, shape: np.ndarray) -> complex:
    """What a step multiplies the mode's complex amplitude by.

    The roots of the recurrence q[n+2] = a q[n+1] + b q[n] that fits the mode's coordinate.
    """
    scale = AMPLITUDE * CELL / np.abs(shape).max()
    start = pc.State(problem.positions + scale * shape, np.zeros_like(shape))
    run = pc.rollout(METHODS[method](problem), state=start)
    weighted = problem.mass_times(shape)
    q = np.einsum("tni,ni->t", run.positions - problem.positions, weighted)[SKIPPED:]
    (a, b), *_ = np.linalg.lstsq(np.stack([q[1:-1], q[:-2]], axis=1), q[2:], rcond=None)
    return complex(max(np.roots([1.0, -a, -b]), key=lambda root: root.imag))


def predicted(integrator: str, kind: str, omega: float, damping: float, h: float) -> complex:
    """The same for q'' + damping q' + omega^2 q = 0, by the scheme's own formula."""
    s = -0.5 * damping + 1j * np.sqrt(omega**2 - 0.25 * damping**2)
    if integrator == "backward-euler":
        return complex(1.0 / (1.0 - s * h))
    if integrator == "bdf2":
        return complex(max(np.roots([1.5 - s * h, -2.0, 0.5]), key=abs))
    if integrator == "midpoint" and kind != "viscosity":
        return complex((1.0 + 0.5 * s * h) / (1.0 - 0.5 * s * h))
    matrix = midpoint_with_viscosity if integrator == "midpoint" else generalised_alpha
    roots = np.linalg.eigvals(matrix(omega * h, damping * h, kind == "viscosity"))
    return complex(min(roots, key=lambda root: abs(root - np.exp(s * h))))


RATE = np.array([1.5, -2.0, 0.5])
"""Steps times the rate at a configuration, from it and those of the two steps before."""


def midpoint_with_viscosity(omega: float, damping: float, _: bool) -> np.ndarray:
    """Its matrix for (q, h v, y, y before, y before that): rates are of y."""
    new, old = np.zeros((5, 5)), np.zeros((5, 5))
    new[0, :2], old[0, :2] = [1.0, -0.5], [1.0, 0.5]
    new[1, 1], new[1, 2:], old[1, 1] = 1.0, damping * RATE, 1.0
    new[1, 2] += omega**2
    new[2, [0, 2]], old[2, 0] = [-0.5, 1.0], 0.5
    return _shifted(new, old)


def generalised_alpha(omega: float, damping: float, viscous: bool) -> np.ndarray:
    """Its matrix for (h v, h^2 a, h^2 A, q, q before, q before that).

    With omega h and damping h (Chung and Hulbert 1993, Arnold and Bruls 2007).
    """
    r = SPECTRAL_RADIUS
    m, f = (2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0)
    gamma, beta = 0.5 - m + f, 0.25 * (1.0 - m + f) ** 2
    new, old = np.zeros((6, 6)), np.zeros((6, 6))
    new[0, :2], old[0, :2] = [1.0, -gamma], [1.0, 1.0 - gamma]
    new[1, 1:3], old[1, 1:3] = [1.0 - m, f - 1.0], [-m, f]
    new[2, [2, 3]] = 1.0, omega**2
    if viscous:
        new[2, 3:] += damping * RATE
    else:
        new[2, 0] = damping
    new[3, [1, 3]], old[3, [0, 1, 3]] = [-beta, 1.0], [1.0, 0.5 - beta, 1.0]
    return _shifted(new, old)


def _shifted(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """A step's matrix, whose last three entries are a quantity, before and before that."""
    for row in (-2, -1):
        new[row, row], old[row, row - 1] = 1.0, 1.0
    return np.linalg.solve(new, old)


def vibration(integrator: str, quick: bool) -> common.Outcome:
    """All dampings and steps of an integrator."""
    found = pc.modes(beam(integrator, 1.0), 1)
    shape, unit = found.shapes[0], 2.0 * np.pi * float(found.frequencies[0])
    figures: common.Figures = {}
    rows = []
    slow = integrator == "bdf2"  # without damping or by mass its line searches take long
    dampings = DAMPING[1 + slow :] if quick else DAMPING
    for split in SPLITS[:1] if quick else SPLITS:
        omega = 2.0 * np.pi / STEP / split
        for kind in dampings:
            critical = 2.0 * RATIO * (kind != "none")
            size = critical * omega if kind == "mass" else critical / omega
            theory = predicted(integrator, kind, omega, critical * omega, STEP)
            for method in ("PD",) if quick else METHODS:
                damping = {} if kind == "none" else {kind: size}
                problem = beam(integrator, (omega / unit) ** 2, **damping)
                root = measured(method, problem, shape)
                label = f"{integrator}, {kind}, {split} steps a period, {method}"
                figures[f"{label}, difference of the factor"] = abs(root - theory)
                rates = [-np.log(abs(x)) / STEP / omega for x in (root, theory)]
                pace = [float(np.angle(x)) / STEP / omega for x in (root, theory)]
                if kind != "none":
                    figures[f"{label}, rate over the body's"] = float(rates[0] / RATIO)
                exact = 0.5 * critical
                rows.append((integrator, kind, float(split), method, *map(float, rates), exact,
                             *pace))  # fmt: skip
    heads = ("integrator", "damping", "steps a period", "solver", "decay over omega",
             "by the scheme", "without time steps", "frequency over omega",
             "by the scheme's formula")  # fmt: skip
    return common.Outcome(figures, (common.Table("Decay of the first mode", heads, tuple(rows)),))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each integrator."""
    return {name: partial(vibration, name, quick) for name in INTEGRATORS}


def finding(record: common.Record) -> str:
    """The largest difference of all, and rates."""
    largest = max(x for n, x in record.figures.items() if "difference" in n)
    rates = {n: x for n, x in record.figures.items() if n.endswith("the body's")}
    ours = [x for n, x in rates.items() if n.startswith("generalised-alpha")]
    first = [x for n, x in rates.items() if n.startswith("backward-euler")]
    return (
        f"Every step multiplies the mode's amplitude by the scheme's own factor, to {largest:.0e}. "
        f"At 10 ms and 20 or 80 steps a period the rate of decay is {min(ours):.3f} to "
        f"{max(ours):.3f} times the body's by generalised-α, {min(first):.1f} to "
        f"{max(first):.1f} times by backward Euler."
    )
