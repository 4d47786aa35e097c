"""Forty scenes of five families of bodies that the training has no draw for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdcorrect as pc

Grid = NDArray[np.bool_]

EACH = 8
"""Scenes of a family."""
_SEED = 2026
STEPS = (0.0025, 0.005, 0.01, 0.02)
"""s."""
_FRAMES = 40


def _arch(rng: np.random.Generator) -> Grid:
    """Half a ring of cells, on two feet."""
    outer, thick, deep = rng.integers(5, 8), rng.integers(2, 4), rng.integers(1, 4)
    x, z = np.mgrid[-outer:outer, 0:outer] + 0.5
    radius = np.hypot(x, z)
    flat = (radius < outer) & (radius > outer - thick)
    return np.repeat(flat[:, None], deep, axis=1)


def _hand(rng: np.random.Generator) -> Grid:
    """Fingers of several lengths on a palm."""
    count, wide, deep = rng.integers(2, 5), rng.integers(1, 3), rng.integers(1, 3)
    solid = np.zeros(((count * (wide + 1) - 1), deep, 10), dtype=bool)
    palm = rng.integers(2, 4)
    solid[:, :, :palm] = True
    for k in range(count):
        solid[k * (wide + 1) :, :, : palm + rng.integers(3, 8)][:wide] = True
    return solid


def _wireframe(rng: np.random.Generator) -> Grid:
    """The edges of a box, and of the cells of a lattice in it."""
    shape, pitch = [int(2 * n + 1) for n in rng.integers(1, 4, size=3)], 2
    if min(shape) == max(shape) == 7:
        shape[0] = 5
    lines = [np.arange(n) % pitch == 0 for n in shape]
    i, j, k = np.meshgrid(*lines, indexing="ij")
    return np.asarray(i.astype(int) + j + k >= 2)


def _hull(rng: np.random.Generator) -> Grid:
    """A closed box with walls of one cell, with a window."""
    shape = rng.integers(5, 8, size=3)
    solid = np.ones(shape, dtype=bool)
    solid[1:-1, 1:-1, 1:-1] = False
    at, size = rng.integers(1, 3, size=2), rng.integers(1, 3, size=2)
    solid[at[0] : at[0] + size[0], 0, at[1] : at[1] + size[1]] = False
    return solid


def _meander(rng: np.random.Generator) -> Grid:
    """A strip that turns back on itself several times."""
    turns, wide, gap, deep = rng.integers(2, 5), rng.integers(1, 3), rng.integers(1, 3), 2
    long = int(rng.integers(4, 8))
    solid = np.zeros((long, deep, turns * (wide + gap) + wide), dtype=bool)
    for k in range(turns + 1):
        start = k * (wide + gap)
        solid[:, :, start : start + wide] = True
        end = slice(0, wide) if k % 2 else slice(long - wide, long)
        if k < turns:
            solid[end, :, start : start + wide + gap] = True
    return solid


FAMILIES: dict[str, Callable[[np.random.Generator], Grid]] = {
    "arch": _arch, "hand": _hand, "wireframe": _wireframe, "hull": _hull, "meander": _meander,
}  # fmt: skip
_FOOT = {"region": {"plane": "z", "at": "min"}}
_TOP = {"plane": "z", "at": "max"}


def scene(family: str, number: int) -> pc.Scene:
    """One of a family's scenes; the same whenever it is asked for.

    Cells of 1 to 100 mm and Young's modulus are such that the slowest vibration takes 12 to 50
    steps, loads are such that their static answer moves a node by 3 to 30 % of the body's size.
    """
    rng = np.random.default_rng([_SEED, list(FAMILIES).index(family), number])
    solid = FAMILIES[family](rng)
    while not 20 <= solid.sum() <= 180:
        solid = FAMILIES[family](rng)
    step = STEPS[number % len(STEPS)]
    base: dict[str, Any] = {
        "name": f"{family} {number}",
        "body": {
            "shape": "voxels", "occupancy": solid.astype(int).tolist(),
            "cell_size": 0.01,
        },
        "material": {
            "young": 1e5, "density": float(rng.choice([900.0, 1050.0, 1200.0])),
            "poisson": round(float(rng.choice([rng.uniform(0.0, 0.4), rng.uniform(0.4, 0.49)])), 3),
        },
        "time": {"step": step, "frames": _FRAMES},
        "clamps": [_FOOT],
    }  # fmt: skip
    frequency = pc.modes(pc.discretise(pc.best_coarse(pc.Scene(**base))), 1).frequencies[0]
    period = step * rng.uniform(12.0, 50.0)
    wanted = 10.0 ** rng.uniform(4.0, 7.0)
    ratio = np.sqrt(wanted / 1e5) * period * frequency
    size = float(f"{np.clip(0.01 * ratio, 1e-3, 0.1):.3g}")
    base["body"]["cell_size"] = size
    base["material"]["young"] = float(f"{1e5 * (size / 0.01 / period / frequency) ** 2:.3g}")
    load = _LOADS[number % len(_LOADS)]
    return load(base, rng, 10.0 ** rng.uniform(np.log10(0.03), np.log10(0.3)), period)


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    way = rng.normal(size=3)
    return np.asarray(way / np.linalg.norm(way))


def _scaled(base: dict[str, Any], load: dict[str, Any], name: str, share: float) -> dict[str, Any]:
    """The load with ``name`` such that its static answer moves a node by a share of the size."""
    value, material = np.asarray(load[name]), base["material"]
    small = 1e-6 * material["young"]
    if name == "acceleration":
        small /= material["density"] * base["body"]["cell_size"]
    weak = {key: x for key, x in load.items() if key not in ("window", "ramp")}
    weak[name] = (small * value).tolist()
    time = {"step": 1.0, "frames": 1, "integrator": "quasi-static"}
    still = pc.Scene(**{**base, "time": time, "loads": [weak]})
    run = pc.rollout(pc.Newton(pc.discretise(pc.best_coarse(still)), tolerance=1e-7))
    moved = np.linalg.norm(run.positions[-1] - run.points, axis=1).max() / small
    factor = share * np.ptp(run.points, axis=0).max() / moved
    rounded = [float(f"{x:.4g}") for x in np.atleast_1d(factor * value)]
    return {**load, name: rounded if value.ndim else rounded[0]}


def _falling(base: dict[str, Any], rng: np.random.Generator, share: float, _: float) -> pc.Scene:
    """Under its weight from the first frame on."""
    load = {"kind": "gravity", "acceleration": _direction(rng).tolist()}
    return pc.Scene(**base, loads=[_scaled(base, load, "acceleration", 0.7 * share)])


def _kicked(
    base: dict[str, Any], rng: np.random.Generator, share: float, period: float
) -> pc.Scene:
    """Accelerated for a while, then free."""
    end = base["time"]["step"] * max(2, round(0.3 * period / base["time"]["step"]))
    load = {"kind": "gravity", "acceleration": _direction(rng).tolist(), "window": [0.0, end]}
    return pc.Scene(**base, loads=[_scaled(base, load, "acceleration", share)])


def _pressed(
    base: dict[str, Any], rng: np.random.Generator, share: float, period: float
) -> pc.Scene:
    """Pressure on one side, which follows the body and fades in."""
    side = {"plane": str(rng.choice(["x", "y"])), "at": "max"}
    load = {
        "kind": "pressure", "pressure": 1.0, "region": side, "follower": True,
        "window": [0.0, 1.0], "ramp": round(float(0.5 * period), 6),
    }  # fmt: skip
    return pc.Scene(**base, loads=[_scaled(base, load, "pressure", 0.5 * share)])


def _driven(
    base: dict[str, Any], rng: np.random.Generator, share: float, period: float
) -> pc.Scene:
    """Moved by a clamp at the top, which then stays."""
    size = base["body"]["cell_size"] * np.array(np.shape(base["body"]["occupancy"])).max()
    moved = (0.5 * share * size * _direction(rng)).tolist()
    end = round(float(0.6 * period), 6)
    motion = {"times": [0.0, end, end + 10.0], "displacement": [[0.0, 0.0, 0.0], moved, moved]}
    return pc.Scene(**{**base, "clamps": [_FOOT, {"region": _TOP, "motion": motion}]})


def _thrown(
    base: dict[str, Any], rng: np.random.Generator, share: float, period: float
) -> pc.Scene:
    """With an initial velocity."""
    size = base["body"]["cell_size"] * np.array(np.shape(base["body"]["occupancy"])).max()
    speed = 2.0 * np.pi / period * share * size * _direction(rng)
    return pc.Scene(**base, initial={"velocity": [float(f"{x:.4g}") for x in speed]})


_LOADS = (_falling, _kicked, _pressed, _driven, _thrown)


def scenes() -> dict[str, pc.Scene]:
    """All of them, by name."""
    return {f"{name} {k}": scene(name, k) for name in FAMILIES for k in range(EACH)}
