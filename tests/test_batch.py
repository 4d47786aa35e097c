"""Many scenes in one batch are many scenes one by one."""

import gc
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam, box_mesh, held, problem_on
from pdcorrect.batch import decomposition, gpu
from pdcorrect.batch.cells import DistinctBodies
from pdcorrect.batch.points import Points
from pdcorrect.batch.triton_kernels import skinny_product
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem import energies
from pdcorrect.fem.decomposition import nearest_volume_lanes
from pdcorrect.fem.hyperelasticity import energy_code

VARIANTS = ["hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced"]
OTHER_HESSIANS = {"hex8-bubble-mean": "G", "hex8-enhanced": "G-scaled"}
DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]
on_every_device = pytest.mark.parametrize("device", DEVICES)


def unlike(seed, element="hex8", **changes):
    """A beam of random size, material, clamps and loads."""
    rng = np.random.default_rng(seed)
    cells = [int(rng.integers(3, 7)), int(rng.integers(1, 3)), int(rng.integers(1, 3))]
    clamps = [{"region": {"plane": "x", "at": 0.0}}]
    if seed % 3 == 1:
        clamps.append({"region": {"plane": "y", "at": 0.0}, "components": ["y"]})
    if seed % 4 == 3:
        clamps = []
    material = {
        "young": float(rng.uniform(1e5, 4e5)),
        "poisson": float(rng.uniform(0.1, 0.45)),
        "density": float(rng.uniform(800, 1400)),
    }
    torsion = {
        "kind": "torsion", "strength": float(rng.uniform(0, 3e4)), "stretch": 0.2,
        "follower": bool(seed % 2),
    }  # fmt: skip
    gravity = {"kind": "gravity", "acceleration": [float(a) for a in rng.uniform(-12, 12, 3)]}
    settings = {
        "clamps": clamps,
        "loads": [gravity, torsion],
        "material": material,
        "solver": {"element": element, "mass": ["lumped", "averaged", "consistent"][seed % 3]},
    }
    return beam(cells, float(rng.uniform(0.02, 0.05)), **{**settings, **changes})


def moving_states(problems, seed=0):
    """States that are strained and move, one for each problem."""
    out = []
    for i, problem in enumerate(problems):
        rng = np.random.default_rng(seed + i)
        x, free = problem.positions, problem.free
        p = x + 0.15 * problem.cell_size * rng.uniform(-0.5, 0.5, x.shape) * free
        out.append(pc.State(p, 0.5 * rng.normal(size=x.shape) * free))
    return out


def stepped(stepper, states, steps):
    batch = stepper.state(states)
    for _ in range(steps):
        result = stepper(batch)
        batch = result.state
    return stepper.states(batch), result


def alone(problem, state, steps, tolerance=1e-9):
    stepper = pc.ProjectiveDynamics(problem, tolerance)
    for _ in range(steps):
        state = stepper(state).state
    return state


def furthest(a, b):
    return np.abs(a.positions - b.positions).max()


# --- points ------------------------------------------------------------------------------------


def matrices():
    rng = np.random.default_rng(0)
    special = [np.zeros((3, 3)), np.diag([1.0, 0, 0]), np.diag([1.0, 1, 0]), -np.eye(3)]
    return np.concatenate(
        [
            rng.normal(size=(3000, 3, 3)),
            np.eye(3) + 0.3 * rng.normal(size=(3000, 3, 3)),
            np.eye(3) + 1e-9 * rng.normal(size=(100, 3, 3)),
            2.5 * np.eye(3) + 0.5 * rng.normal(size=(500, 3, 3)),
            (np.eye(3) + 0.3 * rng.normal(size=(100, 3, 3))) * [1.0, 1.0, 1e-7],
            special,
        ]
    )


def rows(F):
    return torch.as_tensor(np.ascontiguousarray(F.reshape(-1, 9).T))


def test_the_signed_svd_is_the_same_as_numbas():
    F = matrices()
    U, s, V = (torch.stack(a).numpy() for a in decomposition.signed_svd(list(rows(F))))
    _, expected, _ = energies.signed_svd(F)
    np.testing.assert_allclose(s.T, expected, atol=1e-13)
    U, V = U.T.reshape(-1, 3, 3), V.T.reshape(-1, 3, 3)
    np.testing.assert_allclose(U * s.T[:, None] @ V.swapaxes(1, 2), F, atol=3e-14)
    for Q in (U, V):
        np.testing.assert_allclose(Q @ Q.swapaxes(1, 2), np.tile(np.eye(3), (len(F), 1, 1)),
                                   atol=1e-13)  # fmt: skip
        assert (np.linalg.det(Q) > 0).all()


