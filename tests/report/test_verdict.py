"""The verdict of a run: its sentence, its status, and the files for a CI job."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from airl_mav.core.constants import Level
from airl_mav.flight.episode_record import EpisodeRecord, Part, Setup
from airl_mav.flight.judge import BY_HAND, STRANGER, Outcome
from airl_mav.flight.requirements import parse_requirement
from airl_mav.flight.statistics import aggregate, compare_pairs
from airl_mav.flight.trajectory import Leg, Quality
from airl_mav.latency.injection import NOTHING_INJECTED, parse_latency
from airl_mav.report.document import count_flights
from airl_mav.report.run_verdict import (
    OverallVerdict,
    judge_run,
    load_verdict,
    save_verdict,
    write_badge,
    write_junit,
)
from airl_mav.report.run_verdict import verdict_of as judged

SETUP = Setup(
    level="lockstep",
    vehicle=Part("quad"),
    arena=Part("static-obstacles"),
    policy=Part("mine"),
    computer=Part("boards/pi.toml"),
    computer_watts=5.0,
    injection=NOTHING_INJECTED,
    speed=None,
    between_commands="persist",
)
SVG = "{http://www.w3.org/2000/svg}"


def flight(index: int, outcome: Outcome = Outcome.SUCCESS, time_s: float = 8.0) -> EpisodeRecord:
    # Not all alike: a mean needs a spread.
    time_s += 0.01 * (index % 7)
    quality = Quality(time_s, 26.0, 3000.0, 0.0, 3.0, 4.0, Leg(5.0, 2.5, 2000.0))
    return EpisodeRecord(
        index=index,
        seed=40 + index,
        arena="static-obstacles",
        arena_seed=40 + index,
        outcome=outcome,
        reason="",
        goal=(10.0, 0.0),
        goal_radius_m=3.0,
        time_limit_s=120.0,
        started_us=0,
        navigation_us=0,
        ended_us=8_000_000,
        wall_s=None,
        slipped_us=0,
        battery_remaining=1.0,
        quality=quality,
    )


def parsed(path: Path) -> ET.Element:
    return ET.parse(path).getroot()  # noqa: S314 (our own file)


def flights(n: int, failed: int, time_s: float = 8.0) -> list[EpisodeRecord]:
    return [
        flight(i, Outcome.COLLISION if i < failed else Outcome.SUCCESS, time_s) for i in range(n)
    ]


def verdict_of(n: int, failed: int, *requirements: str) -> OverallVerdict:
    flown = flights(n, failed)
    return judge_run(SETUP, aggregate(flown), flown, [parse_requirement(r) for r in requirements])


def test_the_first_line_says_what_flew_on_what_and_what_came_of_it() -> None:
    verdict = verdict_of(100, 13)
    assert verdict.lines == (
        "mine on pi in static-obstacles, level lockstep: 87 of 100 goals reached,"
        " 87.0 % [79.0, 92.2].",
    )
    assert (verdict.status, verdict.exit_code) == ("nothing required", 0)


def test_a_reference_is_told_of() -> None:
    reference, target = flights(100, 0), flights(100, 13, 10.0)
    verdict = judge_run(
        SETUP,
        aggregate(target),
        target,
        [parse_requirement("flight_time gap <= 10 %")],
        compare_pairs(reference, target),
        "mine on workstation",
    )
    assert "13.0 points fewer [" in verdict.sentences[0]
    # 2 s of 8.03 s.
    assert "24.9 % more flight time [" in verdict.sentences[0]
    assert verdict.sentences[0].endswith("than mine on workstation.")
    assert verdict.status == "not met"


@pytest.mark.parametrize(
    ("n", "failed", "status", "code"),
    [(100, 0, "met", 0), (100, 13, "not met", 3), (20, 0, "undecided", 5), (0, 0, "undecided", 5)],
)
def test_the_status_is_the_exit_code(n: int, failed: int, status: str, code: int) -> None:
    verdict = verdict_of(n, failed, "success >= 95 %")
    assert (verdict.status, verdict.exit_code) == (status, code)


def test_the_worst_finding_decides() -> None:
    worst_last = verdict_of(100, 13, "flight_time <= 20 s", "success >= 90 %", "success >= 95 %")
    assert worst_last.status == "not met"
    assert verdict_of(100, 13, "flight_time <= 20 s", "success >= 90 %").status == "undecided"


def test_invalid_flights_come_first_and_leave_no_verdict() -> None:
    flown = [replace(flight(0), invalid=("20 % given up",)), *(flight(i) for i in range(1, 100))]
    verdict = judge_run(SETUP, aggregate(flown), flown, [parse_requirement("success >= 90 %")])
    assert verdict.lines[0] == "INVALID: flight 000, seed 40: 20 % given up"
    assert (verdict.status, verdict.exit_code) == ("invalid", 4)


def test_flights_that_are_all_invalid_are_counted_as_flown() -> None:
    flown = [replace(flight(i), invalid=("20 % given up",)) for i in range(3)]
    verdict = judge_run(SETUP, aggregate(flown), flown)
    assert verdict.sentences[0].endswith(
        "level lockstep: 3 flights flown but invalid (3 reached the goal)."
    )
    assert verdict.short == "no valid flight on pi"
    assert count_flights(flown) == "3 flown but invalid"
    assert set(aggregate(flown).outcomes.values()) == {0}


def test_invalid_flights_are_counted_beside_valid_ones() -> None:
    flown = [flight(0), replace(flight(1, Outcome.COLLISION), invalid=("20 % given up",))]
    verdict = judge_run(SETUP, aggregate(flown), flown)
    assert verdict.sentences[0].endswith("1 flight flown but invalid (0 reached the goal).")
    assert "1 of 1 goals reached, 100.0 % [" in verdict.sentences[0]
    assert count_flights(flown) == "1 goal reached, 1 flown but invalid"


def test_no_flight_is_said_of_no_flight() -> None:
    assert judge_run(SETUP, aggregate([]), []).sentences[0].endswith("no flight was finished.")


def test_the_sentence_contains_the_injected_latency() -> None:
    flown = flights(3, 0)
    setup = replace(SETUP, injection=parse_latency("lognormal:60ms,10ms"))
    verdict = judge_run(setup, aggregate(flown), flown)
    assert verdict.sentences[0].startswith("mine on pi with 60 ± 10 ms of injected latency in ")
    assert verdict.short == "100.0 % on pi with 60 ± 10 ms of injected latency"


@pytest.mark.parametrize(
    ("level", "reason", "proposes"),
    [
        ("sitl", "20 % given up", True),
        ("lockstep", "20 % given up", False),
        ("sitl", BY_HAND, False),
        ("sitl", f"{STRANGER}: system 9", False),
    ],
)
def test_lockstep_is_proposed_once_where_the_host_disturbed_flights(
    level: Level, reason: str, proposes: bool
) -> None:
    flown = [replace(flight(i), invalid=(reason,)) for i in range(2)]
    info = SimpleNamespace(setup=replace(SETUP, level=level), config={})
    run = SimpleNamespace(info=info, episodes=flown, path=Path("runs/my run"))
    lines = judged(run, ()).lines  # type: ignore[arg-type]
    command = "airl-sitl 'runs/my run/scenario.toml' --level lockstep"
    assert [command in line for line in lines] == [False, False, *[True] * proposes, False]


def test_an_abort_is_a_failure_and_drops_out_of_nothing() -> None:
    flown = [flight(0), flight(1, Outcome.ABORTED)]
    assert "1 of 2 goals reached" in judge_run(SETUP, aggregate(flown), flown).sentences[0]


def test_it_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    verdict = verdict_of(100, 13, "success >= 95 %", "flight_time <= 20 s")
    save_verdict(verdict, tmp_path)
    assert load_verdict(tmp_path) == verdict
    data = json.loads((tmp_path / "verdict.json").read_text())
    assert (data["status"], data["exit_code"]) == ("not met", 3)


def test_junit_has_a_case_for_each_requirement(tmp_path: Path) -> None:
    requirements = ("success >= 95 %", "success >= 90 %", "flight_time <= 20 s")
    path = tmp_path / "junit.xml"
    write_junit(verdict_of(100, 13, *requirements), path, "airl evaluate <mine>")
    root = parsed(path)
    assert root.attrib == {"tests": "4", "failures": "2", "errors": "0"}
    cases = {case.attrib["name"]: case for case in root.iter("testcase")}
    assert set(cases) == {"valid flights", *requirements}
    kinds = {name: [f.attrib["type"] for f in case] for name, case in cases.items()}
    assert kinds["success >= 95 %"] == ["not met"]
    assert kinds["success >= 90 %"] == ["undecided"]
    assert kinds["flight_time <= 20 s"] == kinds["valid flights"] == []


def test_junit_calls_invalid_flights_an_error(tmp_path: Path) -> None:
    flown = [replace(flight(0), invalid=("too slow",))]
    write_junit(judge_run(SETUP, aggregate(flown), flown), tmp_path / "junit.xml", "airl-sitl")
    (error,) = parsed(tmp_path / "junit.xml").iter("error")
    assert "too slow" in error.attrib["message"]


def test_the_badge_says_it_in_one_line(tmp_path: Path) -> None:
    write_badge(verdict_of(100, 13, "success >= 95 %"), tmp_path / "badge.svg")
    root = parsed(tmp_path / "badge.svg")
    assert root.findtext(f"{SVG}title") == "rehearsal: 87.0 % on pi: not met"
    texts = root.findall(f"{SVG}g/{SVG}text")
    assert [text.text for text in texts] == ["rehearsal", "87.0 % on pi: not met"]
    # Both fit into their halves.
    width = int(root.attrib["width"])
    assert sum(float(text.attrib["textLength"]) for text in texts) == width - 20
