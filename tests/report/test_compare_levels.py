"""`airl compare-levels`: flights, output, files, and interruptions."""

from __future__ import annotations

import base64
import io
import json
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image

from airl_mav.cli import main
from airl_mav.core.constants import Level
from airl_mav.core.errors import UsageError
from airl_mav.experiments import experiment as levels_experiment
from airl_mav.experiments.campaign import Cell, EpisodeSaver
from airl_mav.experiments.evaluate import declare_compare_levels
from airl_mav.experiments.experiment import make_cell
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import tango
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder, load
from airl_mav.report.comparison import show
from airl_mav.report.comparison.compare_levels_page import other_differences, split_table
from airl_mav.report.comparison.comparison_model import Comparison, RunEntry, load_comparison
from airl_mav.report.comparison.figures import contrast_pictures
from airl_mav.report.comparison.show import build_comparison, write_comparison
from airl_mav.report.comparison.tables import contrast_table, runs_table
from airl_mav.report.document import TableView
from airl_mav.report.measures import MEASURES
from airl_mav.scenario.model import Scenario
from tests.support.command_line import airl, option_words
from tests.support.flown_here import flown_here
from tests.support.page_alone import page_alone
from tests.support.ports import choose_ports
from tests.support.processes import write_arena
from tests.support.run_demo import demo_arena, demo_episode, demo_setup

LEVELS_FILE = "compare-levels.json"
EPISODES, SITL_EPISODES = 24, 6
WORDS: dict[str, Any] = {"arena": "dense-obstacles", "episodes": EPISODES, "seed": 20}
"""Setup in which some flights reach the goal and some do not."""

SLOW: dict[str, Any] = {"computer": "ras-pi-4", "workload": "template-5x32"}
"""Decides some 400 ms later."""


def stand_in(name: str, title: str, scenario: Scenario) -> Cell:
    """Make a cell of levels lockstep and sitl that the twin flies on a slow computer.

    The comparison is under test, not its levels.
    """
    if scenario.level != "gym":
        scenario = scenario.model_copy(update={"level": "gym", "speed": None, **SLOW})
    return make_cell(name, title, scenario)


@pytest.fixture(scope="module")
def _twins() -> Iterator[None]:
    with patch.object(levels_experiment, "make_cell", stand_in):
        yield


def climb(*, page: bool = False, **options: Any) -> tuple[int, str]:
    """Run the command in this process; return exit status and output.

    Pages take longer than flights: without `page` none is made.
    """
    words = option_words(**(WORDS | {"sitl_episodes": SITL_EPISODES} | options))
    with (
        nullcontext()
        if page
        else patch.object(show, "write_document", lambda _, folder: folder / "compare-levels.html")
    ):
        return airl("compare-levels", "greedy", *words, width=100)


