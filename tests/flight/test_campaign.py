"""Campaigns: flights flown once, shared, distributed over workers, and resumed after a kill."""

from __future__ import annotations

import json
import signal
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.core.progress import Progress
from airl_mav.experiments import campaign, experiment
from airl_mav.experiments.campaign import (
    CampaignRun,
    Cell,
    CellRun,
    Declaration,
    DeclaredCell,
    EpisodeSaver,
    load_campaign,
    open_campaign,
    run_cell,
    run_cells,
)
from airl_mav.experiments.executors import ExecutorSettings, InProcessExecutor, open_executor
from airl_mav.experiments.experiment import Experiment, fly_scenario, run_experiment
from airl_mav.rehearsal import run_folder
from airl_mav.rehearsal.run_folder import CAMPAIGN_FILE, FlownEpisode, load
from tests.support.campaign_kit import cells, declared, gym_cell, same_runs
from tests.support.processes import ROOT, has_ended, running, wait_until
from tests.support.worker_jobs import PaperFlier


class Notes(Progress):
    """Keeps what was noted."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, text: str, style: str | None = None) -> None:
        self.lines.append(text)


def fly(
    root: Path, flown: list[Cell], workers: int = 1, **options: Any
) -> tuple[CampaignRun, list[str]]:
    notes = Notes()
    with (
        open_campaign(root, declared(flown), command="a test"),
        open_executor(ExecutorSettings(workers=workers), in_process=True) as executor,
    ):
        run = run_cells(root, flown, executor, progress=notes, **options)
    return run, notes.lines


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("reference") / "root"
    run, _ = fly(root, cells())
    assert run.complete
    return root


def same(root: Path, reference: Path) -> bool:
    return all(same_runs(load(root / name), load(reference / name)) for name in ("a", "b"))


# --- what is flown


def test_flights_do_not_depend_on_who_flies_them(tmp_path: Path, reference: Path) -> None:
    # Two slots and two workers: blocks of four episodes instead of all eight at once.
    run, _ = fly(tmp_path, cells(), workers=2)
    assert run.complete and run.error is None
    assert [(each.cell.name, each.path, each.new) for each in run.cells] == [
        ("a", tmp_path / "a", 8),
        ("b", tmp_path / "b", 8),
    ]
    assert same(tmp_path, reference)


def test_cells_with_the_same_flights_share_them(tmp_path: Path, reference: Path) -> None:
    ended: list[CellRun] = []
    # Flights depend neither on the pace nor on the number of workers.
    twin = replace(gym_cell("c", slots=3, workers=5), title="the same again")
    run, _ = fly(tmp_path, [*cells(), twin], ended=ended.append)
    assert [each.cell.name for each in ended] == ["a", "b"]
    assert [each.cell.name for each in run.cells] == ["a", "b", "c"]
    assert run.cells[2].path == tmp_path / "a"
    assert run.cells[2].cell is twin
    assert run.cells[2].episodes == run.cells[0].episodes
    assert not (tmp_path / "c").exists()
    assert same(tmp_path, reference)


def test_live_cells_with_the_same_flights_share_them(tmp_path: Path) -> None:
    first = gym_cell("a", episodes=2)
    twin = replace(gym_cell("b", episodes=2, slots=3), title="the same again")
    ended: list[CellRun] = []
    # The vectorized simulator replaces level sitl: the test covers sharing, not the level.
    with (
        open_campaign(tmp_path, declared([first]), command="a test"),
        patch.object(experiment, "fly_live", lambda *given, name: fly_scenario(*given)),
    ):
        run = experiment._fly_live(tmp_path, [first, twin], Progress(), ended.append)
    assert [each.cell for each in ended] == [first]
    assert [each.cell for each in run.cells] == [first, twin]
    assert [each.path for each in run.cells] == [tmp_path / "a"] * 2
    assert run.cells[1].episodes == run.cells[0].episodes
    assert not (tmp_path / "b").exists()


def test_an_experiment_grows_by_more_episodes(tmp_path: Path, reference: Path) -> None:
    for episodes in (4, 8):
        grown = Experiment("matrix", "", {}, tuple(cells(episodes)))
        assert run_experiment(grown, tmp_path, Progress()).ended == "complete"
    assert same(tmp_path, reference)
    fewer = Experiment("matrix", "", {}, tuple(cells(4)))
    with pytest.raises(UsageError, match="another cell a: episodes = 8, not 4"):
        run_experiment(fewer, tmp_path, Progress())


def test_what_is_finished_is_told_and_not_flown_again(tmp_path: Path) -> None:
    before, _ = fly(tmp_path, cells())
    files = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()}
    ended: list[CellRun] = []
    run, notes = fly(tmp_path, cells(), ended=ended.append)
    assert run.complete
    assert [each.new for each in run.cells] == [each.new for each in ended] == [0, 0]
    assert [each.episodes for each in run.cells] == [each.episodes for each in before.cells]
    assert notes == [f"{tmp_path / name}: 8 of 8 episodes are there" for name in ("a", "b")]
    assert files == {
        path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path in files
    }


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.nightly), 2])
def test_a_campaign_that_is_stopped_goes_on(tmp_path: Path, reference: Path, workers: int) -> None:
    flown = cells()
    flown_first = load(reference / "a").episodes
    seen: list[CellRun] = []
    # As soon as the first cell is complete.
    run, _ = fly(tmp_path, flown, workers, ended=seen.append, stop=lambda: bool(seen))
    assert not run.complete and run.error is None
    # Two workers may finish the second cell first.
    assert all(each in flown_first for each in run.cells[0].episodes)
    assert sum(each.new for each in run.cells) < 16
    run, _ = fly(tmp_path, flown, 3 - workers)
    assert run.complete
    assert same(tmp_path, reference)


@pytest.mark.slow
@pytest.mark.nightly  # A run that is killed, on the same engine: test_evaluate_lockstep.py.
def test_a_campaign_that_is_killed_leaves_nobody_behind_and_goes_on(tmp_path: Path) -> None:
    root, episodes = tmp_path / "root", 100
    words = ["-m", "tests.support.campaign_kit", f"{root}", f"{episodes}"]
    with running(words, tmp_path, path=ROOT) as parent:

        def saved() -> int:
            file = root / "a" / "episodes.jsonl"
            return len(file.read_bytes().splitlines()) if file.exists() else 0

        wait_until(saved, "an episode to be saved")
        workers = [pid for pid in children(parent.pid) if pid != parent.pid]
        parent.process.send_signal(signal.SIGKILL)
        parent.process.wait()
        for pid in workers:
            wait_until(partial(has_ended, pid), "an orphan to end", 30.0)
    assert load_campaign(root).declaration == declared(cells(episodes))
    held = len(load(root / "a").episodes)
    run, _ = fly(root, cells(episodes))
    assert run.complete
    assert 0 < sum(each.new for each in run.cells) <= 2 * episodes - held
    whole, _ = fly(tmp_path / "whole", cells(episodes))
    assert [each.episodes for each in run.cells] == [each.episodes for each in whole.cells]


def children(parent: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            ppid = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if ppid == parent:
                found.append(int(entry.name))
    return found


@pytest.mark.nightly
def test_a_job_that_loses_its_workers_ends_the_campaign_with_one_line(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load(reference / "a")
    broken = cells()
    episodes = {
        e.index: FlownEpisode(e, whole.trajectories[e.index], whole.latency[e.index])
        for e in whole.episodes
    }
    flier = PaperFlier(episodes, deadly=8, per_job=2)
    monkeypatch.setitem(campaign.FLIERS, "gym", lambda _: flier)
    with open_executor(ExecutorSettings(workers=1)) as executor:
        notes = Notes()
        with open_campaign(tmp_path, declared(broken), command="a test"):
            run = run_cells(tmp_path, broken, executor, progress=notes)
    assert not run.complete
    assert run.error == "a: seeds 7 to 8: lost 3 workers, the last one by SIGKILL"
    assert notes.lines == ["a worker was lost by SIGKILL: a: seeds 7 to 8 begins again"] * 2
    # Nothing of an attempt that did not end: neither seed 7, nor anything twice.
    assert [each.seed for each in load(tmp_path / "a").episodes] == [5, 6]
    assert [each.cell.name for each in run.cells] == ["a"]


def test_one_evaluation_needs_no_campaign(tmp_path: Path, reference: Path) -> None:
    cell = gym_cell("alone")
    run = run_cell(tmp_path / "run", cell, InProcessExecutor())
    assert run.complete
    assert same_runs(load(tmp_path / "run"), load(reference / "a"))
    assert not (tmp_path / "run" / CAMPAIGN_FILE).exists()
    run = run_cell(tmp_path / "other", cell, InProcessExecutor(), stop=lambda: True)
    assert [(each.path, each.episodes) for each in run.cells] == [(tmp_path / "other", ())]


def experiment_of(flown: list[Cell]) -> Experiment:
    return Experiment("matrix", "test", {}, tuple(flown))


def test_latencies_that_are_drawn_anew_are_other_flights(tmp_path: Path) -> None:
    late: dict[str, Any] = {"episodes": 2, "latency": "lognormal:400ms,100ms"}
    run, _ = fly(tmp_path, [gym_cell("a", **late), gym_cell("b", latency_seed=1, **late)])
    first, second = (load(each.path).latency[0] for each in run.cells)
    drawn = [
        (stamps["action_ready_us"] - stamps["infer_start_us"])[:3].tolist()
        for stamps in (first, second)
    ]
    assert drawn[0] != drawn[1]


def test_a_policy_that_may_know_its_episodes_is_named_once(tmp_path: Path) -> None:
    known = [
        gym_cell(name, policy="no-obstacles", seed=1_000_000, episodes=1, latency=latency)
        for name, latency in (("a", None), ("b", "150ms"))
    ]
    experiment = experiment_of(known)
    notes = Notes()
    run_experiment(experiment, tmp_path / "root", notes)
    told = [line for line in notes.lines if "was trained on seeds from 1000000 on" in line]
    assert len(told) == 1
    assert notes.lines[1].startswith("the cell a: 1 ")


@pytest.mark.nightly
def test_a_second_ctrl_c_is_not_waited_for_and_nothing_is_lost(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one lets what has ended be saved; the second is raised at once."""
    real, seen = EpisodeSaver.add, []

    def pressed(saver: EpisodeSaver, episode: FlownEpisode) -> None:
        real(saver, episode)
        seen.append(episode)
        if len(seen) == 3:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    experiment = experiment_of(cells())
    with monkeypatch.context() as patched:
        patched.setattr(EpisodeSaver, "add", pressed)
        with pytest.raises(KeyboardInterrupt):
            run_experiment(experiment, tmp_path / "root", Notes())
    assert 3 <= len(load(tmp_path / "root" / "a").episodes) < 8
    run = run_experiment(experiment, tmp_path / "root", Notes())
    assert run.ended == "complete"
    assert same(tmp_path / "root", reference)


