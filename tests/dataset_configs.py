"""Small data-set configurations for tests."""

from pdcorrect.data.configuration import DatasetConfig

FAMILIES = {"torsion": "cross", "impulse": "weight", "stretch": "weight"}
STRENGTHS = {"torsion": [5.0, 15.0], "impulse": [0.2, 0.6], "stretch": [3.0, 8.0]}


def small(motion="torsion", setting="exact", **changes):
    """A data set of two training meshes and one for evaluation, of a few frames.

    Of one motion, or with ``mixed`` of several.
    """
    family = changes.pop("family", FAMILIES[motion])
    values = {
        "name": f"small-{motion}",
        "seed": 7,
        "family": family,
        "setting": setting,
        "coarse_nodes": [150, 240] if family == "weight" else [72, 108],
        "frames": 3,
        "material": {"young": [2e5, 4e5], "poisson": [0.3, 0.4], "density": [900.0, 1100.0]},
        "motion": {"kind": motion, "strength": STRENGTHS[motion], "duration": 0.02},
        "reference": {"refine": 2},
        "training": {"meshes": 2, "simulations": 3},
        "evaluation": {"meshes": 1, "simulations": 1},
        "validation_share": 0.0,
    }
    if "mixed" in changes:
        del values["motion"]
    return DatasetConfig(**{**values, **changes})
