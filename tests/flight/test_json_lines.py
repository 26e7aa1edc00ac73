"""`--json` and `--quiet`: output for programs and CI jobs, checked in short real runs."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from airl_mav import load_run
from airl_mav.core.errors import UsageError
from airl_mav.experiments.campaign import EpisodeSaver
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.report import run_report
from airl_mav.report.comparison.comparison_model import load_comparison
from airl_mav.report.run_report import write_report
from tests.support.command_line import airl, option_words
from tests.support.page_alone import page_alone

GREEDY = ("greedy", *option_words(arena="no-obstacles", seed=20))


@pytest.fixture(autouse=True)
def _without_pictures(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(run_report, "MAX_PICTURED", 0)
    with page_alone():
        yield


def lines_of(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def of(lines: list[dict[str, Any]], event: str) -> list[dict[str, Any]]:
    return [line for line in lines if line["event"] == event]


def test_an_evaluation_in_lines(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = [*GREEDY, "--out", str(out), "--require", "success >= 99 %", "--json"]
    code, text = airl("evaluate", *words, "--episodes", "4")
    assert code == 5
    lines = lines_of(text)
    assert (lines[0]["event"], lines[-1]["event"]) == ("started", "finished")
    assert (lines[0]["schema"], lines[0]["command"]) == (1, "airl evaluate")
    assert of(lines, "run") == [{"event": "run", "path": str(out), "planned": 4, "done": 0}]
    run = load_run(out)
    told = {line["index"]: line for line in of(lines, "flight")}
    assert sorted(told) == [record.index for record in run.episodes]
    for record in run.episodes:
        line = told[record.index]
        assert (line["seed"], line["outcome"]) == (record.seed, record.outcome.value)
        assert record.quality is not None
        assert line["flight_time_s"] == record.quality.flight_time_s
    last = of(lines, "progress")[-1]
    rate = run.quality.success_rate
    assert (last["done"], last["planned"], last["left_s"]) == (4, 4, 0.0)
    assert last["success"] == {"value": rate.value, "low": rate.low, "high": rate.high, "n": 4}
    finished = lines[-1]
    assert (finished["exit_status"], finished["status"]) == (5, "undecided")
    assert (finished["ended"], finished["path"]) == ("complete", str(out))
    assert finished["page"] is None
    assert "4 of 4 goals reached" in finished["sentences"][0]
    ((held),) = finished["runs"]
    assert (held["planned"], held["flights"], held["sha256"]) == (4, 4, None)
    assert held["quality"]["flight_time_s"]["value"] == run.quality.flight_time_s.value
    assert held["quality"]["outcomes"]["success"] == 4

    # The same again is there already: nothing flies, and the same is found.
    _, again = airl("evaluate", *words, "--episodes", "4")
    assert not of(lines_of(again), "flight")
    assert lines_of(again)[-1] == finished

    # An existing report page is kept up to date.
    page = write_report(out)
    _, again = airl("evaluate", *words, "--episodes", "4")
    assert of(lines_of(again), "status")[-1]["text"] == "drawing the report"
    assert lines_of(again)[-1] == {**finished, "page": str(page)}


def test_flights_one_after_the_other_in_lines(tmp_path: Path) -> None:
    words = option_words(policy="greedy", arena="no-obstacles", level="lockstep", episodes=1)
    code, text = airl("sitl", *words, "--out", str(tmp_path / "run"), "--json")
    assert code == 0
    lines = lines_of(text)
    (flight,) = of(lines, "flight")
    assert len(flight["sha256"]) == 64
    said = [line["text"] for line in of(lines, "status")]
    assert said[0] == "loading"
    assert said[-1] == "drawing the report"
    assert any(text.startswith("flight 000: navigating at ") for text in said)
    assert lines[-1]["runs"][0]["sha256"] == load_run(tmp_path / "run").sha256


def test_a_comparison_in_lines(tmp_path: Path) -> None:
    out = tmp_path / "curve"
    words = [*GREEDY, "--latencies", "native", "200ms", "--episodes", "2", "--json"]
    code, text = airl("latency-sweep", *words, "--out", str(out))
    assert code == 0
    lines = lines_of(text)
    assert lines[0]["command"] == "airl latency-sweep"
    flights = of(lines, "flight")
    assert len(flights) == 4
    runs = lines[-1]["runs"]
    assert {Path(run["path"]).resolve() for run in runs} == {
        Path(flight["path"]).resolve() for flight in flights
    }
    comparison = load_comparison(out, "latency-sweep")
    assert [run["name"] for run in runs] == [run.name for run in comparison.runs]
    # Of all runs together there is a count, too.
    last = [line for line in of(lines, "progress") if line["work"] == "all 2 runs"][-1]
    assert (last["done"], last["planned"]) == (4, 4)


def test_a_rehearsal_ends_with_one_sentence_and_prints_tables_on_request(tmp_path: Path) -> None:
    words = option_words(policy="greedy", arena="no-obstacles", level="lockstep", episodes=1)
    words += ["--latency", "lognormal:60ms,10ms", "--out", str(tmp_path / "run")]
    code, text = airl("sitl", *words)
    lines = text.splitlines()
    assert code == 0
    assert lines[-1] == (
        "greedy on workstation with 60 ± 10 ms of injected latency in no-obstacles, level lockstep:"
        " 1 of 1 goals reached, 100.0 % [20.7, 100.0]."
    )
    assert json.loads((tmp_path / "run" / "verdict.json").read_text())["sentences"] == lines[-1:]
    assert "Quality of flight" not in text
    _, again = airl("sitl", *words, "--tables")
    assert "Quality of flight" in again
    assert again.splitlines()[-1] == lines[-1]


@pytest.mark.nightly
def test_quiet_is_the_verdict_and_the_folder(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["--out", str(out), "--episodes", "1", "--level", "lockstep", "--quiet"]
    code, text = airl("evaluate", *GREEDY, *words)
    assert code == 0
    sentence, sha256, folder = text.splitlines()
    assert "1 of 1 goals reached" in sentence
    assert sha256 == f"sha256 of the flights  {load_run(out).sha256}"
    assert folder == f"folder  {out}"


@pytest.mark.nightly
def test_an_interrupted_run_ends_its_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = EpisodeSaver.add

    def interrupted(saver: EpisodeSaver, episode: FlownEpisode) -> None:
        real(saver, episode)
        signal.raise_signal(signal.SIGINT)

    words = [*GREEDY, "--out", str(tmp_path / "run"), "--episodes", "8", "--slots", "1"]
    with monkeypatch.context() as patched:
        patched.setattr(EpisodeSaver, "add", interrupted)
        code, text = airl("evaluate", *words, "--json")
    finished = lines_of(text)[-1]
    assert (code, finished["exit_status"], finished["ended"]) == (130, 130, "interrupted")
    assert (finished["runs"][0]["planned"], finished["runs"][0]["sha256"]) == (8, None)
    flown = finished["runs"][0]["flights"]
    assert 0 < flown < 8
    code, text = airl("evaluate", *words, "--json")
    assert code == 0
    assert of(lines_of(text), "run")[0]["done"] == flown
    assert len(of(lines_of(text), "flight")) == 8 - flown


def test_both_at_once_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--quiet True: accepted: without --json"):
        airl("evaluate", *GREEDY, "--quiet", "--json", "--out", str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