# --- the folder


def test_the_declaration_is_there_before_anything_flies_and_keeps_its_origin(
    tmp_path: Path,
) -> None:
    flown = cells()
    asked = declared(flown)
    with open_campaign(tmp_path, asked, command="the first command") as campaign_there:
        held = load_campaign(tmp_path)
        assert held == campaign_there
        assert held.declaration == asked
        assert held.made["command"] == "the first command"
    more = replace(asked, cells=asked.cells | {"c": DeclaredCell("one more")})
    with open_campaign(tmp_path, more, command="another command"):
        assert load_campaign(tmp_path).made == held.made
        assert list(load_campaign(tmp_path).declaration.cells) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"kind": "sweep"}, "kind = 'test', not 'sweep'"),
        ({"settings": {"policy": "other"}}, "policy = 'greedy', not 'other'"),
        (
            {"cells": {"a": declared([gym_cell("a", hold_s=0.7)]).cells["a"]}},
            "another cell a: .*hold_s = 0.5, not 0.7",
        ),
    ],
)
def test_another_campaign_is_not_mixed_in(
    tmp_path: Path, changed: dict[str, Any], named: str
) -> None:
    asked = declared(cells())
    with open_campaign(tmp_path, asked, command="a test"):
        pass
    before = (tmp_path / CAMPAIGN_FILE).read_bytes()
    with (
        pytest.raises(UsageError, match=f"holds a campaign with {named}; accepted"),
        open_campaign(tmp_path, replace(asked, **changed), command="a test"),
    ):
        pass
    assert (tmp_path / CAMPAIGN_FILE).read_bytes() == before
    if "settings" in changed:
        other = replace(asked, **changed)
        with open_campaign(tmp_path, other, command="a test", free=("policy",)):
            pass


