"""A small body under each kind of load, and the exact solution of its equations in time.

The reference integrates M a = f_int + f_ext - damping with an explicit Runge-Kutta method of
order 8, which shares nothing with the implicit steps but the forces.  Its time is cut where a
load jumps or bends.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import pdcorrect as pc
from pdcorrect.errors import PdcorrectWarning
from pdcorrect.fem.viscosity import Stretches, small_strain_stress

Array = np.ndarray
END = 0.4
"""s, about a third of the slowest period."""
FRAMES = 8
"""Times at which errors are taken."""
ON, OFF = END / 12, 5 * END / 12
"""Of an impulse, s; a ramp ends at the last.  A third or two thirds through a step of END/40 s
or of its halves, so that the error of a jump falls evenly."""
DAMPING = {
    "none": {},
    "mass": {"mass": 3.0},
    "stiffness": {"stiffness": 0.005},
    "viscosity": {"viscosity": 0.005},
}
SHIFT, ANGLE, CENTRE = np.array([0.03, -0.02, 0.04]), 25.0, np.array([0.0, 0.05, 0.02])
"""Of the moving clamp: m, degrees about x, m."""

_TIMES = np.linspace(0.0, 1.25 * END, 5121)
_CLAMP_TIMES = _TIMES[::4]


def pulse(t: Any) -> Any:
    """From 0 to 1 with three vanishing derivatives at time 0."""
    return np.sin(0.5 * np.pi * np.asarray(t) / END) ** 4


def swing(t: Any) -> Any:
    """0.8 periods of a sine."""
    return np.sin(1.6 * np.pi * np.asarray(t) / END)


def rise(t: float) -> float:
    """To 1 at `OFF`."""
    return min(1.0, t / OFF)


@dataclass(frozen=True)
class Motion:
    """A load of a scene, its amplitude over time, and where that jumps or bends, s."""

    load: dict[str, Any]
    amplitude: Callable[[float], float]
    breaks: tuple[float, ...] = ()


def _gravity(strength: float, **time: Any) -> dict[str, Any]:
    acceleration = (strength * np.array([1.0, -1.5, -4.0])).tolist()
    return {"kind": "gravity", "acceleration": acceleration, **time}


_TORSION = {"kind": "torsion", "strength": 8e3, "attraction": 0.2, "stretch": 0.1}
_PRESSURE = {"kind": "pressure", "pressure": 400.0, "region": {"plane": "z", "at": "max"}}
_IMPULSE = _gravity(2.0, window=(ON, OFF))
_TABLE = _gravity(1.0, table=np.column_stack([_TIMES, swing(_TIMES)]))
_PULSE = np.column_stack([_TIMES, pulse(_TIMES)])
MOTIONS = {
    "gravity": Motion(_gravity(0.75), lambda t: 1.0),
    "ramp": Motion(_gravity(1.0, ramp=OFF), rise, (OFF,)),
    "sine table": Motion(_TABLE, swing),
    "impulse": Motion(_IMPULSE, lambda t: float(ON <= t < OFF), (ON, OFF)),
    "moving clamp": Motion({}, lambda t: 0.0),
    "follower torsion": Motion({**_TORSION, "follower": True, "ramp": OFF}, rise, (OFF,)),
    "follower pressure": Motion({**_PRESSURE, "follower": True, "table": _PULSE}, pulse),
}


def body(motion: str, damping: str, integrator: str = "backward-euler") -> pc.Problem:
    """A soft beam of three cells, held at one end."""
    clamp: dict[str, Any] = {"region": {"plane": "x", "at": "min"}}
    if motion == "moving clamp":
        clamp["motion"] = {
            "times": _CLAMP_TIMES, "displacement": pulse(_CLAMP_TIMES)[:, None] * SHIFT,
            "rotation": ANGLE * pulse(_CLAMP_TIMES), "axis": "x", "centre": CENTRE,
        }  # fmt: skip
    load = MOTIONS[motion].load
    scene = pc.Scene(
        body={"shape": "beam", "cells": [3, 1, 1], "cell_size": 0.1},
        material={"young": 2e4, "poisson": 0.3, "density": 1e3},
        time={"step": 0.01, "frames": 1, "integrator": integrator},
        clamps=[clamp], loads=[load] if load else [], damping=DAMPING[damping],
    )  # fmt: skip
    with warnings.catch_warnings():  # of one cell through the thickness: here only time counts
        warnings.simplefilter("ignore", PdcorrectWarning)
        return pc.discretise(scene)


def _clamps(problem: pc.Problem, motion: str, t: float) -> Array:
    """Prescribed positions as a smooth function of time."""
    x = problem.positions
    if motion != "moving clamp":
        return x
    a = np.radians(ANGLE * pulse(t))
    turn = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    return CENTRE + (x - CENTRE) @ turn.T + SHIFT * pulse(t)


def _speeds(problem: pc.Problem, motion: str, t: float, h: float = 1e-3) -> Array:
    """Of the clamps, by central differences of order 6."""
    out = np.zeros_like(problem.positions)
    if motion == "moving clamp":
        for k, c in ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60)):
            out += c * _clamps(problem, motion, t + k * h) / h
            out -= c * _clamps(problem, motion, t - k * h) / h
    return out


def _forces(problem: pc.Problem, x: Array, v: Array, amplitude: float) -> Array:
    """Elastic, external and damping forces (N, 3)."""
    force, damping = problem.forces(x), problem.scene.damping
    for load in problem.loads:
        force = force + amplitude * (load.pattern if load.sample is None else load.sample(x))
    if damping.mass:
        force = force - damping.mass * problem.mass_times(v)
    if damping.stiffness:
        slowed = problem.stiffness(x, project=True) @ v.ravel()
        force = force - damping.stiffness * slowed.reshape(x.shape)
    if damping.viscosity:
        at = Stretches(problem, x)
        force = force - damping.viscosity * at.forces(small_strain_stress(problem, at.rates(v)))
    return force


def reference(problem: pc.Problem, motion: str) -> tuple[Array, Array]:
    """Positions and velocities (F, free components) at the `FRAMES`."""
    kind, free = MOTIONS[motion], problem.free.ravel()
    shape, mass = problem.positions.shape, np.repeat(problem.mass, 3)[free]

    def rate(t: float, z: Array, middle: float) -> Array:
        x, v = _clamps(problem, motion, t).ravel().copy(), _speeds(problem, motion, t).ravel()
        x[free], v[free] = np.split(z, 2)
        # the amplitude of an impulse is constant in a piece, also at its ends
        amplitude = kind.amplitude(middle if motion == "impulse" else t)
        force = _forces(problem, x.reshape(shape), v.reshape(shape), amplitude)
        return np.concatenate([v[free], force.ravel()[free] / mass])

    times = END * np.arange(1, FRAMES + 1) / FRAMES
    z = np.concatenate([problem.positions.ravel()[free], np.zeros(free.sum())])
    out = np.empty((FRAMES, len(z)))
    for start, end in pairwise((0.0, *kind.breaks, END)):
        inside = (times > start) & (times <= end)
        found = solve_ivp(
            rate, (start, end), z, method="DOP853", rtol=1e-8, atol=1e-11,
            t_eval=np.union1d(times[inside], [end]), args=(0.5 * (start + end),),
        )  # fmt: skip
        if not found.success:
            raise RuntimeError(f"{motion}: {found.message}")
        out[inside] = found.y.T[: inside.sum()]
        z = found.y[:, -1]
    positions, velocities = np.split(out, 2, axis=1)
    return positions, velocities
