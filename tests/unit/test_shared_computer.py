"""A computer's profile as one file to be passed on, and the list of profiles."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from airl_mav.addons.profiling.measurement import ProfileRequest, share
from airl_mav.addons.profiling.profile import profile
from airl_mav.cli.computers_command import ComputersOptions
from airl_mav.cli.computers_command import run as computers
from airl_mav.cli.main import main
from airl_mav.core.errors import UsageError
from airl_mav.latency.injection import select_injection
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import profile_digest

RAS_PI_4 = "9a586d1ed2f0597f62bcacc007f53849d2ed52c3da1d63e0f80db514b7365b53"


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A short measurement of this very machine."""
    request = ProfileRequest(decisions=20, warm_up=2, on="bench", workload="mine")
    measured = profile(request)
    path = share(measured, tmp_path_factory.mktemp("shared") / "new" / "bench.toml")
    return path, measured.t2_us


def test_another_machine_flies_as_it_with_the_file_alone(
    shared: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    path, t2_us = shared
    alone = tmp_path / "bench.toml"
    alone.write_bytes(path.read_bytes())
    loaded = load_computer(str(alone))
    work = loaded.workloads["mine"]
    assert work.latency.samples_ms == pytest.approx(np.maximum(t2_us, 1) / 1000.0, abs=5e-4)
    how = work.measured
    assert how is not None and {"governor", "throttling", "load average"} <= how.state.keys()
    assert "onnxruntime" in how.versions and how.date_utc.startswith("20")
    injection = select_injection(None, loaded, "mine")
    assert injection.latency is not None and injection.latency.samples_ms == work.latency.samples_ms


def test_samples_that_were_changed_are_refused(
    shared: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    path, _ = shared
    text = path.read_text(encoding="utf-8")
    start = text.index("samples_ms = [") + len("samples_ms = [")
    changed = tmp_path / "changed.toml"
    changed.write_text(text[:start] + "9.999," + text[start:], encoding="utf-8")
    with pytest.raises(UsageError, match=r"is not that of latency\.samples_ms"):
        load_computer(str(changed))


def test_profiles_that_do_not_tell_keep_their_digests() -> None:
    # The digest that runs of version 0.2 have recorded: they are resumed by it.
    assert profile_digest(load_computer("ras-pi-4")) == RAS_PI_4


def test_the_list_tells_measured_from_published(shared: tuple[Path, np.ndarray]) -> None:
    path, _ = shared
    console = Console(file=StringIO(), record=True, width=200)
    assert computers(ComputersOptions(profiles=("ras-pi-4", str(path))), console) == 0
    lines = console.export_text().splitlines()
    (mine,) = [line for line in lines if line.split()[:1] == ["mine"]]
    assert " measured " in mine and "airl profile --level bare, 20 decisions" in mine
    paper = [line for line in lines if "template-5x32" in line]
    assert paper and all(" published " in line for line in paper)


def test_what_cannot_be_a_profile_is_refused_before_anything_is_measured(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["profile", "--share", "bench.json"])
    assert ended.value.code == 2
    assert "--share bench.json: accepted: a file whose name ends in .toml" in (
        capsys.readouterr().err
    )
