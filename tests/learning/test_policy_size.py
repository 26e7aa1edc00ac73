"""The study of policy size and latency: real networks, timed for real, network by network."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from airl_mav.policy.template import template_size
from tests.support.processes import ROOT, running

pytestmark = pytest.mark.slow

SMALL = """
description = "four small networks"
layers = [1, 2]
filters = [4, 8]
runs = 70
[observation]
height_px = 24
width_px = 32
horizontal_fov_deg = 90.0
range_m = 20.0
"""


def study(folder: Path, *options: str) -> list[str]:
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    script = f"{ROOT / 'scripts' / 'studies' / 'policy_size.py'}"
    return [script, "--config", "small.toml", "--out", "out", *options]


def test_it_times_what_is_missing_and_no_more(tmp_path: Path) -> None:
    with running(study(tmp_path), tmp_path) as process:
        assert process.wait() == 0, process.text()
    files = {path.stem: path for path in (tmp_path / "out" / "cells").glob("*.json")}
    assert sorted(files) == ["1x4", "1x8", "2x4", "2x8"]
    for name, path in files.items():
        cell = json.loads(path.read_bytes())
        size = template_size(cell["layers"], cell["filters"], 24, 32, 25)
        assert (cell["parameters"], cell["macs"]) == (size.parameters, size.macs), name
        assert 0 < cell["min_ms"] <= cell["p50_ms"] <= cell["p90_ms"] <= cell["max_ms"]
        # 70 runs are enough for a p90, and not for a p99.
        assert cell["runs"] == 70 and cell["p99_ms"] is None
    data = json.loads((tmp_path / "out" / "policy-size.json").read_bytes())
    assert data["fit"]["processor_p50_ms"]["n"] == 4
    assert (tmp_path / "out" / "policy-size.png").read_bytes().startswith(b"\x89PNG")
    # A kill left one out: only that one is timed again.
    before = {name: path.read_bytes() for name, path in files.items()}
    files["2x4"].unlink()
    with running(study(tmp_path), tmp_path) as process:
        assert process.wait() == 0, process.text()
    after = {name: path.read_bytes() for name, path in files.items()}
    assert {name for name in files if after[name] != before[name]} <= {"2x4"}
    # With another number of threads it is another study.
    with running(study(tmp_path, "--threads", "2"), tmp_path) as process:
        assert process.wait() == 2
        assert "timed with another threads" in process.text()
