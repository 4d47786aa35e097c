"""SimKit: pip install simkit==0.1.8

Tetrahedra of 4 nodes, lumped mass, its backward Euler with its defaults (one Newton step, line
search), and its BDF2 with up to 20.  Its "macklin_mueller_neo_hookean" takes lambda + mu for
lambda.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "simkit"
RECOMMENDED = ("BE, 10 ms, 1 Newton",)
SETTINGS = {
    f"{scheme}, {1e3 * step:g} ms, {newton} Newton": {
        "law": "neo-hookean", "scheme": scheme, "longest": step, "newton": newton, "refine": refine,
        "scenes": (1,),
    }
    for scheme, step, newton, refine in (("BE", 1e-2, 1, (1,)), ("BDF2", 1e-2, 20, (1, 2)))
}  # fmt: skip


def simulate(
    case: Case, law: str, scheme: str, longest: float, newton: int
) -> Iterator[np.ndarray]:
    import scipy.sparse as sparse
    import simkit
    from simkit.energies import macklin_mueller_neo_hookean as energy
    from simkit.integrators import backward_euler, bdf2

    X, T = case.points, case.tets
    J, volumes = simkit.deformation_jacobian(X, T), simkit.volume(X, T)
    rho = case.density[case.owners][:, None]
    M = sparse.kron(simkit.massmatrix(X, T, rho=rho), sparse.identity(3)).tocsr()
    loads = [
        M @ np.tile(acceleration, len(X))[:, None] + forces.reshape(-1, 1)
        for acceleration, forces in zip(case.accelerations, case.nodal, strict=True)
    ]
    free = np.setdiff1d(np.arange(3 * len(X)), (3 * case.clamped[:, None] + range(3)).ravel())
    mu, lam = case.mu[case.owners][:, None], (case.lam + case.mu)[case.owners][:, None]
    S = sparse.identity(3 * len(X), format="csr")[:, free]
    held = X.reshape(-1, 1) - S @ (S.T @ X.reshape(-1, 1))
    f = np.zeros_like(held)

    def whole(z):
        return (held + S @ z).reshape(-1, 3)

    def value(z):
        elastic = energy.macklin_mueller_neo_hookean_energy_x(whole(z), J, mu, lam, volumes)
        return elastic - (f.T @ (S @ z)).item()

    def gradient(z):
        g = energy.macklin_mueller_neo_hookean_gradient_x(whole(z), J, mu, lam, volumes)
        return S.T @ (g.reshape(-1, 1) - f)

    def hessian(z):
        H = energy.macklin_mueller_neo_hookean_hessian_x(whole(z), J, mu, lam, volumes)
        return S.T @ H @ S

    substeps = case.substeps(longest)
    h = case.step / substeps
    functions = value, gradient, hessian, S.T @ M @ S, h
    moved = S.T @ np.tile(h * case.velocity, len(X))[:, None]
    past = [S.T @ X.reshape(-1, 1) - k * moved for k in range(4)]
    for frame in case.factors(substeps):
        for factors in frame:
            f[:] = sum(factor * load for factor, load in zip(factors, loads, strict=True))
            step, known = (backward_euler, past[:2]) if scheme == "BE" else (bdf2, past)
            past = [step(*known, *functions, max_iter=newton), *past[:3]]
        yield whole(past[0])


if __name__ == "__main__":
    main(simulate, SETTINGS)
