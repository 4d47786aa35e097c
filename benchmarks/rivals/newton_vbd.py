"""Newton's vertex block descent: pip install newton==1.8.0 (brings warp-lang; float32 on a CPU)

Step and iterations of its example of hanging soft bodies: 1/600 s and 10; backward Euler; no
damping, contact or self-contact.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "newton"
RECOMMENDED = ("1.67 ms, 10 iterations",)
SETTINGS = {
    f"{10 / substeps:.3g} ms, {iterations} iterations": {
        "law": "neo-hookean", "substeps": substeps, "iterations": iterations, "refine": refine,
    }
    for substeps, iterations, refine in ((6, 10, (1, 2)), (6, 100, (1,)), (24, 30, (1,)))
}  # fmt: skip


def simulate(case: Case, law: str, substeps: int, iterations: int) -> Iterator[np.ndarray]:
    import newton
    import warp as wp

    builder = newton.ModelBuilder()
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*point) for point in case.points], indices=case.tets.ravel().tolist(),
        density=case.density, k_mu=case.mu, k_lambda=case.lam, k_damp=0.0,
        add_surface_mesh_edges=False,
    )  # fmt: skip
    for node in case.clamped:
        builder.particle_mass[node] = 0.0
    builder.color()
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        model.set_gravity(tuple(case.gravity))
        solver = newton.solvers.SolverVBD(
            model=model, iterations=iterations, particle_enable_self_contact=False,
            particle_enable_tile_solve=False,
        )  # fmt: skip
        now, then, control = model.state(), model.state(), model.control()
        forces = wp.array(case.forces.astype(np.float32), dtype=wp.vec3)
        for _ in range(case.frames):
            for _ in range(substeps):
                wp.copy(now.particle_f, forces)
                solver.step(now, then, control, None, case.step / substeps)
                now, then = then, now
            yield now.particle_q.numpy()


if __name__ == "__main__":
    main(simulate, SETTINGS)
