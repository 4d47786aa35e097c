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
"""Of critical damping, by mass or by stiffness, for the first mode."""
SPECTRAL_RADIUS = 0.8
STEPS, SKIPPED = 60, 10
"""Steps of a run, and those at its beginning that are not used: several-step schemes start."""
SPLITS = (20, 80)
"""Steps a period of the first mode."""
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
DAMPING = ("none", "mass", "stiffness")
METHODS = {"PD": pc.ProjectiveDynamics, "Newton": pc.Newton}


def beam(step: float, integrator: str, mass: float, stiffness: float) -> pc.Problem:
    """A cantilever of 8×2×1 cells."""
    scene = pc.Scene(
        body={"shape": "beam", "cells": [8, 2, 1], "cell_size": CELL},
        material={"young": 1e5, "poisson": 0.3, "density": 1e3},
        clamps=[{"region": {"plane": "x", "at": "min"}}],
        time={"step": step, "frames": STEPS, "integrator": integrator,
              "spectral_radius": SPECTRAL_RADIUS},
        damping={"mass": mass, "stiffness": stiffness},
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


def predicted(integrator: str, omega: float, damping: float, h: float) -> complex:
    """The same for q'' + damping q' + omega^2 q = 0, by the scheme's own formula."""
    s = -0.5 * damping + 1j * np.sqrt(omega**2 - 0.25 * damping**2)
    if integrator == "backward-euler":
        return complex(1.0 / (1.0 - s * h))
    if integrator == "midpoint":
        return complex((1.0 + 0.5 * s * h) / (1.0 - 0.5 * s * h))
    if integrator == "bdf2":
        return complex(max(np.roots([1.5 - s * h, -2.0, 0.5]), key=abs))
    roots = np.linalg.eigvals(generalised_alpha(omega * h, damping * h))
    return complex(max(roots, key=lambda root: root.imag))


def generalised_alpha(omega: float, damping: float) -> np.ndarray:
    """Its matrix for (q, h v, h^2 a), with omega h and damping h (Chung and Hulbert 1993)."""
    r = SPECTRAL_RADIUS
    m, f = (2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0)
    gamma, beta = 0.5 - m + f, 0.25 * (1.0 - m + f) ** 2
    k = omega**2
    new = [[1.0, 0.0, -beta], [0.0, 1.0, -gamma], [(1 - f) * k, (1 - f) * damping, 1.0 - m]]
    old = [[1.0, 1.0, 0.5 - beta], [0.0, 1.0, 1.0 - gamma], [-f * k, -f * damping, -m]]
    return np.linalg.solve(np.array(new), np.array(old))


def vibration(integrator: str, quick: bool) -> common.Outcome:
    """All dampings and steps of an integrator."""
    rest = beam(1.0, integrator, 0.0, 0.0)
    found = pc.modes(rest, 1)
    omega, shape = 2.0 * np.pi * float(found.frequencies[0]), found.shapes[0]
    figures: common.Figures = {}
    rows = []
    slow = integrator == "bdf2"  # without damping or by mass its line searches take long
    dampings = DAMPING[1 + slow :] if quick else DAMPING
    for split in SPLITS[:1] if quick else SPLITS:
        h = 2.0 * np.pi / omega / split
        for kind in dampings:
            mass = 2.0 * RATIO * omega * (kind == "mass")
            stiffness = 2.0 * RATIO / omega * (kind == "stiffness")
            theory = predicted(integrator, omega, mass + stiffness * omega**2, h)
            for method in ("PD",) if quick else METHODS:
                problem = beam(h, integrator, mass, stiffness)
                root = measured(method, problem, shape)
                label = f"{integrator}, {kind}, {split} steps a period, {method}"
                figures[f"{label}, difference of the factor"] = abs(root - theory)
                rates = [-np.log(abs(x)) / h / omega for x in (root, theory)]
                pace = [float(np.angle(x)) / h / omega for x in (root, theory)]
                exact = RATIO * (kind != "none")
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
    """The largest difference of all."""
    largest = max(x for x in record.figures.values() if isinstance(x, float))
    return (
        f"Every step multiplies the mode's amplitude by the scheme's own factor, to {largest:.0e}."
    )
