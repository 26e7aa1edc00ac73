"""Progress: bars on a terminal, and lines printed elsewhere."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from typing import Any, ClassVar

from rich.console import Console
from rich.text import Text

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.progress import Event, JsonProgress, Progress, RichProgress


def drawn(*, terminal: bool) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=150)
    clock = SimClock()
    with RichProgress(console, clock) as progress:
        bar = progress.bar("no-obstacles", 2_000, completed=1_000, unit="episodes")
        trial = progress.bar("trial 2x8", 1.0)
        clock.advance(4 * US_PER_S)
        for _ in range(5):
            bar.advance()
        clock.advance(2 * US_PER_S)
        for _ in range(5):
            bar.advance()
        bar.update(postfix="90.0 % [reached]")
        trial.update(completed=0.25)
        progress.note("seed 7 [lost]")
        trial.close()
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_bar_shows_count_pace_and_postfix() -> None:
    text = drawn(terminal=True)
    last = Text.from_ansi(text).plain.rsplit("no-obstacles", 1)[1]
    # The pace excludes earlier work and the time up to the first episodes.
    assert "1,010/2,000 4.5 episodes/s" in last
    # Nine in the two seconds since the first one: 990 are left.
    assert "90.0 % [reached]" in last and "0:00:06 0:03:40 left" in last
    assert "trial 2x8" not in last
    assert "seed 7 [lost]" in text


def test_without_a_terminal_only_notes_are_printed() -> None:
    assert drawn(terminal=False) == "seed 7 [lost]\n"


def test_silence_takes_everything() -> None:
    progress: Progress = Progress()
    bar = progress.bar("anything", 3, completed=1, unit="flights")
    bar.advance()
    bar.update(completed=2, postfix="text")
    bar.close()
    progress.note("text", "red")


def test_below_the_bars_stands_what_is_being_done() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with RichProgress(console, SimClock()) as progress:
        progress.status("compiling [kernels]")
    assert isinstance(console.file, io.StringIO)
    assert "compiling [kernels]" in console.file.getvalue()
    console.file.truncate(0)
    with RichProgress(console, SimClock()) as progress:
        progress.watch("5.0 m to goal")
        progress.status(None)
    assert "goal" not in console.file.getvalue()


def test_on_a_narrow_terminal_a_bar_keeps_to_one_line() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    clock = SimClock()
    with RichProgress(console, clock) as progress:
        bar = progress.bar("a policy with a long name in an arena", 100, unit="flights")
        bar.advance(20)
        clock.advance(60 * US_PER_S)
        bar.advance(30)
        bar.update(postfix="100 % [93, 100] reached")
    assert isinstance(console.file, io.StringIO)
    plain = Text.from_ansi(console.file.getvalue()).plain
    last = plain.split("a policy with a")[-1].splitlines()[0]
    assert "50/100 30.0 flights/min" in last
    assert "100 % [93, 100] reached" in last and "0:01:40 left" in last


@dataclass(frozen=True)
class Landed(Event):
    event: ClassVar[str] = "landed"
    where: str


def test_programs_hear_lines_of_json() -> None:
    out, clock = io.StringIO(), SimClock()
    progress = JsonProgress(out, clock)
    progress.status("loading")
    progress.status("loading")
    bar = progress.bar("flights", 10, completed=2, unit="flights")
    clock.advance(9 * US_PER_S)
    for _ in range(5):
        bar.update(figures={"success": {"value": 1.0}})
        bar.advance()
        clock.advance(US_PER_S // 2)
    progress.note("  autopilot: low", "yellow")
    progress.tell(Landed("home"))
    progress.watch("5 m to goal")
    bar.advance()
    bar.close()
    lines: list[dict[str, Any]] = [json.loads(line) for line in out.getvalue().splitlines()]
    # At most one progress line a second for each task. The last state is reported at the end.
    assert [line["event"] for line in lines] == [
        *("status", "progress", "progress", "progress"),
        *("note", "landed", "progress"),
    ]
    first, *_, last = (line for line in lines if line["event"] == "progress")
    assert (first["done"], first["planned"], first["elapsed_s"]) == (3, 10, 9.0)
    # Two a second since the first one; two of ten are left.
    assert (last["done"], last["per_s"], last["left_s"]) == (8, 2.0, 1.0)
    assert last["success"] == {"value": 1.0}
    assert (last["work"], last["unit"]) == ("flights", "flights")
    assert lines[4] == {"event": "note", "text": "autopilot: low"}
    assert lines[5] == {"event": "landed", "where": "home"}
