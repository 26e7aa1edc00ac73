from __future__ import annotations

import io
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from airl_mav.addons.forensics.worst import examine_worst
from airl_mav.arena.geometry import Arena
from airl_mav.flight.judge import Effect, Outcome
from airl_mav.latency.injection import NOTHING_INJECTED
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.episode import with_effects
from airl_mav.rehearsal.run_folder import LoadedRun, RunFolder, load
from airl_mav.report.document import TableView
from airl_mav.report.measures import conduct_table, summarize_run
from airl_mav.report.plotly_scene import plotly_script
from airl_mav.report.run_report import MAX_PICTURED, build_page
from airl_mav.report.run_tables import (
    ages_table,
    episodes_table,
    latency_table,
    print_report,
    quality_table,
    real_time_table,
    run_ages,
)
from airl_mav.report.run_verdict import verdict_of
from airl_mav.report.theme import DARK
from airl_mav.report.timeline import timeline_of
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.page_alone import page_alone, unpacked
from tests.support.run_demo import OUTCOMES_SEEN, demo_setup, write_demo_run

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Checks that tags nest, and collects what could reach outside the file."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.references: list[str] = []
        self.words: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "img":
            self.images.append(dict(attrs))
        self.references += [value or "" for key, value in attrs if key in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedRun, dict[int, Arena]]:
    folder, arenas = write_demo_run(tmp_path_factory.mktemp("run") / "demo", episodes=5)
    run = load(folder.path)
    assert {episode.outcome for episode in run.episodes} == OUTCOMES_SEEN
    return run, arenas


@pytest.fixture(scope="module")
def page(demo: tuple[LoadedRun, dict[int, Arena]]) -> str:
    return build_page(*demo).read_text(encoding="utf-8")


def script_of(page: str, name: str) -> str:
    """Return what the script element of an id holds."""
    begin = page.index(">", page.index(f'id="{name}"')) + 1
    return page[begin : page.index("</script>", begin)]


def cells(view: TableView, first: str) -> dict[str, str]:
    """Return the row that begins with `first`, by column title."""
    (row,) = [row for row in view.rows if row[0] == first]
    return dict(zip([column.title for column in view.columns], row, strict=True))


def test_latency_cells_are_what_numpy_says(demo: tuple[LoadedRun, dict[int, Arena]]) -> None:
    run, _ = demo
    raw = np.concatenate([s["action_ready_us"] - s["infer_start_us"] for s in run.latency.values()])
    row = cells(latency_table(summarize_run(run)), "t2 infer")
    assert row["n"] == str(len(raw))
    assert row["mean"] == f"{raw.mean() / 1e3:.2f}"
    assert row["max"] == f"{raw.max() / 1e3:.2f}"
    assert row["p50"] == f"{np.sort(raw)[int(np.ceil(len(raw) / 2)) - 1] / 1e3:.2f}"
    assert len(raw) < 64
    assert row["p90"] == row["p99"] == "too few"


