"""TorchFEA: pip install torchfea==1.0.1 torch

Tetrahedra of 10 nodes, consistent mass, its Newmark integrator, Newton's method to its default
tolerance, Pardiso.  As its own neo-Hookean energy is none of ours, and its St. Venant-Kirchhoff
stress lacks the deformation gradient, it is given the stable neo-Hookean energy, and body forces
that change.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator

import numpy as np
from case import Case, main, with_middles

PACKAGE = "torchfea"
RECOMMENDED = ("C3D10, 10 ms",)
SETTINGS = {
    f"C3D10, {1e3 * step:g} ms": {
        "law": "neo-hookean", "longest": step, "refine": (1,), "scenes": scenes,
    }
    for step, scenes in ((1e-2, (1,)), (5e-3, ()))
}  # fmt: skip


def stable_neo_hookean(mu, lam):  # type: ignore[no-untyped-def]
    """The energy of Lame parameters (E,) as a material.

    Its stress is (..., j, i) = dPsi/dF_ij, with the derivative by F_kl.
    """
    import torch
    from torchfea.assemble.elements.materials import Materials_Base

    mu, both = torch.as_tensor(mu), torch.as_tensor(mu + lam)

    class StableNeoHookean(Materials_Base):
        def strain_energy_density_C3(self, F):
            J = F.det() - 1
            return mu / 2 * ((F**2).sum([-1, -2]) - 3) - mu * J + both / 2 * J**2

        def material_Constitutive_C3(self, F, J=None, Jneg=None, invF=None, I1=None):
            m, b, J = mu[:, None, None], both[:, None, None], F.det()[..., None, None]
            cofactor, inverse = J * F.inverse(), F.inverse()
            q = b * (J - 1) - m
            one = torch.eye(3, dtype=F.dtype)
            tangent = torch.einsum("e,il,jk->eijkl", mu, one, one) + torch.einsum(
                "geij,gelk->geijkl", b * cofactor + q * inverse, cofactor
            )
            tangent = tangent - torch.einsum("geik,gelj->geijkl", q * cofactor, inverse)
            return m * F.transpose(-1, -2) + q * cofactor, tangent

    return StableNeoHookean()


def body_forces(case: Case):  # type: ignore[no-untyped-def]
    """The case's loads, of which ``set`` takes the factors."""
    import torch
    import torchfea

    class BodyForces(torchfea.loads.BodyForce):
        def initialize(self, assembly):
            super().initialize(assembly)
            body, nodes = self._element, assembly.get_instance("body").nodes
            shapes, weights = body.shape_function_d0_gaussian, body.gaussian_weight
            at = torch.einsum("gea,eai->gei", shapes, nodes[body._elems]).numpy()
            owners = np.broadcast_to(case.owners, at.shape[:2])
            self.patterns = [
                torch.einsum(
                    "gei,ge,gea->eai", torch.as_tensor(case.force_density(k, at, owners)),
                    weights, shapes,
                )
                for k in range(len(case.nodal))
            ]  # fmt: skip
            self._pdU_values = torch.zeros(body._elems.numel() * 3)

        def set(self, factors):
            for k, factor in enumerate(factors):
                rest = self._pdU_values if k else 0
                self._pdU_values = rest + (factor * self.patterns[k]).flatten()

        def get_potential_energy(self, RGC):
            at = RGC[self._instance_RGC_index] + self._assembly.get_instance("body").nodes
            return self._pdU_values @ at[self._element._elems].flatten()

    return BodyForces("body", "body")


def simulate(case: Case, law: str, longest: float) -> Iterator[np.ndarray]:
    import torch
    import torchfea

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    points, tets = with_middles(case.points, case.tets)
    part = torchfea.Part(torch.as_tensor(points))
    numbers = torch.arange(len(tets))
    body = torchfea.elements.initialize_element("C3D10", numbers, torch.as_tensor(tets), part)
    body.set_materials(stable_neo_hookean(case.mu[case.owners], case.lam[case.owners]))
    body.set_density(torch.as_tensor(case.density[case.owners]))
    part.add_element(body, "body")
    held = case.held(points)
    part.set_nodes["clamped"] = np.flatnonzero(held)
    assembly = torchfea.Assembly()
    assembly.add_part(part, "body")
    assembly.add_instance(torchfea.Instance(part), "body")
    assembly.add_boundary(torchfea.boundarys.Boundary_Condition("body", "clamped"))
    loads, factors = body_forces(case), case.factors(case.substeps(longest), at=1.0)
    assembly.add_load(loads)
    h = case.step / case.substeps(longest)
    fea = torchfea.FEAController()
    fea.assembly, fea.solver = assembly, torchfea.solver.DynamicImplicitSolver(deltaT=h)
    fea.initialize()
    x, solver = assembly.GC.clone(), fea.solver
    v = torch.as_tensor(np.tile(case.velocity, int((~held).sum())))
    loads.set(case.amplitudes[:, 0])
    a = -solver.get_current_acceleration(GC0=x, GV0=v)  # which has the wrong sign
    for frame in factors:
        for step in frame:
            loads.set(step)
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
