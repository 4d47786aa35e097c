"""Step five scenes, from bare to full, in a process of their own, and print what each used.

    python pays_only_scene.py MESH_FILE

Run with ``NUMBA_DISABLE_JIT=1`` the kernels are plain functions, so that their calls are counted.
"""

import gc
import json
import sys
from collections import Counter
from types import FunctionType, ModuleType

COUNTED = {
    "volume": ("energies", "nearest_volume_lanes"),
    "shear": ("energies", "corotated_lanes"),
    "hyperelastic": ("energies", "hyperelastic_lanes"),
    "modes": ("internal_modes", "_follow"),
}
END = {"plane": "x", "at": "max"}
HELD = {"region": {"plane": "x", "at": "min"}}
BARE = {
    "body": {"shape": "beam", "cells": [3, 2, 1], "cell_size": 0.05},
    "material": {"young": 1e5, "poisson": 0.3, "density": 1e3, "energy": "corotated-only"},
    "time": {"step": 0.01, "frames": 2},
}
VOLUME = {**BARE, "material": {**BARE["material"], "energy": "corotated"}}
LOADED = {
    **VOLUME,
    "clamps": [HELD],
    "loads": [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
}
BEST = {**LOADED, "solver": {"element": "hex8-bubble-mean", "mass": "averaged"}}
FULL = {
    **BEST,
    "materials": [{"region": {"box": [[0.08, -1, -1], [1, 1, 1]]}, "young": 3e5}],
    "damping": {"mass": 1.0, "stiffness": 1e-3},
    "time": {**BARE["time"], "integrator": "generalised-alpha"},
    "clamps": [
        HELD,
        {"region": END, "motion": {"times": [0.0, 0.1], "rotation": [0.0, 20.0]}},
    ],
    "loads": [
        *LOADED["loads"],
        {"kind": "torsion", "strength": 1e4, "follower": True},
        {"kind": "pressure", "pressure": 50.0, "region": {"plane": "z", "at": "max"}},
    ],
}
SCENES = {"bare": BARE, "volume": VOLUME, "loaded": LOADED, "best": BEST, "full": FULL}


def count_calls(counts):
    """Put counters round kernels that are plain functions."""
    import importlib

    for key, (module, name) in COUNTED.items():
        home = importlib.import_module(f"pdcorrect.fem.{module}")
        kernel = getattr(home, name)

        def counted(*arguments, key=key, kernel=kernel):
            counts[key] += 1
            if key == "volume":  # lanes from the first one with a volume term on
                counts["volume lanes"] += int(arguments[0].shape[1] - arguments[3])
            return kernel(*arguments)

        setattr(home, name, counted)


def held_bytes(*roots):
    """Bytes of the arrays that are reachable from some objects, each buffer once."""
    import numpy as np
    from numba.core.dispatcher import Dispatcher

    seen, buffers, todo = set(), {}, list(roots)
    while todo:
        item = todo.pop()
        if id(item) in seen or isinstance(item, (type, ModuleType, FunctionType, Dispatcher)):
            continue
        seen.add(id(item))
        if isinstance(item, np.ndarray):
            base = item
            while isinstance(base.base, np.ndarray):
                base = base.base
            buffers[id(base)] = base.nbytes
        else:
            todo += gc.get_referents(item)
    return sum(buffers.values())


def main(mesh_file):
    """Two frames of each scene; the full one's body comes from a file."""
    from pdcorrect.solvers import step

    counts = Counter()
    build = step.Rayleigh.__init__

    def damped(self, *arguments):
        counts["damping"] += 1
        build(self, *arguments)

    step.Rayleigh.__init__ = damped
    count_calls(counts)
    found = {}
    for name, settings in SCENES.items():
        counts.clear()
        counts.update(dict.fromkeys([*COUNTED, "volume lanes", "damping"], 0))
        body = {"body": {"shape": "file", "path": mesh_file}} if name == "full" else {}
        found[name] = used({**settings, **body}) | {"counts": dict(counts)}
    print(json.dumps(found))


def used(settings):
    """What stepping one scene used."""
    import pdcorrect as pc

    problem = pc.discretise(pc.Scene(**settings))
    stepper = pc.ProjectiveDynamics(problem)
    run = pc.rollout(stepper)
    return {
        "statuses": run.stats["status"].tolist(),
        "modules": sorted(sys.modules),  # also of the scenes before, which are barer
        "problem_bytes": held_bytes(problem),
        "bytes": held_bytes(problem, stepper),
        "sizes": [len(problem.positions), len(problem.cells)],
        "lanes": problem.quadrature.lanes.shape,
        "loads": [held_bytes(load) for load in problem.loads],
        "clamps": held_bytes(problem.clamps),
    }


if __name__ == "__main__":
    main(*sys.argv[1:])
