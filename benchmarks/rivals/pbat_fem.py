"""PBAT's finite elements: pip install pbatoolkit==0.0.11

Tetrahedra of 4 or 10 nodes (hexahedra are for C++ only), the loop of its examples: backward Euler
by one Newton step, consistent mass, sparse LDL^T; or Newton's method to its end.  Its stable
neo-Hookean energy takes lambda + mu for lambda.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "pbatoolkit"
RECOMMENDED = ("4 nodes, 10 ms, 1 Newton", "10 nodes, 10 ms, 1 Newton")
SETTINGS = {
    f"{nodes} nodes, {10 / substeps:g} ms, {steps} Newton": {
        "law": "neo-hookean", "nodes": nodes, "substeps": substeps, "steps": steps,
        "refine": refine,
    }
    for nodes, substeps, steps, refine in (
        (4, 1, 1, (1, 2)), (4, 10, 1, (1,)),
        (10, 1, 1, (1,)), (10, 1, 20, (1,)), (10, 4, 1, (1,)), (10, 10, 1, (1,)),
    )
}  # fmt: skip
ENOUGH = 1e-7
"""Largest component of a last Newton step, m."""


def simulate(case: Case, law: str, nodes: int, substeps: int, steps: int) -> Iterator[np.ndarray]:
    from pbatoolkit import pbat, pypbat

    fem, order = pbat.fem, 1 if nodes == 4 else 2
    kind = {"element": fem.Element.Tetrahedron, "order": order}
    X, E = fem.mesh(case.points.T, case.tets.T, **kind)
    wg = fem.mesh_quadrature_weights(E, X, quadrature_order=order, **kind)
    shapes = fem.element_shape_functions(quadrature_order=order, **kind)
    at = np.einsum("dne,nq->qed", X[:, E], shapes)
    force = case.force_density(at) + case.density * case.gravity
    loads = np.zeros((X.shape[1], 3))
    np.add.at(loads, E, np.einsum("nq,qe,qed->ned", shapes, wg, force))
    mass = fem.mass_matrix(E, X, rho=case.density, dims=3, **kind).tocsr()
    count, weights = X.shape[1], np.ravel(wg, order="F")
    elastic = {
        "E": E, "n_nodes": count, "eg": np.repeat(np.arange(E.shape[1]), wg.shape[0]),
        "wg": weights, "mug": np.full(weights.size, case.mu),
        "lambdag": np.full(weights.size, case.lam + case.mu),
        "GNeg": fem.shape_function_gradients(E, X, quadrature_order=order, dims=3, **kind),
        "energy": fem.HyperElasticEnergy.StableNeoHookean,
        "flags": fem.ElementElasticityComputationFlags.Gradient
        | fem.ElementElasticityComputationFlags.Hessian,
        "spd_correction": fem.HyperElasticSpdCorrection.Absolute, "dims": 3, **kind,
    }  # fmt: skip
    own = case.match(X.T)
    free = np.flatnonzero(np.repeat(X[0] > 1e-9, 3))
    x, h = X.ravel(order="F"), case.step / substeps
    v, f = np.zeros_like(x), loads.ravel()
    for _ in range(case.frames):
        for _ in range(substeps):
            start, ahead = x, x + h * v
            for _ in range(steps):
                _, gradient, hessian = fem.hyper_elastic_potential(x=x, **elastic)
                A = (mass + h**2 * hessian).tocsc()[:, free].tocsr()[free]
                right = (h**2 * (f - gradient) - mass @ (x - ahead))[free]
                solver = pypbat.math.linalg.ldlt(A)
                solver.compute(A)  # analysis included: entries that vanish leave the pattern
                step = np.asarray(solver.solve(right)).squeeze()
                x = x.copy()
                x[free] += step
                if np.abs(step).max() < ENOUGH:
                    break
            v = (x - start) / h
        yield x.reshape(-1, 3)[own]


if __name__ == "__main__":
    main(simulate, SETTINGS)
