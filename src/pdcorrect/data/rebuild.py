"""The problems that a file's simulations were computed with, from their stored scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pdcorrect.data.scene_mesh import discretise_stored
from pdcorrect.data.schema import BEST, PLAIN, REFERENCE, TOTAL_MASS, Shard
from pdcorrect.errors import InputError
from pdcorrect.fem.coarse_models import BASES
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Scene, best_coarse

FORCE_ERROR = 1e-5
"""Largest difference of loads from the stored ones, over their largest; those are float32."""


def rebuilt_problems(shard: Shard, path: Path, run: str = PLAIN) -> list[Problem]:
    """The problem of each simulation of a file, discretised as one of its runs was.

    Bodies from mesh files are discretised on the file's own mesh.

    Problems of one file share mesh, operators and masses.

    Parameters
    ----------
    shard : Shard
    path : Path
        Of its file, for messages.
    run : str
        One of `pdcorrect.fem.coarse_models.BASES`, or "reference".

    Raises
    ------
    InputError
        If a simulation has no scene, as imported ones, lacks the run, or what its scene
        leads to is not what the file holds.
    """
    if run not in (*BASES, REFERENCE):
        raise InputError(f"run {run!r}: expected one of {', '.join((*BASES, REFERENCE))}.")
    scenes = [_scene(shard, path, k) for k in range(len(shard.simulations))]
    stored = shard.simulations[0].runs.get(run)
    if stored is None:
        raise InputError(f"{path}: no run {run!r}: expected one of {_names(shard)}.")
    plain = discretise_stored(scenes[0], shard.points, shard.cells)
    _check_mesh(plain, shard, path)
    for k, scene in enumerate(scenes):
        _check_loads(plain.with_loads(scene.loads), shard, path, k)
    problem = plain
    if run == TOTAL_MASS:
        problem = plain.with_total_mass(float(stored.attributes["total_mass"]))
    elif run != PLAIN:
        exact = run == BEST or shard.attributes["setting"] == "exact"
        refine = int(stored.attributes.get("refine", 1))
        scene = best_coarse(scenes[0]) if exact else scenes[0]
        problem = discretise_stored(scene, shard.points, shard.cells, refine)
    return [_under(problem, scene) for scene in scenes]


def _under(problem: Problem, scene: Scene) -> Problem:
    """The problem under another scene's loads, and by its name."""
    loaded = problem.with_loads(scene.loads)
    return replace(loaded, scene=loaded.scene.with_changes(name=scene.name))


def _names(shard: Shard) -> str:
    return ", ".join(sorted(shard.simulations[0].runs))


def _scene(shard: Shard, path: Path, k: int) -> Scene:
    text = shard.simulations[k].scene_toml
    if not text:
        raise InputError(
            f"{path}: simulation {k} has no scene, as if imported: expected one that "
            "`pdcorrect dataset generate` made, for it has to be stepped again."
        )
    return Scene.from_toml(text, f"{path}, scene of simulation {k}")


def _check_mesh(problem: Problem, shard: Shard, path: Path) -> None:
    """Refuse a scene that does not lead to the file's coarse mesh and material."""
    step = float(shard.attributes["time_step"])
    materials = problem.materials
    pairs = {
        "points": (problem.positions, shard.points),
        "cells": (problem.cells, shard.cells),
        "free": (problem.free, shard.free),
        "mass": (problem.mass, shard.mass),
        "young": (materials.young, shard.young),
        "poisson": (materials.poisson, shard.poisson),
        "density": (materials.density, shard.density),
        "time_step": (np.array(problem.time_step), np.array(step)),
    }
    for name, (found, stored) in pairs.items():
        if found.shape != stored.shape or not np.allclose(found, stored, rtol=1e-9, atol=1e-12):
            raise InputError(
                f"{path}: {name} rebuilt from the stored scene differs from the file's: expected "
                "the same. Was the file made by another version of the code?"
            )


def _check_loads(problem: Problem, shard: Shard, path: Path, k: int) -> None:
    """The same for the loads in the first and the last step."""
    forces, h = shard.simulations[k].forces, problem.time_step
    size = float(np.abs(forces).max())
    for step in (0, len(forces) - 1):
        found = problem.external_forces(step * h, (step + 1) * h)
        if np.abs(found - forces[step]).max() > FORCE_ERROR * size:
            raise InputError(
                f"{path}: simulation {k}: loads of step {step + 1} rebuilt from the stored scene "
                "differ from the file's: expected the same."
            )
