"""Machines that keep no files, have few threads, or are busy."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect._files import write_bytes

WITHOUT_A_CACHE = """
import warnings
import numba.core.caching as caching
caching.CacheImpl._locator_classes = []
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    import numpy as np
    from pdcorrect.fem.decomposition import OPTIONS
    from pdcorrect.solvers.first_hessian import _turn
texts = [str(w.message) for w in told if w.category.__name__ == "PdcorrectWarning"]
assert len(texts) == 1 and "NUMBA_CACHE_DIR" in texts[0], texts
assert not OPTIONS["cache"]
x = np.ones((2, 3))
_turn(np.stack([2 * np.eye(3)] * 2), x, x)
assert (x == 2).all()
"""


def test_kernels_run_where_none_can_be_kept():
    subprocess.run([sys.executable, "-c", WITHOUT_A_CACHE], check=True)


@pytest.mark.parametrize(("others", "asked", "limited"), [(0, None, 0), (9, None, 1), (9, "2", 0)])
def test_steps_take_one_thread_on_a_busy_machine_and_give_the_others_back(
    monkeypatch, others, asked, limited
):
    monkeypatch.setattr(os, "getloadavg", lambda: (float(others + os.cpu_count() - 1),))
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    if asked:
        monkeypatch.setenv("NUMBA_NUM_THREADS", asked)
    monkeypatch.setattr(numba, "set_num_threads", lambda n: used.append(n))
    used, most = [], numba.get_num_threads()
    stepper = pc.Newton(pc.discretise(beam((2, 1, 1))))
    stepper(stepper.problem.rest_state())
    assert used == [1] * limited + [most]


STEPS_IN_TWO_THREADS = """
from threading import Event, Thread
from pdcorrect.solvers.threads import limited_threads
from threadpoolctl import threadpool_info

def blas():
    return [info["num_threads"] for info in threadpool_info() if info["user_api"] == "blas"]

def step():
    with limited_threads():
        entered.set()
        joined.wait()

entered, joined, before = Event(), Event(), blas()
other = Thread(target=step)
other.start()
entered.wait()
with limited_threads():
    joined.set()
    other.join()
    assert set(blas()) == {1}
assert blas() == before, before
"""


def test_blas_has_its_threads_back_after_steps_in_two():
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    settings = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "PYTHONPATH": paths}
    subprocess.run([sys.executable, "-c", STEPS_IN_TWO_THREADS], check=True, env=settings)


@pytest.mark.parametrize("command", ["simulate", pytest.param("compare", marks=pytest.mark.slow)])
def test_threads_are_set_before_the_kernels_are_loaded(command):
    script = f"""
import os, sys
sys.argv = ["pdcorrect", "{command}", "--threads", "1", "none.toml", "-o", "none"]
from pdcorrect.cli.program import main
assert "numba" not in sys.modules
try:
    main()
except SystemExit as end:
    assert end.code == 2
import numba
assert numba.get_num_threads() == 1
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_file_is_on_the_disk_before_it_takes_its_name(tmp_path, monkeypatch):
    path, synced = tmp_path / "a", []
    path.write_bytes(b"old")

    def sync(file):
        synced.append((os.fstat(file).st_size, path.read_bytes()))

    monkeypatch.setattr(os, "fsync", sync)
    write_bytes(path, b"newer")
    assert synced == [(5, b"old")]
    assert path.read_bytes() == b"newer"