@pytest.mark.parametrize(
    "energy", ["corotated", "neo-hookean", "st-venant-kirchhoff", "linear-corotated"]
)
def test_stress_and_tangent_at_points_are_those_of_the_energies(energy):
    F = matrices()
    F = F[np.abs(np.linalg.det(F)) > 1e-3]  # off the kinks
    rng = np.random.default_rng(1)
    mu, omega = rng.uniform(1, 2, (2, len(F)))
    points = Points(energy_code(energy), 0, 1)
    weights = torch.as_tensor(np.stack([mu, omega]))
    H = rows(F - np.eye(3))
    density, P = points.stress(H, weights)
    np.testing.assert_allclose(density, energies.energy_density(F, mu, omega, energy), rtol=1e-10,
                               atol=1e-13)  # fmt: skip
    exact = energies.first_piola(F, mu, omega, energy)
    scale = 1 + np.abs(exact).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(P.numpy().T.reshape(-1, 3, 3) / scale, exact / scale, atol=1e-11)
    D = rng.normal(size=F.shape)
    found = points.product(points.tangent(H, weights), rows(D)).numpy().T.reshape(-1, 3, 3)
    C = energies.elasticity(F, mu, omega, energy=energy)
    exact = np.einsum("nijkl,nkl->nij", C, D)
    scale = 1 + np.abs(C).max(axis=(1, 2, 3, 4))[:, None, None]
    np.testing.assert_allclose(found / scale, exact / scale, atol=1e-9)


@on_every_device
def test_products_with_few_columns_are_matrix_products(device):
    torch.manual_seed(0)
    for size, columns in ((300, 3), (517, 1), (261, 4), (64, 7)):
        A = torch.randn(3, size, size, device=device)
        x = torch.randn(3, size, columns, device=device)
        torch.testing.assert_close(skinny_product(A, x), A @ x, rtol=1e-4, atol=1e-4)


# --- batch and single ---------------------------------------------------------------------------


@on_every_device
def test_a_dozen_unlike_scenes_step_as_each_alone(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(12)]
    states = moving_states(problems)
    stepper = pc.BatchStepper(problems, 1e-9, device=device, recover=False)
    found, result = stepped(stepper, states, 2)
    assert set(result.statuses) == {pc.Status.CONVERGED}
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 2), after) < 1e-9
        assert after.time == pytest.approx(2 * problem.time_step)


