"""PBAT's finite elements: pip install pbatoolkit==0.0.11

Tetrahedra of 4 or 10 nodes (hexahedra are for C++ only), the loop of its examples: backward Euler
by one Newton step, consistent mass, sparse LDL^T; "converged" are up to 20, until the largest
increment is below 1e-5 of a cell.  Its stable neo-Hookean energy takes lambda + mu for lambda.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "pbatoolkit"
RECOMMENDED = ("4 nodes, 10 ms", "10 nodes, 10 ms")
SETTINGS = {
    f"{nodes} nodes, {1e3 * step:g} ms{', converged' if newton > 1 else ''}": {
        "law": "neo-hookean", "nodes": nodes, "longest": step, "newton": newton, "refine": (1,),
        "scenes": scenes,
    }
    for nodes, step, newton, scenes in (
        (4, 1e-2, 1, ()), (10, 1e-2, 1, (1,)), (10, 1e-2, 20, ()), (10, 2.5e-3, 1, (1,)),
        (10, 1e-3, 1, ()),
    )
}  # fmt: skip
TOLERANCE = 1e-5
"""Of a cell, for the largest increment."""


def simulate(case: Case, law: str, nodes: int, longest: float, newton: int) -> Iterator[np.ndarray]:
    from pbatoolkit import pbat, pypbat

    fem, order = pbat.fem, 1 if nodes == 4 else 2
    kind = {"element": fem.Element.Tetrahedron, "order": order}
    X, E = fem.mesh(case.points.T, case.tets.T, **kind)
    wg = fem.mesh_quadrature_weights(E, X, quadrature_order=order, **kind)
    shapes = fem.element_shape_functions(quadrature_order=order, **kind)
    at = np.einsum("dne,nq->qed", X[:, E], shapes)
    loads = np.zeros((len(case.nodal), X.shape[1], 3))
    for k, load in enumerate(loads):
        force = case.force_density(k, at, case.owners)
        np.add.at(load, E, np.einsum("nq,qe,qed->ned", shapes, wg, force))
    count, weights, tets = X.shape[1], np.ravel(wg, order="F"), E.shape[1]
    eg = np.repeat(np.arange(tets), wg.shape[0])
    # shares of tetrahedra of one density
    mass = sum(
        fem.mass_matrix(E[:, own], X, rho=rho, dims=3, **kind)
        for rho in np.unique(case.density)
        for own in [case.density[case.owners] == rho]
    ).tocsr()
    elastic = {
        "E": E, "n_nodes": count, "eg": eg, "wg": weights, "mug": case.mu[case.owners][eg],
        "lambdag": (case.lam + case.mu)[case.owners][eg],
        "GNeg": fem.shape_function_gradients(E, X, quadrature_order=order, dims=3, **kind),
        "energy": fem.HyperElasticEnergy.StableNeoHookean,
        "flags": fem.ElementElasticityComputationFlags.Gradient
        | fem.ElementElasticityComputationFlags.Hessian,
        "spd_correction": fem.HyperElasticSpdCorrection.Absolute, "dims": 3, **kind,
    }  # fmt: skip
    own = case.match(X.T)
    free = np.flatnonzero(np.repeat(~case.held(X.T), 3))
    substeps = case.substeps(longest)
    x, h = X.ravel(order="F"), case.step / substeps
    v = np.zeros_like(x)
    v[free] = np.tile(case.velocity, count)[free]
    for frame in case.factors(substeps):
        for factors in frame:
            f, start = np.tensordot(factors, loads, 1).ravel(), x
            x = x.copy()
            for _ in range(newton):
                _, gradient, hessian = fem.hyper_elastic_potential(x=x, **elastic)
                A = (mass + h**2 * hessian).tocsc()[:, free].tocsr()[free]
                right = (h**2 * (f - gradient) - mass @ (x - start - h * v))[free]
                solver = pypbat.math.linalg.ldlt(A)
                solver.compute(A)  # analysis included: entries that vanish leave the pattern
                increment = np.asarray(solver.solve(right)).squeeze()
                x[free] += increment
                if np.abs(increment).max() < TOLERANCE * case.size:
                    break
            v = (x - start) / h
        yield x.reshape(-1, 3)[own]


if __name__ == "__main__":
    main(simulate, SETTINGS)
