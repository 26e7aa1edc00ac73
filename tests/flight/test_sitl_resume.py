"""Resuming level sitl: identity of a run, remaining flights, and messages.

Flights have stand-ins; `test_campaign_faults.py` kills real flights.
"""

from __future__ import annotations

import errno
import fcntl
import io
import json
import re
import signal
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from airl_mav.cli import sitl_command as sitl
from airl_mav.core.errors import UsageError
from airl_mav.experiments import live
from airl_mav.experiments.live import FlownRun
from airl_mav.rehearsal import run_folder
from airl_mav.rehearsal.live_view import ViewAddresses
from airl_mav.rehearsal.observer import LiveObserver
from airl_mav.rehearsal.rehearsal import RehearsalError
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder, load
from airl_mav.scenario.aircraft import Ports
from airl_mav.scenario.resolve import ResolvedScenario
from tests.support.processes import write_arena
from tests.support.run_demo import demo_arena, demo_episode


class Stage:
    """Stands in for rehearsals: saves episodes until something comes in between."""

    def __init__(self) -> None:
        self.ends: dict[int, BaseException] = {}
        """Exceptions raised in place of an episode, once each, by index."""
        self.flown: list[int] = []
        self.begun = 0

    def rehearsal(
        self,
        scenario: ResolvedScenario,
        folder: RunFolder,
        observer: LiveObserver,
        keeps: Collection[int],
        view: ViewAddresses | None,
    ) -> Rehearsal:
        assert len(keeps) == 1 and view is None
        self.begun += 1
        return Rehearsal(self, scenario, folder, observer)


class Rehearsal:
    def __init__(
        self, stage: Stage, scenario: ResolvedScenario, folder: RunFolder, observer: LiveObserver
    ) -> None:
        self.stage, self.asked, self.folder, self.observer = (
            stage,
            scenario.scenario,
            folder,
            observer,
        )

    def __enter__(self) -> Rehearsal:
        return self

    def __exit__(self, *_: object) -> None: ...

    def run(self, done: Collection[int]) -> None:
        for index, seed in enumerate(self.asked.seeds):
            if index in done:
                continue
            if index in self.stage.ends:
                raise self.stage.ends.pop(index)
            record, path, stamps = demo_episode(index, demo_arena(index + 1))
            record = replace(record, seed=seed, arena=self.asked.arena)
            self.folder.save_episodes([FlownEpisode(record, path, stamps)])
            self.stage.flown.append(index)
            self.observer.finished(record)


@pytest.fixture(autouse=True)
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    stage = Stage()
    monkeypatch.setattr(live, "Rehearsal", stage.rehearsal)
    return stage


Fly = Callable[..., tuple[int, str]]


@pytest.fixture
def fly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fly:
    """`airl-sitl --out run`: exit status and output, without a report."""
    shown: list[Path] = []

    def conclude(flown: FlownRun, *_: object) -> int:
        shown.append(flown.path)
        return 0

    monkeypatch.setattr(sitl, "conclude", conclude)
    arena = str(write_arena(tmp_path))

    def run(**options: Any) -> tuple[int, str]:
        console = Console(record=True, width=200, file=io.StringIO())
        words: dict[str, Any] = {"policy": "greedy", "arena": arena, "seed": 5, "episodes": 4}
        words |= {"out": tmp_path / "run"} | options
        before = signal.getsignal(signal.SIGTERM)
        try:
            code = sitl.run(sitl.SitlOptions(**words), console)
        finally:
            assert signal.getsignal(signal.SIGTERM) is before
        assert shown.pop() == words["out"]
        return code, console.export_text()

    return run


def test_an_interrupted_run_goes_on(fly: Fly, stage: Stage, tmp_path: Path) -> None:
    out = tmp_path / "run"
    stage.ends[2] = KeyboardInterrupt()
    code, text = fly()
    assert code == 130
    assert f"interrupted: finished flights are kept; resume with --out {out}" in text
    assert stage.flown == [0, 1]
    # Ports decide nothing; an interrupt that comes at once loses nothing.
    stage.ends[2] = KeyboardInterrupt()
    assert (
        fly(ports=Ports(api_port=1, api_local_port=2, gcs_port=3, gcs_local_port=4, camera_port=5))[
            0
        ]
        == 130
    )
    code, text = fly()
    assert code == 0
    assert f"{out}: 2 of 4 episodes are there" in text
    assert stage.flown == [0, 1, 2, 3]
    assert [e.seed for e in load(out).episodes] == [5, 6, 7, 8]
    # Finished: shown again, no process starts. An explicit default value is the same run.
    code, text = fly(speed=1.0, hold_s=0.5)
    assert (code, stage.begun) == (0, 3)
    assert f"{out}: 4 of 4 episodes are there" in text
    assert "MAVSDK" not in text