@pytest.mark.parametrize(
    ("file", "what"),
    [
        ("run.json", "a single run"),
        ("train.json", "a training"),
        ("hardware-gap.json", "a verdict"),
        # Begun by a version that wrote no declaration.
    ],
)
def test_a_folder_of_something_else_is_no_campaign(tmp_path: Path, file: str, what: str) -> None:
    (tmp_path / file).write_text(json.dumps({"schema": 1}))
    with (
        pytest.raises(UsageError, match=f"holds {what}; accepted: another folder"),
        open_campaign(tmp_path, declared(cells()), command="a test"),
    ):
        pass
    assert not (tmp_path / CAMPAIGN_FILE).exists()


def test_a_campaign_belongs_to_one_process_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folder, "WAIT_S", 0.0)
    told: list[str] = []
    asked = declared(cells())
    with (
        open_campaign(tmp_path, asked, command="a test"),
        pytest.raises(UsageError, match="another run flies into it"),
        open_campaign(tmp_path, asked, command="a test", say=told.append),
    ):
        pass
    assert len(told) == 1


@pytest.mark.parametrize("name", ["", "..", "a/b", CAMPAIGN_FILE])
def test_a_cell_is_named_as_a_folder_can_be(name: str) -> None:
    with pytest.raises(ValueError, match="the name of a folder"):
        Declaration("test", {}, {name: DeclaredCell("")})
