"""PBAT's vertex block descent: pip install pbatoolkit==0.0.11

Backward Euler; step, iterations and start of each step ("kinetic energy minimum") of its example.
Its stable neo-Hookean energy takes lambda + mu for lambda.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "pbatoolkit"
RECOMMENDED = ("10 ms, 20 iterations",)
SETTINGS = {
    f"{10 / substeps:g} ms, {iterations} iterations": {
        "law": "neo-hookean", "substeps": substeps, "iterations": iterations, "refine": refine,
    }
    for substeps, iterations, refine in ((1, 20, (1, 2)), (10, 20, (1, 2)), (10, 200, (1,)))
}  # fmt: skip


def simulate(case: Case, law: str, substeps: int, iterations: int) -> Iterator[np.ndarray]:
    from pbatoolkit import pbat

    vbd, count = pbat.sim.vbd, len(case.tets)
    forces, mass = case.forces.T, np.zeros(len(case.points))
    edges = case.points[case.tets[:, 1:]] - case.points[case.tets[:, :1]]
    np.add.at(mass, case.tets, (case.density / 24 * np.linalg.det(edges))[:, None])
    data = (
        vbd.Data()
        .with_volume_mesh(case.points.T, case.tets.T)
        .with_surface_mesh(np.zeros(0, dtype=np.int64), np.zeros((3, 0), dtype=np.int64))
        .with_acceleration(case.gravity[:, None] + forces / mass)
        .with_material(
            np.full(count, case.density), np.full(count, case.mu),
            np.full(count, case.lam + case.mu),
        )
        .with_dirichlet_vertices(case.clamped)
        .with_initialization_strategy(vbd.InitializationStrategy.KineticEnergyMinimum)
        .construct(validate=True)
    )  # fmt: skip
    solver = vbd.Integrator(data)
    for _ in range(case.frames):
        solver.step(case.step, iterations, substeps)
        yield solver.x.T


if __name__ == "__main__":
    main(simulate, SETTINGS)
