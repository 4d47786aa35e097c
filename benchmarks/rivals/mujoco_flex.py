"""MuJoCo's flex: pip install mujoco==4.0.0

Hexahedra with Hooke's law in the frame of each cell, one of 8 nodes for each of the case, or one of
27 for 2x2x2.  Masses are set: its compiler spreads the whole mass over nodes that are not pinned.
Its integrator "discrete" treats flexes implicitly, with the default solver; 2 ms and 1e-8 are the
default step and tolerance, 1e-10 is the tolerance of shorter steps.  No damping but the
integrator's.  Loads are integrated here with the shape functions of the nodes that they act on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, Refused, main

PACKAGE = "mujoco"
RECOMMENDED = ("trilinear, 2 ms", "quadratic, 2 ms")
SETTINGS = {
    f"{dof}, {1e3 * step:g} ms": {
        "law": "linear-corotated", "dof": dof, "longest": step,
        "tolerance": 1e-8 if step == 2e-3 else 1e-10, "refine": refine, "scenes": refine,
    }
    for dof, step, refine in (
        ("trilinear", 2e-3, (1, 2)), ("trilinear", 5e-4, (1,)),
        ("quadratic", 2e-3, (1, 2)), ("quadratic", 5e-4, (1, 2)),
    )
}  # fmt: skip
MODEL = """
<mujoco>
  <option timestep="{step}" integrator="discrete" tolerance="{tolerance}"
          gravity="0 0 0"><flag contact="disable"/></option>
  <size memory="1G"/>
  <worldbody>
    <flexcomp name="body" dim="3" dof="{dof}" mass="{mass}" radius="1e-6" type="direct"
              cellcount="{cells}" point="{points}" element="{tets}">
      <elasticity young="{young}" poisson="{poisson}" damping="0"/>
      <contact selfcollide="none"/>
      <pin id="{held}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


def words(values) -> str:  # type: ignore[no-untyped-def]
    return " ".join(f"{x:.12g}" for x in np.ravel(values))


def masses(case: Case, order: int) -> np.ndarray:
    """Of the nodes (N,) of blocks of ``order`` cells along each edge, kg (Newton-Cotes)."""
    line = np.array([1, 1]) / 2 if order == 1 else np.array([1, 4, 1]) / 6
    nodes = block_nodes(case, order)
    shares = np.broadcast_to(np.einsum("i,j,k", line, line, line).ravel(), nodes.shape)
    total = np.bincount(nodes.ravel(), shares.ravel())
    return case.uniform(case.density) * (order * case.size) ** 3 * total


def blocks(case: Case, order: int) -> np.ndarray:
    """Places (B, 3) of the blocks, of ``order`` cells along each edge, that make up the body."""
    found = np.unique(case.low // order, axis=0)
    if len(found) * order**3 != len(case.cells):
        raise Refused("27 nodes for cells that are no blocks of 2x2x2")
    return found


def block_nodes(case: Case, order: int) -> np.ndarray:
    """Numbers (B, (order + 1)^3) of the points of each block."""
    places = np.indices(3 * (order + 1,)).reshape(3, -1).T
    at = order * blocks(case, order)[:, None] + places
    return numbers(grid(case))[tuple(np.moveaxis(at, -1, 0))]


def grid(case: Case) -> np.ndarray:
    """Places (N, 3) of the points, in cells."""
    return np.rint((case.points - case.points.min(axis=0)) / case.size).astype(int)


def numbers(places: np.ndarray) -> np.ndarray:
    """Which of ``places`` (M, 3) each place of the grid is."""
    found = np.full(places.max(axis=0) + 1, -1)
    found[tuple(places.T)] = np.arange(len(places))
    return found


def quadratic_forces(case: Case) -> np.ndarray:
    """Of loads on nodes of blocks of 2x2x2 cells (L, N, 3), by eight points in each cell, N."""
    line = (np.array([[0.5], [1.5]]) + np.array([-0.5, 0.5]) / 3**0.5).ravel()  # in cells
    s = line / 2
    shapes = np.stack([(1 - s) * (1 - 2 * s), 4 * s * (1 - s), s * (2 * s - 1)])
    shapes = np.einsum("ai,bj,ck->abcijk", shapes, shapes, shapes).reshape(27, 64)
    at = 2.0 * blocks(case, 2)[:, None]
    at = at + np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(64, 3)
    owners = numbers(case.low)[tuple(np.moveaxis(at.astype(int), -1, 0))]
    at = case.points.min(axis=0) + case.size * at
    forces = np.zeros((len(case.nodal), *case.points.shape))
    for k, load in enumerate(forces):
        found = np.einsum("aq,bqi->bai", shapes, case.force_density(k, at, owners))
        np.add.at(load, block_nodes(case, 2), case.size**3 / 8 * found)
    return forces


def simulate(
    case: Case, law: str, dof: str, longest: float, tolerance: float
) -> Iterator[np.ndarray]:
    import mujoco

    substeps, order = case.substeps(longest), 2 if dof == "quadratic" else 1
    counts, mass = case.low.max(axis=0) + 1, masses(case, order)
    places = np.ravel_multi_index(tuple(grid(case).T), tuple(counts + 1))
    model = mujoco.MjModel.from_xml_string(
        MODEL.format(
            step=case.step / substeps, tolerance=tolerance, dof=dof, cells=words(counts // order),
            points=words(case.points), tets=words(case.tets), held=words(places[case.clamped]),
            mass=1.0, young=case.uniform(case.young), poisson=case.uniform(case.poisson),
        )
    )  # fmt: skip
    body = model.flex_nodebodyid[places]
    moves = body > 0
    model.body_mass[body[moves]] = mass[moves]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_forward(model, data)
    joints = model.body_dofadr[body[moves]]
    data.qvel[joints[:, None] + range(3)] = case.velocity
    if order == 1:
        loads = case.nodal + mass[:, None] * case.accelerations[:, None]
    else:
        loads = quadratic_forces(case)
    for frame in case.factors(substeps):
        for factors in frame:
            data.xfrc_applied[body[moves], :3] = np.tensordot(factors, loads, 1)[moves]
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        yield data.flexvert_xpos


if __name__ == "__main__":
    main(simulate, SETTINGS)
