"""Random damage to what users hand to the program, and bounds on what it may cost."""

import contextlib
import copy
import re
import resource
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

SECONDS = 300
"""That one input may take, compilation included, before it counts as a hang."""

MEMORY = 3 * 2**30
"""Bytes that one input may take on top of what the process holds."""


TRIED: list[int] = []
"""An entry for each input of the test that runs."""


@pytest.fixture(autouse=True)
def inputs_recorded(record_property):
    """Tell the test report how many inputs a test took."""
    TRIED.clear()
    yield
    record_property("inputs", len(TRIED))


class HangError(BaseException):
    """An input took too long; not an `Exception`, which readers of files may catch."""


def counts(fast, slow):
    """Numbers of inputs of the two modes, for a test's argument ``count``."""
    slow = pytest.param(slow, marks=pytest.mark.slow)
    return pytest.mark.parametrize("count", [fast, slow], ids=["fast", "slow"])


def for_all(strategy, check, count):
    """Call ``check`` on ``count`` draws of a strategy, the same ones at every run."""
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    options = settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=checks,
    )

    def bounded(value):
        TRIED.append(count)
        with within_seconds(SECONDS):
            check(value)

    with within_memory(MEMORY):
        options(given(strategy)(bounded))()


@contextlib.contextmanager
def within_seconds(seconds):
    """Raise `HangError` in the body if it takes longer."""

    def stop(*_):
        raise HangError(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def within_memory(most):
    """Make allocations fail in the body once the process has grown by ``most`` bytes (Linux)."""
    status = Path("/proc/self/statm")
    if not status.exists():
        yield
        return
    limit = int(status.read_text().split()[0]) * resource.getpagesize() + most
    before = resource.getrlimit(resource.RLIMIT_AS)
    if before[1] != resource.RLIM_INFINITY:
        limit = min(limit, before[1])
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


# --- bytes and text ----------------------------------------------------------------------


@st.composite
def damaged(draw, data, snippets=()):
    """Bytes with one to three places flipped, deleted, doubled, overwritten or cut off.

    ``snippets`` are what may be inserted besides single bytes.
    """
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(out)))
        length = draw(st.integers(1, 12) | st.integers(1, max(len(out), 1)))
        part = slice(start, start + length)
        kind = draw(st.sampled_from(["flip", "delete", "double", "insert", "write", "cut"]))
        if kind == "flip" and start < len(out):
            out[start] ^= draw(st.integers(1, 255))
        elif kind == "delete":
            del out[part]
        elif kind == "double":
            out[start:start] = out[part]
        elif kind == "write":
            out[start : start + 4] = draw(st.binary(min_size=4, max_size=4))
        elif kind == "cut" and draw(st.booleans()):
            del out[start:]
        else:
            out[start:start] = draw(st.binary(max_size=4) | st.sampled_from([b"\0", *snippets]))
    return bytes(out)


NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")

ODD_NUMBERS = (
    b"", b"-1", b"0", b"1", b"2", b"7", b"1.5", b"-0.0", b"nan", b"inf", b"-inf", b"1e400", b"1e30",
    b"1e-320", b"999", b"100000", b"2147483648", b"-2147483649", b"18446744073709551616",
    b"9" * 5000, b"x", b"0x1f", b"1,2", b"1 2",
)  # fmt: skip


@st.composite
def renumbered(draw, data, numbers=ODD_NUMBERS):
    """Text in which one to three numbers are replaced by others."""
    out = data
    for _ in range(draw(st.integers(1, 3))):
        found = list(NUMBER.finditer(out))
        if found:
            place = draw(st.sampled_from(found))
            out = out[: place.start()] + draw(st.sampled_from(numbers)) + out[place.end() :]
    return out


# --- trees of tables and lists -----------------------------------------------------------


@st.composite
def altered(draw, tree, values, most=3):
    """A tree of dicts and lists in which one to ``most`` places are changed."""
    out = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, most))):
        found = list(places(out))
        if found:
            _alter(draw, *draw(st.sampled_from(found)), values)
    return out


def places(tree):
    """All pairs of a container in a tree and a key or an index in it."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], (dict, list)):
            yield from places(tree[key])


def _alter(draw, parent, key, values):
    if isinstance(parent[key], (int, float)) and draw(st.booleans()):
        factor = draw(st.sampled_from([-1, 0, 2, 3, 1000, 1e-9, 0.1, 0.5, 1.1, 1e6, 1e20]))
        parent[key] = type(parent[key])(parent[key] * factor)
        return
    kind = draw(st.sampled_from(["replace"] * 4 + ["remove", "double", "rename", "wrap"]))
    if kind == "remove":
        del parent[key]
    elif kind == "double" and isinstance(parent, list):
        parent.insert(key, copy.deepcopy(parent[key]))
    elif kind == "rename" and isinstance(parent, dict):
        parent[draw(st.text(min_size=1, max_size=6) | st.just(f"{key}s"))] = parent.pop(key)
    elif kind == "wrap":
        parent[key] = [parent[key]]
    else:
        parent[key] = copy.deepcopy(draw(values))  # the next change may be within it
