"""Campaigns killed at random moments: no flight is lost, duplicated or half-written.

Kills hit the firmware, the companion or the harness at any moment. Each seed is flown exactly once
and its files are complete. `test_evaluate_lockstep.py` covers lockstep flights with killed workers,
`test_training.py` covers learners.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil

from airl_mav.rehearsal.run_folder import load
from tests.support.ports import TestPorts, choose_ports
from tests.support.processes import (
    NO_REPORT,
    Running,
    children_of,
    has_ended,
    is_running,
    running,
    wait_until,
    write_arena,
)

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(300)]

SEED = 30
SPEED = 8.0

KILLER = """
import os, signal
from airl_mav.core import files as atomic
from airl_mav.rehearsal import run_folder

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def before(owner, name, when=lambda *_: True):
    real = getattr(owner, name)
    def deadly(*words, **more):
        if when(*words):
            die()
        return real(*words, **more)
    setattr(owner, name, deadly)

def after(owner, name):
    real = getattr(owner, name)
    def deadly(*words, **more):
        real(*words, **more)
        die()
    setattr(owner, name, deadly)

def tear(name):
    real = os.fsync
    def deadly(descriptor):
        real(descriptor)
        if os.readlink(f"/proc/self/fd/{descriptor}").endswith(name):
            os.ftruncate(descriptor, os.fstat(descriptor).st_size - 40)
            die()
    os.fsync = deadly
