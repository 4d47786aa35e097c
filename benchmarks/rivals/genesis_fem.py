"""Genesis: pip install genesis-world==1.4.5 torch

Tetrahedra of 4 nodes with Hooke's law in the frame of each, at its rotation before the step; its
implicit solver, backward Euler, in float64 on a CPU.  The twist is left out: its finite elements
take no forces but gravity.  Its Rayleigh damping, on by default, is off but for one run.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "genesis-world"
DAMPED = {"damping_alpha": 0.5, "damping_beta": 5e-4}
UNDAMPED = {"damping_alpha": 0.0, "damping_beta": 0.0}
SETTINGS = {
    "10 ms, its damping": {"law": "linear-corotated", "substeps": 1, **DAMPED},
    **{
        f"{10 / substeps:g} ms": {"law": "linear-corotated", "substeps": substeps, **UNDAMPED}
        for substeps in (1, 4, 16)
    },
}
"""One Newton step is exact, as rotations are held; so are its other defaults."""


def simulate(
    case: Case, law: str, substeps: int, damping_alpha: float, damping_beta: float
) -> Iterator[np.ndarray]:
    import genesis as gs
    from genesis.engine.entities.fem_entity import FEMEntity

    if case.twist:
        raise NotImplementedError("forces on nodes")
    gs.init(backend=gs.cpu, precision="64", logging_level="error")
    scene = gs.Scene(
        sim_options=gs.options.SimOptions(
            dt=case.step, substeps=substeps, gravity=tuple(case.gravity), floor_height=-10.0
        ),
        fem_options=gs.options.FEMOptions(
            use_implicit_solver=True, enable_vertex_constraints=True,
            damping_alpha=damping_alpha, damping_beta=damping_beta,
        ),
        show_viewer=False,
    )  # fmt: skip
    # its own cutting of a surface into tetrahedra is replaced by the case's
    FEMEntity.sample = lambda self: self.instantiate(case.points, case.tets[:, [0, 1, 3, 2]])
    body = scene.add_entity(
        morph=gs.morphs.Box(size=(0.1, 0.1, 0.1), pos=(0, 0, 0)),
        material=gs.materials.FEM.Elastic(
            model="linear_corotated", E=case.young, nu=case.poisson, rho=case.density
        ),
    )
    scene.build()
    body.set_vertex_constraints(case.clamped)
    for _ in range(case.frames):
        scene.step()
        yield body.get_state().pos[0].cpu().numpy()


if __name__ == "__main__":
    main(simulate, SETTINGS)