@on_every_device
@pytest.mark.parametrize(
    ("element", "first_hessian"),
    [(element, OTHER_HESSIANS.get(element, "rest")) for element in VARIANTS[1:]],
)
def test_so_they_do_with_every_element_and_first_hessian(element, first_hessian, device):
    problems = [pc.discretise(unlike(seed, element)) for seed in range(3)]
    states = moving_states(problems)
    stepper = pc.BatchStepper(
        problems, 1e-9, first_hessian=first_hessian, device=device, recover=False
    )
    found, result = stepped(stepper, states, 1)
    assert set(result.statuses) == {pc.Status.CONVERGED}
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 1), after) < 1e-9


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_scenes_that_differ_by_loads_alone_step_as_if_they_shared_nothing(element):
    """To the bit: what is computed once for them is what each would have by itself."""
    scenes = [unlike(seed, element) for seed in (1, 5, 9)]  # two kinds of clamps, three sizes
    others = [{"kind": "gravity", "acceleration": a} for a in ([3.0, -7.0, 1.0], [0.0, 2.0, 9.0])]
    settings = {"mass": "averaged", "tolerance": 1e-4}
    scenes = [s.with_changes(solver={**settings, "element": element}) for s in scenes]
    pairs = [(s, loads) for s in scenes for loads in (list(s.loads), others[:1], others[1:])]
    own = [pc.discretise(s) for s in scenes]
    shared = [own[i // 3].with_loads(loads) for i, (_, loads) in enumerate(pairs)]
    apart = [pc.discretise(s.with_changes(loads=loads)) for s, loads in pairs]
    order = [4, 0, 8, 1, 3, 7, 2, 6, 5]
    one, other = (pc.BatchStepper([p[i] for i in order]) for p in (shared, apart))
    assert len(one.cells.bodies.distinct) == 3
    assert len(other.cells.bodies.distinct) == 9
    states = moving_states(shared)
    a, b = (stepper(stepper.state([states[i] for i in order])) for stepper in (one, other))
    assert torch.equal(a.y, b.y)
    assert (a.iterations == b.iterations).all()
    assert torch.equal(one.objective.mass.nodal, other.objective.mass.nodal)


def test_bodies_with_other_materials_or_mass_rules_are_not_one():
    problem = pc.discretise(unlike(1))
    twins = [problem, problem.with_loads([]), problem.with_material(density=900.0)]
    found = DistinctBodies.of([*twins, pc.discretise(unlike(1)), problem])
    assert found.owners.tolist() == [0, 0, 1, 2, 0]
    assert [p is q for p, q in zip(found.distinct, (twins[0], twins[2]), strict=False)] == [
        True
    ] * 2


def test_scenes_with_the_same_matrix_share_one_inverse():
    loads = [[{"kind": "gravity", "acceleration": [0.0, a, -9.81]}] for a in (0.0, 3.0, 5.0)]
    problems = [pc.discretise(beam((4, 1, 1), loads=load)) for load in loads]
    problems.append(pc.discretise(beam((4, 1, 1), poisson=0.3)))
    stepper = pc.BatchStepper(problems, 1e-9, first_hessian="G", recover=False)
    found, _ = stepped(stepper, [p.rest_state() for p in problems], 2)
    assert stepper._minimiser._inverse.count == 2
    for problem, after in zip(problems, found, strict=True):
        assert furthest(alone(problem, problem.rest_state(), 2), after) < 1e-9


@on_every_device
def test_a_scene_of_nan_and_one_that_cannot_converge_fail_alone(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(9)]
    absurd = [{"kind": "gravity", "acceleration": [0.0, 0.0, -1e12]}]
    problems[4] = pc.discretise(unlike(4, loads=absurd))
    states = moving_states(problems)
    positions = states[7].positions.copy()
    positions[3, 1] = np.nan
    states[7] = replace(states[7], positions=positions)
    stepper = pc.BatchStepper(problems, 1e-9, device=device, recover=False, max_iterations=60)
    found, result = stepped(stepper, states, 1)
    assert result.statuses[7] is pc.Status.NOT_FINITE
    assert not result.statuses[4].ok
    for i, (problem, state) in enumerate(zip(problems, states, strict=True)):
        if i not in (4, 7):
            assert result.statuses[i] is pc.Status.CONVERGED
            assert furthest(alone(problem, state, 1), found[i]) < 1e-9


def test_scenes_that_fail_are_tried_again_alone():
    problems = [pc.discretise(unlike(seed, "hex8-bubble")) for seed in range(4)]
    states = moving_states(problems)
    stepper = pc.BatchStepper(problems, 1e-9, first_hessian="G", max_iterations=8)
    found, result = stepped(stepper, states, 1)
    assert pc.Status.RECOVERED in result.statuses
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 1), after) < 1e-9


def test_they_are_tried_with_the_material_that_they_have():
    problem = pc.discretise(beam((3, 1, 1)))
    state = moving_states([problem])[0]
    stepper = pc.BatchStepper([problem], 1e-9, max_iterations=1)
    values = {"young": 2e5, "poisson": 0.2, "density": 1500.0}
    stepper.set_material(*(torch.tensor([[v]], dtype=torch.float64) for v in values.values()))
    found, result = stepped(stepper, [state], 1)
    assert result.statuses == [pc.Status.RECOVERED]
    assert furthest(alone(problem.with_material(**values), state, 1), found[0]) < 1e-9
    stepper.set_material()
    found, _ = stepped(stepper, [state], 1)
    assert furthest(alone(problem, state, 1), found[0]) < 1e-9


@on_every_device
def test_single_precision_reaches_a_loose_tolerance(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(4)]
    stepper = pc.BatchStepper(problems, 1e-3, dtype=torch.float32, device=device, recover=False)
    found, result = stepped(stepper, [p.rest_state() for p in problems], 2)
    assert all(s.ok for s in result.statuses)
    for problem, after in zip(problems, found, strict=True):
        exact = alone(problem, problem.rest_state(), 2)
        assert furthest(exact, after) < 5e-3 * problem.cell_size


