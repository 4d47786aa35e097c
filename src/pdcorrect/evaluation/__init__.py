"""Correctors and stored runs of a data set against its reference.

Meshes and solvers of one scene are compared by `pdcorrect.evaluation.compare`.
"""
