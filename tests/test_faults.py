"""Programs killed or told to end, disks that fill up or become read-only, at random moments.

Whatever happened, the same command then ends with what a run without faults leaves.
"""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from conftest import beam  # noqa: E402
from dataset_configs import small  # noqa: E402
from pdcorrect.cli.program import TERMINATED  # noqa: E402
from pdcorrect.data.folder import all_shards  # noqa: E402
from pdcorrect.data.schema import read_header, read_shard  # noqa: E402
from pdcorrect.io.trajectory import load_trajectory  # noqa: E402

NAMESPACE = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
"""Mounts inside are gone with the program, and concern nobody else."""

SOON = 0.3
"""Seconds after the first writing within which all programs here are still at work."""

FULL = """
cp -a "$OUT" "$ASIDE/before" && mount -t tmpfs -o size="$SIZE" none "$OUT" &&
cp -a "$ASIDE/before/." "$OUT" || exit 99
"$@"; status=$?
cp -a "$OUT" "$ASIDE/after" && umount "$OUT" && find "$OUT" -mindepth 1 -delete &&
cp -a "$ASIDE/after/." "$OUT" || exit 99
exit $status
"""
"""Run a command while the disk of $OUT has no more than $SIZE bytes."""

READ_ONLY = """
mount --bind "$OUT" "$OUT" || exit 99
[ "$DELAY" = 0 ] && { mount -o remount,bind,ro "$OUT" || exit 99; }
mark=$(mktemp)
"$@" & program=$!
if [ "$DELAY" != 0 ]; then
    until [ -n "$(find "$OUT" -type f -newer "$mark")" ]; do  # something is written
        kill -0 $program 2>/dev/null || break
        sleep 0.005
    done
    sleep "$DELAY"
    until mount -o remount,bind,ro "$OUT" 2>/dev/null; do  # refused while a file is being written
        kill -0 $program 2>/dev/null || break
        sleep 0.005
    done
fi
rm -f "$mark"
wait $program
"""
"""Run a command whose folder $OUT becomes read-only $DELAY seconds after it wrote something; at
once if that is 0."""

CASE = """
import time
from harness import Outcome, Table


def part(number):
    time.sleep(0.15)
    rows = tuple((float(k), float(k * number)) for k in range(300))
    return Outcome({f"{number}": float(number)}, (Table(f"{number}", ("k", "x"), rows),))


def parts(quick):
    return {f"part {n}": (lambda n=n: part(n)) for n in range(8)}


def draw(record, path):
    from PIL import Image

    Image.effect_noise((128, 128), 90).save(path)
"""
VALIDATION = Path(__file__).parents[1] / "validation"


@dataclass(frozen=True)
class Program:
    """A command that writes into a folder and goes on if it is called again.

    `arguments` are its own, given the folder with its input and that of its output; `found` is what
    its output says, to be the same whatever happened; `sound` fails if a file under a final
    name is not whole, but for the end of a trajectory whose program was killed.
    """

    name: str
    prepare: object
    arguments: object
    found: object
    sound: object


# --- the four programs -------------------------------------------------------------------


def scene_input(folder):
    swing = {"kind": "body-force", "density": [0.0, 3e3, -9e3]}
    scene = beam((3, 1, 1), loads=[swing], time={"step": 0.01, "frames": 300})
    (folder / "scene.toml").write_text(scene.to_toml())


def trajectory(output):
    run = load_trajectory(output / "run.h5")
    return [x.tobytes() for x in (run.positions, run.velocities, run.times)]


def whole_trajectory(output, killed):
    if (output / "run.h5").exists():
        load_trajectory(output / "run.h5", salvage=killed)


def dataset_input(folder):
    config = small(training={"meshes": 6, "simulations": 12}, frames=8)
    (folder / "set.toml").write_text(config.to_toml())


def shards(output):
    folder = output / "set"
    manifest = json.loads((folder / "manifest.json").read_text())["files"]
    return {p.name: read_header(p, verify=True).content_hash for p in all_shards(folder)}, manifest


def whole_shards(output, killed):
    for path in all_shards(output / "set"):
        read_shard(path)
    for path in output.rglob("*.json"):
        json.loads(path.read_text())


