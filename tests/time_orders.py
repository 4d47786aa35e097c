"""Small bodies in smooth motion, and the exact solution of their equations in time.

The reference integrates M a = f_int + f_ext - C v with an explicit Runge-Kutta method of
order 8, which shares nothing with the implicit steps but the forces.
"""

import numpy as np
from scipy.integrate import solve_ivp

import pdcorrect as pc
from conftest import CLAMPED, box_mesh, problem_on

END = 0.4
"""s, about a third of the slowest period."""

_TIMES = np.linspace(0, 1.25 * END, 1281)


def pulse(t):
    """From 0 to 1 with three vanishing derivatives at time 0."""
    return np.sin(0.5 * np.pi * np.asarray(t) / END) ** 4


SHIFT, ANGLE = np.array([0.03, -0.02, 0.04]), 25.0


def clamp(moving):
    if not moving:
        return CLAMPED
    motion = {
        "times": _TIMES, "displacement": pulse(_TIMES)[:, None] * SHIFT,
        "rotation": ANGLE * pulse(_TIMES), "axis": "x", "centre": [0, 0.05, 0.02],
    }  # fmt: skip
    return [{**CLAMPED[0], "motion": motion}]


def swinging(mass="lumped", moving=False, damping=None, element="hex8", strength=1.0, **time):
    """A soft beam of three cells under a smooth pulse of body force."""
    load = {
        "kind": "body-force", "density": (strength * np.array([900.0, 700.0, -1600.0])).tolist(),
        "table": np.column_stack([_TIMES, pulse(_TIMES)]),
    }  # fmt: skip
    problem = problem_on(
        box_mesh((3, 1, 1), (0.3, 0.1, 0.08), 0.0), element,
        material={"young": 2e4, "poisson": 0.3}, clamps=clamp(moving), loads=[load],
        damping=damping or {}, solver={"mass": mass}, time={"step": 0.01, **time},
    )  # fmt: skip
    return problem


def derivative(f, t, order, h=1e-3):
    """Central differences of order 6; the pulse is smooth also before time 0."""
    if order == 1:
        pairs = ((3 / 4, 1), (-3 / 20, 2), (1 / 60, 3))
        return sum(c * (f(t + k * h) - f(t - k * h)) for c, k in pairs) / h
    pairs = ((3 / 2, 1), (-3 / 20, 2), (1 / 90, 3))
    return (-49 / 18 * f(t) + sum(c * (f(t + k * h) + f(t - k * h)) for c, k in pairs)) / h**2


def exact_clamps(problem, moving):
    """Prescribed positions as a smooth function of time."""
    x = problem.positions

    def positions(t):
        if not moving:
            return x
        a = np.radians(ANGLE * pulse(t))
        turn = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        centre = np.array([0, 0.05, 0.02])
        return centre + (x - centre) @ turn.T + SHIFT * pulse(t)

    return positions


def reference(problem, moving=False):
    """Positions and velocities at `END`."""
    free, shape = problem.free.ravel(), problem.positions.shape
    clamps, damping = exact_clamps(problem, moving), problem.scene.damping
    M = np.kron(problem.mass_matrix.toarray(), np.eye(3))
    solve = np.linalg.inv(M[np.ix_(free, free)])
    coupled = M[np.ix_(free, ~free)]
    load = problem.external_forces(END)

    def rate(t, z):
        x, v = clamps(t).ravel().copy(), derivative(clamps, t, 1).ravel()
        x[free], v[free] = np.split(z, 2)
        force = (problem.forces(x.reshape(shape)) + pulse(t) * load).ravel()
        if damping.mass:
            force -= damping.mass * (M @ v)
        if damping.stiffness:
            force -= damping.stiffness * (problem.stiffness(x.reshape(shape), project=True) @ v)
        force = force[free]
        if moving:
            force = force - coupled @ derivative(clamps, t, 2).ravel()[~free]
        return np.concatenate([v[free], solve @ force])

    start = np.concatenate([problem.positions.ravel()[free], np.zeros(free.sum())])
    found = solve_ivp(rate, (0, END), start, method="DOP853", rtol=1e-10, atol=1e-12)
    assert found.success
    return np.split(found.y[:, -1], 2)


def errors(problem, exact, steps, kind=pc.Newton):
    """Largest error of positions and velocities of free components at `END`."""
    free = problem.free.ravel()
    stepper = kind(problem, tolerance=1e-10, time_step=END / steps)
    run = pc.rollout(stepper, steps)
    assert set(run.stats["status"]) == {"CONVERGED"}
    last = run.state()
    return [
        np.abs(found.ravel()[free] - wanted).max()
        for found, wanted in zip((last.positions, last.velocities), exact, strict=True)
    ]
