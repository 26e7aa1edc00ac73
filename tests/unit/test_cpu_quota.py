"""--cpu-quota: a process really held to a share of a core, or refused with the reason."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.scheduling import CpuGroup, check_permitted, held_to, remove_left
from airl_mav.rehearsal.channel import Begin
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.program import prepare
from tests.support.processes import ROOT

BUSY = """
import json, os, threading, time
from airl_mav.core.scheduling import held_to

def burn():
    # By processor time: the same work however slow this machine is.
    end = time.thread_time() + 0.15
    while time.thread_time() < end:
        sum(range(1000))

with held_to(20.0) as group:
    before = group.statistics()
    thread = threading.Thread(target=burn)
    thread.start(); thread.join()
    after = group.statistics()
    inside = os.getpid() in [int(p) for p in (group.path / "cgroup.procs").read_text().split()]
print(json.dumps({"before": before, "after": after, "inside": inside,
                  "left": group.path.exists(), "path": str(group.path)}))
"""


@pytest.fixture
def permitted() -> None:
    try:
        check_permitted(50.0)
    except UsageError as reason:
        pytest.skip(str(reason))


def test_busy_process_is_throttled_and_the_group_removed(permitted: None, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BUSY],
        env={"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    found = json.loads(done.stdout)
    throttled = found["after"]["nr_throttled"] - found["before"]["nr_throttled"]
    periods = found["after"]["nr_periods"] - found["before"]["nr_periods"]
    # 150 ms of work at 1 ms a period of 5 ms: 150 periods, most of them cut off. Some slack is in
    # the kernel's slices.
    assert periods >= 40
    assert throttled >= 0.5 * periods
    assert found["inside"]
    assert not found["left"]


def test_group_is_left_when_the_work_fails(permitted: None) -> None:
    paths = []
    with pytest.raises(RuntimeError, match="on purpose"), held_to(90.0) as group:
        assert group is not None
        paths.append(group.path)
        raise RuntimeError("on purpose")
    assert not paths[0].exists()


KILLED = """
import os
from airl_mav.core.scheduling import held_to
with held_to(50.0) as group:
    print(group.path, flush=True)
    os._exit(3)
"""


def test_group_of_a_killed_process_is_removed_later(permitted: None, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", KILLED],
        env={"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 3, done.stderr
    remove_left()
    assert not Path(done.stdout.strip()).exists()


def test_nothing_asked_nothing_done() -> None:
    with held_to(None, Path("/nowhere")) as group:
        assert group is None
    check_permitted(None, Path("/nowhere"))


def fake_root(root: Path, cgroup: str, mounts: str) -> Path:
    proc = root / "proc/self"
    proc.mkdir(parents=True)
    (proc / "cgroup").write_text(cgroup)
    (proc / "mounts").write_text(mounts)
    return root


@pytest.mark.parametrize(
    ("version", "percent", "written"),
    [
        (1, 20.0, {"cpu.cfs_period_us": "5000", "cpu.cfs_quota_us": "1000"}),
        (1, 150.0, {"cpu.cfs_period_us": "10000", "cpu.cfs_quota_us": "15000"}),
        (1, 2.0, {"cpu.cfs_period_us": "50000", "cpu.cfs_quota_us": "1000"}),
        (2, 20.0, {"cpu.max": "1000 5000"}),
    ],
)
def test_what_the_kernel_is_told(
    tmp_path: Path, version: int, percent: float, written: dict[str, str]
) -> None:
    CpuGroup(tmp_path, version).set_quota(percent)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == written


def test_refused_without_control_groups(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no control groups: Linux has them"):
        check_permitted(20.0, tmp_path)


def test_refused_without_the_controller(tmp_path: Path) -> None:
    root = fake_root(tmp_path, "0::/user\n", "cgroup2 /sys/fs/cgroup cgroup2 rw 0 0\n")
    (root / "sys/fs/cgroup/user").mkdir(parents=True)
    (root / "sys/fs/cgroup/user/cgroup.controllers").write_text("memory pids\n")
    with pytest.raises(UsageError, match="the CPU controller of control groups is not there"):
        check_permitted(20.0, root)


def test_refused_where_no_group_can_be_made(tmp_path: Path) -> None:
    root = fake_root(tmp_path, "3:cpu,cpuacct:/a\n", "c /sys/fs/cgroup/cpu cgroup rw,cpu 0 0\n")
    # A file in place of the hierarchy: even root cannot create a folder in it.
    (root / "sys/fs/cgroup").mkdir(parents=True)
    (root / "sys/fs/cgroup/cpu").write_text("")
    with pytest.raises(
        UsageError, match=r"not permitted here: no group can be made in .*: Not a d"
    ):
        check_permitted(20.0, root)


@pytest.mark.parametrize("percent", [0.5, 10_000.0, float("nan")])
def test_refused_out_of_range(percent: float) -> None:
    with pytest.raises(UsageError, match="accepted: 1 <= value <= 6400 %"):
        Scenario(cpu_quota=percent)


def test_it_is_refused_where_the_companions_time_does_not_count() -> None:
    for asked, why in (
        ({"lockstep": True}, "without level lockstep"),
        ({"latency": "150ms"}, "without an injected latency"),
    ):
        with pytest.raises(FieldError, match=f"cpu_quota 20: accepted: {why}"):
            prepare(StandAloneCompanion(cpu_quota=20.0, **asked))
    for asked, why in (
        ({"level": "lockstep"}, "without level lockstep"),
        ({"level": "gym"}, "without level gym"),
        ({"computer": "ras-pi-4", "workload": "template-5x32"}, "without an injected latency"),
    ):
        with pytest.raises(FieldError, match=f"cpu_quota 20: accepted: {why}"):
            resolve(Scenario(cpu_quota=20.0, **asked))


def test_rehearsal_hands_it_on_and_writes_it_down(permitted: None) -> None:
    resolved = resolve(Scenario(cpu_quota=20.0))
    assert resolved.injection.origin == "measured"
    assert "held to 20 % of a core" in resolved.injection.label
    assert resolved.config["cpu_quota"] == 20.0
    told = Begin.model_validate_json(Begin(scenario=resolved).to_line())
    assert told.scenario.scenario.cpu_quota == 20.0
