"""A contestant: pdcorrect itself, in the environment that runs the driver."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "pdcorrect"
RECOMMENDED = ()
_KINDS = {
    "hex8, 1": ("hex8", 1, (1,)),
    "best coarse, 1": ("hex8-enhanced", 1, (1,)),
    "hex27, 1": ("hex27", 1, (1,)),
    "learned, 1": ("hex8-learned", 1, (1,)),
    "learned, 2": ("hex8-learned", 2, (1,)),
}
"""Element, steps a frame by generalised-alpha, meshes of scenes but the beam."""
SETTINGS = {
    f"{name}, {law}": {
        "law": law, "element": element, "substeps": steps, "refine": (1,), "scenes": scenes,
    }
    for law in ("linear-corotated", "neo-hookean")
    for name, (element, steps, scenes) in _KINDS.items()
}  # fmt: skip


def simulate(case: Case, law: str, element: str, substeps: int) -> Iterator[np.ndarray]:
    import pdcorrect as pc

    scene = pc.Scene.from_toml(case.scene).with_changes(
        material={"energy": law}, time={"integrator": "generalised-alpha", "substeps": substeps}
    )
    if element == "hex8-learned":
        scene = pc.learned_coarse(scene)
    elif element == "hex8-enhanced":
        scene = pc.best_coarse(scene)
    else:
        mass = "lumped" if element == "hex8" else "consistent"
        scene = scene.with_changes(solver={"element": element, "mass": mass})
    problem = pc.discretise(scene, case.refine)
    stepper = pc.ProjectiveDynamics(problem).prepare()
    state, own = problem.initial_state(), case.match(problem.positions)
    for _ in range(case.frames):
        for _ in range(substeps):
            state = stepper(state).state
        yield state.positions[own]


if __name__ == "__main__":
    main(simulate, SETTINGS)
