"""What a summary says of a data set, in numbers and tables."""

import dataclasses
import json

import numpy as np
import pytest

from dataset_samples import write_dataset
from pdcorrect.data.schema import Run, Shard, Simulation, write_shard
from pdcorrect.data.summary import dataset_info
from pdcorrect.errors import FileFormatError, InputError


@pytest.fixture
def dataset(tmp_path):
    """A data set to spoil."""
    write_dataset(tmp_path / "sample")
    return tmp_path / "sample"


def counted_shard(split, number, size):
    """One cube of side 1; node 6 of the reference moves by 3 and 4 ``size`` in two steps."""
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    points = np.array(corners + [[x, y, 1] for x, y, _ in corners], dtype=float)

    def run(factor, steps, **predictions):
        positions = np.repeat(points[None], 3, axis=0)
        positions[1, 6, 0] += factor * 3 * size
        positions[2, 6, 0] += factor * 3 * size
        positions[2, 6, 1] += factor * 4 * size
        return Run(positions, **predictions, statistics={"iterations": np.array(steps)})

    one_step = run(1.0, [0, 0]).positions[1:].copy()
    one_step[:, 0, 2] += 0.2 * size
    forces = np.zeros((2, 8, 3))
    forces[1, 2] = [0.0, 6.0 * size, 8.0 * size]
    runs = {
        "reference": run(1.0, [10, 20]),
        "plain": run(0.5, [2, 4], predictions=one_step),
        "best": run(0.75, [5, 5 + number]),
    }
    seconds = {"reference": 8.0, "plain": 1.5}
    simulation = Simulation(
        forces, runs, attempt=number, rejected=("no",) * number, seconds=seconds
    )
    return Shard(
        attributes={
            "dataset": "counted", "split": split, "number": number, "setting": "exact",
            "config_hash": "0", "time_step": 0.5, "tolerance": 1e-5,
        },
        points=points, cells=np.arange(8)[None], free=np.ones((8, 3), bool), mass=np.ones(8),
        young=np.array([1e5 * (1 + number)]), poisson=np.array([0.3]), density=np.array([1e3]),
        simulations=(simulation,),
    )  # fmt: skip


def test_the_summary_has_the_numbers_of_hand(tmp_path):
    """Displacements 5 s with s = 1, 2, 4."""
    for split, number, size in (("training", 0, 1.0), ("training", 1, 2.0), ("evaluation", 0, 4.0)):
        write_shard(
            tmp_path / split / f"mesh-{number:04d}.h5",
            counted_shard(split, number, size),
            "float64",
        )
    info = dataset_info(tmp_path)
    assert list(info.splits) == ["training", "evaluation"]
    whole, training = info.whole, info.splits["training"]
    assert (whole.meshes, whole.simulations, whole.frames) == (3, 3, 6)
    assert (training.meshes, training.simulations, training.frames) == (2, 2, 4)
    assert whole.bytes == sum(path.stat().st_size for path in tmp_path.glob("*/*.h5"))
    assert whole.nodes == (8, 8)
    assert whole.young == (1e5, 2e5)
    assert info.splits["evaluation"].young == (1e5, 1e5)
    assert whole.displacement == pytest.approx((5.0, 20.0))
    assert training.rejection_rate == pytest.approx(1 / 3)
    assert training.rejections == {"no": 1}
    assert training.seconds == 19.0
    assert whole.seconds == 28.5
    assert list(whole.runs) == ["reference", "plain", "best"]
    reference, plain, best = whole.runs.values()
    assert (reference.iterations, best.iterations) == (15, pytest.approx(31 / 6))
    assert (reference.seconds, plain.seconds, best.seconds) == (24.0, 4.5, 0.0)
    assert reference.rms_error is reference.omega is plain.omega is None
    # squared distances (1.5 s)^2 and (2.5 s)^2 of one node of 8, over two frames
    assert plain.rms_error == pytest.approx(np.sqrt((1.5**2 + 2.5**2) / 16) * 7 / 3)
    assert best.rms_error == pytest.approx(0.5 * plain.rms_error)
    assert best.relative_error == pytest.approx(0.5 * plain.relative_error)
    assert reference.relative_error is None
    assert plain.step_error == pytest.approx(0.2 / np.sqrt(8) * 7 / 3)
    assert best.step_error is None
    assert best.omega == pytest.approx(75.0)


def test_omega_is_a_mean_over_simulations_with_an_error(tmp_path):
    """Displacements off by shares e of the plain run's error: Omega 100 (1 - e^2)."""
    shard = counted_shard("training", 0, 1.0)
    simulation = shard.simulations[0]
    reference, plain = (simulation.runs[name].positions for name in ("reference", "plain"))
    many = []
    for share in (0.0, 0.5, 2.0):
        best = Run(reference + share * (plain - reference))
        many.append(dataclasses.replace(simulation, runs={**simulation.runs, "best": best}))
    still = {**simulation.runs, "plain": simulation.runs["reference"]}
    many.append(dataclasses.replace(simulation, runs=still))  # no error to correct
    shard = dataclasses.replace(shard, simulations=tuple(many))
    write_shard(tmp_path / "training/mesh-0000.h5", shard, "float64")
    best = dataset_info(tmp_path).whole.runs["best"]
    assert best.simulations == 4
    assert best.omega == pytest.approx((100 + 75 - 300) / 3)


def test_a_summary_of_nothing_or_of_a_damaged_file_is_refused(dataset, tmp_path):
    with pytest.raises(InputError, match="none"):
        dataset_info(tmp_path / "none")
    path = dataset / "training" / "mesh-0000.h5"
    path.write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"mesh-0000\.h5"):
        dataset_info(dataset)


# --- the program -------------------------------------------------------------------------


def test_info_prints_tables_and_writes_json(program, dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    status, out, _ = program("dataset", "info", dataset, "--json", tmp_path / "info.json")
    assert status == 0
    assert all(word in out for word in ("training", "evaluation", "Omega", "plain"))
    record = json.loads((tmp_path / "info.json").read_text())
    assert record["whole"]["simulations"] == 8
    assert record["splits"]["training"]["runs"]["best"]["omega"] == pytest.approx(96, abs=0.1)
    again = tmp_path / "no" / "info.json"
    assert program("dataset", "info", dataset, "--json", again)[0] == 0
    assert json.loads(again.read_text()) == record
    assert program("dataset", "info", dataset, "--json", again / "info.json")[0] == 1


def test_info_without_statistics_or_costs(program, tmp_path):
    shard = counted_shard("training", 0, 1.0)
    simulation = shard.simulations[0]
    bare = {"reference": dataclasses.replace(simulation.runs["reference"], statistics={})}
    one = dataclasses.replace(simulation, runs=bare, seconds={})
    root = tmp_path / "bare"
    write_shard(root / "training/mesh-0000.h5", dataclasses.replace(shard, simulations=(one,)))
    assert program("dataset", "info", root)[0] == 0
    reference = dataset_info(root).whole.runs["reference"]
    assert reference.iterations is reference.omega is None
