"""Meshes, operators, energies, kernels, factorisations and the discrete problem."""
