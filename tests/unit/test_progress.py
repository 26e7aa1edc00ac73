"""Progress: what is drawn, and what is printed where nobody looks."""

from __future__ import annotations

import io

from rich.console import Console

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.progress import Progress, RichProgress


def drawn(*, terminal: bool) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=150)
    clock = SimClock()
    with RichProgress(console, clock) as progress:
        bar = progress.bar("no-obstacles", 2_000, completed=1_000, unit="episodes")
        trial = progress.bar("trial 2x8", 1.0)
        clock.advance(4 * US_PER_S)
        for _ in range(10):
            bar.advance()
        bar.update(postfix="90.0 % [reached]")
        trial.update(completed=0.25)
        progress.note("seed 7 [lost]")
        trial.close()
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_bar_shows_count_pace_and_postfix() -> None:
    text = drawn(terminal=True)
    last = text.rsplit("no-obstacles", 1)[1]
    # What had been done before does not count for the pace: ten in four seconds.
    assert "1,010/2,000  2.5 episodes/s" in last
    assert "90.0 % [reached]" in last and "0:00:04" in last
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