@pytest.fixture(scope="module")
def whole(_twins: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the folder and output of an uninterrupted comparison."""
    out = tmp_path_factory.mktemp("whole") / "levels"
    code, text = climb(out=out, page=True)
    assert code == 0
    return out, text


def lines(path: Path) -> dict[int, dict[str, Any]]:
    """Return the episodes of a run by seed, as a reader without this package sees them."""
    episodes = map(json.loads, (path / "episodes.jsonl").read_text().splitlines())
    return {episode["seed"]: episode for episode in episodes}


def data_of(path: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((path / LEVELS_FILE).read_text())
    return data


def levels_of(data: dict[str, Any]) -> list[dict[str, Any]]:
    return [{**run["entry"], **run} for run in data["runs"]]


def contrasts_of(data: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"level": c["entry"]["target"], **c["paired"]} for c in data["contrasts"]]


def read_levels(path: Path) -> Comparison:
    return load_comparison(path, "compare-levels")


def comparison_tables(compared: Comparison) -> list[TableView]:
    return [contrast_table(compared, contrast) for contrast in compared.contrasts]


# --- what it flies


def test_every_level_flies_the_same_seeds(whole: tuple[Path, str]) -> None:
    out, _ = whole
    flights = {level: lines(out / level) for level in ("gym", "lockstep", "sitl")}
    assert list(flights["gym"]) != list(flights["sitl"])
    assert sorted(flights["gym"]) == sorted(flights["lockstep"]) == list(range(20, 44))
    assert sorted(flights["sitl"]) == list(range(20, 26))
    for seed, episode in flights["sitl"].items():
        assert episode["goal"] == flights["gym"][seed]["goal"] == flights["lockstep"][seed]["goal"]


@pytest.mark.slow
def test_levels_gym_and_lockstep_fly(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "arena": "no-obstacles",
        "episodes": 1,
        "sitl_episodes": 1,
        "workers": 1,
    }
    levels = ("gym", "lockstep")
    with patch.object(levels_experiment, "make_cell", make_cell), flown_here():
        with page_alone():
            assert climb(out=tmp_path / "one", levels=levels, page=True, **options)[0] == 0
        # The other way round it is flown again, and flies the same.
        assert climb(out=tmp_path / "two", levels=levels[::-1], **options)[0] == 0
    gym, lockstep = (lines(tmp_path / "one" / level) for level in levels)
    assert sorted(gym) == sorted(lockstep) == [20]
    one, two = data_of(tmp_path / "one"), data_of(tmp_path / "two")
    assert levels_of(one)[0] == levels_of(two)[1]
    assert levels_of(one)[1] == levels_of(two)[0]
    assert re.fullmatch("[0-9a-f]{64}", levels_of(one)[1]["sha256"])
    (found,) = contrasts_of(one)
    assert found["agreement"]["both"] == 1
    # In the open both fly to the goal, from nearly the same place.
    assert abs(found["distance_m"]["difference"]["value"]) < 5.0
    assert levels_of(one)[0]["start"]["takeoff_s"] == 0.0
    assert levels_of(one)[1]["start"]["takeoff_s"] > 4.0
    assert 0.0 < levels_of(one)[1]["position_error_m"] < 1.0
    assert (tmp_path / "one" / "compare-levels.html").exists()


def test_level_sitl_flies_fewer_unless_asked() -> None:
    for episodes, asked, wanted in ((100, None, 10), (4, None, 4), (100, 30, 30)):
        scenario = Scenario(policy="greedy", episodes=episodes)
        declared = declare_compare_levels(scenario, ("gym", "sitl"), sitl_episodes=asked)
        assert [len(cell.scenario.seeds) for cell in declared.cells] == [episodes, wanted]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_level_sitl_flies_in_a_comparison(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        **{f"{name}_port": port for name, port in vars(choose_ports()).items()},
        "arena": write_arena(tmp_path),
        "episodes": 2,
        "sitl_episodes": 1,
        "speed": 4.0,
        "no_validity": True,
        "levels": ("gym", "sitl"),
        "out": tmp_path / "compare-levels",
    }
    with patch.object(levels_experiment, "make_cell", make_cell):
        code, text = climb(**options)
        assert code == 0
        assert "sitl: 1 goal reached\n" in text
        gym, sitl = levels_of(data_of(tmp_path / "compare-levels"))
        assert (gym["flown"], sitl["flown"]) == (2, 1)
        code, text = climb(**options)
        assert code == 0
        assert "sitl: 1 goal reached (flown before)" in text


# --- what it says


@pytest.mark.parametrize("level", ["lockstep", "sitl"])
def test_differences_are_those_of_the_files(whole: tuple[Path, str], level: str) -> None:
    out, _ = whole
    gym, other = lines(out / "gym"), lines(out / level)
    (found,) = [c for c in contrasts_of(data_of(out)) if c["level"] == level]
    seeds = sorted(other)
    reached = [(gym[s]["outcome"] == "success", other[s]["outcome"] == "success") for s in seeds]
    agreement = found["agreement"]
    assert agreement["both"] == sum(a and b for a, b in reached)
    assert agreement["only_reference"] == sum(a and not b for a, b in reached)
    assert agreement["only_other"] == sum(b and not a for a, b in reached)
    assert sum(agreement.values()) == len(seeds)
    rates = np.mean(reached, axis=0)
    success = found["success_rate"]
    assert [success["reference"], success["other"]] == pytest.approx(rates)
    difference = success["difference"]
    assert difference["value"] == pytest.approx(100.0 * (rates[1] - rates[0]))
    expected = tango(agreement["only_other"], agreement["only_reference"], len(seeds))
    assert difference["low"] == pytest.approx(100.0 * (expected.low or 0.0))
    assert difference["n"] == len(seeds)
    common = [s for s, ends in zip(seeds, reached, strict=True) if all(ends)]
    for key in ("flight_time_s", "distance_m", "energy_j"):
        first = np.array([gym[s]["quality"][key] for s in common])
        second = np.array([other[s]["quality"][key] for s in common])
        assert found[key]["reference"] == pytest.approx(np.median(first))
        assert found[key]["other"] == pytest.approx(np.median(second))
        difference = found[key]["difference"]
        assert difference["value"] == pytest.approx(100.0 * np.median(second / first - 1.0))
        if len(common) >= 6:
            assert difference["low"] < difference["value"] < difference["high"]
        else:
            assert difference["low"] is difference["high"] is None
        assert difference["n"] == len(common)


def test_the_levels_differ_and_the_seeds_that_split_are_named(whole: tuple[Path, str]) -> None:
    out, _ = whole
    data = data_of(out)
    # Otherwise nothing of this file shows anything: a late policy flies worse.
    lockstep = contrasts_of(data)[0]
    assert lockstep["agreement"]["only_reference"] > 0
    assert lockstep["agreement"]["both"] >= 3
    flights = {level: lines(out / level) for level in ("gym", "lockstep", "sitl")}
    named = {item["seed"]: item["outcomes"] for item in data["extra"]["split"]}
    for seed in flights["gym"]:
        ends = {level: e[seed]["outcome"] for level, e in flights.items() if seed in e}
        split = len({outcome == "success" for outcome in ends.values()}) > 1
        assert (seed in named) == split
        assert not split or named[seed] == ends
    rows = split_table(read_levels(out)).rows
    assert [int(row[0]) for row in rows] == sorted(named)
    assert {"goal reached", "collision"} <= {cell for row in rows for cell in row[1:]}


def test_what_a_decision_takes(whole: tuple[Path, str]) -> None:
    out, text = whole
    for level in levels_of(data_of(out)):
        t2, period = [], []
        with np.load(out / level["name"] / "latency.npz") as stamps:
            for index in sorted({name.partition("/")[0] for name in stamps.files}):
                start, end, sent = (
                    stamps[f"{index}/{key}"]
                    for key in ("infer_start_us", "action_ready_us", "sent_us")
                )
                ended = (start >= 0) & (end >= 0)
                t2.append((end - start)[ended])
                period.append(np.diff(sent[sent >= 0]))
        for key, values in (("t2", t2), ("period", period)):
            pooled = np.concatenate(values)
            stage = level["stages"][key]
            assert stage["n"] == len(pooled)
            assert stage["mean"] == pytest.approx(pooled.mean())
    times = {
        level["name"]: level["stages"]["period"]["mean"] / 1e3 for level in levels_of(data_of(out))
    }
    told = "; ".join(f"{value:.1f} ms at {name}" for name, value in times.items())
    assert f"Decision period: {told}." in " ".join(text.split())
    assert times["lockstep"] > times["gym"] + 300.0
    assert "as if Raspberry Pi 4" in levels_of(data_of(out))[1]["setup"]["injection"]["label"]


def test_seeds_that_make_the_difference_are_named(whole: tuple[Path, str]) -> None:
    out, text = whole
    gym, other = lines(out / "gym"), lines(out / "lockstep")
    times = {
        seed: [run[seed]["quality"]["flight_time_s"] for run in (gym, other)]
        for seed in gym
        if gym[seed]["outcome"] == other[seed]["outcome"] == "success"
    }
    percent = {seed: 100.0 * (late / early - 1.0) for seed, (early, late) in times.items()}
    first, second, third = sorted(percent, key=lambda seed: abs(percent[seed]))[:-4:-1]
    assert (
        f"Flight time at lockstep by pairs: median {np.median(list(percent.values())):+.1f} %; "
        f"widest {percent[first]:+.1f} % with seed {first}, {percent[second]:+.1f} % with seed "
        f"{second}, {percent[third]:+.1f} % with seed {third}."
    ) in " ".join(text.split())


def test_no_difference_is_printed_without_its_pairs(whole: tuple[Path, str]) -> None:
    out, text = whole
    compared = read_levels(out)
    for view, contrast in zip(comparison_tables(compared), compared.contrasts, strict=True):
        agreement = contrast.paired.agreement
        titles = [column.title for column in view.columns]
        assert titles[-3:] == ["difference", "95 % interval", "pairs"]
        pairs = [agreement.n] + 3 * [agreement.both]
        assert [int(row[-1]) for row in view.rows] == pairs
        for row in view.rows:
            assert re.search(r"\s+".join(map(re.escape, row)), text), row
        assert f"only gym in {agreement.only_reference}" in view.notes[0]
    assert any("Not the same number" in note for note in runs_table(compared.runs).notes)


def test_the_first_level_is_the_reference(whole: tuple[Path, str]) -> None:
    out, _ = whole
    names = ("lockstep", "gym")
    turned = levels_of_runs(out, {}, [RunEntry(name, name, planned=EPISODES) for name in names])
    there, back = read_levels(out).contrasts[0].paired, turned.contrasts[0].paired
    assert back.agreement.only_reference == there.agreement.only_other
    assert back.flight_time_s.reference == there.flight_time_s.other
    high = there.success_rate.difference.high
    assert high is not None
    assert back.success_rate.difference.low == pytest.approx(-high)
    assert comparison_tables(turned)[0].title == "gym against lockstep"


def levels_of_runs(root: Path, facts: dict[str, Any], levels: list[RunEntry]) -> Comparison:
    return build_comparison(root, "compare-levels", facts, levels)[0]


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Comparison]:
    """Flights that begin with a take-off, at two levels that are 0.3 m apart."""
    root = tmp_path_factory.mktemp("rehearsed")
    sides: dict[Level, float] = {"lockstep": 0.0, "sitl": 0.3}
    for level, aside in sides.items():
        setup = replace(demo_setup(), level=level)
        folder = RunFolder.create(root / level, "demo", {}, setup=setup)
        for index in range(3):
            record, path, latency = demo_episode(index, demo_arena(index + 1))
            if index == 2:
                record = replace(record, invalid=("the host was busy",))
            path = replace(path, position=path.position + np.array([0.0, aside, 0.0]))
            estimate: dict[str, np.ndarray] = {
                # Between the samples of the path, and on after the verdict.
                "estimate/time_us": path.time_us[:-1] + 10_000,
                "estimate/position": 0.5 * (path.position[:-1] + path.position[1:])
                + [0.6 + aside, 0.8, 5.0],
            }
            estimate["estimate/position"][path.time_us[:-1] > record.ended_us] += 50.0
            folder.save_episodes([FlownEpisode(record, path, latency | estimate)])
    levels = [RunEntry(level, level, planned=3) for level in ("lockstep", "sitl")]
    return root, levels_of_runs(root, {"policy": "scout", "arena": "static-obstacles"}, levels)


def test_where_navigation_begins_and_what_is_believed(
    rehearsed: tuple[Path, Comparison],
) -> None:
    root, compared = rehearsed
    lockstep, sitl = compared.runs
    assert lockstep.start is not None
    assert sitl.start is not None
    assert lockstep.start.n == 2  # The third one is invalid.
    assert lockstep.start.takeoff_s == pytest.approx(5.0, abs=0.02)
    paths = load(root / "lockstep")
    at = []
    for e, p in zip(paths.episodes[:2], list(paths.trajectories.values())[:2], strict=True):
        assert e.navigation_us is not None
        at.append(p.position[np.searchsorted(p.time_us, e.navigation_us)])
    assert lockstep.start.aside_m == pytest.approx(np.mean([np.hypot(*p[:2]) for p in at]))
    assert lockstep.start.height_m == pytest.approx(np.mean([-p[2] for p in at]))
    assert sitl.start.aside_m != pytest.approx(lockstep.start.aside_m)
    assert lockstep.position_error_m == pytest.approx(1.0, abs=1e-6)
    assert sitl.position_error_m == pytest.approx(np.hypot(0.9, 0.8), abs=1e-6)
    words = " ".join(other_differences(compared))
    assert "Error of the estimated position: 1.00 m at lockstep; 1.20 m at sitl." in words
    assert "after 5.0 s of take-off" in words
    # The first flight of each gave up 8 ms.
    assert "could not keep pace at sitl: 8 ms" in words
    # An invalid flight makes no pair.
    assert compared.contrasts[0].paired.agreement.n == 2


# --- what it leaves behind


class Page(HTMLParser):
    """Checks that tags nest, and collects what reaches outside the file."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.sources: list[str] = []
        self.links: list[str] = []
        self.alts: list[str | None] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in {"meta", "img"}:
            self.open.append(tag)
        found = dict(attrs)
        if tag == "img":
            self.alts.append(found.get("alt"))
        self.sources += [value or "" for key, value in attrs if key == "src"]
        self.links += [value or "" for key, value in attrs if key == "href"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += f" {data}"


def test_the_page_is_one_file(whole: tuple[Path, str]) -> None:
    out, _ = whole
    text = (out / "compare-levels.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert "url(" not in text
    assert "@import" not in text
    assert len(page.sources) == len(MEASURES)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    assert all(page.alts)
    # To the reports of the levels, where there are any.
    assert all((out / link).exists() for link in page.links)
    words = " ".join(page.text.split())
    for fact in ("greedy in dense-obstacles", "sitl against gym", "Decision period:"):
        assert fact in words
    for view in comparison_tables(read_levels(out)):
        for row in view.rows:
            assert " ".join(row) in words


def test_figures_say_what_the_tables_say(whole: tuple[Path, str]) -> None:
    out, _ = whole
    compared = read_levels(out)
    sources = Page((out / "compare-levels.html").read_text(encoding="utf-8")).sources
    for source, measure in zip(sources, MEASURES, strict=True):
        svg = base64.b64decode(source.partition(",")[2]).decode()
        assert "prefers-color-scheme:dark" in svg
        for contrast in compared.contrasts:
            difference = measure.change(contrast.paired).difference
            assert f">{difference.value:+.2f}, n = {difference.n}<" in svg
    with Image.open(out / "compare-levels.png") as image:
        image.load()
        assert min(image.size) > 300
        assert len(np.unique(np.asarray(image.convert("L")))) > 20


def test_a_bar_lies_where_its_interval_is(whole: tuple[Path, str]) -> None:
    """The bar of the figure, in pixels, against the numbers on its axis."""
    compared = read_levels(whole[0])
    picture = contrast_pictures("x", compared, compared.contrasts)[0]
    with Image.open(io.BytesIO(picture.png)) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    blue = np.abs(pixels - (0x28, 0x68, 0xA8)).sum(axis=2) < 30
    grey = np.abs(pixels - (0x68, 0x70, 0x7A)).sum(axis=2) < 30
    rows = np.flatnonzero(blue.sum(axis=1) > 20)
    lockstep_row, sitl_row = rows[0], rows[-1]
    assert lockstep_row < sitl_row - 20
    zero = np.flatnonzero(grey.sum(axis=0) > 60)
    assert len(zero)
    ends = [np.flatnonzero(blue[row])[[0, -1]] - zero.mean() for row in (lockstep_row, sitl_row)]
    limits = [
        (d.low or 0.0, d.high or 0.0)
        for d in (c.paired.success_rate.difference for c in compared.contrasts)
    ]
    # One scale for all of it: pixels a percent.
    scale = np.ptp(ends[0]) / np.ptp(limits[0])
    assert np.ravel(ends) == pytest.approx(scale * np.ravel(limits), abs=4.0)


def test_foreign_text_is_escaped(rehearsed: tuple[Path, Comparison], tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>&\"'"
    root, compared = rehearsed
    spoiled = replace(compared, title=evil, facts={"policy": evil, "arena": evil, evil: evil})
    runs = {run.name: load(root / run.name) for run in compared.runs}
    text = write_comparison(spoiled, runs, tmp_path).read_text(encoding="utf-8")
    page = Page(text)
    assert "script" not in page.tags
    assert "<script" not in text
    assert page.text.count(evil) >= 5


def test_a_level_without_any_success_still_has_a_page(
    rehearsed: tuple[Path, Comparison], tmp_path: Path
) -> None:
    runs = load(rehearsed[0] / "sitl")
    folder = RunFolder.create(tmp_path / "sitl", "demo", {}, setup=runs.info.setup)
    failed = replace(runs.episodes[0], outcome=Outcome.COLLISION, quality=None, navigation_us=None)
    folder.save_episodes([FlownEpisode(failed, runs.trajectories[0], {})])
    folder = RunFolder.create(tmp_path / "lockstep", "demo", {}, setup=runs.info.setup)
    reached = load(rehearsed[0] / "lockstep").episodes[0]
    folder.save_episodes([FlownEpisode(reached, runs.trajectories[0], runs.latency[0])])
    entries = [RunEntry(n, n, planned=1) for n in ("lockstep", "sitl")]
    compared, loaded = build_comparison(tmp_path, "compare-levels", {}, entries)
    rows = comparison_tables(compared)[0].rows[1:]
    assert [row[3:] for row in rows] == [("–", "–", "0")] * 3
    page = write_comparison(compared, loaded, tmp_path)
    assert "n = 0" in Page(page.read_text(encoding="utf-8")).text


def test_airl_report_shows_it_again(whole: tuple[Path, str]) -> None:
    out, text = whole
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    code, again = airl("report", str(out), width=100)
    assert code == 0
    assert text.endswith(again)
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("{", "not JSON"),
        ('{"schema": 99}', "schema = 99: accepted: 3"),
        (
            '{"schema": 3, "facts": {}, "runs": [{"entry": {"name": "gym"}}]}',
            "folder: missing",
        ),
        (
            '{"schema": 3, "facts": {}, "runs": [{"entry": {"name": "gym", "folder": "gym"}}]}',
            "no run here",
        ),
    ],
)
def test_a_broken_comparison_gets_one_line(content: str, named: str, tmp_path: Path) -> None:
    (tmp_path / LEVELS_FILE).write_text(content)
    with pytest.raises(UsageError, match=re.escape(named)) as error:
        airl("report", str(tmp_path))
    assert "\n" not in str(error.value)


# --- what it survives


def interrupted_after(flights: int) -> Any:
    """Return a patch that sends Ctrl-C after a number of flights."""
    real, flown = EpisodeSaver.add, []

    def add(saver: EpisodeSaver, episode: FlownEpisode) -> None:
        real(saver, episode)
        flown.append(episode)
        if len(flown) == flights:
            signal.raise_signal(signal.SIGINT)

    return patch.object(EpisodeSaver, "add", add)


@pytest.mark.nightly
def test_an_interrupted_comparison_goes_on(whole: tuple[Path, str], tmp_path: Path) -> None:
    out = tmp_path / "levels"
    with interrupted_after(2 * EPISODES + 2):
        code, text = climb(out=out, slots=1)
    assert code == 130
    assert f"interrupted: finished flights are kept; resume with --out {out}" in text
    assert "2 of 6 at sitl" in text
    assert contrasts_of(data_of(out))[1]["success_rate"]["difference"]["n"] == 2
    # Cut again at once, then to the end.
    with interrupted_after(1):
        assert climb(out=out, slots=1)[0] == 130
    code, text = climb(out=out)
    assert code == 0
    assert "3 of 6 episodes are there" in text
    assert data_of(out) == data_of(whole[0])


def test_an_interrupted_first_level(_twins: None, tmp_path: Path) -> None:
    out = tmp_path / "levels"
    with interrupted_after(2):
        code, text = climb(out=out, slots=1, levels=("gym", "lockstep"))
    assert code == 130
    assert "resume with" in text
    assert not (out / LEVELS_FILE).exists()
    assert len(load(out / "gym").episodes) == 2


def test_what_is_finished_is_shown_again_and_not_flown(whole: tuple[Path, str]) -> None:
    out, text = whole
    flown = {path: path.read_bytes() for path in out.rglob("episodes.jsonl")}
    code, again = climb(out=out)
    assert code == 0
    assert {path: path.read_bytes() for path in out.rglob("episodes.jsonl")} == flown
    tables = [
        shown.partition("policy ")[2].partition("compare-levels  ")[0] for shown in (text, again)
    ]
    assert tables[0] == tables[1] != ""


# --- what it refuses


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"levels": ("gym",)}, "--levels gym: accepted: two or more"),
        ({"levels": ()}, "--levels none"),
        ({"levels": ("gym", "sitl", "gym")}, "--levels gym sitl gym"),
        ({"episodes": 0}, "--episodes 0"),
        ({"seed": -1}, "--seed -1"),
        ({"sitl_episodes": 25}, "--sitl-episodes 25: accepted: 1 <= value <= 24"),
        ({"sitl_episodes": 0}, "--sitl-episodes 0"),
        ({"workers": 0}, "--workers 0"),
        ({"speed": 100.0}, "--speed 100"),
        ({"arena": "moon"}, "moon"),
        ({"computer": "abacus"}, "abacus"),
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_flies(
    options: dict[str, Any], named: str, tmp_path: Path
) -> None:
    with (
        patch.object(levels_experiment, "make_cell", make_cell),
        pytest.raises(UsageError, match=re.escape(named)) as error,
    ):
        climb(out=tmp_path / "compare-levels", **{"levels": ("gym", "sitl")} | options)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "compare-levels").exists()


def test_another_run_is_not_mixed_in(whole: tuple[Path, str]) -> None:
    out, _ = whole
    before = data_of(out)
    with pytest.raises(UsageError, match=r"another cell gym: seed = 20, not 21"):
        climb(out=out, seed=21)
    with pytest.raises(UsageError, match=r"holds a single run|holds a run"):
        climb(out=out / "gym")
    assert data_of(out) == before


def test_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["compare-levels", "telepathy", "--arena", "no-obstacles", "--levels", "gym", "sitl"]
    monkeypatch.setattr(sys, "argv", ["airl", *words])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert "telepathy" in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())
