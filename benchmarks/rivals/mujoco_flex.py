"""MuJoCo's flex: pip install mujoco==4.0.0

Hexahedra ("trilinear", "quadratic" dofs) have Hooke's law in the frame of each cell, tetrahedra
("full" dofs) St. Venant-Kirchhoff's.  Nodal masses are set to those of the cells, as flexcomp
spreads a trilinear body's mass evenly over the nodes.  Its integrator "discrete" treats flexes
implicitly, with the default solver; 2 ms is the default step.  No damping but the integrator's.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "mujoco"
RECOMMENDED = ("trilinear, 2 ms", "quadratic, 2 ms", "full, 2 ms")
LAW = {
    "trilinear": "linear-corotated",
    "quadratic": "linear-corotated",
    "full": "st-venant-kirchhoff",
}
SETTINGS = {
    f"{dof}, {10 / substeps:g} ms": {
        "law": LAW[dof], "dof": dof, "substeps": substeps, "refine": (1, 2),
    }
    for dof in LAW
    for substeps in (1, 5, 20)
}  # fmt: skip
MODEL = """
<mujoco>
  <option timestep="{step}" integrator="discrete" tolerance="1e-10"
          gravity="{gravity}"><flag contact="disable"/></option>
  <size memory="1G"/>
  <worldbody>
    <flexcomp name="body" dim="3" dof="{dof}" mass="{mass}" radius="1e-6" {mesh}>
      <elasticity young="{young}" poisson="{poisson}" damping="0"/>
      <contact selfcollide="none"/>
      <pin {held}/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


def words(values) -> str:  # type: ignore[no-untyped-def]
    return " ".join(f"{x:.12g}" for x in values)


def simulate(case: Case, law: str, dof: str, substeps: int) -> Iterator[np.ndarray]:
    import mujoco

    counts, order = np.array(case.counts), 1
    if dof == "quadratic":  # a cell of 27 nodes for 2x2x2 of the case
        counts, order = counts // 2, 2
    nodes = order * counts + 1
    if dof == "full":
        points, tets = words(case.points.ravel()), words(case.tets.ravel())
        mesh = f'type="direct" point="{points}" element="{tets}"'
        held = f'id="{words(case.clamped)}"'
    else:
        mesh = (
            f'type="grid" count="{words(nodes)}" cellcount="{words(counts)}" '
            f'spacing="{words(3 * [case.size])}" pos="{words(case.points.max(axis=0) / 2)}"'
        )
        held = f'gridrange="0 0 0 0 {nodes[1] - 1} {nodes[2] - 1}"'
    model = mujoco.MjModel.from_xml_string(
        MODEL.format(
            step=case.step / substeps, gravity=words(case.gravity), dof=dof, mesh=mesh, held=held,
            mass=case.lumped.sum(), young=case.young, poisson=case.poisson,
        )
    )  # fmt: skip
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    own = case.match(data.flexvert_xpos)
    body = model.flex_vertbodyid if dof == "full" else model.flex_nodebodyid
    body = np.asarray(body)[own]
    moves = body > 0
    if dof != "quadratic":  # whose masses are Simpson's
        model.body_mass[body[moves]] = case.lumped[moves]
    else:
        model.body_mass[body[moves]] *= (
            case.lumped[moves].sum() / model.body_mass[body[moves]].sum()
        )
    mujoco.mj_setConst(model, data)
    data.xfrc_applied[body[moves], :3] = case.forces[moves]
    for _ in range(case.frames):
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        yield data.flexvert_xpos[own]


if __name__ == "__main__":
    main(simulate, SETTINGS)
