"""Installation by `make sitl` (only the extra `sim`): flights and reports work."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.processes import run_alone

OF_OTHER_EXTRAS = (
    *("mcap", "pyulog", "foxglove", "viser", "trimesh", "mitsuba", "cyclonedds", "rosbags", "ray"),
    *("gymnasium", "stable_baselines3", "sb3_contrib", "torch", "onnx", "pyrealsense2", "depthai"),
)
"""Packages of extras that no flight needs, by the name that is imported."""

BLOCK = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {OF_OTHER_EXTRAS}:
            raise ModuleNotFoundError(f"No module named {{name}}", name=name)

sys.meta_path.insert(0, Absent())
"""

FLY = """
from airl_mav.cli.options import carry_out
words = ["--arena", "no-obstacles", "--episodes", "1", "--out", "run"]
assert carry_out("airl evaluate", "airl_mav.cli.evaluate_command", ["greedy", *words]) == 0
raise SystemExit(carry_out("airl report", "airl_mav.cli.report_command", ["run"]))
"""

COMPARE = """
from airl_mav.cli.options import carry_out
words = ["greedy", "--arena", "no-obstacles", "--episodes", "1", "--out", "run"]
more = ["--latencies", "1ms", "50ms", "--workers", "1"]
raise SystemExit(
    carry_out("airl latency-sweep", "airl_mav.cli.latency_sweep_command", words + more)
)
"""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("program", "page"),
    [(FLY, "run/report.html"), (COMPARE, "run/latency-sweep.html")],
    ids=["a run", "a comparison"],
)
def test_flies_and_draws_without_other_extras(tmp_path: Path, program: str, page: str) -> None:
    done = run_alone(BLOCK + program, tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / page).is_file()


def test_the_check_itself_can_fail(tmp_path: Path) -> None:
    done = run_alone(BLOCK + "import airl_mav.black_box.mcap_file\n", tmp_path)
    assert "No module named mcap" in done.stderr
