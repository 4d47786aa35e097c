"""One measurement of a cantilever beam in a fresh process; prints JSON.

    python beam.py THREADS MEASUREMENT key=value ...

The beam is DiffPD's: 0.02 m cells along x, clamped at x = 0, under gravity, E = 1e6 Pa,
nu = 0.45, rho = 1000 kg/m3, h = 0.01 s; ``rules=diffpd`` takes its mass and volume weight,
``rules=ours`` the defaults.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ["NUMBA_NUM_THREADS"] = sys.argv[1]

import numpy as np

import pdcorrect as pc


def beam(length: int, rules: str, frames: int = 10) -> pc.Scene:
    """The beam with ``length`` x 2 x 2 coarse cells."""
    diffpd = rules == "diffpd"
    return pc.Scene(
        body={"shape": "beam", "cells": [length, 2, 2], "cell_size": 0.02},
        material={
            "young": 1e6,
            "poisson": 0.45,
            "density": 1e3,
            "volume_weight": "published" if diffpd else "lame",
        },
        time={"step": 0.01, "frames": frames, "integrator": "backward-euler"},
        clamps=[{"region": {"plane": "x", "at": 0.0}}],
        loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
        solver={"mass": "per-node" if diffpd else "lumped"},
    )


def tip(problem: pc.Problem) -> int:
    """The node at the far corner."""
    return int(np.argmax(problem.positions.sum(axis=1)))


def best(function: Any, runs: int = 15) -> float:
    """Shortest of several runs, s: the least disturbed one."""
    taken = []
    for _ in range(runs):
        started = time.perf_counter()
        function()
        taken.append(time.perf_counter() - started)
    return min(taken)


def kernel(length: str, refine: str, rules: str = "ours", element: str = "hex8") -> dict[str, Any]:
    """Nanoseconds a quadrature point of energy and forces, with their sum over cells."""
    problem = pc.discretise(beam(int(length), rules), refine=int(refine), element=element)
    state = pc.rollout(pc.ProjectiveDynamics(problem, 1e-3), 5).state()
    x = problem.relaxed(state.positions)
    seconds = best(lambda: problem.energy_and_forces(x), runs=200 if len(x) < 2000 else 40)
    tangent = problem.linearise(x)
    points = problem.quadrature.weights.size
    return {
        "nodes": len(problem.positions),
        "quadrature_points": points,
        "energy_and_forces_ns": 1e9 * seconds / points,
        "tangent_product_ns": 1e9 * best(lambda: tangent.apply(x)) / points,
        "linearise_ns": 1e9 * best(lambda: problem.linearise(x)) / points,
        "stiffness_blocks_ns": 1e9 * best(tangent.blocks) / points,
    }


def step(
    length: str,
    refine: str,
    rules: str,
    first_hessian: str,
    frames: str = "10",
    tolerances: str = "1e-2,1e-3,1e-4,1e-5",
) -> list[dict[str, Any]]:
    """Time a step and error of the tip against a tight run, by tolerance."""
    problem = pc.discretise(beam(int(length), rules), refine=int(refine))
    count, node = int(frames), tip(problem)
    tight = pc.rollout(pc.ProjectiveDynamics(problem, 1e-9), count)
    rows = []
    for tolerance in tolerances.split(","):
        stepper = pc.ProjectiveDynamics(
            problem, float(tolerance), first_hessian=first_hessian
        ).prepare()
        run = pc.rollout(stepper, count)
        seconds, iterations = run.stats["seconds"], run.stats["iterations"]
        error = np.linalg.norm(run.positions[:, node] - tight.positions[:, node], axis=1)
        rows.append(
            {
                "nodes": len(problem.positions),
                "rules": rules,
                "first_hessian": stepper.describe()["first_hessian"],
                "tolerance": float(tolerance),
                "median_step_ms": 1e3 * float(np.median(seconds)),
                "mean_step_ms": 1e3 * float(np.mean(seconds)),
                "iterations": float(np.mean(iterations)),
                "ms_an_iteration": 1e3 * float(seconds.sum() / iterations.sum()),
                "tip_error_m": float(error.max()),
                "statuses": sorted(set(run.stats["status"].tolist())),
            }
        )
    return rows


def integrator(
    length: str, refine: str, scheme: str, frames: str = "30", viscosity: str = "0"
) -> dict[str, Any]:
    """Milliseconds a step by an integrator at the default tolerance, and peak memory."""
    scene = beam(int(length), "ours", int(frames)).with_changes(
        time={"integrator": scheme}, damping={"viscosity": float(viscosity)}
    )
    problem = pc.discretise(pc.best_coarse(scene), refine=int(refine))
    run = pc.rollout(pc.ProjectiveDynamics(problem).prepare())
    seconds = run.stats["seconds"][2:]  # steps that begin are others
    return {
        "nodes": len(problem.positions),
        "integrator": scheme,
        "viscosity": float(viscosity),
        "median_step_ms": 1e3 * float(np.median(seconds)),
        "mean_step_ms": 1e3 * float(np.mean(seconds)),
        "iterations": float(np.mean(run.stats["iterations"][2:])),
        "peak_mb": peak(),
        "statuses": sorted(set(run.stats["status"].tolist())),
    }


def elements(width: str, height: str, length: str, rounds: str = "5") -> dict[str, Any]:
    """Milliseconds of a set-up and of a step with the best coarse and the learned element.

    By generalised-alpha at the default tolerance; runs of both in turn, the shortest medians.
    """
    scene = beam(int(length), "ours", 30).with_changes(
        body={"cells": [int(length), int(width), int(height)]},
        time={"integrator": "generalised-alpha"},
    )
    kinds = {"best": pc.best_coarse(scene), "learned": pc.learned_coarse(scene)}
    row: dict[str, Any] = {}
    for name, kind in kinds.items():
        pc.discretise(kind)  # compiles
        row[f"{name}_setup_ms"] = 1e3 * best(lambda kind=kind: pc.discretise(kind), runs=5)
    steppers = {n: pc.ProjectiveDynamics(pc.discretise(k)).prepare() for n, k in kinds.items()}
    medians: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(int(rounds)):
        for name, stepper in steppers.items():
            run = pc.rollout(stepper)
            medians[name].append(1e3 * float(np.median(run.stats["seconds"][2:])))
            row[f"{name}_iterations"] = float(np.mean(run.stats["iterations"][2:]))
    problem = steppers["best"].problem
    row = {"nodes": len(problem.positions), "cells": len(problem.cells), **row}
    for name, found in medians.items():
        row[f"{name}_ms"] = min(found)
    return {**row, "ratio": row["learned_ms"] / row["best_ms"]}


def iteration(length: str, refine: str, rules: str, first_hessian: str) -> dict[str, Any]:
    """Milliseconds of one iteration of L-BFGS with a full history, without the error estimate."""
    from pdcorrect.solvers.first_hessian import TrueHessian
    from pdcorrect.solvers.integrators import backward_euler
    from pdcorrect.solvers.minimise import MinimiserOptions, minimise
    from pdcorrect.solvers.step import GlobalSolver, StepObjective
    from pdcorrect.solvers.tangent_solver import TangentFactory
    from pdcorrect.solvers.threads import limited_threads

    problem = pc.discretise(beam(int(length), rules), refine=int(refine))
    state = problem.rest_state()
    loads = problem.external_forces(0.0, 0.01)
    objective = StepObjective(problem, state, backward_euler(problem, state, 0.01), loads)
    with limited_threads():
        if first_hessian == "rest":
            solve: Any = TrueHessian(TangentFactory(problem), lagged=False).solver(objective)
        else:
            solve = GlobalSolver(problem, objective.factors, volume_scale=0.25)

        def run(count: int) -> float:
            options = MinimiserOptions(0.0, max_iterations=count)  # never looks at convergence
            return best(lambda: minimise(objective, objective.start, solve, options), runs=5)

        few, many = (4, 8) if first_hessian == "rest" else (20, 40)
        seconds = (run(many) - run(few)) / (many - few)
    return {
        "nodes": len(problem.positions),
        "rules": rules,
        "first_hessian": first_hessian,
        "iteration_ms": 1e3 * seconds,
    }


def newton(
    length: str, refine: str, rules: str, linear_solver: str = "auto", frames: str = "4"
) -> dict[str, Any]:
    """Time of a Newton step."""
    problem = pc.discretise(beam(int(length), rules), refine=int(refine))
    stepper = pc.Newton(problem, linear_solver=linear_solver).prepare()
    run = pc.rollout(stepper, int(frames))
    return {
        "nodes": len(problem.positions),
        "rules": rules,
        "linear_solver": stepper.linear_solver,
        "factorisation": stepper.describe()["factorisation"],
        "median_step_s": float(np.median(run.stats["seconds"])),
        "iterations": float(run.stats["iterations"].mean()),
        "peak_megabytes": peak(),
    }


def memory(length: str, refine: str, first_hessian: str) -> dict[str, Any]:
    """Peak memory of a process that makes three steps."""
    problem = pc.discretise(beam(int(length), "ours"), refine=int(refine))
    before = peak()
    stepper = pc.ProjectiveDynamics(problem, 1e-4, first_hessian=first_hessian)
    pc.rollout(stepper, 3)
    return {
        "nodes": len(problem.positions),
        "first_hessian": stepper.describe()["first_hessian"],
        "factorisation": stepper.describe()["factorisation"],
        "peak_megabytes": peak(),
        "before_the_first_step": before,
    }


def growth(refine: str, method: str, body: str = "beam") -> dict[str, Any]:
    """Times and memory of one mesh with one solver of the linear systems.

    The body is the beam of 24 x 2 x 2 coarse cells or a compact block of 6 x 6 x 6.
    """
    started = time.perf_counter()
    scene = beam(24, "ours")
    if body == "block":
        scene = scene.with_changes(body={"cells": [6, 6, 6]})
    problem = pc.discretise(scene, refine=int(refine))
    discretised = time.perf_counter() - started
    options: dict[str, Any] = {
        "cholesky": {"first_hessian": "G-scaled", "backend": "cholespy"},
        "amg": {"first_hessian": "G-scaled", "backend": "amg"},
        "band": {"first_hessian": "rest", "backend": "band"},
        "rest-amg": {"first_hessian": "rest", "backend": "amg"},
    }[method]
    stepper = pc.ProjectiveDynamics(problem, 1e-3, **options)
    started = time.perf_counter()
    stepper.prepare()
    prepared = time.perf_counter() - started
    run = pc.rollout(stepper, 3)
    return {
        "body": body,
        "nodes": len(problem.positions),
        "method": method,
        "discretise_s": discretised,
        "prepare_s": prepared,
        "step_s": float(np.median(run.stats["seconds"])),
        "iterations": float(run.stats["iterations"].mean()),
        "peak_megabytes": peak(),
    }


def adjoint(length: str, refine: str, rules: str = "diffpd") -> list[dict[str, Any]]:
    """Seconds of a step to the default tolerance and of its derivative."""
    problem = pc.discretise(beam(int(length), rules), refine=int(refine))
    stepper = pc.ProjectiveDynamics(problem, 1e-5).prepare()
    state = pc.rollout(stepper, 5).state()
    result = stepper(state)
    gradient = np.random.default_rng(0).normal(size=state.positions.shape)
    forward = best(lambda: stepper(state), runs=7)
    rows = []
    for tolerance in (1e-4, 1e-6, 1e-10):

        def backward(tolerance: float = tolerance) -> Any:
            found = pc.adjoint(stepper, state, result, gradient, tolerance=tolerance)
            return found, found.positions, found.velocities

        found = backward()[0]
        rows.append(
            {
                "nodes": len(problem.positions),
                "rules": rules,
                "tolerance": tolerance,
                "forward_ms": 1e3 * forward,
                "forward_iterations": result.iterations,
                "backward_ms": 1e3 * best(backward, runs=7),
                "backward_iterations": found.iterations,
                "residual": found.residual,
            }
        )
    return rows


def tangents(length: str, refine: str) -> dict[str, Any]:
    """Seconds of factorising and solving with a tangent: band against cholespy."""
    import scipy.sparse as sp

    from pdcorrect.fem.banded import BandOrder
    from pdcorrect.fem.factorisation import factorise

    problem = pc.discretise(beam(int(length), "ours"), refine=int(refine))
    order = BandOrder(problem.positions, problem.cells, problem.free)
    blocks = problem.linearise(problem.positions).blocks()
    for i in range(3):
        masses = problem.materials.density[:, None, None] * problem.cell_masses
        blocks[..., i, i] += 1e4 * masses
    right = np.random.default_rng(0).normal(size=problem.positions.shape)
    band = [order.assemble(blocks) for _ in range(3)]
    factor = order.factorise(band.pop())
    matrix = problem.stiffness(problem.positions)
    matrix = matrix + 1e4 * sp.kron(problem.mass_matrix, sp.eye_array(3))
    free = np.flatnonzero(problem.free.ravel())
    matrix = sp.csr_matrix(matrix)[free][:, free]
    row = {
        "nodes": len(problem.positions),
        "bandwidth": order.bandwidth,
        "band_megabytes": 1e-6 * order.factor_bytes,
        "band_assemble_s": best(lambda: order.assemble(blocks), runs=3),
        "band_factorise_s": best(lambda: order.factorise(band.pop()), runs=2),
        "band_solve_s": best(lambda: factor.solve(right)),
    }
    started = time.perf_counter()
    other = factorise(matrix, "cholespy")
    row["cholespy_factorise_s"] = time.perf_counter() - started
    row["cholespy_solve_s"] = best(lambda: other.solve(right.ravel()[free]), runs=5)
    return row


def peak() -> float:
    """Largest resident size of this process so far, MB.

    From Linux's own record: that of ``getrusage`` begins with the parent's.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) / 1024
    raise OSError("/proc/self/status has no VmHWM")


def main() -> None:
    """Measure what the command line asks for."""
    arguments = dict(pair.split("=", 1) for pair in sys.argv[3:])
    print(json.dumps(globals()[sys.argv[2]](**arguments)))


if __name__ == "__main__":
    main()
