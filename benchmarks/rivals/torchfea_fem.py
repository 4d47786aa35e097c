"""TorchFEA: pip install torchfea==1.0.1 torch

Hexahedra of 8 nodes or tetrahedra of 10, consistent mass, its Newmark integrator, Newton's method
to its default tolerance, Pardiso.  As its own neo-Hookean energy is none of ours, and its St.
Venant-Kirchhoff stress lacks the deformation gradient, it is given the stable neo-Hookean energy.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "torchfea"
RECOMMENDED = ("C3D8, 10 ms", "C3D10, 10 ms")
SETTINGS = {
    f"{element}, {10 / substeps:g} ms": {
        "law": "neo-hookean", "element": element, "substeps": substeps, "refine": refine,
    }
    for element, substeps, refine in (("C3D8", 1, (1, 2)), ("C3D8", 4, (1,)), ("C3D10", 1, (1,)))
}  # fmt: skip


def stable_neo_hookean(mu: float, lam: float):  # type: ignore[no-untyped-def]
    """The energy as a material: stress (..., j, i) = dPsi/dF_ij and its derivative by F_kl."""
    import torch
    from torchfea.assemble.elements.materials import Materials_Base

    class StableNeoHookean(Materials_Base):
        def strain_energy_density_C3(self, F):
            J = F.det() - 1
            return mu / 2 * ((F**2).sum([-1, -2]) - 3) - mu * J + (mu + lam) / 2 * J**2

        def material_Constitutive_C3(self, F, J=None, Jneg=None, invF=None, I1=None):
            J = F.det()[..., None, None]
            cofactor, inverse = J * F.inverse(), F.inverse()
            q = (mu + lam) * (J - 1) - mu
            one = torch.eye(3, dtype=F.dtype)
            tangent = mu * torch.einsum("il,jk->ijkl", one, one) + torch.einsum(
                "geij,gelk->geijkl", (mu + lam) * cofactor + q * inverse, cofactor
            )
            tangent = tangent - torch.einsum("geik,gelj->geijkl", q * cofactor, inverse)
            return mu * F.transpose(-1, -2) + q * cofactor, tangent

    return StableNeoHookean()


def with_middles(points: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and tetrahedra of ten nodes, Abaqus's order."""
    ends = np.sort(tets[:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]], axis=2)
    edges, numbers = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middles = numbers.reshape(-1, 6) + len(points)
    return np.concatenate([points, points[edges].mean(axis=1)]), np.hstack([tets, middles])


def simulate(case: Case, law: str, element: str, substeps: int) -> Iterator[np.ndarray]:
    import torch
    import torchfea

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    if case.twist:
        raise NotImplementedError("forces on nodes")
    points, cells = case.points, case.cells
    if element == "C3D10":
        points, cells = with_middles(points, case.tets)
    part = torchfea.Part(torch.as_tensor(points))
    numbers, cells = torch.arange(len(cells)), torch.as_tensor(cells)
    body = torchfea.elements.initialize_element(element, numbers, cells, part)
    body.set_materials(stable_neo_hookean(case.mu, case.lam))
    body.set_density(torch.tensor([case.density]))
    part.add_element(body, "body")
    part.set_nodes["clamped"] = np.flatnonzero(points[:, 0] < 1e-9)
    assembly = torchfea.Assembly()
    assembly.add_part(part, "beam")
    assembly.add_instance(torchfea.Instance(part), "beam")
    assembly.add_boundary(torchfea.boundarys.Boundary_Condition("beam", "clamped"))
    weight = (case.density * case.gravity).tolist()
    assembly.add_load(torchfea.loads.BodyForce("beam", "body", weight))
    h = case.step / substeps
    fea = torchfea.FEAController()
    fea.assembly, fea.solver = assembly, torchfea.solver.DynamicImplicitSolver(deltaT=h)
    fea.initialize()
    x, solver = assembly.GC.clone(), fea.solver
    v = torch.zeros_like(x)
    a = -solver.get_current_acceleration(GC0=x, GV0=v)  # which has the wrong sign
    for _ in range(case.frames):
        for _ in range(substeps):
            ahead = x + h * v + h**2 / 4 * a
            new = solver._solve_iteration(GC0=x, GC_pre=ahead, deltaT=h, tol_error=solver.tol_error)
            if new is False:
                raise RuntimeError("its Newton's method does not reach its tolerance")
            v, a = solver.get_next_velocity(GC_now=new, GC0=x, GV0=v, GA0=a, deltaT=h)
            x = new
        moved = assembly._GC2RGC(x)[0].numpy()
        yield (points + moved)[: len(case.points)]


if __name__ == "__main__":
    with contextlib.redirect_stdout(io.StringIO()):
        main(simulate, SETTINGS)