def training_input(folder):
    samples.dataset(folder / "data", frames=5)
    often = {"iterations": 1}
    stages = samples.one_step(iterations=12), samples.unrolled(iterations=6)
    settings = samples.config(*stages, validate_every=often, checkpoint_every=often, report_every=1)
    (folder / "training.toml").write_text(settings.to_toml())


def training(output):
    folder = output / "training"
    rows = [line.split(",") for line in (folder / "history.csv").read_text().splitlines()]
    seconds = rows[0].index("seconds")
    weights = (folder / "model" / "weights.safetensors").read_bytes()
    return weights, [row[:seconds] + row[seconds + 1 :] for row in rows]


def whole_training(output, killed):
    from pdcorrect.corrector.model_io import load_model
    from pdcorrect.training.progress import read_checkpoint

    if (output / "training" / "model" / "model.json").exists():
        load_model(output / "training" / "model")
    if (output / "training" / "checkpoint.safetensors").exists():
        read_checkpoint(output / "training" / "checkpoint.safetensors")


def case_input(folder):
    case = folder / "validation" / "noise"
    case.mkdir(parents=True)
    for name in ("harness.py", "expectations.py", "report.py"):
        shutil.copy(VALIDATION / name, case.parent)
    (case / "run.py").write_text(CASE)
    (case / "README.md").write_text("# Noise\n\n**Question.** Is it there?\n")
    (case / "expected.json").write_text(
        json.dumps({"3": {"value": 3.0, "tolerance": 0.0, "source": "counting"}})
    )


def report(output):
    folder = output / "report"
    record = json.loads((folder / "noise.json").read_text())
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))
    return record["figures"], record["tables"], names


def whole_report(output, killed):
    from PIL import Image

    for path in output.rglob("*.json"):
        json.loads(path.read_text())
    for path in output.rglob("*.png"):
        Image.open(path).load()
    for path in output.rglob("index.html"):
        assert path.read_text().rstrip().endswith("</html>")


PROGRAMS = [
    Program(
        "simulate", scene_input,
        lambda given, out: ["simulate", given / "scene.toml", "-o", out / "run.h5", "--resume"],
        trajectory, whole_trajectory,
    ),
    Program(
        "generate", dataset_input,
        lambda given, out: ["dataset", "generate", given / "set.toml", "-o", out / "set"],
        shards, whole_shards,
    ),
    Program(
        "train", training_input,
        lambda given, out: ["train", given / "training.toml", "--data", given / "data",
                            "-o", out / "training", "--resume"],
        training, whole_training,
    ),
    Program(
        "validate", case_input,
        lambda given, out: ["validate", "-o", out / "report"],
        report, whole_report,
    ),
]  # fmt: skip


