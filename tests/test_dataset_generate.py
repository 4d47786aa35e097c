"""Generation: what is computed, that it does not depend on who computes, and interruptions."""

import contextlib
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import pdcorrect as pc
from dataset_configs import small
from pdcorrect._files import INTERRUPTED, clear_parts, part_of_process
from pdcorrect.data.check import check_dataset
from pdcorrect.data.engines import OneByOne
from pdcorrect.data.generate import generate
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.data.schema import MANIFEST, read_shard
from pdcorrect.data.simulate import Engines, simulate
from pdcorrect.data.workers import Workers, local_scheduler, make_engines
from pdcorrect.errors import ConvergenceError, FileFormatError, InputError
from pdcorrect.scene import trained_coarse

distributed = pytest.importorskip("distributed")
psutil = pytest.importorskip("psutil")


def all_shards(folder):
    return {str(p.relative_to(folder).with_suffix("")): read_shard(p) for p in folder.rglob("*.h5")}


def hashes(folder):
    return json.loads((folder / MANIFEST).read_text())["files"]


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "set"
    seen = []
    config = small()
    assert generate(config, folder, on_file=lambda *row: seen.append(row))
    names = [plan.name for plan in make_plan(config)]
    assert seen == [(name, done, 4, done) for name, done in zip(names, (1, 3, 4), strict=True)]
    return config, folder


def test_a_generated_data_set_passes_its_check_and_its_runs_are_what_a_user_gets(generated):
    _, folder = generated
    assert check_dataset(folder) == []

    config, folder = generated
    plan = make_plan(config)[1]
    simulation = read_shard(folder / f"{plan.name}.h5").simulations[1]
    scene = pc.Scene.from_toml(simulation.scene_toml)
    assert scene == draw_scene(config, plan, 1, simulation.attempt)
    coarse = pc.discretise(scene)
    best = trained_coarse(scene)
    for name, problem in (
        ("plain", coarse), ("best", pc.discretise(best)), ("reference", pc.discretise(best, 2)),
    ):  # fmt: skip
        run = pc.rollout(pc.ProjectiveDynamics(problem))
        own = pc.restrict(run, to=coarse).positions
        kept = simulation.runs[name].positions
        np.testing.assert_allclose(kept, own, atol=3e-6 * config.cell_size + 1e-7)
    forces = [coarse.external_forces(t * 0.01, (t + 1) * 0.01) for t in range(config.frames)]
    np.testing.assert_allclose(simulation.forces, forces, rtol=1e-6)


@pytest.mark.parametrize("name", ["plain", "best"])
def test_predictions_are_single_steps_from_the_reference(generated, name):
    config, folder = generated
    simulation = read_shard(folder / "training/mesh-0001.h5").simulations[0]
    scene = pc.Scene.from_toml(simulation.scene_toml)
    stepper = pc.ProjectiveDynamics(
        pc.discretise(trained_coarse(scene) if name == "best" else scene)
    )
    truth = simulation.runs["reference"].positions.astype(float)
    before = np.concatenate([truth[:1], truth])[:-1]
    for t, prediction in enumerate(simulation.runs[name].predictions):
        velocities = (truth[t] - before[t]) / config.step
        found = stepper(pc.State(truth[t], velocities, t * config.step))
        # velocities from differences of stored float32 positions
        np.testing.assert_allclose(prediction, found.state.positions, atol=2e-6)


def test_evaluation_has_the_models_and_runs_that_training_leaves_out(generated):
    _, folder = generated
    shard = read_shard(folder / "evaluation/mesh-0000.h5")
    assert set(shard.simulations[0].runs) == {"reference", "plain", "best"}  # refine is 2
    config = small(
        setting="as-published",
        reference={"refine": 3},
        frames=1,
    )
    (shard,) = simulate(config, make_plan(config)[-1:], make_engines(config, "cpu"))
    runs = shard.simulations[0].runs
    assert set(runs) == {"reference", "plain", "intermediate", "total-mass"}
    masses = {name: run.attributes["total_mass"] for name, run in runs.items()}
    assert masses["plain"] > 1.3 * masses["reference"]
    assert masses["total-mass"] == pytest.approx(masses["reference"])

    config = small(converged_steps=4, finest_meshes=1)
    (shard,) = simulate(config, make_plan(config)[-1:], make_engines(config, "cpu"))
    runs = shard.simulations[0].runs
    assert runs["time-converged"].attributes["time_step"] == config.step / 4
    assert runs["finest"].attributes["refine"] == 4
    distance = np.abs(runs["time-converged"].positions - runs["reference"].positions).max()
    assert 1e-5 < distance < 0.01


