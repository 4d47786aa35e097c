"""Tune the learned element to one body: the network learns that body's own linear answers."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import load

from pdcorrect._environment import environment
from pdcorrect._files import check_new, make_folder, write_text
from pdcorrect.elements.answers import answers
from pdcorrect.elements.bodies import Grid, VoxelBody, box, connected, holds, nodes_of
from pdcorrect.elements.linear import Batch, Errors, collate, errors, loss, means, sample
from pdcorrect.elements.network import Descent, ElementNetwork
from pdcorrect.errors import ConvergenceError, InputError, PdcorrectWarning
from pdcorrect.fem.element_network import MODEL, read_network, write_network
from pdcorrect.fem.learned import LARGEST_POISSON, effective_moduli
from pdcorrect.fem.neighbourhood import on_grid
from pdcorrect.fem.problem import Problem

RATE = 2e-3
_CELLS = 110
"""Of a part of the body; a smaller body is learned whole."""
_PARTS = 6
_DRAWS = 2
"""Sets of random loads on a body that is learned whole."""
_SYMMETRIES = 6

Report = Callable[[str], None]


class Tuned(NamedTuple):
    """Errors of the body's linear answers, as `means` has them: of its coarse model without
    learning, with the weights that were there, and tuned.
    """

    without: dict[str, float]
    before: dict[str, float]
    after: dict[str, float]


def tune(
    problem: Problem,
    path: Path,
    *,
    iterations: int = 200,
    seed: int = 0,
    report: Report = print,
    overwrite: bool = False,
) -> Tuned:
    """Write weights that are best for one body, and a card beside them.

    They start from those of the scene (``solver.weights``), or from the released ones.  A body of
    more than 110 cells is learned by parts of it.

    Parameters
    ----------
    problem : Problem
        Of the coarse mesh, whatever its element.
    path : Path
        Of the weights; the card has the same name and the ending json.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConvergenceError
        If the weights do not stay finite.
    InputError
        If cells are off the grid or the body is in several pieces, nodes are held in some
        components, or some nodes but no face of a cell, Poisson's ratios are several or too large,
        or the file's name does not end with safetensors.
    OutputError
        If the file exists, or cannot be written.
    """
    if path.suffix != ".safetensors":
        raise InputError(f"{path}: expected a name that ends with .safetensors.")
    check_new(path, overwrite=overwrite)
    body = own_body(problem)
    make_folder(path.parent)
    rng = np.random.default_rng(seed)
    whole = int(body.solid.sum()) <= _CELLS
    bodies = [body] * _DRAWS if whole else [part(body, rng) for _ in range(_PARTS)]
    report(f"linear answers of {'the body' if whole else f'{_PARTS} parts of the body'}")
    samples = [sample(answers(b, rng)) for b in bodies]
    batches = [collate(samples)] if whole else [collate([s]) for s in samples]
    base = [errors(batch, None, None) for batch in batches]
    torch.manual_seed(seed)
    given = problem.scene.solver.weights
    network = _network(MODEL if given is None else given)
    started = _found(network, batches)
    descent = Descent(network, RATE, iterations)
    for i in range(iterations):
        which = i % len(batches)
        batch = batches[which]
        symmetries = torch.as_tensor(rng.choice(48, _SYMMETRIES, replace=False))
        found = network(batch.numbers, batch.neighbours, symmetries)
        network.zero_grad()
        loss(errors(batch, *found), started[which]).mean().backward()  # type: ignore[no-untyped-call]
        descent.step(i)
    tuned = Tuned(means(base), means(started), means(_found(network, batches)))
    if not np.isfinite(tuned.after["displacements"]):
        raise ConvergenceError("the weights have become infinite or NaN.")
    if all(tuned.after[name] >= tuned.before[name] for name in ("displacements", "frequencies")):
        warnings.warn(
            "neither displacements nor frequencies are nearer: compare both weights with the "
            "converged motion",
            PdcorrectWarning,
            stacklevel=2,
        )
    write_network(path, {k: v.numpy() for k, v in network.state_dict().items()})
    card = {
        "format": 1,
        "scene": problem.scene.name,
        "from": "released" if given is None else str(given),
        "iterations": iterations,
        "seed": seed,
        **tuned._asdict(),
        "environment": environment(),
    }
    write_text(path.with_suffix(".json"), json.dumps(card, indent=1) + "\n")
    return tuned


def own_body(problem: Problem) -> VoxelBody:
    """A problem's body in cells of size 1, its first cell's small-strain modulus and density 1.

    Raises
    ------
    InputError
        See `tune`.
    """
    grid = on_grid(problem.positions, problem.cells)
    materials = problem.materials
    stiff, poisson = effective_moduli(materials.mu, materials.volume_weight)
    if not grid.regular.all():
        raise InputError(
            f"{int((~grid.regular).sum())} of {len(grid.regular)} cells are off the grid: expected "
            "cubic cells on one grid."
        )
    if not np.ptp(poisson) < 1e-6:
        found = f"{poisson.min():.3g} to {poisson.max():.3g}"
        raise InputError(f"poisson = {found}: expected one for the body.")
    if poisson[0] > LARGEST_POISSON:
        raise InputError(f"poisson = {poisson[0]:.4g}: expected at most {LARGEST_POISSON:.3g}.")
    places = grid.place - grid.place.min(axis=0)
    shape = places.max(axis=0) + 1
    solid, young, density = np.zeros(shape, dtype=bool), np.ones(shape), np.ones(shape)
    at = tuple(places.T)
    solid[at] = True
    young[at] = stiff / stiff[0]
    density[at] = materials.density / materials.density[0]
    held = np.zeros(shape + 1, dtype=bool)
    if not (connected(solid) == solid).all():
        raise InputError("the body is in several pieces: expected one.")
    clamped = ~problem.free.any(axis=1)
    if (partly := int((~clamped & ~problem.free.all(axis=1)).sum())) > 0:
        raise InputError(f"{partly} nodes are held in some components: expected all or none.")
    corners = (problem.positions - problem.positions.min(axis=0)) / problem.cell_size
    held[tuple(np.round(corners[clamped]).astype(int).T)] = True
    if held.any() and not holds(held, nodes_of(solid)):
        raise InputError(
            "nodes are held but no face of a cell, or nearly all are: expected some, or none."
        )
    return VoxelBody("own", solid, held, young, density, float(poisson[0]))


def part(body: VoxelBody, rng: np.random.Generator) -> VoxelBody:
    """A box of the body with at most 110 cells, held where the body is, or at a side.

    Parts of a body that nothing holds are free.
    """
    places = np.argwhere(body.solid)
    start = places[rng.integers(len(places))]
    low, high = start.copy(), start + 1
    while True:
        grown = []
        for side, axis in np.ndindex(2, 3):
            a, b = low.copy(), high.copy()
            a[axis], b[axis] = a[axis] - (1 - side), b[axis] + side
            inside = a[axis] >= 0 and b[axis] <= body.solid.shape[axis]
            if inside and body.solid[box(a, b)].sum() <= _CELLS:
                grown.append((a, b))
        if not grown:
            break
        low, high = grown[rng.integers(len(grown))]
    inside = box(low, high)
    solid = connected(body.solid[inside], tuple(start - low))
    nodes = nodes_of(solid)
    held: Grid = body.held[box(low, high + 1)] & nodes
    while body.held.any() and not holds(held, nodes):
        region = np.zeros_like(nodes)
        np.moveaxis(region, int(rng.integers(3)), 0)[-int(rng.integers(2))] = True
        held = region & nodes
    return VoxelBody("part", solid, held, body.young[inside], body.density[inside], body.poisson)


def _network(path: Path) -> ElementNetwork:
    read_network(path)  # refuses what is no network
    arrays = load(Path(path).read_bytes())
    network = ElementNetwork(
        len(arrays["first.bias"]),
        sum(name.startswith("norms.") for name in arrays),
        len(arrays["hidden.bias"]),
    )
    network.load_state_dict({name: value.float() for name, value in arrays.items()})
    return network


def _found(network: ElementNetwork, batches: list[Batch]) -> list[Errors]:
    with torch.no_grad():
        return [errors(b, *network(b.numbers, b.neighbours)) for b in batches]