def test_batches_that_cannot_be_are_refused_by_name():
    def batch(*scenes, **options):
        return pc.BatchStepper([pc.discretise(scene) for scene in scenes], **options)

    with pytest.raises(InputError, match="no problems"):
        pc.BatchStepper([])
    with pytest.raises(InputError, match="element = 'hex8-mean'"):
        batch(unlike(0), unlike(1, "hex8-mean"))
    with pytest.raises(InputError, match=r"time\.step"):
        batch(unlike(0), unlike(1, time={"step": 0.02}))
    radii = ({"integrator": "generalised-alpha", "spectral_radius": r} for r in (0.5, 0.8))
    with pytest.raises(InputError, match=r"time\.spectral_radius"):
        batch(*(unlike(i, time=time) for i, time in enumerate(radii)))
    for name in ("viscosity", "stiffness", "mass"):
        with pytest.raises(InputError, match=rf"damping\.{name}"):
            batch(unlike(0), unlike(1, damping={name: 0.1}))
    adrift = batch(beam((2, 1, 1), clamps=[], loads=[]), integrator="quasi-static")
    with pytest.raises(ConvergenceError, match="scene 'scene'"):
        adrift(adrift.rest_state())
    stepper = batch(unlike(0), unlike(1))
    with pytest.raises(InputError, match="1 states: expected 2"):
        stepper.state([stepper.problems[0].rest_state()])
    with pytest.raises(InputError, match="state 1 has"):
        stepper.state([stepper.problems[0].rest_state()] * 2)


# --- what one scene or step must not do to others ------------------------------------------------


def test_a_stretch_nearest_to_unit_volume_is_that_of_the_other_home():
    """Also next to a uniform expansion, where one candidate vanishes, and inside out."""
    rng = np.random.default_rng(2)
    sizes = np.concatenate([np.linspace(0.01, 12.0, 300), [1.587, 1.8899, 2.0]])
    shapes = [(1 + d, 1 + e * d, sign) for d in (0, 1e-9, 1e-5, 1e-3, 0.03, 0.3, 3.0)
              for e in (0.0, 0.5, 1.0) for sign in (1, -1, 1e-9, -1e-9)]  # fmt: skip
    uniform = (sizes[:, None, None] * np.array(shapes)).reshape(-1, 3)
    random = np.sort(np.exp(rng.normal(scale=1.5, size=(5000, 3))), axis=1)[:, ::-1]
    random[::3, 2] *= -1
    s = np.concatenate([uniform, random, [(5.894, 5.877, 5.874), (1.736, 1.663, 1.659)]]).T.copy()
    exact, k = np.empty_like(s), np.empty(s.shape[1])
    nearest_volume_lanes(s, exact, k, 0)
    v, found_k = decomposition.nearest_volume(list(torch.as_tensor(s)))
    v = torch.stack(v).numpy()
    distance, least = ((v - s) ** 2).sum(axis=0), ((exact - s) ** 2).sum(axis=0)
    np.testing.assert_allclose(v.prod(axis=0), 1.0, rtol=1e-7)
    np.testing.assert_allclose(distance, least, rtol=1e-7, atol=1e-10)
    unique = np.abs(v - exact).max(axis=0) < 1e-6  # where two are as near, either will do
    assert unique.mean() > 0.999
    np.testing.assert_allclose(found_k.numpy()[unique], k[unique], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("factors", [(5.894, 5.877, 5.874), (4, 4, 4), (1.736, 1.663, 1.659)])
def test_bodies_that_are_blown_up_have_the_energy_of_single_ones(factors):
    problem = pc.discretise(beam((2, 2, 2), poisson=0.45, clamps=[], loads=[]))
    stepper = pc.BatchStepper([problem])
    positions = problem.positions * factors
    energy, forces = stepper.cells.energy_and_forces(torch.as_tensor(positions)[None])
    assert float(energy) == pytest.approx(problem.energy(positions), rel=1e-9)
    exact = problem.forces(positions)
    if len(set(factors)) == 3:  # else any direction may be the flattened one
        np.testing.assert_allclose(forces[0], exact, atol=1e-7 * np.abs(exact).max())


def test_a_failed_step_leaves_nothing_behind():
    problems = [pc.discretise(beam((2, 1, 1)))] * 2
    stepper = pc.BatchStepper(problems, 1e-9, recover=False)
    bad = stepper.rest_state()
    bad.positions[0] = torch.nan
    statuses = stepper(bad).statuses
    assert statuses == [pc.Status.NOT_FINITE, pc.Status.CONVERGED]
    rest = stepper.rest_state()
    result = stepper(rest)
    assert result.statuses == [pc.Status.CONVERGED] * 2
    torch.testing.assert_close(result.y[0], result.y[1], rtol=0, atol=1e-12)
    gradients = pc.BatchGradients(stepper, rest, result, torch.ones_like(rest.positions))
    assert gradients.ok.all()


@pytest.mark.parametrize(("built", "given"), [(0.3, 0.0), (0.0, 0.4)])
def test_poissons_ratio_may_become_zero_and_leave_it_again(built, given):
    problem = pc.discretise(beam((3, 1, 1), poisson=built))
    stepper, state = pc.BatchStepper([problem], 1e-9), moving_states([problem])[0]
    for poisson in (given, 0.4, None):
        stepper.set_material(poisson=poisson)
        found, _ = stepped(stepper, [state], 1)
        values = {"young": 1e6, "poisson": built if poisson is None else poisson}
        assert furthest(alone(problem.with_material(**values), state, 1), found[0]) < 1e-9


def test_an_energy_without_a_volume_term_stays_without():
    problem = pc.discretise(beam((2, 1, 1), material={"energy": "corotated-only"}))
    stepper, state = pc.BatchStepper([problem], 1e-9), problem.rest_state()
    exact = alone(problem, state, 1)
    stepper.set_material(poisson=0.1, young=1e6 * 1.1 / 1.45)  # the same mu
    found, _ = stepped(stepper, [state], 1)
    assert furthest(exact, found[0]) < 1e-9


@pytest.fixture(scope="module")
def named():
    """A stepper of two scenes with names, its state at rest and a step from there."""
    problems = [pc.discretise(beam((n, 1, 1), poisson=0.3, name=f"n{n}")) for n in (2, 3)]
    stepper = pc.BatchStepper(problems, 1e-9)
    rest = stepper.rest_state()
    return stepper, rest, stepper(rest)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("young", -1e5), ("young", 0.0), ("young", np.inf), ("density", -1.0),
        ("density", np.nan), ("poisson", -0.2), ("poisson", 0.5), ("poisson", np.nan),
    ],
)  # fmt: skip
def test_materials_out_of_range_are_refused_and_leave_the_stepper_alone(name, value, named):
    stepper, rest, expected = named
    good = {"young": 1e6, "poisson": 0.3, "density": 1e3}[name]
    given = torch.tensor([[good], [value]], dtype=torch.float64)
    message = rf"{name} of cell 0 in scene 1 \('n3'\) is .*: expected a finite number"
    with pytest.raises(InputError, match=message):
        stepper.set_material(**{name: given})
    again = stepper(rest)
    assert torch.equal(again.y, expected.y)
    assert again.statuses == expected.statuses
    assert (again.iterations == expected.iterations).all()