"""

WINDOWS = {
    "the settings half written": "before(atomic, 'sync', lambda p: p.name.startswith('run.json.'))",
    "no scenario file": "before(atomic, 'sync', lambda p: p.name.startswith('scenario.toml.'))",
    "nothing saved": "before(run_folder.RunFolder, 'save_episodes')",
    "half an archive": "tear('latency.npz')",
    "one archive": "after(atomic, 'add_arrays')",
    "half a line": "tear('episodes.jsonl')",
    "a line": "after(run_folder.RunFolder, 'save_episodes')",
    "no directory": "before(run_folder.RunFolder, 'close')",
    "a directory": "after(atomic, 'close_archive')",
}
"""Moments at which a harness dies while saving, named by the content on disk."""


class Campaign:
    """One run folder, and the same command again and again until all of it is flown."""

    def __init__(self, folder: Path, episodes: int) -> None:
        self.folder, self.episodes = folder, episodes
        self.out = folder / "run"
        self.arena = write_arena(folder, 9.0)
        self.pids: set[int] = set()
        """All processes that it ever had."""

    def options(self, ports: TestPorts) -> list[str]:
        return [
            *("--policy", "greedy", "--arena", str(self.arena), "--altitude-m", "1.5"),
            *("--episodes", str(self.episodes), "--seed", str(SEED), "--speed", str(SPEED)),
            *("--out", str(self.out), "--no-validity", *ports.options()),
        ]

    @contextmanager
    def flying(self, script: str = "") -> Iterator[Running]:
        """Run the command; other ports every time, as they decide nothing."""
        code = f"{NO_REPORT}\n{script}\nfrom airl_mav.cli import main\nmain.sitl()"
        with running(["-c", code, *self.options(choose_ports())], self.folder) as process:
            yield process
            self.look(process)

    def look(self, process: Running) -> dict[str, int]:
        """Return the two processes of a harness, by name."""
        found = {
            name: pid
            for name, pid in children_of(process.pid).items()
            if name in ("firmware", "companion")
        }
        process.children |= found
        self.pids |= {process.pid, *found.values()}
        return found

    def saved(self) -> list[dict[str, Any]]:
        """Return the lines that are there, as a reader without this package sees them."""
        path = self.out / "episodes.jsonl"
        data = path.read_bytes() if path.exists() else b""
        return [json.loads(line) for line in data[: data.rfind(b"\n") + 1].splitlines()]

    def check_half_way(self) -> int:
        """Fail when what lies there is not whole, after any kill; return how many flights do."""
        numbers = [line["index"] for line in self.saved()]
        assert numbers == sorted(set(numbers)), numbers
        if not (self.out / "run.json").exists():
            assert not numbers
            return 0
        run = load(self.out)
        assert [episode.index for episode in run.episodes] == numbers
        assert set(run.trajectories) == set(run.latency) == set(numbers)
        return len(numbers)

    def check_whole(self) -> None:
        """Fail unless every seed has been flown once and everything of it is there."""
        assert self.check_half_way() == self.episodes
        lines = self.saved()
        assert [line["seed"] for line in lines] == [SEED + i for i in range(self.episodes)]
        # One arena without obstacles: there is no reason to fail.
        assert {line["outcome"] for line in lines} == {"success"}
        for name in ("trajectories.npz", "latency.npz"):
            with np.load(self.out / name) as archive:
                assert len(set(archive.files)) == len(archive.files)
                groups = {key.partition("/")[0] for key in archive.files}
            assert groups == {f"{i:03d}" for i in range(self.episodes)}
        run = load(self.out)
        for episode in run.episodes:
            path, stamps = run.trajectories[episode.index], run.latency[episode.index]
            assert episode.navigation_us is not None
            assert path.time_us[0] <= episode.started_us + 20_000
            assert path.time_us[-1] >= episode.ended_us
            # Where it was judged: a late companion flies on for some metres before it lands.
            judged = int(np.searchsorted(path.time_us, episode.ended_us, side="right")) - 1
            there = path.position[judged, :2]
            assert np.hypot(*(there - episode.goal)) < episode.goal_radius_m + 1.0
            decided = stamps["sent_us"]
            assert len(decided) >= 1
            # Equality is possible: while the simulator is stopped, events occur at a single tick.
            assert episode.navigation_us <= decided.min() <= decided.max() <= path.time_us[-1]
            check_log(self.out / f"flight-{episode.index:03d}.tlog", path.time_us)
        names = {path.name for path in self.out.iterdir()}
        logs = {f"flight-{i:03d}.{kind}" for i in range(self.episodes) for kind in ("tlog", "ulg")}
        assert names == logs | {
            *("run.json", "scenario.toml", "episodes.jsonl", "trajectories.npz", "latency.npz"),
            *("firmware.log", "companion.log"),
        }

    def nobody_left(self) -> None:
        """Fail when one of its processes outlives it by more than a moment."""
        for pid in self.pids:
            wait_until(partial(has_ended, pid), f"process {pid} to end", 30.0)


def check_log(path: Path, time_us: np.ndarray) -> None:
    """Fail unless a MAVLink log holds a whole flight, and that one alone."""
    log = mavutil.mavlogfile(str(path))
    times, landed = [], 0
    while (message := log.recv_match()) is not None:
        times.append(message._timestamp)
        assert message.get_type() != "BAD_DATA"
        landed += message.get_type() == "STATUSTEXT" and "Disarmed by landing" in message.text
    log.close()
    assert landed == 1
    assert max(times) - min(times) == pytest.approx((time_us[-1] - time_us[0]) / 1e6, abs=1.5)


@pytest.mark.nightly
@pytest.mark.parametrize("chance", [random.Random(11)], ids=["seed-11"])
def test_whoever_is_killed_whenever_every_seed_is_flown_once(
    tmp_path: Path, chance: random.Random
) -> None:
    campaign = Campaign(tmp_path, episodes=3)
    victims = ["harness", "companion", "firmware", "harness"]
    chance.shuffle(victims)
    killed: list[str] = []
    held = 0
    told = ""
    for _ in range(20):
        with campaign.flying() as run:
            while victims:
                # From the start of the processes to the landing of the next flight but one.
                ends = time.monotonic() + chance.uniform(0.0, 6.0)
                while run.process.poll() is None and time.monotonic() < ends:
                    campaign.look(run)
                    time.sleep(0.02)
                if run.process.poll() is not None:
                    break
                pid = run.pid if victims[-1] == "harness" else campaign.look(run).get(victims[-1])
                if pid is None:
                    continue
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                killed.append(victims.pop())
                if killed[-1] == "harness":
                    break
            code = run.wait()
            told += run.text()
        campaign.nobody_left()
        now = campaign.check_half_way()
        assert now >= held, told
        held = now
        # Killed; the same flight was lost three times; finished.
        assert code in (-signal.SIGKILL, 1, 0), run.text()
        assert code != 1 or "lost 3 times" in run.text(), run.text()
        if code == 0:
            break
    assert held == campaign.episodes
    # It may be through before all have had their turn, but not untouched.
    assert len(killed) >= 2
    assert "Traceback" not in told
    campaign.check_whole()
    # Each survived loss is reported, and noted with the flight.
    for name in ("companion", "firmware"):
        told_of = told.count(f"begins again: the {name} died (SIGKILL)")
        noted = [note for line in campaign.saved() for note in line["notes"]]
        kept = sum(f"flown again: the {name} died (SIGKILL)" in note for note in noted)
        assert kept <= told_of <= killed.count(name)


FORKS = """
import json, os, sys
from airl_mav.cli import main
from airl_mav.experiments import evaluate, gym_flier
from airl_mav.experiments import campaign
from airl_mav.report import run_report
from airl_mav.report import run_report

