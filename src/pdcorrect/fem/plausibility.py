"""One line where numbers look as if they were in other units than SI."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from pdcorrect.errors import PdcorrectWarning
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.scene import Scene

_LENGTHS = 1e-4, 100.0
"""Of a body, m."""
_STEPS = 1e-4, 1e4
"""In which a pressure wave crosses a body."""
_GRAVITY = 9.81
"""m/s2."""
_DENSITY = 1.0
"""Least, kg/m3; aerogels are lighter."""


def warn_of_units(scene: Scene, body: ElasticBody) -> None:
    """A `PdcorrectWarning` that names what is implausible, if anything is."""
    found = list(_implausible(scene, body))
    if found:
        warnings.warn(
            f"{'; '.join(found)}: are all numbers in m, kg, s and Pa?",
            PdcorrectWarning,
            stacklevel=3,
        )


def _implausible(scene: Scene, body: ElasticBody) -> Iterator[str]:
    low, high = body.mesh.bounds
    length = float((high - low).max())
    if not _LENGTHS[0] <= length <= _LENGTHS[1]:
        yield f"the body is {length:.3g} m long"
    density = float(body.materials.density.min())
    if density < _DENSITY:
        yield f"the density is {density:.3g} kg/m3"
    young, heaviest = float(body.materials.young.max()), float(body.materials.density.max())
    if young < _GRAVITY * heaviest * length:
        yield f"its Young's modulus, {young:.3g} Pa, is below the pressure under its own height"
    if scene.time.integrator == "quasi-static":
        return
    poisson = body.materials.poisson
    modulus = body.materials.young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    speed = float(np.sqrt(modulus / body.materials.density).max())
    steps = length / (speed * scene.time.step / scene.time.substeps)
    if not _STEPS[0] <= steps <= _STEPS[1]:
        yield f"a pressure wave crosses it in {steps:.2g} steps"
