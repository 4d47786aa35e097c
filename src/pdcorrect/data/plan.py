"""What a data set consists of: its meshes and, one by one, its simulations.

Everything is drawn from streams of random numbers that are named by the configuration's
seed, the split, the mesh, the simulation and the attempt, so that any part can be
generated alone, in any order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect._config import as_toml
from pdcorrect.data.configuration import (
    EVALUATION,
    TRAINING,
    VALIDATION,
    DatasetConfig,
    ExtraSplit,
    FamilyName,
    MotionRange,
    Split,
)
from pdcorrect.data.families import PUBLISHED, Box, Design, draw, extreme
from pdcorrect.data.schema import SUFFIX
from pdcorrect.errors import InputError
from pdcorrect.scene import Scene

_DRAWS = 10_000  # bodies that are drawn for a mesh before giving up on one that is not there yet


@dataclass(frozen=True)
class MeshPlan:
    """One mesh with its material: the unit of generation, and one file of the data set."""

    split: str
    number: int  # of the mesh in its split
    design: Design  # in cells
    # Pa, dimensionless, kg/m3
    young: float
    poisson: float
    density: float
    simulations: int
    step: float  # s
    frames: int
    refine: int  # of the reference
    strength_factor: float
    stream: tuple[int, ...]  # name of the mesh's stream of random numbers

    @property
    def name(self) -> str:
        """Of its file, without suffix, relative to the data set's folder."""
        return f"{self.split}/mesh-{self.number:04d}"

    def path(self, folder: Path) -> Path:
        """Of its file."""
        return folder / f"{self.name}{SUFFIX}"


def make_plan(config: DatasetConfig) -> list[MeshPlan]:
    """All meshes of a data set, no body twice.

    The first mesh of the training split has the fewest and the second one the most nodes of
    the family's range, where there are two or more.
    """
    plans: list[MeshPlan] = []
    known: set[str] = set()
    splits: list[tuple[str, Split]] = [(TRAINING, config.training), (EVALUATION, config.evaluation)]
    splits += [(extra.name, extra) for extra in config.extra]
    for number, (name, split) in enumerate(splits):
        found = list(_split(config, name, split, number, known))
        if name == TRAINING:
            found = _with_validation(found, config.validation_share)
        plans += found
    return plans


