"""Derivatives of a step by everything it depends on, against difference quotients."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import common
import numpy as np

import pdcorrect as pc

Array = np.ndarray
CELL, TOLERANCE, ADJOINT = 0.05, 1e-12, 1e-12
SHARES = (1e-2, 1e-3, 1e-4, 1e-5)
"""Steps of the difference quotients, of each input's scale."""
INTEGRATORS = ("backward-euler", "bdf2", "midpoint", "generalised-alpha")
METHODS = {"PD": pc.ProjectiveDynamics, "Newton": pc.Newton}
MATERIAL = ("young", "poisson", "density")


def problem(element: str, integrator: str, follower: bool) -> pc.Problem:
    """A clamped beam that is twisted and falls."""
    scene = pc.Scene(
        body={"shape": "beam", "cells": [4, 2, 1], "cell_size": CELL},
        material={"young": 1e5, "poisson": 0.35, "density": 1e3},
        clamps=[{"region": {"plane": "x", "at": "min"}}],
        loads=[{"kind": "gravity", "acceleration": [0, 0, -9.81]},
               {"kind": "torsion", "strength": 2e4, "follower": follower}],
        time={"step": 0.01, "frames": 3, "integrator": integrator},
        damping={"mass": 1.0},
        solver={"element": element, "mass": "averaged", "tolerance": TOLERANCE},
    )  # fmt: skip
    return pc.discretise(scene)


@dataclass(frozen=True)
class Step:
    """A step and a loss w . p + v . dp/dt of what comes out of it."""

    method: str
    body: pc.Problem
    state: pc.State
    weights: tuple[Array, Array]

    def loss(self, changes: Mapping[str, Any]) -> float:
        """With some inputs changed, each by an array or number that is added."""
        material = {
            name: getattr(self.body.materials, name) + changes.get(name, 0.0) for name in MATERIAL
        }
        changed = any(name in changes for name in MATERIAL)
        body = self.body.with_material(**material) if changed else self.body
        state, step = self.state, body.time_step + changes.get("time_step", 0.0)
        memory = dict(state.memory)
        if "previous_times" in memory:  # as if the step before were as long
            memory["previous_times"] = np.full_like(state.positions, state.time - step)
        moved = pc.State(
            state.positions + changes.get("positions", 0.0),
            state.velocities + changes.get("velocities", 0.0),
            state.time, memory,
        )  # fmt: skip
        after = METHODS[self.method](body, time_step=step)(moved, changes.get("forces")).state
        return float(
            np.vdot(self.weights[0], after.positions) + np.vdot(self.weights[1], after.velocities)
        )


def compared(step: Step, solver: str) -> common.Figures:
    """Relative error of the best quotient by input."""
    rng = np.random.default_rng(1)
    body, state = step.body, step.state
    stepper = METHODS[step.method](body)
    gradients = pc.adjoint(
        stepper, state, stepper(state), *step.weights, solver=solver, tolerance=ADJOINT
    )
    scales = {
        "positions": CELL * body.free, "velocities": 1.0 * body.free, "forces": 1.0 * body.free,
        "young": 1e5, "poisson": 0.1, "density": 1e3, "time_step": body.time_step,
    }  # fmt: skip
    out = {}
    for name, scale in scales.items():
        derivative = getattr(gradients, name)
        along = scale * rng.uniform(-1.0, 1.0, np.shape(derivative))
        exact = float(np.vdot(derivative, along))
        errors = []
        for share in SHARES:
            ends = [step.loss({name: sign * share * along}) for sign in (1.0, -1.0)]
            quotient = (ends[0] - ends[1]) / (2.0 * share)
            errors.append(abs(quotient - exact) / abs(exact))
        out[name] = min(errors)
    return out


def derivatives(element: str, integrator: str, method: str, solver: str) -> common.Outcome:
    """All inputs of one step, which begins after two others."""
    body = problem(element, integrator, follower=solver != "cg")  # which wants symmetry
    state = pc.rollout(METHODS[method](body), 2).state(-1)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=state.positions.shape), 0.01 * rng.normal(size=state.positions.shape)
    found = compared(Step(method, body, state, weights), solver)
    label = f"{element}, {integrator}, {method}, {solver}"
    return common.Outcome({f"{label}, {name}": error for name, error in found.items()})


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each element, integrator and solver."""
    chosen = [("hex8-bubble-mean", "backward-euler", "PD", "direct")]
    if not quick:
        chosen += [(e, "backward-euler", "PD", "direct") for e in common.ELEMENTS
                   if e != "hex8-bubble-mean"]  # fmt: skip
        chosen += [("hex8", i, "PD", "direct") for i in INTEGRATORS[1:]]
        chosen += [("hex8", "backward-euler", "PD", "cg"),
                   ("hex8", "backward-euler", "Newton", "direct")]  # fmt: skip
    return {", ".join(c): partial(derivatives, *c) for c in chosen}


def finding(record: common.Record) -> str:
    """The largest difference of all."""
    largest = max(x for x in record.figures.values() if isinstance(x, float))
    return f"All derivatives agree with difference quotients, to {largest:.0e} at worst."
