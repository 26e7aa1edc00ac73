"""The bench of real firmware, as a process, with a stand-in of PX4."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.ports import reserved_instance
from tests.support.processes import ROOT, running
from tests.support.px4_peer import write_build

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.slow,
    pytest.mark.xdist_group("rehearsal"),
    pytest.mark.timeout(400),
]


@pytest.fixture
def instance() -> Iterator[int]:
    """An instance of PX4 with free ports."""
    with reserved_instance() as number:
        yield number


def test_the_bench_names_the_version_and_flies_nothing_twice(tmp_path: Path, instance: int) -> None:
    build = write_build(tmp_path / "px4")
    words = [
        *(str(ROOT / "scripts/real_firmware.py"), f"peer={build}", "--out", "drift"),
        *("--parts", "identity", "--instance", str(instance)),
    ]
    for flown in (["peer", "builtin"], []):
        with running(words, tmp_path) as process:
            assert process.wait() == 0, process.text()
            started = re.findall(r"^([a-z]+).*: identity \.\.\.$", process.text(), re.M)
            assert started == flown
            assert re.search(r"^\| version \| 1\.\d+\.\d+", process.text(), re.M)
    data = json.loads((tmp_path / "drift" / "drift.json").read_text())
    assert data["peer"]["builtin"].startswith("builtin-1.")
    (row,) = data["peer"]["rows"]
    assert row["real"].startswith("1.")


def test_a_parameter_that_px4_lacks_ends_the_start_at_once(tmp_path: Path, instance: int) -> None:
    build, profile = write_build(tmp_path / "px4"), tmp_path / "mine.toml"
    profile.write_text('base = "quad"\n[px4.parameters]\nEKF2_GONE = 1.0\n')
    words = [
        *("-m", "airl_mav.cli.firmware_command", "--arena", "open-field"),
        *("--vehicle", str(profile), "--firmware", "px4", "--px4-dir", str(build)),
        *("--instance", str(instance), "--firmware-timeout", "300"),
    ]
    with running(words, tmp_path) as process:
        assert process.wait(120.0) == 2, process.text()
        assert re.search(r"PX4 1\.\d+\.\d+.* lacks EKF2_GONE: accepted: ", process.text())
