"""Stiff and extreme scenes: bodies, loads, states to start from, and what is to be reached."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import pdcorrect as pc
from pdcorrect.fem.mesh import voxel_mesh
from pdcorrect.fem.mesh_files import write_vtu

Array = np.ndarray

CELL = 0.05
HELD = {"region": {"plane": "x", "at": "min"}}
CALM = {"mass": 20.0}
"""Damping, 1/s: a beam comes to rest within half a second."""


@dataclass(frozen=True)
class Scenario:
    """A scene, how it begins, and what has to be reached.

    ``goal`` is "rest": at the end the body is at rest where it was made; "shape": that but for a
    rigid motion of each part of it; or "motion": all frames are those of the same steps by the
    other method, solved tightly.  ``start`` gives positions and ``velocity`` velocities (N, 3);
    ``forces`` nodal forces by the number of the step.  ``known`` says that hybrids were trained
    on such bodies; ``finer`` into how many cells, along each axis, those of a reference are cut,
    beside which hybrids are judged (0: beside the coarse model).
    """

    name: str
    about: str
    scene: pc.Scene
    goal: str
    start: Callable[[pc.Problem], Array] | None = None
    velocity: Callable[[pc.Problem], Array] | None = None
    forces: Callable[[pc.Problem, int], Array] | None = None
    quick: bool = False
    solvers: Sequence[str] = ()
    known: bool = False
    finer: int = 0

    def state(self, problem: pc.Problem) -> pc.State:
        """Where a run begins; what is clamped stays there."""
        positions = self.start(problem) if self.start else problem.positions
        velocities = self.velocity(problem) if self.velocity else np.zeros_like(positions)
        held = ~problem.free
        positions = np.where(held, problem.positions, positions)
        return pc.State(positions, np.where(held, 0.0, velocities))


def beam(
    cells: tuple[int, int, int] = (6, 2, 2),
    frames: int = 40,
    step: float = 0.01,
    **sections: Any,
) -> pc.Scene:
    """A beam held at one end; ``material`` changes E = 1 MPa, Poisson's ratio 0.4, 1000 kg/m3."""
    material = {"young": 1e6, "poisson": 0.4, "density": 1e3, **sections.pop("material", {})}
    settings = {
        "body": {"shape": "beam", "cells": cells, "cell_size": CELL},
        "clamps": [HELD],
        "time": {"step": step, "frames": frames, "integrator": "backward-euler"},
    }  # fmt: skip
    return pc.Scene(**{**settings, "material": material, **sections})


def gravity(acceleration: float) -> dict[str, Any]:
    """A load across the beam, with a share along it; m/s2."""
    return {"kind": "gravity", "acceleration": [0.3 * acceleration, 0.0, -acceleration]}


def end_force(share: float, young: float) -> dict[str, Any]:
    """Traction across the end face, ``share`` of Young's modulus."""
    traction = [0.0, 0.3 * share * young, -share * young]
    return {"kind": "traction", "traction": traction, "region": {"plane": "x", "at": "max"}}


# --- starts ----------------------------------------------------------------------------------


def squashed(factors: Sequence[float]) -> Callable[[pc.Problem], Array]:
    """Displacements scaled along each axis about the middle of the held face."""

    def start(problem: pc.Problem) -> Array:
        low, high = problem.positions.min(axis=0), problem.positions.max(axis=0)
        centre = np.array([low[0], *(0.5 * (low + high)[1:])])
        return centre + (problem.positions - centre) * np.array(factors)

    return start


def scattered(amplitude: float, seed: int = 5) -> Callable[[pc.Problem], Array]:
    """Each node displaced by up to ``amplitude`` cells along each axis."""

    def start(problem: pc.Problem) -> Array:
        noise = np.random.default_rng(seed).uniform(-1.0, 1.0, problem.positions.shape)
        return problem.positions + amplitude * problem.cell_size * noise

    return start


def inside_out(problem: pc.Problem) -> Array:
    """All nodes mirrored in the middle of the body."""
    x = problem.positions
    return x.min(axis=0) + x.max(axis=0) - x


def bending(speed: float) -> Callable[[pc.Problem], Array]:
    """Velocity across the beam that grows with the square of the distance from the clamp."""

    def velocity(problem: pc.Problem) -> Array:
        along = (problem.positions[:, :1] - problem.positions[:, 0].min()) / np.ptp(
            problem.positions[:, 0]
        )
        return speed * along**2 * np.array([0.0, 0.4, -1.0])

    return velocity


def reversing(problem: pc.Problem, step: int) -> Array:
    """A body force of 100 m/s2 that turns round at every step."""
    direction = np.array([20.0, 0.0, -100.0]) * (-1.0) ** step
    return problem.mass[:, None] * direction


# --- bodies that no shape gives ----------------------------------------------------------------


def block_file(cells: tuple[int, int, int], place: Callable[[Array], Array]) -> dict[str, Any]:
    """A mesh file of a block whose nodes, counted in cells, are put elsewhere; as a body."""
    mesh = voxel_mesh(np.ones(cells, dtype=bool), (0, 0, 0), 1.0)
    path = Path(tempfile.mkdtemp()) / "block.vtu"
    write_vtu(path, place(mesh.positions), mesh.cells)
    return {"shape": "file", "path": path}


def warped(points: Array) -> Array:
    """Inner nodes moved by up to 0.3 cells, and the sections turned by 10 degrees a cell."""
    noise = np.random.default_rng(2).uniform(-0.3, 0.3, points.shape)
    moved = points + noise * (points[:, :1] > 0)
    angle = np.radians(10.0) * moved[:, 0]
    y, z = (moved[:, 1:] - 1.0).T
    turned = [y * np.cos(angle) - z * np.sin(angle), y * np.sin(angle) + z * np.cos(angle)]
    return CELL * np.column_stack([moved[:, 0], *turned])


