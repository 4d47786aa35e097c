"""SimKit: pip install simkit==0.1.8

Tetrahedra of 4 nodes, lumped mass, its backward Euler and BDF2 with its defaults (one Newton step,
line search), or up to 20 steps.  Its "macklin_mueller_neo_hookean" takes lambda + mu for lambda.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from case import Case, main

PACKAGE = "simkit"
RECOMMENDED = ("BE, 10 ms, 1 Newton",)
SETTINGS = {
    f"{scheme}, {10 / substeps:g} ms, {newton} Newton": {
        "law": "neo-hookean", "scheme": scheme, "substeps": substeps, "newton": newton,
        "refine": refine,
    }
    for scheme, substeps, newton, refine in (
        ("BE", 1, 1, (1, 2)), ("BE", 1, 20, (1,)), ("BDF2", 1, 20, (1, 2)),
    )
}  # fmt: skip


def simulate(case: Case, law: str, scheme: str, substeps: int, newton: int) -> Iterator[np.ndarray]:
    import scipy.sparse as sparse
    import simkit
    from simkit.energies import macklin_mueller_neo_hookean as energy
    from simkit.integrators import backward_euler, bdf2

    X, T = case.points, case.tets
    count = len(T)
    J, volumes = simkit.deformation_jacobian(X, T), simkit.volume(X, T)
    M = sparse.kron(simkit.massmatrix(X, T, rho=case.density), sparse.identity(3)).tocsr()
    f = M @ np.tile(case.gravity, len(X))[:, None] + case.forces.reshape(-1, 1)
    free = np.setdiff1d(np.arange(3 * len(X)), (3 * case.clamped[:, None] + range(3)).ravel())
    moduli = (np.full((count, 1), case.mu), np.full((count, 1), case.lam + case.mu), volumes)
    S = sparse.identity(3 * len(X), format="csr")[:, free]
    held = X.reshape(-1, 1) - S @ (S.T @ X.reshape(-1, 1))

    def whole(z):
        return (held + S @ z).reshape(-1, 3)

    def value(z):
        return (
            energy.macklin_mueller_neo_hookean_energy_x(whole(z), J, *moduli)
            - (f.T @ (S @ z)).item()
        )

    def gradient(z):
        g = energy.macklin_mueller_neo_hookean_gradient_x(whole(z), J, *moduli)
        return S.T @ (g.reshape(-1, 1) - f)

    def hessian(z):
        return S.T @ energy.macklin_mueller_neo_hookean_hessian_x(whole(z), J, *moduli) @ S

    functions = value, gradient, hessian, S.T @ M @ S, case.step / substeps
    past = 4 * [S.T @ X.reshape(-1, 1)]
    for _ in range(case.frames):
        for _ in range(substeps):
            step, known = (backward_euler, past[:2]) if scheme == "BE" else (bdf2, past)
            past = [step(*known, *functions, max_iter=newton), *past[:3]]
        yield whole(past[0])


if __name__ == "__main__":
    main(simulate, SETTINGS)
