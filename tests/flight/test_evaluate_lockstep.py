"""`airl evaluate --level lockstep`: the same flights with many workers or few, killed or not."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.core.progress import Progress
from airl_mav.experiments import campaign
from airl_mav.experiments.live import fly_live
from airl_mav.flight.judge import Outcome
from airl_mav.policy.card import load_card
from airl_mav.rehearsal.run_folder import FlownEpisode, LoadedRun, load
from airl_mav.report import run_report
from airl_mav.report.comparison import show
from airl_mav.report.run_report import write_report
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.flight.test_evaluate import Page
from tests.support.campaign_kit import same_runs
from tests.support.command_line import airl, option_words
from tests.support.flown_here import flown_here
from tests.support.linear_policy import write_linear
from tests.support.page_alone import page_alone
from tests.support.processes import Running, has_ended, running, wait_until
from tests.support.worker_jobs import PaperFlier

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("lockstep-evaluation")]

ARENA, EPISODES, SEED = "no-obstacles", 2, 40


def evaluate(*policies: str | Path, page: bool = False, **options: Any) -> tuple[int, str]:
    """Run the command in this process; return exit status and output."""
    settings = {"arena": ARENA, "episodes": EPISODES, "seed": SEED, "level": "lockstep"}
    with ExitStack() as stack:
        if not page:
            stack.enter_context(
                patch.object(show, "write_document", lambda _, folder: folder / "matrix.html")
            )
        return airl("evaluate", *map(str, policies), *option_words(**(settings | options)))


@pytest.fixture(scope="module", autouse=True)
def _few_pictures() -> Iterator[None]:
    """Pictures take longer than flights."""
    with patch.object(run_report, "MAX_PICTURED", 1):
        yield


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedRun, str]:
    """Undisturbed run with this process as the only worker, and the printed text."""
    out = tmp_path_factory.mktemp("lockstep") / "one"
    with page_alone(), flown_here():
        code, text = evaluate("greedy", workers=1, out=out)
        write_report(out)
    assert code == 0
    return load(out), text


# --- what is flown


@pytest.mark.nightly
def test_one_worker_or_two_or_the_rehearsal_fly_the_same(
    reference: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    one, text = reference
    assert [(e.index, e.seed) for e in one.episodes] == [(i, SEED + i) for i in range(EPISODES)]
    assert {e.outcome for e in one.episodes} == {Outcome.SUCCESS}
    assert len({e.sha256["flight"] for e in one.episodes if e.sha256}) == EPISODES
    code, again = evaluate("greedy", workers=2, out=tmp_path / "two")
    assert code == 0
    assert same_runs(load(tmp_path / "two"), one)
    rehearsal = Scenario(
        level="lockstep", policy="greedy", arena=ARENA, episodes=EPISODES, seed=SEED
    )
    assert fly_live(resolve(rehearsal), tmp_path / "sitl", Progress()).ended == "complete"
    assert same_runs(load(tmp_path / "sitl"), one)
    # One line says the same of whole runs; by hand, as a shell would do it.
    lines = (tmp_path / "two" / "episodes.jsonl").read_text().splitlines()
    flights = {(e := json.loads(line))["index"]: e["sha256"]["flight"] for line in lines}
    told = "".join(f"{flights[i]}\n" for i in range(EPISODES))
    line = f"sha256 of the flights  {hashlib.sha256(told.encode()).hexdigest()}"
    assert line in again.splitlines()
    assert line in text.splitlines()


def test_the_run_says_what_it_is(reference: tuple[LoadedRun, str]) -> None:
    one, text = reference
    setup, config = one.info.setup, one.info.config
    assert (setup.level, setup.speed) == ("lockstep", None)
    assert (config["level"], config["workers"], config["tlogs"]) == ("lockstep", 1, False)
    assert config["pilot"]["hold_s"] == 0.5
    assert not list(one.path.glob("*.tlog*"))
    assert not list(one.path.glob("*.partial"))
    assert "success rate" in text
    page = Page((one.path / "report.html").read_text(encoding="utf-8"))
    assert "lockstep" in page.words
    # Simulated stages, none of them this machine's: 5 ms of transport, 1 ms of inference.
    for stamps in one.latency.values():
        decided = stamps["action_ready_us"] >= 0
        took = (stamps["action_ready_us"] - stamps["infer_start_us"])[decided]
        assert set(took.tolist()) == {1_000}
    for stage in ("t1 fetch", "t2 infer", "link", "control", "end to end"):
        assert stage in page.words


def test_a_learned_policy_without_an_input_and_its_card_and_logs(tmp_path: Path) -> None:
    folder = write_linear(tmp_path / "linear")
    whole, blind = tmp_path / "whole", tmp_path / "blind"
    options: dict[str, Any] = {"episodes": 1, "workers": 1}
    with flown_here():
        code, _ = evaluate(folder, on_card=True, tlogs=True, out=whole, **options)
    assert code == 0
    assert [e.outcome for e in load(whole).episodes] == [Outcome.SUCCESS]
    assert (whole / "flight-000.tlog").stat().st_size > 10_000
    (result,) = load_card(folder).results
    assert (result.level, result.arena, result.episodes) == ("lockstep", ARENA, 1)
    assert result.success_rate == 1.0
    # Without the goal it flies straight on.
    with flown_here():
        evaluate(folder, ablate="goal", time_limit_s=10.0, out=blind, **options)
    assert [e.outcome for e in load(blind).episodes] == [Outcome.TIMEOUT]
    assert "'goal' made zero" in load(blind).info.setup.policy.description


@pytest.mark.nightly
def test_a_table_of_arenas(reference: tuple[LoadedRun, str], tmp_path: Path) -> None:
    arenas = (ARENA, "static-obstacles")
    code, text = evaluate("greedy", arena=arenas, episodes=1, workers=1, out=tmp_path / "m")
    assert code == 0
    told = json.loads((tmp_path / "m" / "matrix.json").read_text())
    assert told["facts"]["level"] == "lockstep"
    assert [r["quality"]["success_rate"]["n"] for r in told["runs"]] == [1, 1]
    assert [len(r["sha256"]) for r in told["runs"]] == [64, 64]
    assert f"{ARENA}: 1 goal reached" in text
    assert load(tmp_path / "m" / f"greedy-{ARENA}").episodes == reference[0].episodes[:1]


# --- what it survives

SCRIPT = """
from airl_mav.cli import main
from airl_mav.experiments import campaign
campaign.INTERVAL_S, campaign.INTERVAL_PER_SAVE = 0.05, 0.0
main.main()
"""


class Evaluating:
    """A running `airl evaluate`, and all processes that it has started."""

    def __init__(self, process: Running, out: Path) -> None:
        self.process, self.out = process, out
        self.seen: set[int] = set()

    def children(self) -> list[int]:
        """Return its children now."""
        found = []
        for entry in Path("/proc").iterdir():
            with suppress(OSError, ValueError, IndexError):
                stat = (entry / "stat").read_text().rpartition(")")[2].split()
                if int(stat[1]) == self.process.pid and stat[0] not in "ZX":
                    found.append(int(entry.name))
        self.seen |= set(found)
        return found

    def workers(self) -> list[int]:
        """Return its workers now."""
        found = []
        for pid in self.children():
            with suppress(OSError):
                words = Path(f"/proc/{pid}/cmdline").read_bytes()
                if b"spawn_main" in words:
                    found.append(pid)
        return found

    def wait_for_workers(self) -> list[int]:
        """Wait until both workers are there."""

        def there() -> list[int]:
            assert self.process.process.poll() is None, self.process.text()
            found = self.workers()
            return found if len(found) == 2 else []

        pids: list[int] = wait_until(there, "two workers")
        return pids

    def nothing_left(self) -> None:
        """Fail when one of its processes outlives it by more than a moment."""
        assert len(self.seen) >= 2
        for pid in self.seen:
            wait_until(partial(has_ended, pid), "a process to end", 30.0)


@contextmanager
def evaluating(folder: Path, out: Path) -> Iterator[Evaluating]:
    """Run the evaluation of the reference on two workers in a separate process.

    Pacing leaves time to disturb the run, at least a second a flight, and changes nothing else.
    """
    words = ["evaluate", "greedy", "--level", "lockstep", "--arena", ARENA, "--workers", "2"]
    words += ["--episodes", str(EPISODES), "--seed", str(SEED), "--out", str(out), "--speed", "25"]
    with running(["-c", SCRIPT, *words], folder) as process:
        evaluation = Evaluating(process, out)
        try:
            yield evaluation
        finally:
            for pid in evaluation.workers():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


@pytest.mark.nightly
def test_killed_at_any_moment_it_goes_on_and_nothing_is_lost_or_doubled(
    reference: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    """A worker first, whose flight begins again, then all of it."""
    one, text = reference
    out = tmp_path / "run"
    with evaluating(tmp_path, out) as killed:
        os.kill(killed.wait_for_workers()[0], signal.SIGKILL)
        killed.process.wait_for_text(r"a worker was lost by SIGKILL: seed 4\d begins again")
        time.sleep(random.Random().uniform(0.0, 2.0))
        killed.children()
        killed.process.process.kill()
        killed.process.wait()
        killed.nothing_left()
    if (out / "run.json").exists():
        assert all(episode in one.episodes for episode in load(out).episodes)
    code, again = evaluate("greedy", workers=1, out=out)
    assert code == 0
    assert same_runs(load(out), one)
    lines = (out / "episodes.jsonl").read_text().splitlines()
    assert sorted(json.loads(line)["index"] for line in lines) == list(range(EPISODES))
    assert not list(out.glob("*.partial"))
    assert again.splitlines()[-1] == text.splitlines()[-1]
    assert again.splitlines()[-1].startswith("sha256 of the flights")


def test_what_is_finished_is_shown_again_and_not_flown(
    reference: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    one, text = reference
    with patch("airl_mav.experiments.executors._spawn", side_effect=AssertionError):
        code, again = evaluate("greedy", workers=7, speed=100.0, out=one.path)
    assert code == 0
    assert again.splitlines()[-1] == text.splitlines()[-1]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 41}, "seed = 40, not 41"),
        ({"hold_s": 0.6}, "hold_s = 0.5, not 0.6"),
        ({"time_limit_s": 60.0}, "time_limit_s = 120.0, not 60.0"),
        ({"computer": "ras-pi-4"}, "computer = 'workstation', not 'ras-pi-4'"),
        ({"hover_after_s": 0.1}, "watchdog.hover_after_s = None, not 0.1"),
        pytest.param({"level": "gym"}, "level = 'lockstep', not 'gym'", marks=pytest.mark.nightly),
    ],
)
def test_another_run_is_not_mixed_in(
    reference: tuple[LoadedRun, str], change: dict[str, Any], named: str
) -> None:
    one, _ = reference
    with pytest.raises(UsageError, match=re.escape(named)):
        evaluate("greedy", out=one.path, **({"workers": 1} | change))
    assert same_runs(load(one.path), one)


# --- what it refuses


@pytest.mark.parametrize(
    "deadly",
    [None, pytest.param(SEED + 1, marks=pytest.mark.nightly)],  # In every run: test_campaign.py.
)
def test_a_flight_that_kills_its_workers_ends_the_run_with_one_line(
    reference: tuple[LoadedRun, str], tmp_path: Path, deadly: int | None
) -> None:
    one, _ = reference
    flown = {
        e.index: FlownEpisode(replace(e, notes=()), one.trajectories[e.index], one.latency[e.index])
        for e in one.episodes
    }
    paper = PaperFlier(flown, deadly or -1)
    with patch.dict(campaign.FLIERS, {"lockstep": lambda _: paper}):
        code, text = evaluate("greedy", workers=1, out=tmp_path / "run")
    held = load(tmp_path / "run")
    if deadly is None:
        assert code == 0
        assert same_runs(held, one)
        return
    assert code == 1
    assert text.count("a worker was lost by SIGKILL: seed 41 begins again") == 2
    assert "error: seed 41: lost 3 workers, the last one by SIGKILL\n" in text
    assert f"broken off: finished flights are kept; resume with --out {tmp_path / 'run'}" in text
    assert [e.index for e in held.episodes] == [0]
    # The table has the digest of the finished flight; the last line, of whole runs, is missing.
    assert text.count("sha256 of the flights") == 1