def test_percentiles_appear_once_there_are_enough(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, _ = demo
    many = {
        k: {
            n: np.tile(v, (20, *[1] * (v.ndim - 1))) if n == "setpoint" else np.tile(v, 20)
            for n, v in stamps.items()
        }
        for k, stamps in run.latency.items()
    }
    view = latency_table(summarize_run(replace(run, latency=many)))
    row = cells(view, "t2 infer")
    raw = np.concatenate([s["action_ready_us"] - s["infer_start_us"] for s in many.values()])
    assert row["p99"] == f"{np.percentile(raw, 99, method='inverted_cdf') / 1e3:.2f}"
    assert "too few" not in row.values()


def test_the_real_time_table(demo: tuple[LoadedRun, dict[int, Arena]]) -> None:
    run, _ = demo
    view = real_time_table(run, summarize_run(run))
    assert view is not None
    lateness = np.concatenate([s["tick_lateness_us"] for s in run.latency.values()])
    p99 = np.percentile(lateness, 99, method="inverted_cdf") / 1e3
    assert cells(view, "tick lateness, p99")["value"] == f"{p99:.2f} ms"
    assert cells(view, "simulated time given up")["value"] == "8.00 ms"
    assert cells(view, "setpoints never accepted")["value"] == "1"
    flown = sum(e.ended_us - e.started_us for e in run.episodes) / 1e6
    wall = sum(e.wall_s or 0.0 for e in run.episodes)
    # Five flights of 2, 3, 4, 5 and 6 s of processor time in 20 s each; the second knows no power.
    spent = cells(view, "companion, processor time a flight")
    assert (spent["value"], spent["n"]) == ("4.00 s, 0.20 cores", "5")
    assert cells(view, "companion, greatest memory of any flight")["value"] == "94 MiB"
    power = cells(view, "mean power of the machine")
    assert (power["value"], power["n"]) == ("6.2 W (INA monitor: VDD_IN)", "4")
    older = replace(run, episodes=tuple(replace(e, companion_use=None) for e in run.episodes))
    fewer = real_time_table(older, summarize_run(run))
    assert fewer is not None
    assert len(fewer.rows) == len(view.rows) - 3
    assert cells(view, "real-time factor")["value"] == f"{flown / wall:.3f} (asked 1)"


def test_quality_tables(demo: tuple[LoadedRun, dict[int, Arena]]) -> None:
    run, _ = demo
    good = [e.quality for e in run.episodes if e.outcome is Outcome.SUCCESS and e.quality]
    row = cells(quality_table(summarize_run(run)), "flight time")
    assert row["value"] == f"{np.mean([q.flight_time_s for q in good]):.2f} s"
    assert row["n"] == str(len(good))
    for episode in run.episodes:
        row = cells(episodes_table(run), str(episode.index))
        assert episode.quality is not None
        assert row["distance"] == f"{episode.quality.distance_m:.2f}"
        assert row["why"].startswith(episode.reason)


def test_deadlines_and_smoothness(demo: tuple[LoadedRun, dict[int, Arena]], page: str) -> None:
    run, _ = demo
    view = conduct_table(run, summarize_run(run))
    assert view is not None
    late = [np.mean(s["motor_us"] - s["capture_us"] > 500_000) for s in run.latency.values()]
    misses = cells(view, "deadline misses")
    assert misses["value"] == f"{100 * np.mean(late):.1f} %"
    assert misses["n"] == str(len(run.episodes))
    reached = [e for e in run.episodes if e.outcome is Outcome.SUCCESS]
    rows = [run.latency[e.index]["setpoint"][:, :3].astype(float) for e in reached]
    steps = np.concatenate([np.sqrt(((r[1:] - r[:-1]) ** 2).sum(axis=1)) for r in rows])
    assert cells(view, "step of the command, greatest")["value"] == f"{steps.max():.2f} m/s"
    assert cells(view, "step of the command, p95")["value"] == "too few"
    # Steps of 0.01, 0.02, ... 2 m/s in one flight, none in the others.
    ramp = np.zeros((201, 4))
    ramp[1:, 0] = np.cumsum(np.arange(1, 201) / 100)
    long = {reached[0].index: {"sent_us": np.arange(201), "setpoint": ramp}}
    longer = conduct_table(replace(run, latency=long), summarize_run(run))
    assert longer is not None
    assert cells(longer, "step of the command, p95")["value"] == "1.90 m/s"
    peaks = [e.quality.jerk_peak_m_s3 or 0.0 for e in reached if e.quality]
    assert cells(view, "jerk, flown, peak")["value"] == f"{max(peaks):,.1f} m/s³"
    assert view.title in page


def test_a_run_recorded_without_them_has_no_such_table(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, _ = demo
    old = []
    for episode in run.episodes:
        assert episode.quality is not None
        quality = replace(
            episode.quality, deadline_misses=None, jerk_rms_m_s3=None, command_step_m_s=None
        )
        old.append(replace(episode, quality=quality))
    run = replace(run, episodes=tuple(old))
    assert conduct_table(run, summarize_run(run)) is None


def test_the_page_is_one_file_that_reaches_nothing_else(page: str) -> None:
    parsed = Page(page)
    (first,) = [ref for ref in parsed.references if not ref.startswith("#")]
    assert first.startswith("data:image/svg+xml;base64,")
    assert not parsed.tags & {"link", "iframe", "object"}
    # The library, the script of the views, and their data are in the page, once each.
    assert page.count("<script") == 3
    assert unpacked(script_of(page, "page-library")) == plotly_script()
    script = page[page.rindex("<script>") :]
    assert not re.search(r"https?:|fetch\(|XMLHttp|import\(|WebSocket|eval\(", script)
    style = page[page.index("<style>") : page.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert all(image["alt"] for image in parsed.images)
    # All flights; six stages that vary and their timeline; one map for each flight.
    assert len(parsed.images) == 1 + 6 + 1 + 5
    named = {image["data-picture"] for image in parsed.images[1:]}
    assert named == set(json.loads(unpacked(script_of(page, "page-data")))["pictures"])
    inside = {ref[1:] for ref in parsed.references if ref.startswith("#")}
    assert inside <= set(re.findall(r'id="([^"]+)"', page))
    assert len(page) < 4_000_000


def test_pictures_follow_light_and_dark_and_carry_no_links(page: str) -> None:
    pictures = json.loads(unpacked(script_of(page, "page-data")))["pictures"]
    assert pictures
    for svg in pictures.values():
        ET.fromstring(svg)  # noqa: S314 - our own
        body = svg.partition("</style>")[2]
        assert "prefers-color-scheme:dark" in svg
        assert not [colour for colour in DARK if colour in body]
        assert set(re.findall(r"var\(--c\d+\)", body)) <= {f"var(--c{i})" for i in range(len(DARK))}
        links = re.findall(r'(?:href|src)="([^"]*)"', body)
        assert all(link.startswith(("#", "data:image/png")) for link in links)


def test_the_page_says_what_flew_and_where_t2_comes_from(page: str) -> None:
    text = " ".join(" ".join(Page(page).words).split())
    for fact in (
        "injected: as if Raspberry Pi 4",
        "Air Learning, system evaluation, No Obstacles",
        "the paper gives no spread",
        "static-obstacles – 5 to 10 standing obstacles",
        "hit obstacle",
        "watchdog: a decision was 620 ms late",
        '"hold_s": 0.5',
        np.__version__,
    ):
        assert fact in text


def test_every_picture_is_a_whole_png(page: str, demo: tuple[LoadedRun, dict[int, Arena]]) -> None:
    run, _ = demo
    names = {path.name for path in run.path.glob("*.png")}
    expected = {f"flight-{i:03d}-map.png" for i in range(5)}
    alone = {"latency.png", "latency-timeline.png", "trajectories.png"}
    assert names == expected | alone
    for name in names:
        with Image.open(run.path / name) as image:
            image.load()
            assert min(image.size) > 500
            # Something is drawn: a blank picture has one colour.
            assert len(np.unique(np.asarray(image.convert("L")))) > 20
    assert not list(run.path.glob("*.partial"))


@pytest.mark.nightly
def test_the_same_run_gives_the_same_page(
    page: str, demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path
) -> None:
    with page_alone():
        assert build_page(*demo, tmp_path / "again").read_text(encoding="utf-8") == page


def test_the_path_on_the_map_is_where_the_vehicle_was(
    page: str, demo: tuple[LoadedRun, dict[int, Arena]]
) -> None:
    """The end marker of a collision lies on the pixel of the vehicle's place at the verdict."""
    run, arenas = demo
    episode = next(e for e in run.episodes if e.outcome is Outcome.COLLISION)
    with Image.open(run.path / f"flight-{episode.index:03d}-map.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    b = arenas[episode.index].bounds
    wall = np.abs(pixels - (153, 0, 0)).sum(axis=2) < 30
    rows, columns = np.flatnonzero(wall.sum(axis=1) > 200), np.flatnonzero(wall.sum(axis=0) > 200)
    path = run.trajectories[episode.index]
    north, east = path.position[path.time_us == episode.ended_us][0, :2]
    # The wall band's outer edges; the walls are drawn 1.2 % of the longer side thick.
    thick = 0.012 * max(b.north_max - b.north_min, b.east_max - b.east_min)
    scale = (columns[-1] - columns[0] + 1) / (b.east_max - b.east_min + 2 * thick)
    x = columns[0] + (east - b.east_min + thick) * scale
    y = rows[-1] + 1 - (north - b.north_min + thick) * scale
    red = np.abs(pixels - (192, 38, 28)).sum(axis=2) < 30
    near = red[round(y) - 4 : round(y) + 5, round(x) - 4 : round(x) + 5]
    assert near.mean() > 0.5


def test_tables_have_medians_and_their_intervals(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, _ = demo
    good = [e.quality for e in run.episodes if e.outcome is Outcome.SUCCESS and e.quality]
    row = cells(quality_table(summarize_run(run)), "distance")
    assert row["value"] == f"{np.median([q.distance_m for q in good]):.2f} m"
    assert row["mean"] == f"{np.mean([q.distance_m for q in good]):.2f}"


def test_worst_flights_come_first_and_have_causes(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, arenas = demo
    judged = examine_worst(run, arenas, load_vehicle("quad"))
    failed = [j.record.outcome is not Outcome.SUCCESS for j in judged]
    assert failed == sorted(failed, reverse=True)
    lost = [j.lost_s or 0.0 for j, bad in zip(judged, failed, strict=True) if not bad]
    assert lost == sorted(lost, reverse=True)
    hits = [j for j in judged if j.record.outcome is Outcome.COLLISION]
    assert hits
    for j in hits:
        assert "collision" in " ".join(j.cause.sentences)
        assert j.cause.kind != "no cause found in the data"


def test_the_timeline_has_every_decision_in_order(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, _ = demo
    timeline = timeline_of(run)
    t2 = np.concatenate([s["action_ready_us"] - s["infer_start_us"] for s in run.latency.values()])
    assert timeline.stages["t2"].tolist() == t2.tolist()
    first = len(run.latency[0]["sent_us"])
    assert timeline.starts[1] == first


def test_the_age_of_the_flown_command_is_weighted_by_time(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, _ = demo
    view = ages_table(run_ages(run), summarize_run(run).stages["end_to_end"])
    assert view is not None
    # The same by brute force: the age at every millisecond of every flight.
    ages = []
    for stamps in run.latency.values():
        there = stamps["motor_us"] != -1
        frames, motors = stamps["capture_us"][there], stamps["motor_us"][there]
        moments = np.arange(motors[0], motors[-1], 1000)
        flown = np.searchsorted(motors, moments, side="right") - 1
        ages.append(moments - frames[flown])
    every = np.concatenate(ages)
    row = cells(view, "at any moment, by time")
    assert float(row["mean"].replace(",", "")) == pytest.approx(every.mean() / 1e3, abs=1.0)
    assert float(row["p50"].replace(",", "")) == pytest.approx(np.median(every) / 1e3, abs=2.0)


def test_user_text_is_escaped(demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path) -> None:
    run, arenas = demo
    evil = "<script>alert(1)</script>&\"'"
    setup = replace(run.info.setup, between_commands=evil)
    info = replace(run.info, name=evil, config={evil: evil}, setup=setup)
    episode = replace(run.episodes[0], reason=evil, notes=(evil,))
    spoiled = replace(run, info=info, episodes=(episode,))
    with page_alone():
        text = build_page(spoiled, arenas, tmp_path).read_text(encoding="utf-8")
    parsed = Page(text)
    assert "alert(1)</script>" not in text
    assert text.count("<script") == 3 + plotly_script().count("<script")
    assert sum(evil in word for word in parsed.words) >= 4


def test_a_lockstep_run_and_an_aborted_flight(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path
) -> None:
    run, _ = demo
    setup = replace(run.info.setup, level="lockstep", speed=None, injection=NOTHING_INJECTED)
    first = replace(run.episodes[0], outcome=Outcome.ABORTED, quality=None, wall_s=None)
    same = {name: np.full(3, 5_000) for name in ("sent_us", "accepted_us", "motor_us")}
    bare = replace(
        run,
        info=replace(run.info, setup=setup),
        episodes=(first,),
        trajectories={},
        latency={0: same},
    )
    text = " ".join(Page(build_page(bare, {}, tmp_path).read_text(encoding="utf-8")).words)
    assert "not paced" in text
    assert "aborted" in text
    assert "nothing injected" in text


def test_the_page_names_who_made_a_flight_invalid(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path
) -> None:
    run, _ = demo
    first = run.episodes[0]
    sender = ("gcs", "", 255, 190)
    effects = [
        Effect(*sender, "PARAM_SET MPC_XY_VEL_MAX", 2, first.ended_us - 1, False, 12.0, 3.0),
        Effect("onboard", "127.0.0.1:5", 77, 1, "ODOMETRY", 40, first.started_us, False),
    ]
    record = with_effects(first, resolve(Scenario(policy="greedy")), effects)
    bare = replace(run, episodes=(record,), trajectories={}, latency={})
    html = build_page(bare, {}, tmp_path, verdict=verdict_of(bare)).read_text(encoding="utf-8")
    text = " ".join(Page(html).words)
    assert "gcs, system 255 component 190, PARAM_SET MPC_XY_VEL_MAX from 12 to 3 (2 times," in text
    assert (
        "onboard 127.0.0.1:5, system 77 component 1, ODOMETRY (40 times, first 0.0 s after the"
        in text
    )


def test_a_run_without_flights_still_has_a_page(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", "empty", {}, setup=demo_setup())
    run = load(folder.path)
    parsed = Page(build_page(run, {}).read_text(encoding="utf-8"))
    assert "no flight finished" in " ".join(parsed.words)
    assert parsed.images == []
    print_report(run, Console(file=io.StringIO(), width=80))


def test_pictures_go_to_the_flights_that_failed(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path
) -> None:
    run, _ = demo
    good = next(e for e in run.episodes if e.outcome is Outcome.SUCCESS)
    bad = next(e for e in run.episodes if e.outcome is Outcome.TIMEOUT)
    n = MAX_PICTURED + 4
    many = [replace(good if i < n - 2 else bad, index=i) for i in range(n)]
    missed = replace(run, episodes=tuple(many), trajectories={}, latency={})
    with page_alone():
        text = build_page(missed, {}, tmp_path).read_text(encoding="utf-8")
    shown = [int(i) for i in re.findall(r"<h3>Flight (\d+)</h3>", text)]
    assert len(shown) == MAX_PICTURED
    assert shown[:2] == [n - 2, n - 1]
    assert f"Pictures of {MAX_PICTURED} of {n} flights" in text


def test_the_terminal_shows_the_same_tables_in_80_columns(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, _ = demo
    printed = io.StringIO()
    console = Console(file=printed, width=80, color_system=None)
    print_report(run, console)
    text = printed.getvalue()
    assert "…" not in text.replace(" … ", "")
    summary = summarize_run(run)
    for view in (latency_table(summary), episodes_table(run), real_time_table(run, summary)):
        assert view is not None
        for row in view.rows:
            shown = [
                cell for cell, column in zip(row, view.columns, strict=True) if not column.page_only
            ]
            assert re.search(r"\s+".join(map(re.escape, shown)), text), shown


def test_reported_json_config_is_readable(page: str) -> None:
    block = page[page.index("<pre>") + 5 : page.index("</pre>")]
    assert json.loads(block.replace("&#34;", '"'))["companion"] == {"hold_s": 0.5}


@pytest.mark.nightly
def test_a_run_in_which_nothing_arrived(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path
) -> None:
    run, arenas = demo
    lost = replace(run.episodes[0], outcome=Outcome.TIMEOUT, reason="9.00 m from the goal")
    for latency in (run.latency, {}):
        alone = replace(run, episodes=(lost,), latency=latency)
        with page_alone():
            path = build_page(alone, arenas, tmp_path, vehicle=load_vehicle("quad"))
        text = " ".join(Page(path.read_text(encoding="utf-8")).words)
        assert "Worst flights" in text
        assert "Closest to the goal after" in text
    grounded = replace(lost, quality=None, navigation_us=None, outcome=Outcome.ABORTED)
    bare = replace(run, episodes=(grounded,), latency={}, trajectories={})
    text = build_page(bare, {}, tmp_path / "bare").read_text(encoding="utf-8")
    assert "Aborted." in text
    assert 'id="scene"' not in text