def test_newton_as_reference_agrees_with_pd():
    config = small(frames=2, training={"meshes": 1, "simulations": 1})
    plan = make_plan(config)[:1]
    found = []
    for solver in ("pd", "newton"):
        chosen = small(
            frames=2, training={"meshes": 1, "simulations": 1},
            reference={"refine": 2, "solver": solver},
        )  # fmt: skip
        (shard,) = simulate(chosen, plan, make_engines(chosen, "cpu"))
        run = shard.simulations[0].runs["reference"]
        assert run.attributes["solver"] == solver
        assert shard.simulations[0].runs["plain"].attributes["solver"] == "pd"
        found.append(run.positions)
    np.testing.assert_allclose(*found, atol=2e-5 * config.cell_size)


def test_batches_agree_with_one_by_one():
    pytest.importorskip("torch")
    from pdcorrect.data.batch_engine import Batched

    config = small(frames=2, tolerance=1e-7)
    plans = make_plan(config)[:2]
    batched = Batched("cpu", config.tolerance, most=4)
    alone = OneByOne("pd", config.tolerance)
    found = [
        simulate(config, plans, Engines(engine, engine)) for engine in (batched, alone)
    ]  # fmt: skip
    for one, other in zip(*found, strict=True):
        for a, b in zip(one.simulations, other.simulations, strict=True):
            assert a.runs.keys() == b.runs.keys()
            for name in a.runs:
                x, y = a.runs[name], b.runs[name]
                np.testing.assert_allclose(x.positions, y.positions, atol=1e-8)
                if y.predictions is not None:
                    np.testing.assert_allclose(x.predictions, y.predictions, atol=1e-8)
                ratios = [r.statistics["smallest_volume_ratios"] for r in (x, y)]
                np.testing.assert_allclose(*ratios, atol=1e-6)


class Failing(OneByOne):
    """Fails the first rollouts of refined meshes."""

    def __init__(self, times):
        super().__init__("pd", 1e-4)
        self.times = times

    def rollouts(self, problems, steps, divisor=1):
        found = super().rollouts(problems, steps, divisor)
        if problems[0].refine == 1 or self.times <= 0:
            return found
        self.times -= 1
        return [dataclasses.replace(found[0], failure="step 1: broke"), *found[1:]]


def test_a_rejected_load_is_noted_and_drawn_again():
    config = small(frames=1, training={"meshes": 1, "simulations": 2})
    plan = make_plan(config)[0]
    engine = Failing(2)
    (shard,) = simulate(config, [plan], Engines(engine, engine))
    first, second = shard.simulations
    assert (first.attempt, second.attempt) == (2, 0)
    assert first.rejected == ("reference, step 1: broke",) * 2
    assert first.scene_toml == draw_scene(config, plan, 0, attempt=2).to_toml()
    engine = Failing(1000)
    with pytest.raises(ConvergenceError, match="20 loads"):
        simulate(config, [plan], Engines(engine, engine))


def test_two_workers_write_the_same_as_one(generated, tmp_path):
    config, folder = generated
    assert generate(config, tmp_path / "two", Workers(2))
    assert hashes(tmp_path / "two") == hashes(folder)


def test_a_part_can_be_generated_first_and_the_rest_later(generated, tmp_path):
    config, folder = generated
    assert not generate(config, tmp_path, splits=["evaluation"], seconds=0.0)
    assert generate(config, tmp_path, splits=["evaluation"])
    assert sorted(all_shards(tmp_path)) == ["evaluation/mesh-0000"]
    assert not (tmp_path / "manifest.json").exists()
    assert not generate(config, tmp_path, seconds=0.0)
    assert generate(config, tmp_path)
    assert (tmp_path / "manifest.json").exists()
    assert hashes(tmp_path) == hashes(folder)


