"""dolfinx: apt-get install --no-install-recommends python3-dolfinx (Debian 12: 0.5.2, 213 packages)

Debian's version is of October 2022; newer ones may be quicker.  Hexahedra of degree 1 or 2 (8 or 27
nodes), consistent mass, the stable neo-Hookean energy in UFL, generalised-alpha (spectral radius
0.8).  dolfinx's Newton solver with MUMPS starts from the motion at the old acceleration (once
that takes over 8 iterations, from the last positions) and stops at an RMS increment below 1e-5
of a cell.  It has no time steps, so those are written here.
FOLDER/dolfinx_fem/bin/python may be a link to the system's.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "fenics-dolfinx"
RECOMMENDED = ("8 nodes, 10 ms", "27 nodes, 10 ms")
SETTINGS = {
    f"{nodes} nodes, {1e3 * step:g} ms": {
        "law": "neo-hookean", "nodes": nodes, "longest": step, "refine": refine,
        "scenes": scenes,
    }
    for nodes, step, refine, scenes in (
        (8, 1e-2, (1, 2), (1,)), (27, 1e-2, (1,), (1,)), (27, 2.5e-3, (1,), ()),
    )
}  # fmt: skip
RADIUS = 0.8
"""Spectral radius at infinite frequency."""
TOLERANCE = 1e-5
"""Of a cell, for the RMS of Newton's increment."""
COMPILER = {"cffi_extra_compile_args": ["-O3", "-march=native", "-g0"]}
_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]  # of a cell's corners, from VTK's


def simulate(case: Case, law: str, nodes: int, longest: float) -> Iterator[np.ndarray]:
    import ufl
    from dolfinx import fem, mesh, nls
    from mpi4py import MPI

    degree = 1 if nodes == 8 else 2
    domain = ufl.Mesh(ufl.VectorElement("Lagrange", "hexahedron", 1))
    body = mesh.create_mesh(MPI.COMM_WORLD, case.cells[:, _ORDER], case.points, domain)
    V = fem.VectorFunctionSpace(body, ("Lagrange", degree))
    owner = np.asarray(body.topology.original_cell_index)

    def by_cell(values):
        """A function of values (C,) or (C, 3) in cells."""
        space = fem.VectorFunctionSpace if values.ndim == 2 else fem.FunctionSpace
        found = fem.Function(space(body, ("DG", 0)))
        found.x.array[:] = values[owner].ravel()
        return found

    mu, lam, rho = (by_cell(values) for values in (case.mu, case.lam, case.density))
    substeps = case.substeps(longest)
    h = case.step / substeps
    alpha_m, alpha_f = (2 * RADIUS - 1) / (RADIUS + 1), RADIUS / (RADIUS + 1)
    gamma = 0.5 - alpha_m + alpha_f
    beta = 0.25 * (1 - alpha_m + alpha_f) ** 2
    at = ufl.SpatialCoordinate(body)
    factors = [fem.Constant(body, 0.0) for _ in case.nodal]
    force = fem.Constant(body, np.zeros(3))
    for k, factor in enumerate(factors):
        density = case.densities[k] + case.density[:, None] * case.accelerations[k]
        force += factor * by_cell(density)
        strength, attraction, stretch, *centre = case.twists[k]
        if strength:
            y, z = at[1] - centre[1], at[2] - centre[2]
            field = ufl.as_vector([stretch + 0 * y, -z - attraction * y, y - attraction * z])
            force += factor * strength * field / ufl.sqrt(ufl.inner(field, field) + 1e-24)
    u, u0, v0, a0 = (fem.Function(V) for _ in range(4))
    w, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    dx = ufl.dx(metadata={"quadrature_degree": 2 * degree + 1})

    places = V.tabulate_dof_coordinates()
    held = np.flatnonzero(case.held(places)).astype(np.int32)
    condition = fem.dirichletbc(np.zeros(3), held, V)
    own = case.match(places)
    v0.x.array.reshape(-1, 3)[:] = case.velocity
    v0.x.array.reshape(-1, 3)[held] = 0

    def set_factors(values):
        for factor, value in zip(factors, values, strict=True):
            factor.value = value

    set_factors(case.amplitudes[:, 0])
    fem.petsc.LinearProblem(
        rho * ufl.inner(du, w) * dx, ufl.inner(force, w) * dx, bcs=[condition], u=a0,
        petsc_options={"ksp_type": "preonly", "pc_type": "lu"},
    ).solve()  # fmt: skip
    a = (u - u0 - h * v0) / (beta * h**2) - (0.5 / beta - 1) * a0
    inside = ufl.grad((1 - alpha_f) * u + alpha_f * u0)
    F = ufl.variable(ufl.Identity(3) + inside)
    J = ufl.det(F) - 1
    energy = mu / 2 * (ufl.inner(F, F) - 3) - mu * J + (lam + mu) / 2 * J**2
    form = ufl.inner(rho * ((1 - alpha_m) * a + alpha_m * a0) - force, w) * dx
    form += ufl.inner(ufl.diff(energy, F), ufl.grad(w)) * dx
    problem = fem.petsc.NonlinearProblem(
        form, u, bcs=[condition], J=ufl.derivative(form, u, du), jit_params=COMPILER
    )
    solver = nls.petsc.NewtonSolver(MPI.COMM_WORLD, problem)
    solver.convergence_criterion, solver.rtol = "incremental", 0.0
    solver.atol = TOLERANCE * case.size * len(places) ** 0.5
    solver.krylov_solver.setType("preonly")
    solver.krylov_solver.getPC().setType("lu")
    solver.krylov_solver.getPC().setFactorSolverType("mumps")
    ahead, solver.max_it = True, 8
    for frame in case.factors(substeps, at=1 - alpha_f):
        for step in frame:
            set_factors(step)
            if ahead:
                u.x.array[:] += h * v0.x.array + h**2 / 2 * a0.x.array
            try:
                solver.solve(u)
            except RuntimeError:  # too many iterations
                ahead, solver.max_it, u.x.array[:] = False, 50, u0.x.array
                solver.solve(u)
            new = (u.x.array - u0.x.array - h * v0.x.array) / (beta * h**2)
            new -= (0.5 / beta - 1) * a0.x.array
            v0.x.array[:] += h * ((1 - gamma) * a0.x.array + gamma * new)
            a0.x.array[:], u0.x.array[:] = new, u.x.array
        yield case.points + u.x.array.reshape(-1, 3)[own]


if __name__ == "__main__":
    main(simulate, SETTINGS)
