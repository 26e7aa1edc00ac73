"""A busy host is reported before the flight, and a user at a terminal may choose lockstep."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
from rich.console import Console

from airl_mav.cli import sitl_command
from airl_mav.cli.options import read_options
from airl_mav.cli.shared_options import Voice
from airl_mav.cli.sitl_command import lockstep_command, on_this_host
from airl_mav.rehearsal import host_pace
from airl_mav.rehearsal.run_folder import RUN_FILE
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.pacing import MAX_LAG_US

LATE = "a tick in a short test began 90 ms late (limit 20 ms)"
COMMAND = "airl-sitl --vehicle quad --level lockstep"


class Terminal(io.StringIO):
    """Standard input of a user with one answer."""

    def isatty(self) -> bool:
        return True


def decided(
    monkeypatch: pytest.MonkeyPatch,
    *words: str,
    answer: str | None = None,
    problem: str = LATE,
) -> tuple[str, str, str]:
    """Return the level to fly, the warning, and the printed text; answer None: no terminal."""
    monkeypatch.setattr(host_pace, "host_problem", lambda _speed: problem)
    monkeypatch.setattr(sys, "stdin", io.StringIO() if answer is None else Terminal(answer))
    monkeypatch.setattr(sys, "argv", ["airl-sitl", "--vehicle", "quad"])
    options = read_options(sitl_command.OPTIONS, "airl-sitl", ["--policy", "greedy", *words])
    console = Console(file=io.StringIO(), width=200, force_terminal=answer is not None)
    scenario = resolve(Scenario(policy="greedy", level=options.level, validity=options.validity))
    flown, warning = on_this_host(scenario, options, Voice(options, "airl-sitl", console))
    assert isinstance(console.file, io.StringIO)
    return flown.scenario.level, warning, console.file.getvalue()


def test_an_idle_host_flies_without_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    assert decided(monkeypatch, answer="y\n", problem="") == ("sitl", "", "")


@pytest.mark.parametrize("words", [("--level", "lockstep"), ("--no-validity",)])
def test_flights_that_the_host_cannot_make_invalid_skip_the_check(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert decided(monkeypatch, *words, answer="y\n")[1:] == ("", "")


@pytest.mark.parametrize("words", [(), ("--quiet",)])
def test_without_a_terminal_it_names_the_command_and_flies(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    level, warning, printed = decided(monkeypatch, *words, answer="y\n" if words else None)
    assert (level, printed) == ("sitl", "")
    assert warning == (
        "warning: flights may be invalid, as this host does not keep real time: "
        f"{LATE}. Without real time: {COMMAND}"
    )


@pytest.mark.parametrize(
    ("answer", "level"), [("\n", "lockstep"), ("y\n", "lockstep"), ("No\n", "sitl")]
)
def test_at_a_terminal_it_asks(answer: str, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    flown, warning, printed = decided(monkeypatch, answer=answer)
    assert (flown, warning) == (level, "")
    assert LATE in printed
    assert "Fly at level lockstep instead: the same tables, without real time?" in printed


def test_a_run_that_continues_is_not_asked_about(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / RUN_FILE).touch()
    level, warning, printed = decided(monkeypatch, "--out", str(tmp_path), answer="y\n")
    assert (level, printed) == ("sitl", "")
    assert COMMAND in warning


def test_what_lockstep_cannot_fly_gets_no_proposal(monkeypatch: pytest.MonkeyPatch) -> None:
    level, warning, _ = decided(monkeypatch, "--firmware", "ardupilot", answer="y\n")
    assert (level, "lockstep" in warning) == ("sitl", False)


def test_the_proposed_command_flies_into_a_new_folder() -> None:
    words = [
        "sitl",
        "--out",
        "a run",
        "--latency",
        "lognormal:60ms,10ms",
        "--out=x",
        "runs/a.toml",
    ]
    assert lockstep_command(words) == (
        "airl-sitl --latency lognormal:60ms,10ms runs/a.toml --level lockstep"
    )


def test_work_that_takes_longer_than_a_tick_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_pace, "LOOPS", 0)
    punctual_ms = host_pace.greatest_lateness_ms(0.1, 5)
    monkeypatch.setattr(host_pace, "LOOPS", 4_000_000)
    late_ms = host_pace.greatest_lateness_ms(1.0, 20)
    assert 0.0 <= punctual_ms < late_ms
    assert late_ms >= MAX_LAG_US / 1e3


def test_the_check_measures_in_processes_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_pace, "LATE_MS", -1.0)
    assert host_pace.host_problem(1.0).endswith(" ms late (limit -1 ms)")
