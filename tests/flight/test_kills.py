"""Commands killed at random moments (kill -9), on full disks and in read-only folders.

Each command is killed repeatedly and resumed with the same arguments. Files are whole after each
kill, no process stays, and the final results equal an undisturbed run. Add more kills:
`AIRL_KILLS=50 pytest tests/flight/test_kills.py`.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from matplotlib import get_cachedir

from airl_mav.core import files
from airl_mav.policy.card import read_card
from airl_mav.rehearsal.run_folder import LoadedRun, load
from tests.support.campaign_kit import same_runs
from tests.support.ports import choose_ports
from tests.support.processes import ROOT, wait_until, write_arena
from tests.support.sweep_kit import TINY

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.xdist_group("kills"),
]

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

ZYGOTE = """
import importlib, json, os, sys, tempfile
from airl_mav.cli import main, sitl_command
from airl_mav.report import run_report

for name in sys.argv[1:]:
    importlib.import_module(name)
sitl_command.conclude = lambda *_: 0
run_report.MAX_PICTURED = 1
for line in sys.stdin:
    order = json.loads(line)
    if (pid := os.fork()) == 0:
        log = os.open(order["log"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.environ["TMPDIR"] = order["scratch"]
        os.chdir(order["folder"])
        sys.argv = ["airl", *order["words"]]
        try:
            main.main()
        except SystemExit as end:
            os._exit(end.code)
        except BaseException:
            sys.excepthook(*sys.exc_info())
        os._exit(1)
    print(pid, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""
"""Process that has imported all modules, and forks for each command line."""

MODULES = (
    "airl_mav.addons.fault_matrix.command",
    "airl_mav.addons.sweep.trial_run",
    "airl_mav.cli.evaluate_command",
    "airl_mav.cli.hardware_gap_command",
    "airl_mav.cli.train_command",
    "airl_mav.experiments.gym_flier",
    "airl_mav.training.training_run",
)
SMALL_FLIGHTS = ("--altitude-m", "1.5", "--time-limit-s", "20", "--seed", f"{SEED}")


def sitl(folder: Path) -> list[str]:
    arena = write_arena(folder, 9.0)
    options = ("--policy", "greedy", "--arena", f"{arena}", "--altitude-m", "1.5", "--speed", "8")
    ports = choose_ports().options()
    return ["sitl", *options, "--episodes", "2", "--seed", f"{SEED}", "--no-validity", *ports]


def evaluation(folder: Path) -> list[str]:
    arena = write_arena(folder, 9.0)
    words = ("evaluate", "greedy", "--arena", f"{arena}", "--level", "lockstep", *SMALL_FLIGHTS)
    return [*words, "--episodes", "4", "--workers", "1", "--tlogs"]


def gap(folder: Path) -> list[str]:
    words = (
        "hardware-gap",
        "--policy",
        "static-obstacles",
        "--arena",
        "no-obstacles",
        *SMALL_FLIGHTS,
    )
    return [*words, "--episodes", "20", "--slots", "4"]


def train(folder: Path) -> list[str]:
    config = folder / "short.toml"
    config.write_text(TRAINING, encoding="utf-8")
    return ["train", f"{config}", "--resume"]


def faults(folder: Path) -> list[str]:
    words = ("--fault", "baro off", "--fault", "gps off", "--phases", "hold", "climb")
    return ["faults", *words, "--episodes", "2", "--workers", "2"]


def sweep(folder: Path) -> list[str]:
    config = folder / "small.toml"
    config.write_text(TINY.replace("seeds = [1, 2]", "seeds = [6]"), encoding="utf-8")
    return ["sweep", f"{config}", "--workers", "2"]


def anywhere(run: LoadedRun) -> LoadedRun:
    """Return a run without the folder of its arena's file."""
    return replace(run, episodes=tuple(replace(e, arena=Path(e.arena).name) for e in run.episodes))


def check_flights(one: Path, other: Path) -> None:
    """Fail unless all run folders have equal flights, bit by bit."""
    runs = sorted(path.parent.relative_to(one) for path in one.rglob("run.json"))
    assert runs == sorted(path.parent.relative_to(other) for path in other.rglob("run.json"))
    for name in runs:
        assert same_runs(anywhere(load(one / name)), anywhere(load(other / name))), name
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


class Zygote:
    """Process that forks for each command line: kills are many, imports are slow."""

    def __init__(self, folder: Path, inside: Sequence[str] = ()) -> None:
        """Start the process, by a command that runs its last arguments if given."""
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}", "COLUMNS": "200"}
        environment |= {"MPLCONFIGDIR": get_cachedir()}
        self._process = subprocess.Popen(
            [*inside, sys.executable, "-c", ZYGOTE, *MODULES],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment,
        )

    def start(self, **order: Any) -> int:
        """Start a command; return its process."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return int(self._line())

    def status(self) -> int:
        """Wait for the end of the command; return its exit status."""
        return int(self._line())

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    @property
    def pid(self) -> int:
        """The process."""
        return self._process.pid

    def close(self) -> None:
        """End the process."""
        self._process.communicate(timeout=60.0)


@pytest.fixture(scope="module")
def zygote(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Zygote]:
    made = Zygote(tmp_path_factory.mktemp("zygote"))
    yield made
    made.close()


class Command:
    """One command line with one output folder."""

    def __init__(self, zygote: Zygote, folder: Path, victim: Victim, out: str) -> None:
        self.zygote, self.folder, self.victim = zygote, folder, victim
        self.out = folder / out
        name = out.replace("/", "-")
        self.scratch = folder / f"{name}-tmp"
        self.scratch.mkdir(exist_ok=True)
        self.log = folder / f"{name}.txt"

    def start(self) -> int:
        """Start the command; return its process."""
        words = [*self.victim.words(self.folder), "--out", f"{self.out}"]
        places = {"folder": f"{self.folder}", "scratch": f"{self.scratch}", "log": f"{self.log}"}
        return self.zygote.start(words=words, **places)

    def text(self) -> str:
        """Return what it has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def finish(self) -> float:
        """Run to the end; return the duration [s]."""
        started = time.monotonic()
        self.start()
        assert self.zygote.status() in self.victim.ends, self.text()
        return time.monotonic() - started

    def kill_after(self, delay_s: float) -> bool:
        """Start, kill after a delay, and check what is left; return False if it had ended."""
        process = psutil.Process(self.start())
        family: set[psutil.Process] = set()
        ends = time.monotonic() + delay_s
        while not has_ended(process) and time.monotonic() < ends:
            with suppress(psutil.Error):
                family |= set(process.children(recursive=True))
            time.sleep(0.02)
        with suppress(psutil.NoSuchProcess):
            process.kill()
        status = self.zygote.status()
        assert status in (-signal.SIGKILL, *self.victim.ends), self.text()
        for each in family:
            wait_until(partial(has_ended, each), f"{each} to end", 30.0)
        check_whole_files(self.out)
        return status == -signal.SIGKILL

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
            # The archives of a run get their directory at the end of a command.
            held = files._archive(path.read_bytes()) if path.suffix == ".npz" else None
            with held or zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    archive.read(member)  # Checks the CRC.


@pytest.fixture(scope="module")
def straight(
    zygote: Zygote, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], tuple[Path, float]]:
    """Return the folder of an undisturbed run, and its duration [s]."""

    @cache
    def run(name: str) -> tuple[Path, float]:
        folder = tmp_path_factory.mktemp(f"straight-{name}")
        command = Command(zygote, folder, VICTIMS[name], "run")
        duration_s = command.finish()
        if "compil" in command.text():  # Kills must hit flights, too.
            shutil.rmtree(command.out)
            duration_s = command.finish()
        return command.out, duration_s

    return run


@pytest.mark.parametrize("name", VICTIMS)
def test_killed_at_any_moment_results_are_the_same(
    zygote: Zygote, straight: Callable[[str], tuple[Path, float]], tmp_path: Path, name: str
) -> None:
    victim, (undisturbed, duration_s) = VICTIMS[name], straight(name)
    chance = random.Random(f"{name}-{SEED}")
    kills = runs = 0
    while kills < KILLS:
        killed = Command(zygote, tmp_path, victim, f"killed-{runs}")
        # A few kills in each run at most: a finished run starts again.
        for _ in range(5):
            if kills == KILLS or not killed.kill_after(chance.uniform(0.0, duration_s)):
                break
            kills += 1
        killed.finish()
        killed.nothing_left()
        victim.check(killed.out, undisturbed)
        runs += 1
        sys.stdout.write(f"{name}: {kills} kills in {runs} runs of {duration_s:.1f} s\n")
        sys.stdout.flush()


PAGE_BYTES = 4096

MOUNT = 'mount -t tmpfs -o size=$1 tmpfs "$2" && shift 2 && exec "$@"'
"""Shell command: mount a disk of a size, and continue inside."""


class Disk:
    """Small disk, seen by one zygote only."""

    def __init__(self, folder: Path, size_bytes: int) -> None:
        self.folder = folder / "disk"
        self.folder.mkdir()
        shell = ["unshare", "-rm", "bash", "-c", MOUNT, "mount"]
        self.zygote = Zygote(folder, [*shell, f"{size_bytes}", f"{self.folder}"])

    @property
    def seen(self) -> Path:
        """Path of the disk's content for this process."""
        return Path(f"/proc/{self.zygote.pid}/root{self.folder}")

    def remount(self, options: str) -> None:
        """Change the disk's size, or make it read-only."""
        words = ["nsenter", "-t", f"{self.zygote.pid}", "-U", "-m", "--preserve-credentials"]
        remount = ["mount", "-o", f"remount,{options}", f"{self.folder}"]
        subprocess.run([*words, *remount], check=True)


def has_namespaces() -> bool:
    """Return True if users can mount a disk on this machine."""
    told = subprocess.run(
        ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"],
        capture_output=True,
        check=False,
    )
    return told.returncode == 0


@pytest.mark.parametrize("name", VICTIMS)
def test_full_and_read_only_disks_are_told_in_one_line(
    straight: Callable[[str], tuple[Path, float]], tmp_path: Path, name: str
) -> None:
    if not has_namespaces():
        pytest.skip("no user namespaces here")
    victim, (undisturbed, _) = VICTIMS[name], straight(name)
    sizes = [path.stat().st_size for path in undisturbed.rglob("*") if path.is_file()]
    pages = sum(-(-size // PAGE_BYTES) for size in sizes)
    disk = Disk(tmp_path, max(pages // 2, 1) * PAGE_BYTES)
    command = Command(disk.zygote, tmp_path, victim, "disk/run")
    try:
        command.start()
        check_told(command, disk.zygote.status(), "No space left on device")
        check_whole_files(disk.seen / "run")
        disk.remount("size=64m")
        command.finish()
        victim.check(disk.seen / "run", undisturbed)
        disk.remount("ro")
        refused = Command(disk.zygote, tmp_path, victim, "disk/new")
        refused.start()
        check_told(refused, disk.zygote.status(), "Read-only file system")
    finally:
        disk.zygote.close()


def check_told(command: Command, status: int, reason: str) -> None:
    """Fail unless a command ended with one line that contains the reason."""
    assert status not in (0, -signal.SIGKILL), command.text()
    assert "Traceback" not in command.text()
    lines = [line for line in command.text().splitlines() if reason in line]
    assert len(lines) == 1, command.text()
