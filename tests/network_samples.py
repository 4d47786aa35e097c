"""Deformed bodies as graphs, and correctors with random weights."""

from dataclasses import replace

import numpy as np
import torch

from conftest import box_mesh
from pdcorrect.corrector import features
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector, preset
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, FeatureView, Snapshot
from pdcorrect.corrector.normaliser import RunningMoments
from pdcorrect.fem.graph import mesh_edges

SIZE, STEP = 0.1, 0.02

NODAL = ("rest", "free", "mass", "young", "poisson", "density")


def tensor(array):
    return torch.tensor(np.asarray(array))


def body(cells=(3, 2, 1), seed=0, distortion=0.15, clamped=True, size=SIZE, mesh=None):
    """A distorted box, or another mesh, with uneven material; one end held."""
    mesh = box_mesh(cells, np.multiply(cells, size), distortion, seed) if mesh is None else mesh
    rng = np.random.default_rng((seed, 1))
    n = len(mesh.positions)
    free = np.ones((n, 3), dtype=bool)
    if clamped:
        free[mesh.positions[:, 0] < 1e-9] = False
    return BodyGraph(
        rest=tensor(mesh.positions),
        free=tensor(free),
        mass=tensor(rng.uniform(0.1, 0.3, n)),
        young=tensor(rng.uniform(1e5, 3e5, n)),
        poisson=tensor(rng.uniform(0.3, 0.45, n)),
        density=tensor(rng.uniform(900, 1100, n)),
        edge_index=tensor(mesh_edges(mesh.cells)),
        cells=tensor(mesh.cells),
        graph=torch.zeros(n, dtype=torch.int64),
        cell_size=torch.tensor([size], dtype=torch.float64),
        time_step=torch.tensor([STEP], dtype=torch.float64),
    )


def moving(bodies, seed=0, strength=0.15):
    """A step of bent and turned bodies; ``strength`` of a cell."""
    rng = np.random.default_rng((seed, 2))
    x, size = bodies.rest.numpy(), bodies.by_node(bodies.cell_size).numpy()[:, None]

    def field(amount):
        return tensor(amount * size * rng.normal(size=x.shape)) * bodies.free

    bent = bodies.rest + strength * tensor(size * np.sin(2 * x[:, [1, 2, 0]] / size)) * bodies.free
    positions = bent + field(0.3 * strength)
    return Snapshot(
        positions=positions,
        velocities=field(strength) / STEP,
        proposed=positions + field(0.3 * strength),
        forces=field(1.0),
        correction=field(0.01),
    )


def joined(*parts):
    """Graphs of bodies side by side in one."""
    first = np.cumsum([0, *(len(p.rest) for p in parts)])[:-1]
    offset = list(zip(parts, first, strict=True))
    bodies = np.cumsum([0, *(p.bodies for p in parts)])[:-1]
    return BodyGraph(
        **{name: torch.cat([getattr(p, name) for p in parts]) for name in NODAL},
        edge_index=torch.cat([p.edge_index + int(o) for p, o in offset], dim=1),
        cells=torch.cat([p.cells + int(o) for p, o in offset]),
        graph=torch.cat([p.graph + int(o) for p, o in zip(parts, bodies, strict=True)]),
        cell_size=torch.cat([p.cell_size for p in parts]),
        time_step=torch.cat([p.time_step for p in parts]),
    )


def together(*snapshots):
    """Snapshots of such graphs."""
    names = ("positions", "velocities", "proposed", "forces", "correction")
    return Snapshot(**{n: torch.cat([getattr(s, n) for s in snapshots]) for n in names})


def turned_and_moved(bodies, snapshot, R, shift):
    """The whole scene elsewhere."""
    R, shift = tensor(R), tensor(np.asarray(shift, dtype=float))
    return replace(bodies, rest=bodies.rest @ R.T + shift), Snapshot(
        snapshot.positions @ R.T + shift,
        snapshot.velocities @ R.T,
        snapshot.proposed @ R.T + shift,
        snapshot.forces @ R.T,
        snapshot.correction @ R.T,
    )


def renumbered(bodies, snapshot, seed=5):
    """The same with nodes and cells in another order; third: the old number of each node."""
    rng = np.random.default_rng(seed)
    old = rng.permutation(len(bodies.rest))
    new = np.argsort(old)
    cells = new[bodies.cells.numpy()][rng.permutation(len(bodies.cells))]
    nodal = {name: getattr(bodies, name)[old] for name in NODAL}
    changed = replace(
        bodies, **nodal, cells=tensor(cells), edge_index=tensor(mesh_edges(cells)),
        graph=bodies.graph[old],
    )  # fmt: skip
    names = ("positions", "velocities", "proposed", "forces", "correction")
    return changed, Snapshot(**{n: getattr(snapshot, n)[old] for n in names}), old


def fit(corrector, view):
    """Fit the normaliser to one view, and to targets of a fifth of a cell's deformation."""
    config, found = corrector.config, {}
    for table, names in (
        (NODE_FEATURES, config.node_features), (EDGE_FEATURES, config.edge_features),
    ):  # fmt: skip
        for name, values in features.values(table, names, view).items():
            found[name] = RunningMoments()
            found[name].add(values)
    target = RunningMoments()
    target.add(torch.tensor([[0.1], [-0.3]]))
    corrector.normaliser.fit(found, target)
    rest = {"shape": view.bodies.shapes, "time_step": view.bodies.time_steps[:, None]}
    averages = view.bodies.body_means(corrector.inputs(view)[0])
    for name, values in {"average": averages, **rest}.items():
        found[name] = RunningMoments()
        found[name].add(values)
    corrector.envelope.fit(found)
    return corrector


SMALL = {"layers": 2, "width": 16}


def corrector(name="compact", view=None, seed=0, dtype=torch.float64, **changes):
    """A small one, fitted to a view; networks of one seed are alike."""
    view = FeatureView(body(), moving(body())) if view is None else view
    torch.manual_seed(seed)
    made = Corrector(preset(name, **{**SMALL, **changes}))
    made.network.to(dtype)
    return fit(made, view)
