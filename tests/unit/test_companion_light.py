"""The companion needs nothing that a Raspberry Pi has no use for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.processes import run_alone

HEAVY = (
    "airl_mav.arena",
    "airl_mav.core.kernels",
    "filterpy",
    "firmware_sim",
    "gymnasium",
    "jinja2",
    "matplotlib",
    "numba",
    "onnx",
    "onnxruntime",  # Only with a learned policy.
    "pybullet",
    "pymavlink",
    "scipy",
    "stable_baselines3",
    "torch",
)

BLOCK = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if any(name == heavy or name.startswith(heavy + ".") for heavy in {HEAVY}):
            raise ImportError(f"{{name}} is not for the companion")

sys.meta_path.insert(0, Absent())
"""

EVERY_MODULE = """
import importlib, pkgutil
import companion
names = [m.name for m in pkgutil.walk_packages(companion.__path__, "companion.")]
assert len(names) >= 5, names
# Drivers that come with an extra, which may want a library of the system.
for driver, needs in (
    ("oak_d", ["depthai"]), ("realsense", ["pyrealsense2"]),
    ("ros2", ["cyclonedds", "rosbags"]), ("rosbag", ["rosbags"]),
):
    try:
        for needed in needs:
            importlib.import_module(needed)
    except ImportError:
        names.remove(f"companion.addons.cameras.{driver}")
for name in names:
    importlib.import_module(name)
"""

COMMAND = """
import airl_mav.cli.companion_command as cli
from companion.program import prepare
asked = cli.OPTIONS(policy="greedy", computer="ras-pi-4", workload="template-5x32")
mission = prepare(asked)
assert mission.latency.sample_us() > 300_000
"""

REPORT = f"""
import sys
found = sorted(set({HEAVY}) & set(sys.modules))
assert not found, found
"""


@pytest.mark.parametrize("block", ["", BLOCK], ids=["looked for", "blocked"])
@pytest.mark.parametrize("work", ["import companion\n", EVERY_MODULE, COMMAND])
def test_imports_nothing_heavy(tmp_path: Path, work: str, block: str) -> None:
    done = run_alone(block + work + REPORT, tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_check_itself_can_fail(tmp_path: Path) -> None:
    done = run_alone(BLOCK + "import airl_mav.arena.generate\n", tmp_path)
    assert "is not for the companion" in done.stderr
