"""How much memory may be used."""

import os

import pytest

from pdcorrect._environment import total_memory

V1, V2 = "sys/fs/cgroup/memory/{}/memory.limit_in_bytes", "sys/fs/cgroup/{}/memory.max"
MACHINE = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def system(root, groups, limits):
    """A system's files: the groups that a process is in, and limits by file."""
    for name, content in {"proc/self/cgroup": groups, **limits}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return root


@pytest.mark.parametrize(
    ("groups", "limits", "expected"),
    [
        ("0::/jobs/7\n", {V2.format("jobs/7"): "3000000\n"}, 3e6),
        ("0::/jobs/7\n", {V2.format("jobs/7"): "max\n", V2.format("jobs"): "2000000\n"}, 2e6),
        ("0::/jobs/7\n", {V2.format("jobs/8"): "1000\n"}, MACHINE),
        ("0::/seen/from/outside\n", {V2.format("."): "4000000\n"}, 4e6),
        ("4:memory:/jobs\n1:cpu:/x\n", {V1.format("jobs"): "5000000\n"}, 5e6),
        ("4:cpu,memory:/\n0::/\n", {V1.format("."): "9223372036854771712\n"}, MACHINE),
        ("1:cpu:/jobs\n", {V1.format("jobs"): "1000\n"}, MACHINE),
        ("0::/\n", {V2.format("."): "\n"}, MACHINE),
        ("no group\n0::/jobs\n", {V2.format("jobs"): "6000000\n"}, 6e6),
    ],
)
def test_the_least_limit_of_the_control_groups_counts(tmp_path, groups, limits, expected):
    assert total_memory(system(tmp_path, groups, limits)) == expected


def test_without_control_groups_it_is_the_machine_s(tmp_path):
    assert total_memory(tmp_path) == MACHINE
    assert 0 < total_memory() <= MACHINE