def test_a_scene_without_a_minimum_fails_alone():
    scenes = [beam((2, 1, 1)), beam((2, 1, 1), clamps=[])]
    problems = [pc.discretise(s) for s in scenes]
    for recover in (False, True):
        stepper = pc.BatchStepper(problems, integrator="quasi-static", recover=recover)
        statuses = stepper(stepper.rest_state()).statuses
        assert [s.ok for s in statuses] == [True, False]


def test_steps_of_another_length_start_bdf2_anew():
    time = {"integrator": "bdf2", "step": 0.01}
    problems = [pc.discretise(unlike(seed, time=time)) for seed in range(2)]
    states = [alone(p, s, 2) for p, s in zip(problems, moving_states(problems), strict=True)]
    stepper = pc.BatchStepper(problems, 1e-9, time_step=0.005, recover=False)
    found, _ = stepped(stepper, states, 1)
    for problem, state, after in zip(problems, states, found, strict=True):
        exact = pc.ProjectiveDynamics(problem, 1e-9, time_step=0.005)(state).state
        assert furthest(exact, after) < 1e-9
    mixed = stepper.state([states[0], found[1]])
    with pytest.raises(InputError, match="scene 0 "):
        stepper(mixed)


def test_float32_does_not_lose_the_memory_of_bdf2():
    problem = pc.discretise(beam((2, 1, 1), time={"integrator": "bdf2"}))
    stepper = pc.BatchStepper([problem], 1e-3, dtype=torch.float32)
    result = stepper(stepper.rest_state())
    late = result.state.times[0] + 7.3
    memory = {**result.state.memory}
    memory["previous_times"] = memory["previous_times"] + 7.3
    state = replace(result.state, times=(late,), memory=memory)
    assert stepper.prepare(state).scheme.inertia == pytest.approx(2.25 / problem.time_step**2)


