from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

AUTOGROUP = Path("/proc/self/autogroup")

GIVING_WAY = """
import os
from airl_mav.core.scheduling import give_way
give_way(7)
print(os.getpriority(os.PRIO_PROCESS, 0), os.getsid(0) == os.getpid())
try:
    print(open("/proc/self/autogroup").read())
except OSError:
    pass
"""


@pytest.mark.parametrize("leads", [False, True], ids=["of its session", "leads a session"])
def test_a_process_gives_way_as_a_session_too(leads: bool) -> None:
    before = AUTOGROUP.read_text() if AUTOGROUP.exists() else ""
    done = subprocess.run(
        [sys.executable, "-c", GIVING_WAY],
        check=True,
        capture_output=True,
        text=True,
        start_new_session=leads,
    )
    niceness, session, *group = done.stdout.split()
    assert int(niceness) == min(19, os.getpriority(os.PRIO_PROCESS, 0) + 7)
    assert session == "True"
    if before:
        # "/autogroup-1412 nice 7"; the caller's autogroup is unchanged.
        assert group[1:] == ["nice", "7"] and group[0] != before.split()[0]
        assert AUTOGROUP.read_text() == before


PACED = """
import ctypes, platform
from airl_mav.core.scheduling import SLICE_NS, give_way
from firmware_sim.pacing import WallPacing

def slice_ns():
    attributes = (ctypes.c_uint64 * 6)()  # struct sched_attr; its fourth word is the slice.
    number = {"x86_64": 315, "aarch64": 275}[platform.machine()]  # sched_getattr(2)
    ctypes.CDLL(None).syscall(number, 0, ctypes.byref(attributes), 48, 0)
    return attributes[3]

give_way(1)  # Whoever has started this may have asked for short ones.
before = slice_ns()
WallPacing(1.0)
paced = slice_ns()
give_way(7)
print(before, paced, SLICE_NS, slice_ns())
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "aarch64"), reason="numbers of its calls")
def test_what_keeps_pace_with_the_wall_clock_runs_soon_after_it_was_woken() -> None:
    done = subprocess.run([sys.executable, "-c", PACED], check=True, capture_output=True, text=True)
    before, paced, asked, given_way = map(int, done.stdout.split())
    if not before:
        pytest.skip("this kernel knows no slices of threads (Linux has them from 6.12 on)")
    assert paced == asked < before == given_way


def test_a_view_gives_way() -> None:
    from airl_mav.addons.view.view_messages import ViewSettings
    from airl_mav.addons.view.viewer import Viewer

    request = ViewSettings(run="t", port=None, paced=False, speed=None,
                      compensable=False, compensated=False)  # fmt: skip
    viewer = Viewer(request)
    try:
        (view,) = (
            child
            for child in psutil.Process().children()
            if "airl_mav.addons.view.view_server" in child.cmdline()
        )
        assert os.getsid(view.pid) == view.pid
        assert view.nice() > psutil.Process().nice()
    finally:
        viewer.close()
