"""Commands killed at random moments (kill -9), on full disks and in read-only folders.

Each command is killed again and again and resumed by the same words. Files are whole after each
kill, no process stays, and the final results are those of an undisturbed run. Add more kills:
`AIRL_KILLS=50 pytest tests/flight/test_kills.py`.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from matplotlib import get_cachedir

from airl_mav.policy.card import read_card
from airl_mav.rehearsal.run_folder import LATENCY_FILE, TRAJECTORIES_FILE, load
from tests.support.campaign_kit import same_runs
from tests.support.ports import choose_ports
from tests.support.processes import NO_REPORT, ROOT, wait_until, write_arena
from tests.support.sweep_kit import TINY

KILLS = int(os.environ.get("AIRL_KILLS", "10"))
SEED = 50

TRAINING = """
description = "a short one"
steps = 1_500
vehicles = 16
checkpoint_every = 250
[environment]
arena = "no-obstacles"
image_width_px = 16
image_height_px = 12
[algorithm]
learning_starts = 300
[selection]
every = 500
episodes = 10
"""

MAIN = ("-m", "airl_mav.cli.main")
SMALL_FLIGHTS = ("--altitude-m", "1.5", "--time-limit-s", "20", "--seed", f"{SEED}")


def sitl(folder: Path) -> list[str]:
    code = f"{NO_REPORT}\nfrom airl_mav.cli import main\nmain.sitl()"
    arena = write_arena(folder, 9.0)
    options = ("--policy", "greedy", "--arena", f"{arena}", "--altitude-m", "1.5", "--speed", "8")
    ports = choose_ports().options()
    return ["-c", code, *options, "--episodes", "2", "--seed", f"{SEED}", "--no-validity", *ports]


def evaluation(folder: Path) -> list[str]:
    arena = write_arena(folder, 9.0)
    words = ("evaluate", "greedy", "--arena", f"{arena}", "--level", "lockstep", *SMALL_FLIGHTS)
    return [*MAIN, *words, "--episodes", "6", "--workers", "2", "--tlogs"]


def gap(folder: Path) -> list[str]:
    words = (
        "hardware-gap",
        "--policy",
        "static-obstacles",
        "--arena",
        "no-obstacles",
        *SMALL_FLIGHTS,
    )
    return [*MAIN, *words, "--episodes", "20", "--slots", "4"]


def train(folder: Path) -> list[str]:
    config = folder / "short.toml"
    config.write_text(TRAINING, encoding="utf-8")
    return [*MAIN, "train", f"{config}", "--resume"]


def faults(folder: Path) -> list[str]:
    words = ("--fault", "baro off", "--fault", "gps off", "--phases", "hold", "climb")
    return [*MAIN, "faults", *words, "--episodes", "2", "--workers", "2"]


def sweep(folder: Path) -> list[str]:
    config = folder / "small.toml"
    config.write_text(TINY.replace("seeds = [1, 2]", "seeds = [6]"), encoding="utf-8")
    return [*MAIN, "sweep", f"{config}", "--workers", "2"]


def check_flights(one: Path, other: Path) -> None:
    """Fail unless all run folders have equal flights, bit by bit."""
    runs = sorted(path.parent.relative_to(one) for path in one.rglob("run.json"))
    assert runs == sorted(path.parent.relative_to(other) for path in other.rglob("run.json"))
    for name in runs:
        assert same_runs(load(one / name), load(other / name)), name
        logs = sorted(path.name for path in (one / name).glob("*.tlog"))
        assert [(one / name / log).read_bytes() for log in logs] == [
            (other / name / log).read_bytes() for log in logs
        ]


def check_complete(one: Path, other: Path) -> None:
    """Fail unless flights in real time are complete and valid."""
    names = {path.name for path in one.iterdir()}
    assert names == {path.name for path in other.iterdir()}
    run = load(one)
    assert [record.seed for record in run.episodes] == list(run.info.seeds)
    assert {record.outcome.value for record in run.episodes} == {"success"}


def plain(value: Any) -> Any:
    """Return data without what depends on the wall clock."""
    if isinstance(value, dict):
        clocks = ("seconds", "made", "crc32", "created_utc", "date_utc", "command")
        return {key: plain(each) for key, each in value.items() if key not in clocks}
    return [plain(each) for each in value] if isinstance(value, list) else value


def check_json(*names: str) -> Callable[[Path, Path], None]:
    """Return a check of equal data in files, and of equal policies."""

    def check(one: Path, other: Path) -> None:
        for name in names:
            found = []
            for folder in (one, other):
                text = (folder / name).read_text(encoding="utf-8")
                lines = text.splitlines() if name.endswith("l") else [text]
                found.append([plain(json.loads(line)) for line in lines])
            assert found[0] == found[1], name
        policies = sorted(path.parent.relative_to(one) for path in one.rglob("card.json"))
        assert policies == sorted(p.parent.relative_to(other) for p in other.rglob("card.json"))
        for policy in policies:
            assert read_card(one / policy).sha256 == read_card(other / policy).sha256

    return check


@dataclass(frozen=True)
class Victim:
    words: Callable[[Path], list[str]]
    check: Callable[[Path, Path], None]
    ends: tuple[int, ...] = (0,)
    """Exit statuses of a complete run."""


VICTIMS = {
    "sitl": Victim(sitl, check_complete),
    "lockstep": Victim(evaluation, check_flights),
    "gap": Victim(gap, check_flights),
    "train": Victim(train, check_json("evaluations.jsonl", "best/best.json")),
    "faults": Victim(faults, check_json("faults.json"), (0, 3)),
    "sweep": Victim(sweep, check_json("sweep.json")),
}


class Command:
    """One command line with one output folder."""

    def __init__(self, folder: Path, victim: Victim, out: str) -> None:
        self.folder, self.victim = folder, victim
        self.out = folder / out
        self.scratch = folder / f"{out}-tmp"
        self.scratch.mkdir(exist_ok=True)
        self.log = folder / f"{out}.txt"

    def start(self) -> subprocess.Popen[bytes]:
        environment = {
            **os.environ,
            "PYTHONPATH": f"{ROOT}",
            "COLUMNS": "200",
            "TMPDIR": f"{self.scratch}",
            "MPLCONFIGDIR": get_cachedir(),
        }
        words = [sys.executable, *self.victim.words(self.folder), "--out", f"{self.out}"]
        with self.log.open("ab") as log:
            return subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=environment,
            )

    def text(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")

    def finish(self, timeout_s: float = 400.0) -> float:
        """Run to the end; return the duration [s]."""
        started = time.monotonic()
        assert self.start().wait(timeout_s) in self.victim.ends, self.text()
        return time.monotonic() - started

    def kill_after(self, delay_s: float) -> bool:
        """Start, kill after a delay, and check what is left; return False if it had ended."""
        process = self.start()
        family: set[psutil.Process] = set()
        ends = time.monotonic() + delay_s
        while process.poll() is None and time.monotonic() < ends:
            with suppress(psutil.Error):
                family |= set(psutil.Process(process.pid).children(recursive=True))
            time.sleep(0.02)
        alive = process.poll() is None
        if alive:
            process.send_signal(signal.SIGKILL)
            process.wait()
        else:
            assert process.returncode in self.victim.ends, self.text()
        for each in family:
            wait_until(partial(has_ended, each), f"{each} to end", 30.0)
        check_whole_files(self.out)
        return alive

    def nothing_left(self) -> None:
        """Fail if a temporary file or folder remains."""
        left = [path for path in self.out.rglob("*") if path.suffix in (".partial", ".part")]
        left += list(self.out.rglob(".*"))
        left += [path for path in self.scratch.iterdir() if path.name.startswith("airl-")]
        assert left == []
        assert "Traceback" not in self.text()


def has_ended(process: psutil.Process) -> bool:
    """Return True if a process has ended, reaped or not."""
    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def check_whole_files(out: Path) -> None:
    """Fail if a file under its final name is half-written."""
    for path in out.rglob("*"):
        # A training moves whole checkpoints.
        if not path.is_file() or ".partial" in path.name:
            continue
        if path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".jsonl":
            whole, _, _ = path.read_bytes().rpartition(b"\n")
            for line in whole.splitlines():
                json.loads(line)
        elif path.suffix in (".npz", ".zip"):
            with zipfile.ZipFile(path) as archive:
                assert archive.testzip() is None


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", VICTIMS)
def test_killed_at_any_moment_results_are_the_same(tmp_path: Path, name: str) -> None:
    victim = VICTIMS[name]
    straight = Command(tmp_path, victim, "straight")
    duration_s = straight.finish()
    chance = random.Random(f"{name}-{SEED}")
    kills = runs_done = 0
    while kills < KILLS:
        killed = Command(tmp_path, victim, f"killed-{runs_done}")
        # A few kills in each run at most: a finished run starts anew.
        for _ in range(5):
            if kills == KILLS or not killed.kill_after(chance.uniform(0.0, duration_s)):
                break
            kills += 1
        killed.finish()
        killed.nothing_left()
        victim.check(killed.out, straight.out)
        runs_done += 1
    sys.stdout.write(f"{name}: {kills} kills in {runs_done} runs, undisturbed {duration_s:.1f} s\n")
    assert (killed.out / LATENCY_FILE).exists() == (straight.out / LATENCY_FILE).exists()
    assert (killed.out / TRAJECTORIES_FILE).exists() == (straight.out / TRAJECTORIES_FILE).exists()