def test_threads_may_share_a_stepper():
    problems = [pc.discretise(unlike(seed)) for seed in range(2)]
    stepper = pc.BatchStepper(problems, 1e-9)
    states = [stepper.state(moving_states(problems, seed)) for seed in (0, 10, 20, 30)]
    expected = [stepper(s).y for s in states]
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(4) as pool:
        found = [r.y for r in pool.map(stepper, states)]
        assert set(pool.map(lambda _: torch.get_num_threads(), range(8))) == {threads}
    assert torch.get_num_threads() == threads
    for a, b in zip(found, expected, strict=True):
        assert torch.equal(a, b)


def test_inverted_cells_are_told():
    scenes = [beam((2, 1, 1), loads=[]), beam((3, 1, 1), clamps=[], loads=[], poisson=0.0)]
    problems = [pc.discretise(s) for s in scenes]
    states = [p.rest_state() for p in problems]
    mirrored = states[1].positions * [1.0, 1.0, -1.0]
    states[1] = pc.State(mirrored, states[1].velocities)
    single = pc.ProjectiveDynamics(problems[1], time_step=1e-5)(states[1])
    stepper = pc.BatchStepper(problems, time_step=1e-5)
    result = stepper(stepper.state(states))
    assert single.status is pc.Status.INVERTED
    assert result.statuses == [pc.Status.CONVERGED, pc.Status.INVERTED]
    for problem, state, ratio in zip(
        problems, stepper.states(result.state), result.smallest_volume_ratios, strict=True
    ):
        assert ratio == pytest.approx(problem.volume_ratios(state.positions).min(), abs=1e-12)


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_volume_ratios_do_not_see_the_padding(element):
    settings = {"clamps": [], "loads": [], "solver": {"element": element}}
    problems = [pc.discretise(beam((n, 1, 1), **settings)) for n in (1, 3)]
    cells = pc.BatchStepper(problems).cells
    states = [2.0 * p.positions + 0.7 for p in problems]
    ratios = cells.volume_ratios(cells.nodal(states)).amin(dim=1)
    np.testing.assert_allclose(ratios, 8.0, rtol=1e-12)


def test_a_step_in_inference_mode_changes_nothing_later():
    problem = pc.discretise(beam((2, 1, 1)))
    with torch.inference_mode():
        stepper = pc.BatchStepper([problem], 1e-9)
        first = stepper(stepper.rest_state())
    state = stepper.rest_state()
    state.positions.requires_grad_()
    again = stepper(state, torch.zeros_like(state.positions, requires_grad=True))
    assert torch.equal(first.y, again.y)
    assert not again.y.requires_grad
    gradients = pc.BatchGradients(stepper, state, again, state.positions * 1.0)
    assert not gradients.density.requires_grad


def test_clamps_hold_where_they_are_told_to():
    """Not where the body is at rest."""
    problem = pc.discretise(beam((3, 1, 1), loads=[]))
    nodes = np.flatnonzero(~problem.free.all(axis=1))
    positions = problem.positions.copy()
    positions[nodes] += [0.002, 0.001, 0.0]
    moved = held(problem, nodes, positions)
    found, _ = stepped(pc.BatchStepper([moved], 1e-9), [moved.rest_state()], 1)
    assert furthest(alone(moved, moved.rest_state(), 1), found[0]) < 1e-9


def test_each_scene_has_its_own_tolerance():
    tolerances = (1e-2, 1e-10)
    problems = [
        pc.discretise(unlike(seed, solver={"tolerance": tolerance}))
        for seed, tolerance in enumerate(tolerances)
    ]
    states = moving_states(problems)
    found, result = stepped(pc.BatchStepper(problems), states, 1)
    assert furthest(alone(problems[1], states[1], 1, 1e-11), found[1]) < 2e-10
    assert result.error_estimates[1] <= 1e-10 * problems[1].cell_size