TWO_BODIES = [[[1, 1], [1, 1]]] * 4 + [[[0, 0], [0, 0]]] * 2 + [[[1, 1], [1, 1]]] * 3


# --- the battery -------------------------------------------------------------------------------

TURN = {"times": [0.0, 0.24, 0.48], "rotation": [0.0, 720.0, 0.0], "axis": "x"}
PULL = {"times": [0.0, 0.2, 0.4], "displacement": [[0, 0, 0], [9 * 6 * CELL, 0, 0], [0, 0, 0]]}
END = {"plane": "x", "at": "max"}
SOFT_END = {"region": {"box": [[0.15, -1, -1], [1, 1, 1]]}, "young": 1e3}
CALM_BEAM = beam(frames=80, damping=CALM)


def moving(motion: dict[str, Any], cells: tuple[int, int, int], frames: int) -> pc.Scene:
    """A calm beam whose other end is moved and brought back."""
    centre = {"centre": [0.0, CELL, CELL]} if "rotation" in motion else {}
    clamps = [HELD, {"region": END, "motion": {**motion, **centre}}]
    return beam(cells, frames, clamps=clamps, damping=CALM)


# fmt: off
SCENARIOS = (
    Scenario("plane", "squashed to a plane", CALM_BEAM, "rest", squashed((1, 1, 0)), quick=True),
    Scenario("line", "squashed to a line", CALM_BEAM, "rest", squashed((1, 0, 0))),
    Scenario("point", "squashed to a point", CALM_BEAM, "rest", squashed((0, 0, 0))),
    Scenario("random 1", "nodes displaced by up to 1 cell", CALM_BEAM, "rest", scattered(1.0)),
    Scenario("random 5", "by up to 5 cells", CALM_BEAM, "rest", scattered(5.0)),
    Scenario("random 50", "by up to 50 cells", CALM_BEAM, "rest", scattered(50.0)),
    Scenario("inside-out", "mirrored in its middle", CALM_BEAM, "rest", inside_out),
    Scenario("twist 720", "one end turned twice and back", moving(TURN, (24, 2, 2), 128), "rest"),
    Scenario("stretch 10", "drawn to ten times its length and back", moving(PULL, (6, 2, 2), 80),
             "rest"),
    *(Scenario(f"E {young:.0e}", "force at the end in proportion to Young's modulus (Pa)",
               beam(frames=frames, material={"young": young}, loads=[end_force(share, young)]),
               "motion")
      for young, share, frames in ((1e2, 1.0, 60), (1e5, 2e-2, 15), (1e8, 2e-2, 15),
                                   (1e11, 2e-2, 15))),
    Scenario("contrast 1e4", "half of the body ten thousand times stiffer",
             beam(frames=15, material={"young": 1e7}, materials=[SOFT_END], loads=[gravity(9.81)]),
             "motion", quick=True),
    *(Scenario(f"nu {nu}", "nearly incompressible, bending under its weight",
               beam(frames=15, material={"young": 2e5, "poisson": nu}, loads=[gravity(9.81)]),
               "motion")
      for nu in (0.49, 0.499, 0.4999)),
    *(Scenario(f"density {density:g}", "force at the end, mass from nearly none to much (kg/m3)",
               beam(frames=15, material={"density": density}, loads=[end_force(2e-2, 1e6)]),
               "motion")
      for density in (1e-1, 1e1, 1e3, 1e5)),
    *(Scenario(f"h {step:g}", f"a bending motion at {speed:g} m/s, by steps of this length (s)",
               beam(frames=frames, step=step, loads=[gravity(9.81)]), "motion",
               velocity=bending(speed), quick=step == 1.0)
      for step, speed, frames in ((1e-5, 50.0, 500), (1e-3, 2.0, 10), (1e-1, 2.0, 10),
                                  (1.0, 2.0, 10))),
    Scenario("slivers", "a strip of cells a hundred times wider than thick, falling under its "
             "weight",
             beam(body=block_file((6, 2, 2), lambda p: p * [CELL, CELL, CELL / 100]), frames=15,
                  loads=[gravity(9.81)]),
             "motion", quick=True),
    Scenario("warped", "cells with random corners and turned faces",
             beam(body=block_file((6, 2, 2), warped), frames=15, loads=[gravity(9.81)]), "motion"),
    Scenario("1 cell", "a body of one cell",
             beam((1, 1, 1), 15, material={"young": 1e4}, loads=[gravity(9.81)]), "motion",
             quick=True),
    Scenario("2 cells", "a body of two cells",
             beam((2, 1, 1), 15, material={"young": 1e4}, loads=[gravity(9.81)]), "motion"),
    Scenario("reversal", "a load of ten times gravity that turns round at every step",
             beam(frames=15, material={"young": 2e5}), "motion", forces=reversing, quick=True),
    Scenario("no clamp", "a free body, squashed to half its height",
             beam(frames=80, clamps=[], damping=CALM), "shape", squashed((1, 1, 0.5))),
    Scenario("two bodies", "two bodies in one mesh, one held and one free, nodes displaced by half "
             "a cell",
             beam(body={"shape": "voxels", "occupancy": TWO_BODIES, "cell_size": CELL}, frames=80,
                  damping=CALM),
             "shape", scattered(0.5)),
    Scenario("200 000 cells", "a large compact body, one step under its weight",
             beam((50, 64, 64), 1, step=0.05, loads=[gravity(9.81)]), "motion",
             solvers=("PD", "PD best", "PD enhanced", "PD learned", "Newton", "hybrid",
                      "hybrid torsion")),
)