@dataclass
class Bench:
    """A program with its input, what it leaves without faults, and how long that took."""

    program: Program
    given: object
    output: object
    expected: object = None
    seconds: float = 0.0
    size: int = 0

    def command(self):
        own = self.program.arguments(self.given, self.output)
        return [sys.executable, "-m", "pdcorrect", *map(str, own)]

    def environment(self, **more):
        paths = {"PYTHONPATH": os.pathsep.join(sys.path), "PDCORRECT_HOME": str(self.given)}
        return {**os.environ, **paths, "OMP_NUM_THREADS": "1", **more}

    def start(self, wrapper=(), **environment):
        return subprocess.Popen(
            [*wrapper, *self.command()], env=self.environment(**environment),
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip

    def state(self):
        """Changes when something is written."""
        with contextlib.suppress(FileNotFoundError):
            files = [p for p in self.output.rglob("*") if p.is_file()]
            return sorted((p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files)
        return None

    def ended(self, process):
        """The exit status and what was said, which is no traceback."""
        try:
            said = process.communicate(timeout=300)[1]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
        assert "Traceback" not in said
        assert process.returncode != 99, said  # of the wrappers
        self.program.sound(self.output, process.returncode == -signal.SIGKILL)
        return process.returncode, said

    def finish(self):
        """The same command without faults: nothing is lost, and nothing is left over."""
        assert self.ended(self.start())[0] == 0
        assert self.program.found(self.output) == self.expected
        assert not [p.name for p in self.output.rglob("*") if ".part" in p.name]


@pytest.fixture(scope="module")
def benches(tmp_path_factory):
    """By program: its input, expected result, time and size; made when first asked for."""
    known = {}

    def bench(program, folder):
        if program.name not in known:
            given = tmp_path_factory.mktemp(f"{program.name}-input")
            program.prepare(given)
            whole = Bench(program, given, tmp_path_factory.mktemp(f"{program.name}-whole"))
            began = time.perf_counter()
            assert whole.ended(whole.start())[0] == 0
            seconds = time.perf_counter() - began
            size = sum(p.stat().st_size for p in whole.output.rglob("*") if p.is_file())
            known[program.name] = given, program.found(whole.output), seconds, size
        given, expected, seconds, size = known[program.name]
        return Bench(program, given, folder, expected, seconds, size)

    return bench


# --- the four faults ---------------------------------------------------------------------


def kill(bench, number, chance):
    process = bench.start()
    share = chance.uniform(0.0, 1.0)
    if share < 0.25:  # anywhere, while it starts too
        time.sleep(4.0 * share * bench.seconds)
    else:  # while it works
        before = bench.state()
        while process.poll() is None and bench.state() == before:
            time.sleep(0.002)
        time.sleep(min((share - 0.25) * 0.2 * bench.seconds, SOON))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
    return bench.ended(process)


def killed(bench, times, chance):
    for _ in range(times):
        yield kill(bench, signal.SIGKILL, chance)[0] == -signal.SIGKILL


def terminated(bench, times, chance):
    for _ in range(times):
        status, _ = kill(bench, signal.SIGTERM, chance)
        assert status in (0, TERMINATED, -signal.SIGTERM)  # the last one while Python starts
        yield status != 0


def full_disk(bench, times, chance):
    aside = bench.output.parent / "aside"
    for share in np.sort([chance.uniform(0.05, 0.9) for _ in range(times)]):
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir()
        used = sum(-(-p.stat().st_size // 4096) for p in bench.output.rglob("*") if p.is_file())
        room = 4096 * (used + 2) + int(share * bench.size)
        process = bench.start(
            [*NAMESPACE, FULL, "full"], OUT=str(bench.output), ASIDE=str(aside), SIZE=str(room)
        )
        status, said = bench.ended(process)
        if status:
            assert "No space left on device" in said, said
        yield status != 0


def read_only_folder(bench, times, chance):
    for number in range(times):
        delay = min(chance.uniform(0.01, 0.1) * bench.seconds, SOON) if number else 0
        process = bench.start(
            [*NAMESPACE, READ_ONLY, "read-only"], OUT=str(bench.output), DELAY=str(delay)
        )
        status, said = bench.ended(process)
        if status:
            assert "Read-only file system" in said, said
        yield status != 0 and (number > 0 or bench.program.name in HOLDING)


HOLDING = ("simulate", "train")
"""They write to one file all the time, and Linux keeps its folder writable until they end: only a
folder that is read-only when they start can hit them."""
FAULTS = [killed, terminated, full_disk, read_only_folder]
QUICK = {("validate", fault) for fault in ("killed", "full_disk", "read_only_folder")}
"""Those that take seconds; test_resume has the first of the others."""


def namespaces():
    """Whether mounts of one's own are possible here."""
    try:
        command = [*NAMESPACE, f"mount -t tmpfs none {tempfile.gettempdir()}"]
        return not subprocess.run(command, timeout=10).returncode
    except (OSError, subprocess.TimeoutExpired):
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals and mounts of Linux")
@pytest.mark.parametrize(
    ("program", "fault", "times"),
    [
        pytest.param(p, f, times if quick else 6, id=f"{p.name}-{f.__name__}",
                     marks=() if quick else pytest.mark.slow)
        for p in PROGRAMS
        for f in FAULTS
        for quick, times in [((p.name, f.__name__) in QUICK, 2 if f is read_only_folder else 1)]
    ],
)  # fmt: skip
def test_whatever_happens_the_same_command_ends_with_the_same_result(
    benches, tmp_path, program, fault, times
):
    if fault in (full_disk, read_only_folder) and not namespaces():
        pytest.skip("no mount namespaces for users here")
    output = tmp_path / "out"
    bench = benches(program, output)
    chance = random.Random(f"{program.name} {fault.__name__}")
    injected = hits = 0
    while not hits and injected < 4 * times:  # on a busy machine all of a round may come too late
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        hits += sum(fault(bench, times, chance))
        injected += times
    assert hits, "the program was never hit"
    bench.finish()