def _split(
    config: DatasetConfig, name: str, split: Split, number: int, known: set[str]
) -> Iterator[MeshPlan]:
    extra = split if isinstance(split, ExtraSplit) else ExtraSplit(name=name, **dict(split))
    family = extra.family or config.family
    nodes = config.coarse_nodes or PUBLISHED[family].coarse
    for i in range(split.meshes):
        stream = (config.seed, number, i)
        rng = np.random.default_rng(stream)
        ends = name == TRAINING and split.meshes > 1
        design = _new_design(family, nodes, i if ends else 2, rng, known)
        low, high = extra.young or config.material.young
        young = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        poisson = float(rng.uniform(*(extra.poisson or config.material.poisson)))
        density = float(rng.uniform(*config.material.density))
        first, last = (split.simulations * k // split.meshes for k in (i, i + 1))
        yield MeshPlan(
            name, i, design, young, poisson, density,
            simulations=last - first,
            step=config.step * extra.step_factor,
            frames=config.frames * extra.frames_factor,
            refine=extra.refine or config.reference.refine,
            strength_factor=extra.strength_factor,
            stream=stream,
        )  # fmt: skip


def _new_design(
    family: FamilyName, nodes: tuple[int, int], i: int, rng: np.random.Generator, known: set[str]
) -> Design:
    for _ in range(_DRAWS):
        design = extreme(family, nodes, i == 1, rng) if i < 2 else draw(family, nodes, rng)
        if design.key() not in known:
            known.add(design.key())
            return design
    raise InputError(
        f"coarse_nodes = {as_toml(nodes)}: {_DRAWS} bodies of family {family!r} were drawn "
        f"that {len(known)} meshes have already. Ask for fewer meshes or a wider range."
    )


def _with_validation(meshes: list[MeshPlan], share: float) -> list[MeshPlan]:
    """The same with the last ``share`` of the training meshes as validation split."""
    count = round(share * len(meshes))
    kept = len(meshes) - count
    moved = [replace(mesh, split=VALIDATION, number=i) for i, mesh in enumerate(meshes[kept:])]
    return meshes[:kept] + moved


def draw_scene(config: DatasetConfig, mesh: MeshPlan, simulation: int, attempt: int = 0) -> Scene:
    """A simulation's scene, for the plain coarse model, after ``attempt`` rejected draws."""
    rng = np.random.default_rng((*mesh.stream, 1 + simulation, attempt))
    published = config.setting == "as-published"
    cell = config.cell_size
    return Scene(
        name=f"{config.name}/{mesh.name}/{simulation}",
        body={**mesh.design.shape, "cell_size": cell},
        material={
            "young": mesh.young, "poisson": mesh.poisson, "density": mesh.density,
            "volume_weight": "published" if published else "lame",
        },
        time={
            "step": mesh.step, "frames": mesh.frames,
            "integrator": (
                "generalised-alpha" if config.setting == "converged" else "backward-euler"
            ),
        },
        clamps=[{"region": _region(box, cell)} for box in mesh.design.clamps],
        loads=[_LOADS[m.kind](config, m, mesh, rng) for m in _drawn_motions(config, rng)],
        solver={
            "mass": "per-node" if published else "lumped", "element": "hex8",
            "tolerance": config.tolerance,
        },
    )  # fmt: skip


def _region(box: Box, cell: float) -> dict[str, Any]:
    return {"box": [[cell * c for c in corner] for corner in box]}


def _drawn_motions(config: DatasetConfig, rng: np.random.Generator) -> Sequence[MotionRange]:
    """The only motion of a data set, or one or two of those that are mixed."""
    if config.mixed is None:
        return config.motions
    chosen = rng.choice(len(config.mixed), int(rng.integers(1, 3)), replace=False)
    return [config.mixed[k] for k in sorted(chosen)]


def _strength(motion: MotionRange, mesh: MeshPlan, rng: np.random.Generator) -> float:
    return mesh.strength_factor * float(rng.uniform(*motion.strength))


def _direction(rng: np.random.Generator) -> np.ndarray:
    found: np.ndarray = rng.normal(size=3)
    return found / np.linalg.norm(found)


def _torsion(
    config: DatasetConfig, motion: MotionRange, mesh: MeshPlan, rng: np.random.Generator
) -> dict[str, Any]:
    """Eq. 6-1 to 6-3 about the central beam's axis.

    Published: sigma is a force on each coarse node.  Exact: a force density, that force over
    a cell's volume.  The torque about the axis is then about a third of the published one.
    """
    cell = config.cell_size
    density = mesh.density * _strength(motion, mesh, rng)
    published = config.setting == "as-published"
    attraction, stretch = rng.uniform(*motion.attraction), rng.uniform(*motion.stretch)
    turn = 1.0 if rng.random() < 0.5 else -1.0
    return {
        "kind": "torsion",
        "strength": turn * density * (cell**3 if published else 1.0),
        "attraction": turn * attraction,
        "stretch": turn * stretch * cell,
        "centre": [0.0, cell, cell],
        "distribution": "nodal" if published else "consistent",
    }


def _impulse(
    config: DatasetConfig, motion: MotionRange, mesh: MeshPlan, rng: np.random.Generator
) -> dict[str, Any]:
    """A force on the loaded part in a random direction, for a short time."""
    direction = _direction(rng)
    load = _part_load(config, mesh, _strength(motion, mesh, rng), direction, motion.duration)
    return {**load, "window": [0.0, motion.duration]}


def _stretch(
    config: DatasetConfig, motion: MotionRange, mesh: MeshPlan, rng: np.random.Generator
) -> dict[str, Any]:
    """A force on the loaded part, mostly along its axis, that rises and stays."""
    axis = np.array(mesh.design.axis)
    across = rng.normal(size=3)
    across -= axis * (across @ axis)
    across *= rng.uniform(*motion.transverse) / np.linalg.norm(across)
    load = _part_load(config, mesh, _strength(motion, mesh, rng), axis + across)
    return {**load, "ramp": motion.duration}


def _body_force(
    config: DatasetConfig, motion: MotionRange, mesh: MeshPlan, rng: np.random.Generator
) -> dict[str, Any]:
    """An acceleration of the whole body in a random direction that rises and stays."""
    direction = _direction(rng)
    acceleration = _strength(motion, mesh, rng) * direction
    return {"kind": "gravity", "acceleration": acceleration.tolist(), "ramp": motion.duration}


_LOADS = {
    "torsion": _torsion, "impulse": _impulse, "stretch": _stretch, "body-force": _body_force,
}  # fmt: skip


def _part_load(
    config: DatasetConfig,
    mesh: MeshPlan,
    strength: float,
    direction: np.ndarray,
    duration: float = 1.0,
) -> dict[str, Any]:
    """The loaded part's mass times strength over duration, over its nodes or its volume."""
    low, high = np.array(mesh.design.loaded)
    mass = float(mesh.density * np.prod(config.cell_size * (high - low)))
    return {
        "kind": "force",
        "force": (mass * strength / duration * direction).tolist(),
        "region": _region(mesh.design.loaded, config.cell_size),
        "distribution": "nodal" if config.setting == "as-published" else "consistent",
    }
