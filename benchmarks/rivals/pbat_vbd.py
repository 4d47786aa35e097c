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
    f"{1e3 * step:g} ms, {iterations} iterations": {
        "law": "neo-hookean", "longest": step, "iterations": iterations, "refine": refine,
        "scenes": (1,),
    }
    for step, iterations, refine in ((1e-2, 20, (1,)), (1e-3, 20, (1, 2)))
}  # fmt: skip


def simulate(case: Case, law: str, longest: float, iterations: int) -> Iterator[np.ndarray]:
    from pbatoolkit import pbat

    vbd, mass, owners = pbat.sim.vbd, np.zeros(len(case.points)), case.owners
    edges = case.points[case.tets[:, 1:]] - case.points[case.tets[:, :1]]
    shares = case.density[owners] / 24 * np.linalg.det(edges)
    np.add.at(mass, case.tets, shares[:, None])
    accelerations = case.accelerations[:, None] + case.nodal / mass[:, None]
    accelerations[:, case.clamped] = 0
    substeps = case.substeps(longest)
    h = case.step / substeps
    velocity = np.tile(case.velocity[:, None], len(case.points))
    velocity[:, case.clamped] = 0
    data = (
        vbd.Data()
        .with_volume_mesh(case.points.T, case.tets.T)
        .with_surface_mesh(np.zeros(0, dtype=np.int64), np.zeros((3, 0), dtype=np.int64))
        .with_velocity(velocity)
        .with_acceleration(np.zeros((3, len(case.points))))
        .with_material(case.density[owners], case.mu[owners], (case.lam + case.mu)[owners])
        .with_dirichlet_vertices(case.clamped)
        .with_initialization_strategy(vbd.InitializationStrategy.KineticEnergyMinimum)
        .construct(validate=True)
    )
    solver = vbd.Integrator(data)
    for frame in case.factors(substeps):
        for step in frame:
            solver.v += h * np.tensordot(step, accelerations, 1).T  # as by its aext
            solver.step(h, iterations, 1)
        yield solver.x.T


if __name__ == "__main__":
    main(simulate, SETTINGS)