def test_a_damaged_file_is_made_again_and_a_whole_one_is_not(generated, tmp_path):
    config, folder = generated
    generate(config, tmp_path)
    target = tmp_path / "training/mesh-0001.h5"
    data = bytearray(target.read_bytes())
    data[len(data) // 2] ^= 1
    target.write_bytes(data)
    done, begun = [], []
    assert generate(
        config,
        tmp_path,
        on_begin=lambda *row: begun.append(row),
        on_file=lambda *row: done.append(row),
    )
    (there,) = (p.simulations for p in make_plan(config) if p.name == "training/mesh-0001")
    assert begun == [(4 - there, 4, ["training/mesh-0001"])]
    assert done == [("training/mesh-0001", 4, 4, there)]
    assert hashes(tmp_path) == hashes(folder)


def test_the_command_prints_a_line_for_each_file_and_says_which_splits_are_complete(
    program, tmp_path
):
    config = small(frames=1)
    path, folder = tmp_path / "set.toml", tmp_path / "set"
    path.write_text(config.to_toml())
    command = ("dataset", "generate", path, "-o", folder)
    status, out, _ = program(*command, "--seconds", 0)
    assert status == 1
    assert f"{folder}: training 0 of 3, evaluation 0 of 1 simulations" in out.splitlines()[-1]
    status, out, _ = program(*command, "--split", "evaluation")
    assert status == 0
    assert "training 0 of 3, evaluation 1 of 1" in out.splitlines()[-1]
    status, out, _ = program(*command)
    assert status == 0
    _, *lines, last = out.splitlines()
    assert last == f"{folder}: complete"
    for line, plan, done in zip(lines, make_plan(config)[:2], (2, 4), strict=True):
        assert plan.name in line
        assert f"{done} of 4 simulations" in line


def test_an_interruption_says_what_is_there_and_how_to_go_on(program, tmp_path, monkeypatch):
    from pdcorrect.data import workers as module

    real = module.produce

    def interrupted_at_the_second(config, folder, plans, device):
        if plans[0].number == 1:
            raise KeyboardInterrupt
        return real(config, folder, plans, device)

    monkeypatch.setattr(module, "produce", interrupted_at_the_second)
    path = tmp_path / "set.toml"
    path.write_text(small(frames=1).to_toml())
    status, _, err = program("dataset", "generate", path, "-o", tmp_path / "set")
    assert status == INTERRUPTED
    assert "1 of 4 simulations" in err


def test_folders_of_other_configurations_and_files_of_others_are_never_overwritten(
    generated, tmp_path, monkeypatch
):
    _, folder = generated
    with pytest.raises(InputError, match=r"config\.toml is another"):
        generate(small(seed=99), folder)

    config, folder = generated
    foreign = tmp_path / "foreign"
    shutil.copytree(folder, foreign)
    (foreign / "config.toml").unlink()
    with pytest.raises(InputError, match=r"config\.toml"):
        generate(config, foreign)
    other = small(seed=8)
    (foreign / "config.toml").write_text(other.to_toml())
    with pytest.raises(InputError, match=r"mesh-0000\.h5"):
        generate(other, foreign)
    monkeypatch.setattr("pdcorrect.data.schema.VERSION", 0)
    with pytest.raises(FileFormatError, match="version 1"):
        generate(config, folder)


def test_what_is_refused_leaves_no_folder(program, tmp_path):
    folder = tmp_path / "set"
    few = small(coarse_nodes=[72, 72], training={"meshes": 500, "simulations": 500})
    for config, options, words in (
        (few, {}, "coarse_nodes .* meshes"),
        (small(), {"splits": ["nonsense"]}, "nonsense"),
        (small(), {"device": "gpu"}, "device 'gpu'"),
        (small(), {"count": 0}, "count = 0"),
        (small(), {"batch": 0}, "batch = 0"),
    ):
        own = {k: options.pop(k) for k in ("device", "count", "batch") if k in options}
        with pytest.raises(InputError, match=words):
            generate(config, folder, Workers(**own), **options)
    path = tmp_path / "set.toml"
    path.write_text(small().to_toml())
    command = ("dataset", "generate", path, "-o")
    for arguments, words in (((folder, "--seconds", "-1"), "--seconds"), ((path,), "set.toml")):
        status, _, err = program(*command, *arguments)
        assert status == 2
        assert words in err
    assert not folder.exists()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_does_not_answer_or_has_no_workers_is_named(
    tmp_path, monkeypatch, address
):
    monkeypatch.setattr("pdcorrect.data.workers._ANSWER", 0.5)
    with pytest.raises(InputError, match=f"--scheduler {address}"):
        generate(small(), tmp_path, Workers(scheduler=address))
    monkeypatch.setattr("pdcorrect.data.workers._PATIENCE", 0.2)
    options = {"n_workers": 0, "processes": False, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        pytest.raises(InputError, match=r"0\.2 s"),
    ):
        generate(small(), tmp_path, Workers(scheduler=cluster.scheduler_address))


def test_processes_write_to_places_of_their_own_and_clear_up_after_dead_ones(tmp_path):
    path = tmp_path / "training" / "mesh-0000.h5"
    path.parent.mkdir()
    own, again = part_of_process(path), part_of_process(path)
    assert own != again
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    dead = own.with_name(own.name.replace(f".{os.getpid()}.", f".{ended.pid}."))
    strange = path.with_name("mesh-0000.h5.part")
    for part in (own, dead, strange):
        part.write_bytes(b"half")
    clear_parts(tmp_path)
    assert own.exists()
    assert strange.exists()
    assert not dead.exists()
    if not os.path.exists("/proc/self/stat"):  # only Linux tells
        return
    with subprocess.Popen(["sleep", "60"]) as killed:
        part = own.with_name(own.name.replace(f".{os.getpid()}.", f".{killed.pid}."))
        part.write_bytes(b"half")
        clear_parts(tmp_path)
        assert part.exists()
        killed.send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, killed.pid, os.WEXITED | os.WNOWAIT)  # dead, and still listed
        clear_parts(tmp_path)
        assert not part.exists()