def test_a_flight_that_is_lost_too_often_ends_the_run(
    fly: Fly, stage: Stage, tmp_path: Path
) -> None:
    stage.ends[1] = RehearsalError("flight 001, seed 6: lost 3 times; at last the companion died")
    code, text = fly()
    assert code == 1
    assert "error: flight 001, seed 6: lost 3 times; at last the companion died" in text
    assert f"broken off: finished flights are kept; resume with --out {tmp_path / 'run'}" in text
    assert fly()[0] == 0
    assert stage.flown == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"seed": 6}, "seed = 5, not 6"),
        ({"episodes": 3}, "episodes = 4, not 3"),
        ({"speed": 2.0}, "speed = 1.0, not 2.0"),
        ({"policy": "static-obstacles"}, "policy"),
        ({"arena": "no-obstacles"}, "arena"),
        ({"hold_s": 0.4}, "pilot.hold_s = 0.5, not 0.4"),
        ({"computer": "ras-pi-4", "workload": "template-5x32"}, "computer = 'workstation'"),
        ({"latency": "150ms"}, "latency = None, not '150ms'"),
        ({"latency_seed": 1}, "latency_seed = 0, not 1"),
        ({"arena_seed": 3}, "arena_seed = None, not 3"),
        ({"time_limit_s": 60.0}, "time_limit_s = 120.0, not 60.0"),
    ],
)
def test_another_run_is_not_mixed_in(
    fly: Fly, stage: Stage, tmp_path: Path, options: dict[str, Any], named: str
) -> None:
    fly()
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    with pytest.raises(UsageError, match=f"holds a run with .*{re.escape(named)}"):
        fly(**options)
    assert stage.begun == 1
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before


def test_a_changed_profile_is_another_run(fly: Fly, tmp_path: Path) -> None:
    """Its name is the same, its content is not."""
    fly()
    write_arena(tmp_path, 9.0)
    with pytest.raises(UsageError, match=r"profiles_sha256\.arena"):
        fly()


def test_more_episodes_are_added(fly: Fly, stage: Stage, tmp_path: Path) -> None:
    """Flights in real time are worth keeping."""
    fly(episodes=2)
    code, text = fly(episodes=5)
    assert code == 0
    assert "2 of 5 episodes are there" in text
    assert stage.flown == [0, 1, 2, 3, 4]
    run = load(tmp_path / "run")
    assert run.info.seeds == (5, 6, 7, 8, 9)
    assert run.info.config["episodes"] == 5
    # Not from another seed on, nor with anything else changed.
    with pytest.raises(UsageError, match="seed = 5, not 4"):
        fly(episodes=5, seed=4)
    with pytest.raises(UsageError, match=r"pilot\.hold_s = 0\.5, not 0\.4"):
        fly(episodes=9, hold_s=0.4)
    assert load(tmp_path / "run").info == run.info


def test_input_that_cannot_be_used_takes_nothing_away(
    fly: Fly, stage: Stage, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    stage.ends[0] = UsageError("port 1 is taken")
    with pytest.raises(UsageError, match="port 1 is taken"):
        fly()
    # A run that never began: the same folder can be used again.
    assert not out.exists()
    stage.ends[2] = UsageError("no arena can be made of seed 7")
    with pytest.raises(UsageError, match="seed 7"):
        fly()
    assert len(load(out).episodes) == 2
    stage.ends[2] = UsageError("port 1 is taken")
    with pytest.raises(UsageError, match="port 1 is taken"):
        fly()
    assert len(load(out).episodes) == 2
    assert fly()[0] == 0
    assert len(load(out).episodes) == 4


def test_what_a_killed_run_left_is_swept_and_flown_again(
    fly: Fly, stage: Stage, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    stage.ends[2] = KeyboardInterrupt()
    fly()
    lines = out / "episodes.jsonl"
    whole = lines.read_bytes()
    # Killed in the middle of a line, of an archive, of a flight.
    lines.write_bytes(whole[:-20])
    for name in (".episode-001.npz", ".decisions-001.npz.partial", "latency.npz.partial"):
        (out / name).write_bytes(b"half")
    (out / "flight-001.tlog.part").write_bytes(b"cut")
    code, text = fly()
    assert code == 0
    assert "1 of 4 episodes are there" in text
    assert stage.flown == [0, 1, 1, 2, 3]
    names = {path.name for path in out.iterdir()}
    assert names == {
        *("run.json", "scenario.toml", "episodes.jsonl", "latency.npz", "trajectories.npz"),
        "flight-001.tlog",
    }
    assert [json.loads(line)["index"] for line in lines.read_bytes().splitlines()] == [0, 1, 2, 3]
    run = load(out)
    assert set(run.trajectories) == set(run.latency) == {0, 1, 2, 3}


def test_a_folder_is_kept_to_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    folder = tmp_path / "new" / "run"
    monkeypatch.setattr(run_folder, "WAIT_S", 0.1)
    with run_folder.locked(folder, told.append):
        assert told == []
        with pytest.raises(UsageError, match="another run flies into it"):
            run_folder.locked(folder, told.append).__enter__()
    assert told == [f"{folder}: waiting for the processes of an earlier run to end"]
    with run_folder.locked(folder, told.append):
        assert len(told) == 1
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"--out .*file: File exists"):
        run_folder.locked(tmp_path / "file", told.append).__enter__()


def test_a_file_system_without_locks_is_flown_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.EBADF, "not of a folder")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with run_folder.locked(tmp_path, lambda _: None):
        pass
