"""Momentum, angular momentum, energy, free fall and reactions."""

from __future__ import annotations

import common
import numpy as np

import pdcorrect as pc

Array = np.ndarray
SPEED, SPIN, GRAVITY = (0.7, -0.4, 0.2), (3.0, 5.0, -2.0), 9.81
STEP, SECONDS = 0.01, 0.2
ELEMENT, LEARNED = "hex8-bubble", "hex8-learned"
METHODS = {"PD": pc.ProjectiveDynamics, "Newton": pc.Newton}
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")


def block(
    integrator: str, split: int = 1, element: str = ELEMENT, **sections: object
) -> pc.Problem:
    """A free cross-shaped body, soft enough to strain as it spins."""
    body = {"shape": "cross", "cells": [4, 2, 2], "cell_size": 0.05, "arms": 2, "arm_start": 1,
            "arm_width": 2, "arm_length": 2}  # fmt: skip
    scene = pc.Scene(
        body=body, material={"young": 2e4, "poisson": 0.4, "density": 1e3},
        time={"step": STEP / split, "frames": round(SECONDS / STEP) * split,
              "integrator": integrator, "spectral_radius": 0.8},
        solver={"tolerance": 1e-9}, **sections,
    )  # fmt: skip
    return pc.discretise(scene, element=element, mass="averaged")


def flight(method: str, integrator: str, split: int = 1, element: str = ELEMENT) -> pc.Trajectory:
    """The body thrown, spinning and stretched by 10 per cent."""
    problem = block(integrator, split, element)
    centre = problem.mass @ problem.positions / problem.mass.sum()
    arms = problem.positions - centre
    start = centre + arms * [1.1, 1.0, 0.95]
    velocities = np.array(SPEED) + np.cross(SPIN, start - centre)
    return pc.rollout(METHODS[method](problem), state=pc.State(start, velocities))


def momenta(run: pc.Trajectory) -> tuple[Array, Array]:
    """Linear and angular momentum (T+1, 3) with the mass matrix."""
    push = np.stack([run.problem.mass_times(v) for v in run.velocities])
    return push.sum(axis=1), np.cross(run.positions, push).sum(axis=1)


def thrown(method: str, integrator: str, element: str = ELEMENT) -> common.Figures:
    """Largest relative changes of momentum, angular momentum and energy in a flight."""
    run, name = flight(method, integrator, element=element), f"{method}, {integrator}"
    if element != ELEMENT:
        name = f"{name}, {element}"
    linear, angular = momenta(run)
    energy = pc.metrics.energy_balance(run)
    return {
        f"{name}, momentum": pc.metrics.relative_drift(linear),
        f"{name}, angular momentum": pc.metrics.relative_drift(angular),
        f"{name}, energy": float(np.abs(energy.dissipation).max() / energy.total[0]),
    }


def order() -> float:
    """Of backward Euler's loss of angular momentum, between h/2 and h/4."""
    runs = [flight("PD", "backward-euler", split) for split in (2, 4)]
    before, after = (pc.metrics.relative_drift(momenta(run)[1]) for run in runs)
    return float(np.log2(before / after))


def fall(method: str, integrator: str) -> float:
    """Largest distance of the centre of mass from what the integrator has to give, m.

    Backward Euler falls by g h2 n (n + 1) / 2; midpoint and generalised-alpha are exact.
    """
    load = {"kind": "gravity", "acceleration": [0.0, 0.0, -GRAVITY]}
    problem = block(integrator, loads=[load])
    run = pc.rollout(METHODS[method](problem))
    n = np.arange(len(run.times))
    steps = n * (n + 1) if integrator == "backward-euler" else n * n
    height = run.positions[:, :, 2] @ problem.mass / problem.mass.sum()
    return float(np.abs(height - height[0] + 0.5 * GRAVITY * STEP**2 * steps).max())


def support() -> float:
    """Sum of the clamps' forces over the weight, at rest."""
    load = {"kind": "gravity", "acceleration": [0.0, 0.0, -GRAVITY]}
    held = {"region": {"plane": "x", "at": "min"}}
    problem = block("quasi-static", loads=[load], clamps=[held])
    positions = common.equilibrium(problem, 1)
    state = pc.State(positions, np.zeros_like(positions))
    forces = pc.reactions(problem, state, np.zeros_like(positions))
    return float(forces[:, 2].sum() / (problem.mass.sum() * GRAVITY))


def case(quick: bool) -> common.Outcome:
    """All figures; quick runs leave Newton out of the flights."""
    figures: common.Figures = {}
    for method in ("PD",) if quick else METHODS:
        for integrator in INTEGRATORS:
            figures |= thrown(method, integrator)
    for integrator in INTEGRATORS:
        figures |= thrown("PD", integrator, LEARNED)
    figures["PD, backward-euler, order of the loss of angular momentum"] = order()
    for integrator in ("backward-euler", "midpoint", "generalised-alpha"):
        figures[f"PD, {integrator}, fall, m"] = fall("PD", integrator)
    return common.Outcome(figures | {"support over weight": support()})


def finding(record: common.Record) -> str:
    """Angular momentum and energy by integrator."""
    lost = {n: record.figures[f"PD, {n}, energy"] for n in ("backward-euler", "midpoint")}
    turned = record.figures["PD, midpoint, angular momentum"]
    return (
        f"Midpoint keeps angular momentum to {turned:.0e}; a free flight of 0.2 s loses "
        f"{lost['backward-euler']:.0%} of its energy by backward Euler and "
        f"{lost['midpoint']:.1%} by midpoint."
    )
