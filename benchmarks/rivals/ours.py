"""A contestant: pdcorrect itself, in the environment that runs the driver."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import COUNTS, FRAMES, GRAVITY, SIZE, STEP, Case, main

PACKAGE = "pdcorrect"
RECOMMENDED = ()

LAWS = ("linear-corotated", "neo-hookean")
_KINDS = (
    ("hex8", "generalised-alpha", 1, (1,)),
    ("hex8-enhanced", "generalised-alpha", 1, (1, 2)),
    ("hex8-learned", "backward-euler", 1, (1,)),
    ("hex8-learned", "generalised-alpha", 1, (1,)),
    ("hex8-learned", "generalised-alpha", 2, (1,)),
    ("hex8-learned", "generalised-alpha", 4, (1,)),
    ("hex27", "generalised-alpha", 1, (1,)),
    ("hex27", "generalised-alpha", 2, (1,)),
)
"""Element, integrator, substeps, meshes."""
SETTINGS = {
    f"{element}, {integrator}, {10 / substeps:g} ms, {law}": {
        "law": law, "element": element, "integrator": integrator, "substeps": substeps,
        "refine": refine,
    }
    for law in LAWS
    for element, integrator, substeps, refine in _KINDS
}  # fmt: skip


def scene(case: Case, law: str):  # type: ignore[no-untyped-def]
    """The case as a scene."""
    import pdcorrect as pc

    load = {"kind": "gravity", "acceleration": [0.0, 0.0, -GRAVITY]}
    if case.twist:
        load = {"kind": "torsion", "strength": case.twist}
    return pc.Scene(
        name=case.name,
        body={"shape": "beam", "cells": list(COUNTS), "cell_size": SIZE},
        material={
            "energy": law, "young": case.young, "poisson": case.poisson, "density": case.density,
        },
        time={"step": STEP, "frames": FRAMES},
        clamps=[{"region": {"plane": "x", "at": 0.0}}],
        loads=[load],
    )  # fmt: skip


def simulate(
    case: Case, law: str, element: str, integrator: str, substeps: int
) -> Iterator[np.ndarray]:
    import pdcorrect as pc

    chosen = scene(case, law).with_changes(time={"integrator": integrator, "substeps": substeps})
    mass = {"hex8": "lumped", "hex27": "consistent"}
    if element == "hex8-learned":
        chosen = pc.learned_coarse(chosen)
    elif element == "hex8-enhanced":
        chosen = pc.best_coarse(chosen)
    else:
        chosen = chosen.with_changes(solver={"element": element, "mass": mass[element]})
    problem = pc.discretise(chosen, case.refine)
    stepper = pc.ProjectiveDynamics(problem).prepare()
    state, own = problem.initial_state(), case.match(problem.positions)
    for _ in range(case.frames):
        for _ in range(substeps):
            state = stepper(state).state
        yield state.positions[own]


if __name__ == "__main__":
    main(simulate, SETTINGS)
