"""Where the energy of a run goes: kept, put in, damped, lost by the integrator."""

from dataclasses import replace

import numpy as np
import pytest

import pdcorrect as pc
from conftest import CLAMPED, beam
from pdcorrect.errors import InputError

SPAN = 0.08
"""Seconds; the beam's first period is 0.047 s."""


def bent(problem, by=0.002):
    """At rest in a gently bent shape, ``by`` m: almost only the first mode."""
    mode = pc.modes(problem, 1).shapes[0]
    start = problem.positions + by * mode / np.abs(mode).max()
    return pc.State(start, np.zeros_like(start))


def vibration(integrator, step, by=0.002, **changes):
    scene = beam((4, 1, 1), loads=[], time={"step": step, "integrator": integrator}, **changes)
    problem = pc.discretise(scene)
    frames = round(SPAN / step)
    return pc.rollout(pc.Newton(problem, tolerance=1e-9), frames=frames, state=bent(problem, by))


def lost_share(integrator, step, **changes):
    """Largest dissipation of a vibration as a share of its energy."""
    balance = pc.metrics.energy_balance(vibration(integrator, step, **changes))
    return np.abs(balance.dissipation).max() / balance.total[0]


def test_midpoint_keeps_the_energy_of_a_vibration_to_second_order():
    shares = [lost_share("midpoint", h) for h in (0.004, 0.002, 0.001)]
    assert shares[0] < 0.02
    assert np.log2(shares[0] / shares[1]) == pytest.approx(2, abs=0.4)
    assert np.log2(shares[1] / shares[2]) == pytest.approx(2, abs=0.4)


def test_backward_euler_always_loses():
    balance = pc.metrics.energy_balance(vibration("backward-euler", 0.004))
    assert (np.diff(balance.dissipation) > 0).all()
    assert balance.dissipation[0] == 0
    assert balance.dissipation[-1] > 0.2 * balance.total[0]
    assert (balance.external_work == 0).all()


@pytest.mark.parametrize("damping", [{"mass": 12.0}, {"stiffness": 0.0005}])
def test_the_damping_accounts_for_the_loss_of_a_damped_vibration(damping):
    balance = pc.metrics.energy_balance(vibration("midpoint", 0.001, damping=damping))
    lost = balance.total[0] - balance.total[-1]
    assert lost > 0.3 * balance.total[0]
    assert balance.damping_loss[-1] == pytest.approx(lost, rel=0.03)
    assert (np.diff(balance.damping_loss) >= 0).all()


def test_the_loss_of_damped_internal_modes_is_recorded_rightly():
    """In motion so small that the shape holds one mode only."""
    changes = {"damping": {"stiffness": 0.0005}, "solver": {"element": "hex8-bubble"}, "by": 2e-6}
    exact = pc.metrics.energy_balance(vibration("midpoint", 0.0005, **changes))
    assert exact.damping_loss[-1] == pytest.approx(exact.total[0] - exact.total[-1], rel=1e-3)
    for integrator in ("bdf2", "generalised-alpha"):
        found = pc.metrics.energy_balance(vibration(integrator, 0.0005, **changes))
        lost = found.total[0] - found.total[-1]
        assert lost == pytest.approx(exact.damping_loss[-1], rel=0.03), integrator
        assert found.damping_loss[-1] == pytest.approx(exact.damping_loss[-1], rel=0.01), integrator


def test_the_terms_add_up_to_the_work_of_the_loads():
    problem = pc.discretise(beam((4, 1, 1), time={"step": 0.002, "integrator": "midpoint"}))
    run = pc.rollout(pc.Newton(problem), frames=30)
    balance = pc.metrics.energy_balance(run)
    fallen = problem.mass @ (problem.positions - run.positions[-1])[:, 2]
    assert balance.external_work[-1] == pytest.approx(9.81 * fallen, rel=1e-9)
    assert balance.total[-1] == pytest.approx(9.81 * fallen, rel=0.02)
    np.testing.assert_allclose(
        balance.dissipation,
        balance.external_work - balance.kinetic - balance.elastic,
        atol=1e-15,
    )


def pushed(integrator, step, mass="lumped"):
    """A beam whose clamp speeds up uniformly, still moving at the end."""
    times = [float(t) for t in np.arange(0.0, SPAN + 2.5 * step, step)]
    motion = {"times": times, "displacement": [[0.0, 0.0, 4.0 * t * t] for t in times]}
    scene = beam(
        (4, 1, 1), loads=[], clamps=[{**CLAMPED[0], "motion": motion}], solver={"mass": mass},
        time={"step": step, "integrator": integrator},
    )  # fmt: skip
    problem = pc.discretise(scene)
    run = pc.rollout(pc.Newton(problem), frames=round(SPAN / step))
    return pc.metrics.energy_balance(run)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "midpoint", "generalised-alpha"])
def test_the_work_of_a_moving_clamp_is_what_the_body_gains(integrator, mass):
    """Clamped nodes included: their inertia, an eighth of the mass, is counted once."""
    shares = []
    for step in (0.004, 0.001):
        balance = pushed(integrator, step, mass)
        shares.append(abs(balance.dissipation[-1]) / balance.clamp_work[-1])
    assert balance.kinetic[-1] > 0.5 * balance.clamp_work[-1] > 0
    assert shares[1] < 0.02
    assert shares[1] < 0.5 * shares[0]


def test_a_run_from_a_file_needs_the_problem_unless_it_starts_at_rest(tmp_path):
    moving = vibration("midpoint", 0.004)
    pc.save_trajectory(tmp_path / "run.h5", moving)
    read = pc.load_trajectory(tmp_path / "run.h5")
    with pytest.raises(InputError, match=r"energy_balance\(run, problem\)"):
        pc.metrics.energy_balance(read)
    known = pc.metrics.energy_balance(read, moving.problem)
    np.testing.assert_array_equal(known.total, pc.metrics.energy_balance(moving).total)
    assert known.elastic[0] == moving.problem.energy(moving.positions[0]) > 0

    falling = pc.rollout(pc.Newton(pc.discretise(beam((2, 1, 1)))), frames=2)
    np.testing.assert_array_equal(
        pc.metrics.energy_balance(replace(falling, problem=None)).dissipation,
        pc.metrics.energy_balance(falling).dissipation,
    )


def test_initial_velocities_count():
    problem = pc.discretise(beam((2, 1, 1), clamps=[], loads=[]))
    state = pc.State(problem.positions, np.full_like(problem.positions, 2.0))
    run = pc.rollout(pc.Newton(problem), frames=2, state=state)
    balance = pc.metrics.energy_balance(run)
    assert balance.kinetic == pytest.approx(0.5 * problem.mass.sum() * 12.0)
    assert np.abs(balance.dissipation).max() < 1e-9


def test_no_steps_and_missing_statistics():
    one = pc.rollout(pc.Newton(pc.discretise(beam((2, 1, 1)))), frames=1)
    start = {name: getattr(one, name)[:1] for name in ("positions", "velocities", "times")}
    none = replace(one, **start, stats={name: column[:0] for name, column in one.stats.items()})
    assert pc.metrics.energy_balance(none).dissipation.tolist() == [0.0]
    stats = {k: v for k, v in one.stats.items() if k != "clamp_work"}
    with pytest.raises(InputError, match="lack clamp_work"):
        pc.metrics.energy_balance(replace(one, stats=stats))
