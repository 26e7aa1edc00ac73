"""The study of policy size and latency: real networks, timed for real, network by network."""

from __future__ import annotations

import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from unittest.mock import patch

import pytest

from airl_mav.policy.card_writing import template_size
from tests.support.processes import ROOT, running

STUDIES = ROOT / "scripts" / "studies"


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
    script = f"{STUDIES / 'policy_size.py'}"
    return [script, "--config", "small.toml", "--out", "out", *options]


@pytest.mark.nightly
@pytest.mark.slow
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


def test_fit_of_times_that_follow_a_line_exactly() -> None:
    spec = spec_from_file_location("size_latency_fit", STUDIES / "size_latency_fit.py")
    assert spec is not None and spec.loader is not None
    study = module_from_spec(spec)
    # A dataclass looks for its module there.
    with patch.dict(sys.modules, {spec.name: study}):
        spec.loader.exec_module(study)
    sizes = {(n, f): template_size(n, f, 24, 32, 25) for n in (1, 2, 3) for f in (4, 8)}
    fit = study.fit_times(
        sizes, {cell: 0.5 + 3.0 * size.macs / 1e9 for cell, size in sizes.items()}
    )
    assert fit is not None
    assert fit.intercept_ms == pytest.approx(0.5)
    assert fit.ms_per_gmac == pytest.approx(3.0)
    assert fit.r_squared == pytest.approx(1.0) == fit.both_r_squared
    assert fit.parameters_r_squared < 1.0
    assert fit.grows == 1.0
    flat = study.fit_times(sizes, {cell: 100.0 * size.macs for cell, size in sizes.items()})
    assert flat is not None and flat.estimate_error_worst == pytest.approx(0.0, abs=1e-12)
    assert study.fit_times(sizes, dict.fromkeys(list(sizes)[:3], 1.0)) is None
    assert ((1, 4), (2, 4)) in study.neighbours(list(sizes)) and len(
        study.neighbours(list(sizes))
    ) == 7
