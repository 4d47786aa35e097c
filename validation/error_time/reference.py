"""The converged motions' own errors, and errors from runs on 8x8x8 cells."""

from __future__ import annotations

import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from methods import METHODS

import pdcorrect as pc
from pdcorrect._environment import cache_folder
from pdcorrect._files import make_folder, replacing
from pdcorrect.evaluation import converged
from pdcorrect.fem.mesh import coincident_nodes
from pdcorrect.solvers.rollout import march
from pdcorrect.state import State

OWN = "Errors of the converged motions, %"
HEADS = ("scene", "time", "order", "mesh", "order of the mesh", "cells along each axis")
FINER = "Errors from the finest mesh, % of the RMS displacement"
COMPARED = ("best coarse, 1", "hex27, 1", "hex27, 2", "learned, 1", "learned, 2")
SCENES = ("cantilever", "plate", "angle", "portal", "hard and soft", "stretch")
"""Those whose finest mesh takes up to seven minutes; others take up to twenty."""
_EVERY = 30.0
"""Seconds from one checkpoint to the next."""
_MEMORY = "memory."


def of_scene(label: str, scene: pc.Scene) -> common.Outcome:
    """A scene's row; what is computed is kept on disk, and goes on where it was ended."""
    motion = pc.converged(scene)

    def run_of(refine: int, divisor: int) -> pc.Trajectory:
        if (refine, divisor) == (converged.REFINE, converged.DIVISOR):
            return motion
        return replace(motion, positions=positions(scene, refine, divisor))

    found, meshes = converged.own_errors(scene, len(motion.cells), run_of)
    spent = [found[name] for name in (converged.TIME_ERROR, converged.MESH_ERROR)]
    cells = [x for share, order in spent for x in (100.0 * share, order)]
    finest = run_of(meshes[-1], converged.DIVISOR)
    runs = [motion, *(pc.rollout(METHODS[name].stepper(scene)) for name in COMPARED)]
    beside = [100.0 * pc.metrics.relative_error(run, finest) for run in runs]
    tables = (
        common.Table(OWN, HEADS, ((label, *cells, ", ".join(map(str, meshes))),)),
        common.Table(FINER, ("scene", "converged motion", *COMPARED), ((label, *beside),)),
    )
    return common.Outcome({}, tables)


def positions(scene: pc.Scene, refine: int, divisor: int) -> common.Array:
    """Of the coarse nodes in all frames, (T+1, N, 3), m, at so many cells and substeps."""
    name = f"{converged.cache_key(scene)}-{refine}-{divisor}.npz"
    path = make_folder(cache_folder("levels")) / name
    frames, known = _load(path)
    if len(frames) > scene.time.frames:
        return np.array(frames)
    stepper, coarse = converged.level(scene, refine, divisor)
    fine = stepper.problem
    nodes = coincident_nodes(fine.positions, coarse.positions, 1e-6 * fine.cell_size)
    state = known or fine.initial_state()
    frames = frames or [state.positions[nodes]]
    told = time.monotonic()
    for result, _ in march(stepper, scene.time.frames + 1 - len(frames), state=state):
        frames.append(result.state.positions[nodes])
        if time.monotonic() > told + _EVERY:
            _save(path, frames, result.state)
            told = time.monotonic()
    _save(path, frames)
    return np.array(frames)


def _save(path: Path, frames: list[common.Array], state: State | None = None) -> None:
    """Frames and, of a run that is not finished, the state to go on from."""
    content: dict[str, Any] = {"frames": np.array(frames)}
    if state is not None:
        content |= {key: getattr(state, key) for key in ("positions", "velocities", "time")}
        content |= {_MEMORY + key: array for key, array in state.memory.items()}
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **content)


def _load(path: Path) -> tuple[list[common.Array], State | None]:
    """What `_save` wrote; nothing if there is no such file, or it is damaged."""
    try:
        with np.load(path) as file:
            content = dict(file)
    except (OSError, ValueError, zipfile.BadZipFile):
        return [], None
    frames = list(content.pop("frames"))
    if not content:
        return frames, None
    memory = {k.removeprefix(_MEMORY): x for k, x in content.items() if k.startswith(_MEMORY)}
    state = State(content["positions"], content["velocities"], float(content["time"]), memory)
    return frames, state
