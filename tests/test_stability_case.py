"""How the case on stability makes its scenes and judges runs."""

import sys
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc

VALIDATION = Path(__file__).parents[1] / "validation"
sys.path.insert(0, str(VALIDATION))
import harness  # noqa: E402
from expectations import Expectation  # noqa: E402

CASE = harness.Case(VALIDATION / "stability")
RUN = CASE.module
SCENES = RUN.battery.scenarios()
STRESSED = {name.split(", generalised")[0] for name in SCENES}


def test_all_that_is_computed_is_expected_and_nothing_else():
    names = {
        f"{name}, {element}, {what}"
        for name, scenario in SCENES.items()
        for element in RUN.battery.ELEMENTS
        for what in ("distance", "status", *(("gap",) if scenario.scene.obstacles else ()))
    }
    found = {name for name in CASE.expected if name.split(", generalised")[0] in STRESSED}
    assert found == names


def test_damped_scenes_are_as_long_as_their_damping_asks_for():
    beam, cross = (
        SCENES[f"{name}, generalised-alpha"].scene for name in ("plane", "cross random 0.5")
    )
    assert (beam.time.frames, cross.time.frames) == (160, 800)
    for scene in (beam, cross):
        assert scene.time.step * scene.time.frames * scene.damping.mass / 2 == pytest.approx(16.0)


def test_starts_below_the_floor_and_moved_clamps_have_none():
    floors = {name.split(",")[0] for name, s in SCENES.items() if s.scene.obstacles}
    assert {"plane", "inside-out", "no clamp", "cross kick"} <= floors
    assert not {"random 1", "two bodies", "twist 720", "stretch 10", "cross turned"} & floors
    problem = pc.discretise(SCENES["no clamp, generalised-alpha, floor"].scene)
    assert RUN.battery.floor_of(problem) == pytest.approx(-0.01)


@pytest.mark.parametrize(
    ("far", "status", "word"),
    [(0.0, "CONVERGED", "pass"), (1.0, "CONVERGED", "explained"), (1.0, "INVERTED", "fail")],
)
def test_a_run_is_explained_only_if_all_that_it_misses_is_known(far, status, word):
    aims = {
        "distance": {"at_most": 0.5, "source": "s", "known_failure": "why"},
        "status": {"status": ["CONVERGED"], "source": "s"},
    }
    expected = {name: Expectation.model_validate(aim) for name, aim in aims.items()}
    found, reason = RUN.battery.outcome({"distance": far, "status": status}, expected)
    assert (found, reason) == (word, "why" if word == "explained" else "")


def test_the_energy_of_a_falling_body_stays_until_it_touches():
    """Of a body at rest it is that of its weight: 0.375 kg, 5 mm above the floor."""
    found, failed = RUN.long_runs.energies("dropped", "learned", "generalised-alpha, radius 1", 8)
    assert found[0] == pytest.approx(0.375 * 9.81 * 0.005)
    np.testing.assert_allclose(found, found[0], rtol=1e-6)
    assert failed == 0
