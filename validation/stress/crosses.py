"""A cross that the torsion model knows, in what they were trained on and far outside it.

Body, material and load are drawn as those of `datasets/torsion-exact`, by another seed: the
cross is none of that data set's.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scenarios import END, HELD, Array, Scenario, bending, scattered, squashed
from solvers import KNOWN_SOLVERS

import pdcorrect as pc
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan

DATASET = Path(__file__).resolve().parents[2] / "datasets" / "torsion-exact"
SEED, MESH = 8, 3
"""Of the draw: a small cross, 270 nodes, so that finer meshes of it are quick."""


def drawn() -> pc.Scene:
    """A scene of the training's distribution, for the plain coarse model."""
    config = DatasetConfig.load(DATASET / "config.toml").model_copy(update={"seed": SEED})
    return draw_scene(config, make_plan(config)[MESH], 0)


CROSS = drawn()
STEP = CROSS.time.step


def cross(frames: int, load: float = 1.0, **sections: Any) -> pc.Scene:
    """The cross with its load times ``load``, and other sections' keys replaced."""
    twist = CROSS.loads[0].model_dump(exclude_none=True)
    twist["strength"] *= load
    loads = [twist, *sections.pop("more_loads", ())]
    step = sections.pop("step", STEP)
    return CROSS.with_changes(
        name="cross", loads=loads, time={"step": step, "frames": frames}, **sections
    )


def scaled(key: str, factor: float) -> dict[str, float]:
    """Its material with one number times ``factor``."""
    return {key: factor * getattr(CROSS.material, key)}


def calm(**sections: Any) -> pc.Scene:
    """The cross without loads, its slowest motion (0.3 Hz) damped about critically, for 8 s."""
    return CROSS.with_changes(
        name="cross", loads=[], damping={"mass": 4.0}, time={"frames": 800}, **sections
    )


def turning(problem: pc.Problem, step: int) -> Array:
    """Makes the scene's loads turn round at every step."""
    times = step * problem.time_step, (step + 1) * problem.time_step
    return -2.0 * (step % 2) * problem.external_forces(*times)


def twisted(problem: pc.Problem) -> Array:
    """Sections turned about the beam's axis, those at the far end twice."""
    rest, (_, y, z) = problem.positions, CROSS.loads[0].centre
    along = (rest[:, 0] - rest[:, 0].min()) / np.ptp(rest[:, 0])
    cos, sin = np.cos(4.0 * np.pi * along), np.sin(4.0 * np.pi * along)
    dy, dz = rest[:, 1] - y, rest[:, 2] - z
    return np.column_stack([rest[:, 0], y + cos * dy - sin * dz, z + sin * dy + cos * dz])


TURN = {"times": [0.0, 0.24, 0.48], "rotation": [0.0, 720.0, 0.0], "centre": CROSS.loads[0].centre}
WEIGHT = {"kind": "gravity", "acceleration": [3.5, 4.7, -7.9]}

_moved = partial(Scenario, goal="motion", known=True, finer=2, solvers=KNOWN_SOLVERS)
_calmed = partial(Scenario, goal="rest", known=True, solvers=KNOWN_SOLVERS)

# fmt: off
CROSSES = (
    _moved("cross ordinary", "under a load as in training", cross(40), finer=4),
    _moved("cross long", "the same, five times as long", cross(200)),
    _moved("cross load 10", "ten times the load", cross(30, 10.0)),
    _moved("cross load 100", "a hundred times the load", cross(15, 100.0)),
    *(_moved(f"cross reversal {load:g}", f"{words}, which turns round at every step",
             cross(40, load), forces=turning)
      for load, words in ((1.0, "the load as in training"), (10.0, "ten times the load"))),
    _moved("cross weight", "gravity besides, across and along it", cross(40, more_loads=[WEIGHT])),
    _moved("cross kick", "struck: a bending motion at 20 m/s, faster than waves in it", cross(30),
           velocity=bending(20.0)),
    _moved("cross E 1e3", "a thousand times stiffer, under a thousand times the load",
           cross(40, 1e3, material=scaled("young", 1e3))),
    _moved("cross E 1e-3", "a thousand times softer, under the same load",
           cross(30, material=scaled("young", 1e-3))),
    _moved("cross density 1e3", "a thousand times heavier, under a hundred times the load",
           cross(40, 100.0, material=scaled("density", 1e3))),
    _moved("cross nu 0.499", "nearly incompressible", cross(40, material={"poisson": 0.499})),
    _moved("cross h 10", "by steps ten times as long", cross(15, step=10 * STEP)),
    _moved("cross h 0.01", "struck as above, by steps of a hundredth",
           cross(200, step=0.01 * STEP), velocity=bending(20.0)),
    _calmed("cross plane", "squashed to a plane", calm(), start=squashed((1, 1, 0))),
    _calmed("cross random 0.5", "nodes displaced by up to half a cell", calm(),
            start=scattered(0.5)),
    _calmed("cross random 5", "by up to 5 cells", calm(), start=scattered(5.0)),
    _calmed("cross twisted", "let go twisted by 720 degrees", calm(), start=twisted),
    _calmed("cross turned", "its far end held, too, turned twice and back",
            calm(clamps=[HELD, {"region": END, "motion": TURN}])),
)
