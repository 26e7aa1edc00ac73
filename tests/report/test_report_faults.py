"""Messages of `airl report` for runs that are damaged or cannot be recomputed."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from airl_mav.cli import main
from airl_mav.core.errors import UsageError
from airl_mav.flight.episode_record import Part
from airl_mav.rehearsal.run_folder import load
from airl_mav.report.comparison.show import compare_folders
from airl_mav.report.run_report import write_report
from tests.support.run_demo import write_demo_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_demo_run(tmp_path / "run", episodes=2)[0].path


def flip(path: Path) -> None:
    """Turn over every bit of some bytes in the middle."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    for place in range(middle, middle + 64):
        data[place] ^= 0xFF
    path.write_bytes(data)


def damage(run: Path, how: str) -> None:
    name, _, what = how.partition(" ")
    if what == "flipped":
        flip(run / name)
    elif what == "empty":
        (run / name).write_bytes(b"")
    else:
        (run / name).write_text('{"schema": 1, "name": ' + "[" * 200_000)


@pytest.mark.parametrize(
    "how",
    [
        "latency.npz flipped",
        "latency.npz empty",
        "trajectories.npz flipped",
        "trajectories.npz empty",
        "run.json nested",
        "run.json empty",
    ],
)
def test_a_damaged_run_gets_one_line_and_exit_code_2(
    run: Path, how: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(run, how)
    with pytest.raises(UsageError) as caught:
        write_report(run)
    assert str(run) in str(caught.value)
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(sys, "argv", ["airl", "report", str(run)])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1
    assert not (run / "report.html").exists()


def test_a_damaged_run_among_others_is_named(run: Path, tmp_path: Path) -> None:
    other = write_demo_run(tmp_path / "other", episodes=2)[0].path
    damage(other, "latency.npz empty")
    with pytest.raises(UsageError, match="other") as caught:
        compare_folders([run, other])
    assert "\n" not in str(caught.value)


def test_a_vehicle_that_cannot_hover_gets_one_line(run: Path, tmp_path: Path) -> None:
    heavy = tmp_path / "heavy.toml"
    heavy.write_text('base = "quad"\n[body]\nmass_kg = 90.0\n')
    flown = load(run)
    setup = replace(flown.info.setup, vehicle=Part(str(heavy)))
    with pytest.raises(UsageError, match="heavy") as caught:
        write_report(replace(flown, info=replace(flown.info, setup=setup)))
    assert "\n" not in str(caught.value)


@pytest.mark.nightly
def test_a_report_goes_where_it_is_asked_to_and_prints_nothing(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = write_report(run, tmp_path / "out")
    assert page == tmp_path / "out" / "report.html"
    assert page.stat().st_size > 100_000
    assert not (run / "report.html").exists()
    assert capsys.readouterr() == ("", "")
