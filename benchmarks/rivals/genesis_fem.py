"""Genesis: pip install genesis-world==1.4.5 torch

Tetrahedra of 4 nodes with Hooke's law in the frame of each, at its rotation before the step; its
implicit solver, backward Euler, in float64 on a CPU; only on the beam, as it compiles anew before
each run.  Its finite elements take no forces but a steady gravity, and start at rest.  Its Rayleigh
damping, on by default, is off but for one run.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, Refused, main

PACKAGE = "genesis-world"
RECOMMENDED = ("10 ms, its damping",)
SETTINGS = {
    f"{1e3 * step:g} ms{', its damping' if alpha else ''}": {
        "law": "linear-corotated", "longest": step, "damping_alpha": alpha,
        "damping_beta": beta, "refine": refine, "scenes": (),
    }
    for step, alpha, beta, refine in ((1e-2, 0.5, 5e-4, (1,)), (1e-2, 0.0, 0.0, (2,)))
}  # fmt: skip
"""One Newton step is exact, as rotations are held; so are its other defaults."""


def simulate(
    case: Case, law: str, longest: float, damping_alpha: float, damping_beta: float
) -> Iterator[np.ndarray]:
    import genesis as gs
    import genesis.utils.element as utils

    if case.nodal.any() or case.velocity.any() or not case.steady:
        raise Refused("more than steady gravity")
    gs.init(backend=gs.cpu, precision="64", logging_level="warning")
    scene = gs.Scene(
        sim_options=gs.options.SimOptions(
            dt=case.step, substeps=case.substeps(longest), floor_height=-10.0,
            gravity=tuple(case.accelerations.sum(axis=0)),
        ),
        fem_options=gs.options.FEMOptions(
            use_implicit_solver=True, enable_vertex_constraints=True,
            damping_alpha=damping_alpha, damping_beta=damping_beta,
        ),
        show_viewer=False,
    )  # fmt: skip
    # in place of its own cutting of a box into tetrahedra
    utils.mesh_to_elements = lambda mesh, tet_cfg: (case.points, case.tets)
    utils.split_all_surface_tets = lambda points, tets: (points, tets)
    body = scene.add_entity(
        morph=gs.morphs.Box(size=(0.1, 0.1, 0.1), pos=(0, 0, 0)),
        material=gs.materials.FEM.Elastic(
            model="linear_corotated",
            E=case.uniform(case.young),
            nu=case.uniform(case.poisson),
            rho=case.uniform(case.density),
        ),
    )
    scene.build()
    body.set_vertex_constraints(case.clamped)
    for _ in range(case.frames):
        scene.step()
        yield body.get_state().pos[0].cpu().numpy()


if __name__ == "__main__":
    main(simulate, SETTINGS)
