"""Scenes that several tests share; all asymmetric on purpose."""

import numpy as np
import pytest

import pdcorrect as pc

CLAMPED = [{"region": {"plane": "x", "at": 0.0}}]
GRAVITY = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]


def beam(cells=(6, 2, 2), cell_size=0.02, poisson=0.45, **changes):
    """A cantilever under its own weight."""
    settings = {
        "body": {"shape": "beam", "cells": list(cells), "cell_size": cell_size},
        "material": {"young": 1e6, "poisson": poisson, "density": 1e3},
        "time": {"step": 0.01, "frames": 20},
        "clamps": CLAMPED,
        "loads": GRAVITY,
    }
    for key, value in changes.items():
        old = settings.get(key)
        settings[key] = {**old, **value} if isinstance(old, dict) else value
    return pc.Scene(**settings)


def cross(poisson=0.45, **changes):
    """A four-armed cross, twisted."""
    body = {
        "shape": "cross", "cells": [8, 2, 2], "cell_size": 0.05, "arms": 4, "arm_start": 5,
        "arm_width": 2, "arm_length": 2,
    }  # fmt: skip
    return beam(
        poisson=poisson,
        **{
            "body": body,
            "material": {"young": 3e5},
            "loads": [{"kind": "torsion", "strength": 3e4, "stretch": 0.01}],
            **changes,
        },
    )


def disturbed(problem, amplitude, seed=0):
    """Rest positions plus noise (of the cell size) on the free components."""
    noise = np.random.default_rng(seed).normal(size=problem.positions.shape)
    return problem.positions + amplitude * problem.cell_size * noise * problem.free


def rotation(seed=3):
    """A rotation matrix without symmetry."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.fixture
def rng():
    return np.random.default_rng(12345)
