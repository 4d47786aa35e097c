"""An independent backward-Euler step: residual and tangent as literal scikit-fem forms.

Nothing here comes from the package but the scene's numbers.  The nearest
rotation is NumPy's, the nearest matrix of unit determinant solves its
optimality conditions on full matrices, and their derivatives come from
differentiating those conditions; no singular-value formulas are shared.
"""

import numpy as np
import scipy.sparse.linalg as spla
from skfem import Basis, BilinearForm, ElementHex1, ElementVector, LinearForm, MeshHex, condense
from skfem.helpers import dot, grad

LEVI = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI[_i, _j, _k], LEVI[_i, _k, _j] = 1.0, -1.0


def nearest_rotation(F):
    """R and dR/dF for F (..., 3, 3).

    R = the polar factor; dR = R [w]x where (tr(S) I - S) w is the axial vector
    of R^T dF - dF^T R and S = R^T F.
    """
    U, _, Vt = np.linalg.svd(F)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    R = U @ Vt
    S = np.swapaxes(R, -1, -2) @ F
    inverse = np.linalg.inv(np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - S)
    axial = -np.einsum("ilc,...ki->...ckl", LEVI, R)
    w = np.einsum("...ab,...bkl->...akl", inverse, axial)
    return R, -np.einsum("...mi,ija,...akl->...mjkl", R, LEVI, w)


def nearest_unit_determinant(F):
    """V and dV/dF for F (..., 3, 3) with det F > 0: Newton on X - F + k cof X = 0, det X = 1."""
    X = F / np.cbrt(np.linalg.det(F))[..., None, None]
    k = np.zeros(F.shape[:-2])
    for _ in range(30):
        cofactor = np.linalg.det(X)[..., None, None] * np.linalg.inv(X).swapaxes(-1, -2)
        derivative = np.einsum("ikm,jln,...mn->...ijkl", LEVI, LEVI, X)
        system = np.zeros((*k.shape, 10, 10))
        system[..., :9, :9] = np.eye(9) + (k[..., None, None, None, None] * derivative).reshape(
            *k.shape, 9, 9
        )
        system[..., :9, 9] = system[..., 9, :9] = cofactor.reshape(*k.shape, 9)
        right = np.empty((*k.shape, 10))
        right[..., :9] = (F - X - k[..., None, None] * cofactor).reshape(*k.shape, 9)
        right[..., 9] = 1 - np.linalg.det(X)
        step = np.linalg.solve(system, right[..., None])[..., 0]
        X = X + step[..., :9].reshape(X.shape)
        k = k + step[..., 9]
        if np.abs(step).max() < 1e-14:
            break
    return X, np.linalg.inv(system)[..., :9, :9].reshape(*k.shape, 3, 3, 3, 3)


def stress_and_tangent(F, mu, omega):
    """P (..., 3, 3) and dP/dF (..., 3, 3, 3, 3) of mu |F - R|^2 + omega/2 |F - V|^2."""
    R, dR = nearest_rotation(F)
    V, dV = nearest_unit_determinant(F)
    identity = np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3))
    return 2 * mu * (F - R) + omega * (F - V), 2 * mu * (identity - dR) + omega * (identity - dV)


@LinearForm
def residual(v, w):
    """Inertia and internal forces: rho (u - target)/h2 . v + P : grad v - f . v."""
    inertia = w.density / w.h2 * dot(w["offset"], v)
    return inertia + np.einsum("ij...,ij...->...", w.P, grad(v)) - dot(w.force, v)


@BilinearForm
def tangent(u, v, w):
    """Rho u . v / h2 + grad v : dP/dF : grad u."""
    stiff = np.einsum("ij...,ijkl...,kl...->...", grad(v), w.C, grad(u))
    return w.density / w.h2 * dot(u, v) + stiff


class Oracle:
    """Backward Euler with a consistent mass on a clamped box of hexahedra."""

    def __init__(self, counts, cell_size, mu, omega, density, gravity, time_step):
        axes = [np.linspace(0, n * cell_size, n + 1) for n in counts]
        self.mesh = MeshHex.init_tensor(*axes)
        self.basis = Basis(self.mesh, ElementVector(ElementHex1()), intorder=3)
        self.clamped = self.basis.get_dofs(lambda x: x[0] < 1e-9).all()
        self.mu, self.omega, self.density, self.h = mu, omega, density, time_step
        self.force = density * np.array(gravity)
        self.u = np.zeros(self.basis.N)
        self.v = np.zeros(self.basis.N)

    def step(self):
        """One Newton-solved step; returns the number of iterations."""
        predicted = self.u + self.h * self.v
        u = self.u.copy()
        for iteration in range(50):  # noqa: B007
            gradient = np.moveaxis(self.basis.interpolate(u).grad, (0, 1), (-2, -1))
            P, C = stress_and_tangent(np.eye(3) + gradient, self.mu, self.omega)
            points = {
                "P": np.moveaxis(P, (-2, -1), (0, 1)),
                "C": np.moveaxis(C, (-4, -3, -2, -1), (0, 1, 2, 3)),
                "h2": self.h**2,
                "density": self.density,
                "force": np.broadcast_to(self.force[:, None, None], (3, *self.basis.dx.shape)),
                "offset": self.basis.interpolate(u - predicted),
            }
            r = residual.assemble(self.basis, **points)
            K = tangent.assemble(self.basis, **points)
            A, b, _, free = condense(K, -r, D=self.clamped)
            change = spla.spsolve(A.tocsc(), b)
            u[free] += change
            if np.abs(change).max() < 1e-14:
                break
        self.v, self.u = (u - self.u) / self.h, u
        return iteration

    def displacement_at(self, points):
        """Displacement (n, 3) of the mesh nodes at rest points (n, 3)."""
        distance = np.abs(self.mesh.p.T[None] - points[:, None]).max(axis=-1)
        assert distance.min(axis=1).max() < 1e-12
        nodes = distance.argmin(axis=1)
        return self.u[self.basis.nodal_dofs[:, nodes]].T
