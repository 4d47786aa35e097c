"""Cases that time the solvers on the beam of `beam.py`, each measurement in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cases
import numpy as np

import pdcorrect as pc
from pdcorrect.solvers.first_hessian import TrueHessian
from pdcorrect.solvers.minimise import MinimiserOptions
from pdcorrect.solvers.tangent_solver import TangentFactory

SIZES = ((24, 1), (24, 2), (24, 4), (56, 4))
"""(length, refine): 225, 1 225, 7 857 and 18 225 nodes."""


def measure(threads: int, name: str, **arguments: Any) -> Any:
    """What `beam.py` prints."""
    script = str(Path(__file__).parent / "beam.py")
    pairs = [f"{key}={value}" for key, value in arguments.items()]
    command = [sys.executable, script, str(threads), name, *pairs]
    out = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(out.stdout.splitlines()[-1])


def kernel() -> list[dict[str, Any]]:
    """Nanoseconds a quadrature point, one and two threads."""
    rows = []
    for length, refine in SIZES:
        for threads in (1, 2):
            row = measure(threads, "kernel", length=length, refine=refine)
            rows.append({"threads": threads, **row})
    for element in ("hex8-mean", "hex8-bubble", "hex27"):
        row = measure(2, "kernel", length=24, refine=2, element=element)
        rows.append({"threads": 2, "element": element, **row})
    return rows


def beam_steps() -> list[dict[str, Any]]:
    """Time against tip error: DiffPD's rules and ours, G and the lagged Hessian."""
    rows = []
    for length, refine in SIZES:
        frames = 50 if refine == 1 else 10
        for threads in (1, 2):
            for rules in ("diffpd", "ours"):
                for first in ("G-scaled", "rest"):
                    found = measure(
                        threads, "step", length=length, refine=refine, rules=rules,
                        first_hessian=first, frames=frames,
                    )  # fmt: skip
                    rows += [{"threads": threads, **row} for row in found]
    return rows


def iteration() -> list[dict[str, Any]]:
    """Milliseconds of one iteration of L-BFGS, one and two threads."""
    return [
        {
            "threads": threads,
            **measure(
                threads, "iteration", length=length, refine=refine, rules=rules,
                first_hessian=first,
            ),
        }
        for length, refine in SIZES
        for threads in (1, 2)
        for rules in ("diffpd", "ours")
        for first in ("G-scaled", "rest")
    ]  # fmt: skip


def newton() -> list[dict[str, Any]]:
    """Seconds of a Newton step, direct and by conjugate gradients."""
    rows = []
    for length, refine in SIZES:
        for rules in ("diffpd", "ours"):
            for linear_solver in ("direct", "cg"):
                row = measure(
                    2, "newton", length=length, refine=refine, rules=rules,
                    linear_solver=linear_solver,
                )  # fmt: skip
                rows.append({"threads": 2, **row})
    return rows


def memory() -> list[dict[str, Any]]:
    """Peak memory of whole processes."""
    return [
        measure(2, "memory", length=length, refine=refine, first_hessian=first)
        for length, refine in SIZES
        for first in ("G-scaled", "rest")
    ]


def tangent_factors() -> list[dict[str, Any]]:
    """Band against cholespy on tangents."""
    return [measure(1, "tangents", length=length, refine=refine) for length, refine in SIZES]


def growth() -> dict[str, Any]:
    """Time and memory from 225 to 200 000 nodes by the solver of the linear systems.

    Of a slender beam and of a compact block, whose factors fill far more.
    """
    rows = []
    for body, refinements, largest_band in (
        ("beam", (1, 2, 3, 4, 6, 8, 12), 8),
        ("block", (1, 2, 3, 4, 6, 8, 9), 4),
    ):
        for refine in refinements:
            for method in ("cholesky", "amg", "band", "rest-amg"):
                if method != "band" or refine <= largest_band:
                    rows.append(measure(2, "growth", refine=refine, method=method, body=body))
                    print(rows[-1], flush=True)
    return {
        "rows": rows,
        "powers": {
            body: powers([row for row in rows if row["body"] == body]) for body in ("beam", "block")
        },
    }


def powers(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Exponents of the number of nodes, fitted over meshes of 3 000 nodes and more."""
    out: dict[str, dict[str, float]] = {}
    for method in sorted({row["method"] for row in rows}):
        large = [row for row in rows if row["method"] == method and row["nodes"] > 3000]
        nodes = np.log([row["nodes"] for row in large])
        out[method] = {
            key: float(np.polyfit(nodes, np.log([row[key] for row in large]), 1)[0])
            for key in ("prepare_s", "step_s", "peak_megabytes")
        }
    return out


def adjoint() -> list[dict[str, Any]]:
    """A step and its derivative, one and two threads."""
    rows = []
    for length, refine in SIZES:
        for threads in (1, 2):
            for row in measure(threads, "adjoint", length=length, refine=refine):
                rows.append({"threads": threads, **row})
    return rows


def first_guesses() -> list[dict[str, Any]]:
    """Mean iterations of a step by where it starts, with the rest shape's turned Hessian.

    "position" p, "inertial" p + h v (for backward Euler the previous increment repeated),
    "extrapolated" p + h v + h (v - v_).
    """
    rows = []
    for motion in ("twist", "bending", "flight"):
        problem = pc.discretise(cases.example_beam(motion, 0.45), refine=2)
        row: dict[str, Any] = {"motion": motion, "poisson": 0.45}
        for name in ("position", "inertial", "extrapolated"):
            row[name] = _iterations(problem, motion, name)
        rows.append(row)
    return rows


def _iterations(problem: pc.Problem, motion: str, start: str) -> float:
    h, hessian = problem.time_step, TrueHessian(TangentFactory(problem), lagged=False)

    def guess(state: pc.State, before: cases.Array) -> cases.Array:
        p, v = state.positions, state.velocities
        ahead = {"position": 0.0 * v, "inertial": h * v, "extrapolated": h * (2 * v - before)}
        return p + ahead[start]

    options = MinimiserOptions(1e-5 * problem.cell_size)
    return cases.mean_iterations(problem, motion, hessian.solver, options, guess)


def integrators() -> list[dict[str, Any]]:
    """A step by each integrator, two threads, the best of three processes."""
    rows = []
    for length, refine in SIZES[:3]:
        frames = 30 if refine < 4 else 12
        for name in ("backward-euler", "bdf2", "midpoint", "generalised-alpha"):
            for viscosity in (0.0, 2e-3) if name == "generalised-alpha" else (0.0,):
                found = [
                    measure(
                        2, "integrator", length=length, refine=refine, scheme=name, frames=frames,
                        viscosity=viscosity,
                    )
                    for _ in range(3)
                ]  # fmt: skip
                best = min(found, key=lambda row: row["median_step_ms"])
                rows.append({"threads": 2, "tolerance": 1e-5, **best})
    return rows


def elements() -> list[dict[str, Any]]:
    """A step with the learned element beside the best coarse one, two threads."""
    sizes = ((2, 2, 24), (2, 8, 18), (8, 8, 24), (8, 8, 96))
    return [
        {"threads": 2, "tolerance": 1e-5, **measure(2, "elements", width=a, height=b, length=c)}
        for a, b, c in sizes
    ]


CASES: dict[str, Callable[[], Any]] = {
    "kernel": kernel,
    "beam_steps": beam_steps,
    "integrators": integrators,
    "elements": elements,
    "iteration": iteration,
    "newton": newton,
    "memory": memory,
    "tangent_factors": tangent_factors,
    "growth": growth,
    "first_guesses": first_guesses,
    "adjoint": adjoint,
}
