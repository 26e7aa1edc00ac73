"""A rehearsal with PX4 in HITL on a pseudo-terminal, in place of a board.

    AIRL_HITL_BOARD=board.py pytest tests/flight/test_hitl_px4.py

`AIRL_HITL_BOARD LINK --instance N` runs PX4's nolockstep SITL with the parameters of hitl.md, and
makes LINK a symbolic link to the host's end of its serial line. PX4 on Linux denies a reboot: on
this command, the program ends PX4, and starts it again 3 s later, as a board does.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.support.ports import choose_ports, free_ports
from tests.support.processes import SITL_WITHOUT_REPORT, running, wait_until

BOARD = os.environ.get("AIRL_HITL_BOARD")

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(400)]


@pytest.mark.skipif(BOARD is None, reason="AIRL_HITL_BOARD names no program")
def test_flights_with_px4_on_a_pseudo_terminal(tmp_path: Path, px4_instance: int) -> None:
    assert BOARD is not None
    line, ports = tmp_path / "line", choose_ports()
    _, (camera,) = free_ports(0, 1)
    words = [
        *SITL_WITHOUT_REPORT,
        *("--firmware", "px4-hitl", "--serial", str(line), "--camera-port", str(camera)),
        *("--api-port", str(ports.api), "--gcs-port", str(ports.gcs)),
        *("--api-local-port", str(ports.api_local), "--gcs-local-port", str(ports.gcs_local)),
        *("--policy", "static-obstacles", "--episodes", "3", "--no-validity", "--out", "run"),
    ]
    with subprocess.Popen([BOARD, str(line), "--instance", str(px4_instance)]) as board:
        try:
            wait_until(line.is_symlink, "the serial line")
            with running(words, tmp_path) as process:
                assert process.wait(350.0) == 0, process.text()
        finally:
            board.terminate()
    flown = (tmp_path / "run" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(each)["outcome"] for each in flown] == ["success"] * 3
