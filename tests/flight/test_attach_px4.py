"""Flights of PX4's own simulator (SIH), which airl-mav attaches to.

    AIRL_PX4_DIR=PX4-Autopilot pytest tests/flight/test_attach_px4.py

PX4 runs in real time: without two idle cores its clock falls behind.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from firmware_sim.external.programs import find_px4
from tests.support.ports import free_ports
from tests.support.processes import SITL, running

REAL = os.environ.get("AIRL_PX4_DIR")

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(300)]


@pytest.mark.skipif(REAL is None, reason="AIRL_PX4_DIR names no PX4")
def test_two_flights_of_sih_from_where_it_stands(tmp_path: Path, px4_instance: int) -> None:
    assert REAL is not None
    program, folder = find_px4(Path(REAL)), tmp_path / "px4"
    folder.mkdir()
    start = program.start(px4_instance, 10_040, folder)
    environment = {**os.environ, "PX4_SIM_MODEL": "sihsim_quadx"}
    _, (camera,) = free_ports(0, 1)
    words = [
        *SITL,
        *("--firmware", "attach", "--connect", "udpin://127.0.0.1:14550", "--limits.drift-m", "3"),
        *("--api-port", str(14_540 + px4_instance), "--camera-port", str(camera)),
        *("--policy", "static-obstacles", "--episodes", "2", "--no-validity", "--out", "run"),
    ]
    with subprocess.Popen(
        start.argv, env=environment, cwd=folder, stdout=subprocess.DEVNULL
    ) as px4:
        try:
            with running(words, tmp_path) as process:
                assert process.wait(200.0) == 0, process.text()
        finally:
            px4.kill()
    run = tmp_path / "run"
    lines = (run / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["outcome"] for line in lines] == ["success", "success"]
    assert process.text().count("poses: true state (HIL_STATE_QUATERNION)") == 1
    title = json.loads((run / "run.json").read_text(encoding="utf-8"))["setup"]["firmware"]
    assert title.startswith("vehicle 1.")
    assert title.endswith("; true state (HIL_STATE_QUATERNION)")