def test_editing_a_state_does_not_change_what_was_solved():
    problem = pc.discretise(beam((2, 1, 1), damping={"mass": 0.5}))
    stepper = pc.BatchStepper([problem], 1e-9)
    before = stepper.rest_state()
    result = stepper(before)
    g = torch.ones_like(before.positions)
    exact = pc.BatchGradients(stepper, before, result, g).density
    late = pc.BatchGradients(stepper, before, result, g)
    result.state.positions.zero_()
    before.positions.add_(1.0)
    torch.testing.assert_close(late.density, exact)


def test_a_stepper_can_be_copied():
    """With follower loads, and after a step."""
    problem = pc.discretise(unlike(1))
    assert any(load.sample is not None for load in problem.loads)
    pressure = [{"kind": "pressure", "region": {"plane": "z", "at": 0.05}, "pressure": 100.0}]
    other = pc.discretise(beam((2, 1, 1), 0.05, loads=[{**pressure[0], "follower": True}]))
    stepper = pc.BatchStepper([problem, other], 1e-9)
    first = stepper(stepper.rest_state())
    copy = pickle.loads(pickle.dumps(stepper))
    assert torch.equal(copy(copy.rest_state()).y, first.y)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("first_hessian", "foo"), ("integrator", "euler"), ("integrator", ["midpoint"]),
        ("time_step", -0.01), ("time_step", 0), ("time_step", "0.01"), ("time_step", True),
        ("tolerance", -1.0), ("tolerance", 0), ("tolerance", np.nan), ("tolerance", [1e-3]),
        ("max_iterations", -1), ("max_iterations", 0), ("max_iterations", 2.0),
        ("dtype", torch.float16), ("dtype", torch.int64), ("dtype", "float32"),
        ("storage", "float32"), ("device", "gpu"), ("device", 3.5), ("device", "meta"),
        ("device", "cuda:99"),
    ],
)  # fmt: skip
def test_options_that_make_no_sense_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        pc.BatchStepper([pc.discretise(beam((2, 1, 1)))], **{name: value})


def two(**options):
    """A batch of two scenes of unlike size, its state at rest and a step from it."""
    stepper = pc.BatchStepper([pc.discretise(beam((n, 1, 1))) for n in (2, 3)], **options)
    rest = stepper.rest_state()
    return stepper, rest, stepper(rest)


@pytest.fixture(scope="module")
def two_that_refuse():
    """One such batch for all calls that are refused, and so leave it as it is."""
    return two()


WRONG = {
    "few times": (lambda s, r, o: s(replace(r, times=(0.0,))), r"times = \(0\.0,\): expected 2"),
    "no times": (lambda s, r, o: s(replace(r, times=None)), "times = None: expected 2"),
    "array forces": (lambda s, r, o: s(r, r.positions.numpy()), "forces: a ndarray"),
    "flat forces": (lambda s, r, o: s(r, r.positions[0]), r"forces: \(16, 3\); expected \(2, 16"),
    "float32": (
        lambda s, r, o: s.states((r.positions.float(), r.velocities)),
        r"positions: torch\.float32 on cpu; expected a tensor of torch\.float64 .*dtype=",
    ),
    "young of scenes": (
        lambda s, r, o: s.set_material(torch.full((2,), 1e5, dtype=torch.float64)),
        r"young: \(2,\).*one value a scene is \(2, 1\)",
    ),
    "density in float32": (
        lambda s, r, o: s.set_material(density=torch.ones(1, 1)), r"density: torch\.float32",
    ),
    "others": (
        lambda s, r, o: pc.BatchGradients(pc.BatchStepper(s.problems[:1]), r, o), "positions: ",
    ),
    "another step": (lambda s, r, o: pc.BatchGradients(s, o.state, o), r"a step of 0\.01 s"),
    "array": (lambda s, r, o: pc.BatchGradients(s, r, o, r.positions.numpy()), "grad_positions: a"),
    "tolerance": (lambda s, r, o: pc.BatchGradients(s, r, o, tolerance=0), "tolerance = 0"),
    "no memory": (
        lambda s, r, o: pc.BatchGradients(s, r, o, grad_memory={"momentum": r.positions}),
        "grad_memory has 'momentum'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_arguments_of_the_wrong_kind_are_named(what, two_that_refuse):
    call, message = WRONG[what]
    with pytest.raises(InputError, match=message):
        call(*two_that_refuse)


def test_a_result_keeps_its_numbers():
    """Whatever steps come later."""
    stepper, rest, result = two()
    names = ("iterations", "evaluations", "error_estimates", "smallest_volume_ratios")
    before = [getattr(result, name).copy() for name in names]
    y = result.y.clone()
    stretched = [pc.State(1.2 * s.positions, s.velocities) for s in stepper.states(rest)]
    later = stepper(stepper.state(stretched))
    assert (later.iterations != result.iterations).any()
    for name, value in zip(names, before, strict=True):
        np.testing.assert_array_equal(getattr(result, name), value)
    assert torch.equal(result.y, y)


def test_padding_is_told():
    stepper, rest, result = two()
    assert stepper.node_counts == (12, 16)
    assert stepper.node_mask.sum(dim=1).tolist() == [12, 16]
    assert not rest.positions[~stepper.node_mask].any()
    pair = (result.state.positions, result.state.velocities)
    for found in (stepper.states(pair, result.state.times), stepper.states(result.state)):
        assert [s.positions.shape for s in found] == [(12, 3), (16, 3)]
        assert [s.time for s in found] == list(result.state.times)
        np.testing.assert_array_equal(found[0].velocities, pair[1][0, :12])
    assert [s.time for s in stepper.states(pair)] == [0.0, 0.0]


# --- more kinds of scenes ------------------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_distorted_meshes_step_as_alone(element):
    problems = [
        problem_on(box_mesh((n, 2, 2), (0.1 * n, 0.2, 0.2), 0.2, seed=n), element) for n in (2, 3)
    ]
    states = moving_states(problems)
    found, result = stepped(pc.BatchStepper(problems, 1e-9, recover=False), states, 1)
    assert all(s.ok for s in result.statuses)
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 1), after) < 1e-9