def slow_work(config, folder, plans, device):
    """In place of the computation, on a worker in this process; the second one joins now."""
    SEEN.add(distributed.get_worker().address)
    CLUSTERS[-1].scale(2)
    time.sleep(0.3)
    return plans


SEEN, CLUSTERS = set(), []


def test_workers_that_join_later_are_used(tmp_path, monkeypatch):
    config = small(frames=1, coarse_nodes=[72, 150], training={"meshes": 9, "simulations": 9})
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    monkeypatch.setattr("pdcorrect.data.workers._work", slow_work)
    with distributed.LocalCluster(**options, dashboard_address=":0") as cluster:
        CLUSTERS.append(cluster)
        workers = Workers(scheduler=cluster.scheduler_address)
        assert not generate(config, tmp_path, workers)  # for nothing was written
    assert len(SEEN) == 2


def interrupted(config, folder, delay, workers):
    """Start the generation in processes of its own and kill them; whether it was running."""
    path = folder.parent / "set.toml"
    path.write_text(config.to_toml())
    command = [
        sys.executable, "-m", "pdcorrect", "dataset", "generate", path, "-o", folder,
        "--workers", str(workers),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(timeout=delay)
    except subprocess.TimeoutExpired:
        every = [process, *psutil.Process(process.pid).children(recursive=True)]
        for each in every:  # Dask's workers too, which would go on for a moment
            with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
                os.kill(each.pid, signal.SIGKILL)
        psutil.wait_procs(every[1:], timeout=30)
    return process.wait() == -signal.SIGKILL


@pytest.mark.slow
def test_ctrl_c_ends_the_workers_without_further_words(tmp_path):
    (tmp_path / "set.toml").write_text(small(frames=200).to_toml())
    command = [
        sys.executable, "-m", "pdcorrect", "dataset", "generate", tmp_path / "set.toml",
        "-o", tmp_path / "set", "--workers", "2",
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout.readline().startswith("0 of 4 simulations")
    time.sleep(8)  # the workers have begun
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert re.fullmatch(r"interrupted: \d of 4 simulations .*\n", err)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_killed_twenty_times_it_ends_with_the_same_files(generated, tmp_path, workers):
    config, folder = generated
    rng = np.random.default_rng(0)
    target = tmp_path / "killed"
    started = time.perf_counter()
    assert not interrupted(config, tmp_path / "whole", 600, workers)
    whole = time.perf_counter() - started
    killed = 0
    for _ in range(20):
        done = sorted(target.rglob("*.h5"))
        for path in done:
            read_shard(path)
        if done:  # so that there always is something to do
            done[rng.integers(len(done))].unlink()
        started = time.perf_counter()
        if interrupted(config, target, rng.uniform(0.3, 0.9) * whole, workers):
            killed += 1
        else:  # other programs have left the machine since
            whole = min(whole, time.perf_counter() - started)
    assert killed >= 10
    assert generate(config, target)
    assert not list(target.rglob("*.part"))
    assert hashes(target) == hashes(folder)


class SlowCluster:
    """Takes longer to close than Dask waits for."""

    scheduler_address = "tcp://here:1"

    def __init__(self, count):
        self.count, self.closed = count, 0

    def close(self):
        self.closed += 1
        raise TimeoutError("workers are still there")


def test_a_cluster_that_closes_slowly_stops_nothing_and_hides_no_error(monkeypatch):
    made = []

    def cluster(count):
        made.append(SlowCluster(count))
        return made[-1]

    monkeypatch.setattr("pdcorrect.data.workers.local_cluster", cluster)
    with contextlib.ExitStack() as stack:
        assert stack.enter_context(local_scheduler(3)) == "tcp://here:1"
        stack.close()  # before the end, and then not once more
        assert made[0].closed == 1
    assert (made[0].count, made[0].closed) == (3, 1)
    with pytest.raises(TimeoutError, match="of the work"), local_scheduler(2):
        raise TimeoutError("of the work itself")
    assert made[1].closed == 1
    for count in (0, 1):  # one worker needs no cluster
        with local_scheduler(count) as address:
            assert address is None
    assert len(made) == 2
