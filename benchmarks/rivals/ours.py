"""This package, as a contestant."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import COUNTS, FRAMES, GRAVITY, SIZE, STEP, Case, main

PACKAGE = "pdcorrect"

LAWS = ("corotated", "linear-corotated", "neo-hookean", "st-venant-kirchhoff")
SETTINGS = {
    f"{element}, {label}, {10 // substeps} ms, {law}": {
        "law": law, "element": element, "integrator": integrator, "substeps": substeps,
    }
    for law in LAWS
    for element in ("hex8", "hex8-enhanced", "hex8-learned", "hex27")
    for label, integrator in (("gen.-α", "generalised-alpha"), ("BE", "backward-euler"))
    for substeps in (1, 2)
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
