"""A campaign of evaluations: what it checks first, flies once, goes on with, and says."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from airl_mav.cli.cells import Cell, FlownCell, check_cells, check_root, fly_cells
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_task import Result, Task
from rich.console import Console

from airl_mav.cli import evaluate_task
from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import RunFolder, load
from airl_mav.report.comparison.model import KINDS

EPISODES = 4


def cell(key: str, *, policy: str = "greedy", **options: Any) -> Cell:
    words: dict[str, Any] = {"arena": ("no-obstacles",), "episodes": EPISODES, "seed": 5}
    command = EvaluateCommand((policy,), **(words | options))
    return Cell(key, f"the cell {key}", command)


def fly(root: Path, cells: list[Cell], **options: Any) -> tuple[list[FlownCell], int, str]:
    console = Console(record=True, width=200, file=io.StringIO())
    flown, code = fly_cells(root, cells, console, **options)
    return flown, code, console.export_text()


@pytest.fixture
def flights() -> Iterator[list[EvaluateCommand]]:
    """What is really flown."""
    seen: list[EvaluateCommand] = []
    real = evaluate_task.prepare

    def prepare(command: EvaluateCommand, policy: str, arena: str) -> Task:
        task = real(command, policy, arena)

        def noted(out: Path | None, console: Console) -> Result:
            seen.append(command)
            return task.fly(out, console)

        return replace(task, fly=noted)

    with patch.object(evaluate_task, "prepare", prepare):
        yield seen


def test_every_cell_gets_its_run_folder(tmp_path: Path) -> None:
    cells = [cell("near"), cell("late", latency="150ms")]
    flown, code, text = fly(tmp_path, cells)
    assert code == 0
    assert [held.folder for held in flown] == ["near", "late"]
    for held in flown:
        run = load(tmp_path / held.folder)
        assert run.episodes == held.episodes
        assert [episode.seed for episode in run.episodes] == [5, 6, 7, 8]
        assert held.arena_name == "no-obstacles"
        assert held.policy.name == "greedy"
        assert "goal radius 3 m" in held.rules
        assert held.code == 0
        assert not (tmp_path / held.folder / "report.html").exists()
    lines = [line for line in text.splitlines() if line.startswith("[")]
    assert lines[0].startswith("[1/2] the cell near: 4 goal reached")
    assert lines[1].startswith("[2/2] the cell late: ")


def test_nothing_flies_before_all_is_checked(tmp_path: Path, flights: list[Any]) -> None:
    for wrong in (
        cell("b", policy="nobody"),
        cell("b", arena=("nowhere",)),
        cell("b", latency="soon"),
        cell("b", workload="template-9x99"),
        cell("b", episodes=0),
        cell("b", seed=-1),
        cell("b", latency_seed=-1),
    ):
        with pytest.raises(UsageError):
            fly(tmp_path / "root", [cell("a"), wrong])
    assert flights == []
    assert not (tmp_path / "root").exists()


def test_a_policy_that_may_know_its_episodes_is_named_once(tmp_path: Path) -> None:
    known: dict[str, Any] = {"policy": "no-obstacles", "seed": 1_000_000, "episodes": 1}
    _, _, text = fly(tmp_path, [cell("a", **known), cell("b", latency="150ms", **known)])
    assert text.count("no-obstacles was trained on seeds from 1000000 on") == 1


def test_a_cell_is_one_policy_in_one_arena() -> None:
    with pytest.raises(ValueError, match="0 of arena"):
        check_cells([cell("a", arena=())])
    with pytest.raises(ValueError, match="must be different"):
        check_cells([cell("a"), cell("a", seed=7)])


def test_equal_cells_are_flown_once(tmp_path: Path, flights: list[EvaluateCommand]) -> None:
    cells = [cell("a"), cell("b", latency="150ms"), cell("c", slots=3, out=tmp_path / "x")]
    flown, code, text = fly(tmp_path / "root", cells)
    assert code == 0
    assert len(flights) == 2
    assert [(held.cell.key, held.folder) for held in flown] == [("a", "a"), ("b", "b"), ("c", "a")]
    assert flown[2].cell is cells[2]
    assert flown[2].episodes == flown[0].episodes
    assert sorted(path.name for path in (tmp_path / "root").iterdir()) == ["a", "b"]
    assert "[2/2]" in text


def test_cells_with_other_draws_are_not_equal(
    tmp_path: Path, flights: list[EvaluateCommand]
) -> None:
    late = {"latency": "lognormal:400ms,100ms"}
    flown, _, _ = fly(tmp_path, [cell("a", **late), cell("b", latency_seed=1, **late)])
    assert len(flights) == 2
    first, second = (load(tmp_path / held.folder) for held in flown)
    drawn = [
        [int(t) for t in run.latency[0]["action_ready_us"] - run.latency[0]["infer_start_us"]][:3]
        for run in (first, second)
    ]
    assert drawn[0] != drawn[1]


def test_what_is_finished_is_not_flown_again(tmp_path: Path) -> None:
    cells = [cell("a"), cell("b", latency="150ms")]
    before, _, _ = fly(tmp_path, cells)
    files = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()}
    flown, code, text = fly(tmp_path, cells)
    assert code == 0
    assert [held.episodes for held in flown] == [held.episodes for held in before]
    assert files == {path: path.read_bytes() for path in files}
    assert text.count("(flown before)") == 2


def test_a_folder_with_other_flights_is_refused(tmp_path: Path) -> None:
    fly(tmp_path, [cell("a")])
    with pytest.raises(UsageError, match="seed = 5, not 9"):
        fly(tmp_path, [cell("a", seed=9)])


class Broken:
    """Cells of which one is cut short: by Ctrl-C (130), a dead process (1), or a second Ctrl-C."""

    def __init__(self, ends: dict[str, int | type[BaseException]]) -> None:
        self.ends = ends
        self.real = evaluate_task.prepare

    def prepare(self, command: EvaluateCommand, policy: str, arena: str) -> Task:
        task = self.real(command, policy, arena)
        return replace(task, fly=partial(self._fly, task))

    def _fly(self, task: Task, out: Path | None, console: Console) -> Result:
        assert out is not None
        end = self.ends.pop(out.name, 0)
        if isinstance(end, int) and not end:
            return task.fly(out, console)
        # Half of it, as a run that was stopped leaves it.
        task.fly(out, console)
        lines = (out / "episodes.jsonl").read_bytes().splitlines(keepends=True)
        (out / "episodes.jsonl").write_bytes(b"".join(lines[: EPISODES // 2]))
        if isinstance(end, type):
            raise end
        _, run = RunFolder.resume(out)
        return Result(out, end, run.episodes, len(run.episodes))


@pytest.mark.parametrize("end", [130, 1, KeyboardInterrupt])
def test_a_campaign_that_is_stopped_goes_on(tmp_path: Path, end: int | type[BaseException]) -> None:
    cells = [cell("a"), cell("b", latency="150ms"), cell("c", latency="300ms")]
    whole, _, _ = fly(tmp_path / "whole", cells)
    root = tmp_path / "root"
    broken = Broken({"b": end})
    with patch.object(evaluate_task, "prepare", broken.prepare):
        flown, code, text = fly(root, cells)
    assert code == (1 if end == 1 else 130)
    assert f"the same command with --out {root} goes on" in text
    assert ("broken off" if end == 1 else "interrupted") in text
    assert not (root / "c").exists()
    if isinstance(end, int):
        assert [(held.folder, len(held.episodes)) for held in flown] == [("a", 4), ("b", 2)]
        assert [held.code for held in flown] == [0, end]
    flown, code, _ = fly(root, cells)
    assert code == 0
    assert [held.episodes for held in flown] == [held.episodes for held in whole]


def test_a_report_for_every_cell_that_asks(tmp_path: Path) -> None:
    with patch("airl_mav.report.run_report.write_report") as write_report:
        fly(tmp_path, [cell("a")], reports=True)
        write_report.assert_called_once_with(tmp_path / "a")
    (tmp_path / "a" / "report.html").write_text("there")
    with patch("airl_mav.report.run_report.write_report") as write_report:
        fly(tmp_path, [cell("a")], reports=True)
        write_report.assert_not_called()


@pytest.mark.parametrize("kind", ["run", *KINDS])
def test_a_folder_of_something_else_is_no_campaign(tmp_path: Path, kind: Any) -> None:
    (tmp_path / f"{kind}.json").write_text(json.dumps({"schema": 1}))
    with pytest.raises(UsageError, match="accepted: another folder"):
        check_root(tmp_path)
    if kind != "run":
        check_root(tmp_path, but=kind)
