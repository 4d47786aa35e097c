"""MuJoCo's flex: pip install mujoco==4.0.0

Hexahedra with Hooke's law in the frame of each cell, one of 8 nodes for each of the case, or one of
27 for 2x2x2.  Masses are set: its compiler spreads the whole mass over nodes that are not pinned.
Its integrator "discrete" treats flexes implicitly, with the default solver; 2 ms is the default
step.  No damping but the integrator's.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "mujoco"
RECOMMENDED = ("trilinear, 2 ms", "quadratic, 2 ms")
SETTINGS = {
    f"{dof}, {1e3 * step:g} ms": {
        "law": "linear-corotated", "dof": dof, "longest": step, "refine": refine,
        "scenes": refine,
    }
    for dof, step, refine in (
        ("trilinear", 2e-3, (1, 2)), ("trilinear", 5e-4, (1,)),
        ("quadratic", 2e-3, (1, 2)), ("quadratic", 5e-4, (1, 2)),
    )
}  # fmt: skip
MODEL = """
<mujoco>
  <option timestep="{step}" integrator="discrete" tolerance="1e-10"
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


def masses(case: Case, blocks: np.ndarray, order: int, nodes: np.ndarray) -> np.ndarray:
    """Of all nodes of the grid, kg: the trapezoidal rule, or Simpson's."""
    line = np.array([1, 1]) / 2 if order == 1 else np.array([1, 4, 1]) / 6
    corners = order * blocks[:, None] + np.indices(3 * (order + 1,)).reshape(3, -1).T
    shares = np.einsum("i,j,k", line, line, line).ravel()
    numbers = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), tuple(nodes))
    total = np.bincount(numbers.ravel(), np.tile(shares, len(blocks)), nodes.prod())
    return case.uniform(case.density) * (order * case.size) ** 3 * total


def simulate(case: Case, law: str, dof: str, longest: float) -> Iterator[np.ndarray]:
    import mujoco

    substeps, order = case.substeps(longest), 2 if dof == "quadratic" else 1
    counts = case.low.max(axis=0) + 1
    blocks = np.unique(case.low // order, axis=0)
    if (counts % order).any() or len(blocks) * order**3 != len(case.cells):
        raise NotImplementedError("cells that are no blocks of 2x2x2")
    grid = np.rint((case.points - case.points.min(axis=0)) / case.size).astype(int)
    held = np.ravel_multi_index(tuple(grid[case.clamped].T), tuple(counts + 1))
    model = mujoco.MjModel.from_xml_string(
        MODEL.format(
            step=case.step / substeps, dof=dof, cells=words(counts // order),
            points=words(case.points), tets=words(case.tets), held=words(held),
            mass=1.0, young=case.uniform(case.young), poisson=case.uniform(case.poisson),
        )
    )  # fmt: skip
    body = model.flex_nodebodyid
    moves = body > 0
    model.body_mass[body[moves]] = masses(case, blocks, order, counts + 1)[moves]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_forward(model, data)
    body = body[np.ravel_multi_index(tuple(grid.T), tuple(counts + 1))]
    moves = body > 0
    joints = model.body_dofadr[body[moves]]
    data.qvel[joints[:, None] + range(3)] = case.velocity
    mass = model.body_mass[body[moves], None]
    for frame in case.factors(substeps):
        for factors in frame:
            forces = np.tensordot(factors, case.nodal, 1)[moves]
            data.xfrc_applied[body[moves], :3] = forces + mass * (factors @ case.accelerations)
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        yield data.flexvert_xpos


if __name__ == "__main__":
    main(simulate, SETTINGS)
