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
    f"{1e3 * step:.3g} ms, {iterations} iterations": {
        "law": "neo-hookean", "longest": step, "iterations": iterations, "refine": refine,
        "scenes": scenes,
    }
    for step, iterations, refine, scenes in (
        (1 / 600, 10, (1, 2), (1,)), (1 / 600, 100, (1,), ()),
    )
}  # fmt: skip


def simulate(case: Case, law: str, longest: float, iterations: int) -> Iterator[np.ndarray]:
    import newton
    import warp as wp

    substeps = case.substeps(longest)

    builder = newton.ModelBuilder()
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(*case.velocity),
        vertices=[wp.vec3(*point) for point in case.points], indices=case.tets.ravel().tolist(),
        density=case.uniform(case.density), k_mu=case.uniform(case.mu),
        k_lambda=case.uniform(case.lam), k_damp=0.0, add_surface_mesh_edges=False,
    )  # fmt: skip
    for node in case.clamped:
        builder.particle_mass[node], builder.particle_qd[node] = 0.0, wp.vec3(0.0, 0.0, 0.0)
    builder.color()
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        model.set_gravity((0.0, 0.0, 0.0))
        solver = newton.solvers.SolverVBD(
            model=model, iterations=iterations, particle_enable_self_contact=False,
            particle_enable_tile_solve=False,
        )  # fmt: skip
        now, then, control = model.state(), model.state(), model.control()
        mass = model.particle_mass.numpy()[:, None]
        forces = case.nodal + mass * case.accelerations[:, None]
        for frame in case.factors(substeps):
            for factors in frame:
                total = np.tensordot(factors, forces, 1).astype(np.float32)
                wp.copy(now.particle_f, wp.array(total, dtype=wp.vec3))
                solver.step(now, then, control, None, case.step / substeps)
                now, then = then, now
            yield now.particle_q.numpy()


if __name__ == "__main__":
    main(simulate, SETTINGS)