def test_loads_act_at_each_scenes_own_time_and_on_each_nodes_own_mass():
    gravity = {"kind": "gravity", "acceleration": [0, 0, -9.81], "table": [[0, 0], [1, 1]]}
    heavy = [{"region": {"box": [[-1, -1, -1], [0.05, 1, 1]]}, "density": 3000.0}]
    problems = [pc.discretise(unlike(seed, loads=[gravity], materials=heavy)) for seed in range(2)]
    states = [
        pc.State(s.positions, s.velocities, time)
        for s, time in zip(moving_states(problems), (0.2, 0.7), strict=True)
    ]
    found, _ = stepped(pc.BatchStepper(problems, 1e-9), states, 1)
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 1), after) < 1e-9
        assert after.time == state.time + problem.time_step


def test_a_volume_term_alone_is_solved_one_by_one():
    """Its Hessian is singular at rest; single scenes renew their first Hessian on the way."""
    problem = pc.discretise(beam((3, 1, 1), material={"energy": "volume-only"}))
    stepper = pc.BatchStepper([problem], 1e-9, max_iterations=100)
    found, result = stepped(stepper, [problem.rest_state()], 1)
    assert result.statuses[0].ok
    assert furthest(alone(problem, problem.rest_state(), 1), found[0]) < 1e-9


@on_every_device
def test_a_stepper_that_is_dropped_frees_its_memory_at_once(device):
    problems = [pc.discretise(unlike(k)) for k in range(3)]
    stepper = pc.BatchStepper(problems, device=device)
    stepper(stepper.rest_state())
    known = weakref.ref(stepper._minimiser), weakref.ref(stepper)
    gc.disable()
    try:
        del stepper
        assert [ref() for ref in known] == [None, None]
    finally:
        gc.enable()


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_points_do_not_depend_on_how_their_numbers_lie_in_memory(element):
    problem = pc.discretise(unlike(0, element))
    stepper = pc.BatchStepper([problem, problem])
    cells, y = stepper.cells, stepper.cells.rest.clone()
    y += 1e-3 * torch.as_tensor(np.random.default_rng(0).normal(size=y.shape))
    H = cells.gradients(y - cells.rest)
    apart = H.transpose(0, 1).contiguous().transpose(0, 1)  # as on a GPU
    assert H.stride() != apart.stride()
    for a, b in zip(
        cells.points.stress(H, cells.point_weights),
        cells.points.stress(apart, cells.point_weights),
        strict=True,
    ):  # fmt: skip
        assert torch.equal(a, b)
    assert torch.equal(cells.gathered(H), cells.gathered(apart))


def test_no_garbage_is_collected_while_work_is_recorded():
    seen = []

    def fail():
        seen.append(gc.isenabled())
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), gpu._no_collection():
        fail()
    assert seen == [False]
    assert gc.isenabled()