campaign.INTERVAL_S, campaign.INTERVAL_PER_SAVE = 0.02, 0.0
run_report.MAX_PICTURED = 1
for script in json.loads(sys.argv.pop(1)):
    if (pid := os.fork()) == 0:
        exec(script)
        try:
            main.main()
        except SystemExit as end:
            os._exit(end.code)
    print("status", os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""
"""Program that runs one command line repeatedly, each time in a forked process."""


def evaluate(folder: Path, out: Path, *scripts: str) -> list[int]:
    """Run `airl evaluate` at level gym after each script; return the exit statuses."""
    words = ["evaluate", "greedy", "--arena", "no-obstacles", "--episodes", "40", "--slots", "8"]
    words = ["-c", FORKS, json.dumps(scripts), *words, "--out", str(out)]
    with running(words, folder) as process:
        assert process.wait() == 0, process.text()
        return [int(status) for status in re.findall(r"^status (-?\d+)$", process.text(), re.M)]


@pytest.mark.nightly
@pytest.mark.xdist_group("evaluation")
def test_an_evaluation_dies_at_every_moment_of_saving(tmp_path: Path) -> None:
    """At level gym flights are the same every time: so are runs, killed or not."""
    out, straight = tmp_path / "killed", tmp_path / "straight"
    page = "before(atomic, 'sync', lambda p: p.name.startswith('report.html.'))"
    draw = f"sys.argv[1:] = ['report', {str(out)!r}]"
    deadly = [f"{KILLER}\n{window}" for window in WINDOWS.values()]
    deadly.append(f"{KILLER}\n{page}\n{draw}")
    statuses = evaluate(tmp_path, out, *deadly, "", draw)
    assert statuses == [-signal.SIGKILL] * len(deadly) + [0, 0]
    assert evaluate(tmp_path, straight, "") == [0]
    assert (out / "report.html").read_text(encoding="utf-8").rstrip().endswith("</html>")
    held = [(path / "episodes.jsonl").read_bytes().splitlines() for path in (out, straight)]
    assert len(held[0]) == 40
    assert sorted(held[0]) == sorted(held[1])
    assert (out / "scenario.toml").read_bytes() == (straight / "scenario.toml").read_bytes()
    for name in ("trajectories.npz", "latency.npz"):
        with np.load(straight / name) as one, np.load(out / name) as other:
            assert sorted(one.files) == sorted(other.files)
            assert all(np.array_equal(one[key], other[key]) for key in one.files)
    assert not list(out.glob("*.partial"))
    assert not list(out.glob(".*"))


@pytest.mark.nightly
def test_two_do_not_fly_into_one_folder(tmp_path: Path) -> None:
    campaign = Campaign(tmp_path, episodes=2)
    impatient = "from airl_mav.rehearsal import run_folder\nrun_folder.WAIT_S = 0.2"
    with campaign.flying() as first:
        first.find_children("firmware", "companion")
        # Stopped: it must outlast the start of the second, on a slow machine too.
        os.kill(first.pid, signal.SIGSTOP)
        with campaign.flying(impatient) as second:
            assert second.wait() == 2
            assert "another run flies into it" in second.text()
        # A process that outlives its harness still has it: it may be about to write.
        children = campaign.look(first)
        os.kill(children["firmware"], signal.SIGSTOP)
        first.process.kill()
        first.process.wait()
        wait_until(lambda: not is_running(children["companion"]), "the companion to end")
        with campaign.flying(impatient) as third:
            assert third.wait() == 2
        with campaign.flying() as fourth:
            fourth.wait_for_text("waiting for the processes of an earlier run to end")
            os.kill(children["firmware"], signal.SIGCONT)
            assert fourth.wait() == 0, fourth.text()
    campaign.nobody_left()
    campaign.check_whole()
