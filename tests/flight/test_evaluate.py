"""`airl evaluate`: flights, output files, and recovery."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image

from airl_mav.arena.generate import generate
from airl_mav.core.errors import EXIT_INVALID, UsageError
from airl_mav.core.files import read_groups
from airl_mav.envs.evaluation import fly_episodes
from airl_mav.envs.spec import EnvironmentSpec, EpisodeRules
from airl_mav.experiments import campaign, gym_flier
from airl_mav.experiments.campaign import EpisodeSaver
from airl_mav.flight.judge import Outcome, Referee, Task, TruthSample
from airl_mav.policy.card import load_card
from airl_mav.policy.layouts import Encoded
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile, profiles_dir
from airl_mav.rehearsal import host_pace, run_folder
from airl_mav.rehearsal.run_folder import FlownEpisode, LoadedRun, RunFolder, arena_of, load
from airl_mav.report import run_report, run_tables
from airl_mav.report.comparison import show
from airl_mav.report.run_report import write_report
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.campaign_kit import same_runs
from tests.support.command_line import airl, option_words
from tests.support.linear_policy import ACTIONS, SPEC, weights, write_linear
from tests.support.ports import choose_ports
from tests.support.processes import ROOT, run_alone, wait_until

EPISODES = 30
LOCKSTEP = {"level": "lockstep"}
DENSE: dict[str, Any] = {"arena": ("dense-obstacles",), "episodes": EPISODES, "seed": 20}
"""Arena in which only some flights reach the goal."""


def evaluate(*policies: str | Path, page: bool = False, **options: Any) -> tuple[int, str]:
    """Run the command in this process; return exit status and output.

    The page of a comparison takes longer than its flights: it is made with `page` alone.
    """
    with ExitStack() as stack:
        if not page:
            stack.enter_context(
                patch.object(show, "write_document", lambda _, folder: folder / "matrix.html")
            )
        words = [*map(str, policies), *option_words(**options)]
        return airl("evaluate", *words, width=100)


@pytest.fixture(scope="module", autouse=True)
def _few_pictures() -> Iterator[None]:
    """Pictures take longer than flights."""
    with patch.object(run_report, "MAX_PICTURED", 2):
        yield


@pytest.fixture(scope="module")
def greedy(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedRun, str]:
    """`airl evaluate greedy` and `airl report`: the run, and the printed text."""
    out = tmp_path_factory.mktemp("greedy") / "run"
    code, text = evaluate("greedy", out=out, **DENSE)
    assert code == 0
    assert not list(out.glob("*.png"))
    tables, command = text.rsplit("\n\nreport  ", 1)
    # The printed command draws the page and prints the same tables.
    words = shlex.split(command.splitlines()[0])
    assert words == ["airl", "report", str(out)]
    code, shown = airl(*words[1:], width=100)
    assert code == 0
    assert tables.endswith(shown.rsplit("\n\nreport  ", 1)[0])
    assert f"\nreport  {out / 'report.html'}\n" in shown
    return load(out), text


@pytest.fixture(scope="module")
def linear(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_linear(tmp_path_factory.mktemp("policies") / "linear")


# --- what is flown


def test_episodes_are_those_of_the_seeds(greedy: tuple[LoadedRun, str]) -> None:
    run_, _ = greedy
    assert [e.index for e in run_.episodes] == list(range(EPISODES))
    assert [e.seed for e in run_.episodes] == [20 + i for i in range(EPISODES)]
    assert run_.info.seeds == tuple(20 + i for i in range(EPISODES))
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    for episode in run_.episodes:
        arena = generate(spec, episode.arena_seed, name="again", vehicle_width_m=0.55)
        assert episode.goal == tuple(arena.goal)
        assert episode.arena == "dense-obstacles"
        assert episode.goal_radius_m == 3.0


@pytest.mark.parametrize("level", ["gym", pytest.param("lockstep", marks=pytest.mark.nightly)])
def test_goals_of_a_zone(level: str, tmp_path: Path) -> None:
    """The curriculum's zones: the same arenas, and goals no farther than the zone's radius."""
    asked: dict[str, Any] = {
        "zone": 0,
        "level": level,
        "episodes": 3,
        "seed": 20,
        "arena": ("static-obstacles",),
    }
    code, _ = evaluate("greedy", out=tmp_path / "run", **asked)
    assert code == 0
    run_ = load(tmp_path / "run")
    spec = load_profile("arenas", "static-obstacles", ArenaSpec)
    again = partial(generate, spec, name="again", vehicle_width_m=0.55)
    for episode in run_.episodes:
        whole, small = again(episode.arena_seed), again(episode.arena_seed, zone=0)
        assert episode.goal == tuple(small.goal)
        assert math.hypot(*episode.goal) <= spec.zones_m[0] == 16.0
        redrawn = arena_of(run_, episode)
        assert redrawn is not None
        assert tuple(redrawn.goal) == episode.goal, "the report draws what was flown"
        assert np.array_equal(redrawn.obstacles.center, whole.obstacles.center)
    assert any(math.hypot(*again(seed).goal) > 16.0 for seed in run_.info.seeds)
    assert "zone 0 (goals within 16 m)" in run_.info.setup.conditions


def test_the_referee_of_the_rehearsal_says_the_same(greedy: tuple[LoadedRun, str]) -> None:
    run_, _ = greedy
    assert {e.outcome for e in run_.episodes} >= {Outcome.SUCCESS, Outcome.COLLISION}
    for episode in run_.episodes:
        referee = Referee(Task(episode.goal, episode.goal_radius_m, episode.time_limit_s))
        referee.start_navigation(0)
        path = run_.trajectories[episode.index]
        for i, time_us in enumerate(path.time_us.tolist()):
            hit = episode.reason.partition("hit ")[2] if time_us == episode.ended_us else ""
            north, east, down = path.position[i]
            referee.observe(TruthSample(time_us, (north, east, down), hit or None, 0.5))
        assert referee.verdict is not None
        assert referee.verdict.outcome is episode.outcome
        assert referee.verdict.reason == episode.reason
        assert referee.verdict.time_us == episode.ended_us == path.time_us[-1]


def test_a_collision_names_what_stands_there(greedy: tuple[LoadedRun, str]) -> None:
    run_, _ = greedy
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    crashed = [e for e in run_.episodes if e.outcome is Outcome.COLLISION]
    for episode in crashed:
        arena = generate(spec, episode.arena_seed, name="again", vehicle_width_m=0.55)
        where = run_.trajectories[episode.index].position[-1]
        match = re.fullmatch(r"hit static-(box|cylinder|sphere)-(\d+)", episode.reason)
        assert match
        obstacle = int(match[2])
        reach = np.linalg.norm(arena.obstacles.half_size[obstacle, :2]) + 0.3
        gap = np.linalg.norm(arena.obstacles.center[obstacle, :2] - where[:2])
        assert gap < reach


def test_quality_is_that_of_the_path(greedy: tuple[LoadedRun, str]) -> None:
    run_, _ = greedy
    for episode in run_.episodes:
        path, q = run_.trajectories[episode.index], episode.quality
        assert q is not None
        assert q.flight_time_s == pytest.approx(episode.ended_us / 1e6)
        length = np.linalg.norm(np.diff(path.position, axis=0), axis=1).sum()
        assert q.distance_m == pytest.approx(length)
        # A hovering Iris-class vehicle draws some 190 W; the workstation stays on the ground.
        assert q.energy_j is not None
        assert 150.0 < q.energy_j / q.flight_time_s < 260.0
        assert q.computer_energy_j == 0.0
        assert q.endurance_s is not None
        # 5.2 Ah at a mean of 15.4 V.
        pack_j = q.endurance_s * q.energy_j / q.flight_time_s
        assert pack_j == pytest.approx(5.2 * 3600 * 15.4)
        assert q.takeoff.time_s == q.takeoff.energy_j == 0.0
        assert 0.9 < (episode.battery_remaining or 0.0) < 1.0


def test_same_seeds_same_results_however_many_fly_at_a_time(
    greedy: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    reference, _ = greedy
    for slots in (1, 7):
        evaluate("greedy", slots=slots, out=tmp_path / f"{slots}", **DENSE)
        assert same_runs(load(tmp_path / f"{slots}"), reference)


def test_an_episode_does_not_depend_on_the_others(
    greedy: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    reference, _ = greedy
    evaluate("greedy", out=tmp_path / "one", **(DENSE | {"episodes": 1, "seed": 27}))
    (episode,) = load(tmp_path / "one").episodes
    assert replace(episode, index=7) == reference.episodes[7]


def by_hand(without: str | None = None) -> Callable[[Encoded], np.ndarray]:
    """Return the linear policy in numpy."""
    matrix, bias = weights()

    def decide(encoded: Encoded) -> np.ndarray:
        parts = {key: array.astype(np.float64) for key, array in encoded.items()}
        if without is not None:
            parts[without] *= 0.0
        flat = parts["depth"].reshape(len(parts["depth"]), -1) / 255.0
        features = np.concatenate([flat, parts["velocity"], parts["goal"]], axis=1)
        chosen: np.ndarray = np.argmax(features @ matrix.T + bias, axis=1)
        return chosen

    return decide


@pytest.mark.parametrize("ablate", [None, "depth", "velocity", "goal"])
def test_a_learned_policy_flies_in_the_environment_of_its_card(
    linear: Path, tmp_path: Path, ablate: Any
) -> None:
    """The same network by hand, in an environment written down here."""
    options: dict[str, Any] = {"arena": ("static-obstacles",), "time_limit_s": 25.0}
    evaluate(linear, episodes=12, seed=3, ablate=ablate, out=tmp_path / "run", **options)
    spec = EnvironmentSpec(
        arena="static-obstacles",
        layout="body",
        image_width_px=SPEC.width_px,
        image_height_px=SPEC.height_px,
        actions=ACTIONS.set,
        max_speed_m_s=ACTIONS.max_speed_m_s,
        episode=EpisodeRules(goal_radius_m=2.5, time_limit_s=25.0, hold_s=0.4, altitude_m=2.0),
    )
    wanted = {f.seed: f for f in fly_episodes(spec, by_hand(ablate), range(3, 15), slots=5)}
    run_ = load(tmp_path / "run")
    assert len(run_.episodes) == len(wanted) == 12
    for episode in run_.episodes:
        flown = wanted[episode.seed]
        assert episode.outcome.name == flown.verdict.name
        assert episode.ended_us == round(flown.flight_time_s * 1e6)
        assert episode.quality is not None
        assert episode.quality.energy_j == pytest.approx(flown.energy_j)
        assert len(run_.latency[episode.index]["sent_us"]) == flown.decisions


@pytest.mark.nightly
def test_ablation_costs_what_the_input_is_worth(linear: Path, tmp_path: Path) -> None:
    rates = {}
    for ablate in (None, "depth", "goal"):
        out = tmp_path / f"{ablate}"
        evaluate(linear, episodes=20, ablate=ablate, time_limit_s=25.0, out=out)
        run_ = load(out)
        assert run_.info.config["ablate"] == ablate
        reached = [e for e in run_.episodes if e.outcome is Outcome.SUCCESS and e.quality]
        times = [e.quality.flight_time_s for e in reached if e.quality]
        assert reached, ablate
        rates[ablate] = len(reached) / 20, np.mean(times)
    assert rates[None][0] > 0.9
    # Without the goal it flies on; without depth nothing ahead looks free: it creeps.
    assert rates["goal"][0] < 0.4
    assert rates["depth"][1] > 1.5 * rates[None][1]


def test_random_actions_do_not_depend_on_the_neighbours(tmp_path: Path) -> None:
    folder = write_linear(tmp_path / "dithering", epsilon=0.3)
    for slots in (1, 4):
        evaluate(folder, episodes=6, slots=slots, out=tmp_path / f"{slots}")
    assert same_runs(load(tmp_path / "1"), load(tmp_path / "4"))
    evaluate(write_linear(tmp_path / "sure"), episodes=6, out=tmp_path / "sure-run")
    assert not same_runs(load(tmp_path / "1"), load(tmp_path / "sure-run"))


def test_the_latency_of_a_workload_is_flown_and_told(linear: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "computer": "ras-pi-4",
        "workload": "template-5x32",
        "out": tmp_path / "run",
    }
    evaluate(linear, episodes=4, **options)
    run_ = load(tmp_path / "run")
    t2 = np.concatenate(
        [
            (s["action_ready_us"] - s["infer_start_us"])[s["action_ready_us"] >= 0]
            for s in run_.latency.values()
        ]
    )
    assert t2.mean() / 1e3 == pytest.approx(396.0, rel=0.02)
    assert 0.03 < t2.std() / t2.mean() < 0.07
    assert run_.info.setup.injection.origin == "injected"
    assert "template-5x32" in run_.info.setup.injection.label
    # As airl-companion draws it: from the episode's seed.
    rng = np.random.default_rng(1)
    variance = math.log1p(0.05**2)
    mean = math.log(396_000.0) - 0.5 * variance
    first = [round(rng.lognormal(mean, math.sqrt(variance))) for _ in range(3)]
    stamps = run_.latency[0]
    assert (stamps["action_ready_us"] - stamps["infer_start_us"])[:3].tolist() == first


def test_rules_that_are_asked_for_beat_those_of_the_card(linear: Path, tmp_path: Path) -> None:
    rules: dict[str, Any] = {
        "goal_radius_m": 5.0,
        "hold_s": 0.7,
        "altitude_m": 1.5,
        "hover_after_s": 0.1,
    }
    evaluate(linear, episodes=2, **rules, out=tmp_path / "run")
    run_ = load(tmp_path / "run")
    assert all(e.goal_radius_m == 5.0 for e in run_.episodes)
    assert run_.info.setup.between_commands == "hover-after 100 ms"
    assert run_.trajectories[0].position[0].tolist() == [0.0, 0.0, -1.5]
    sent = run_.latency[0]["sent_us"]
    assert set(np.diff(sent[sent >= 0]).tolist()) == {700_000}


# --- what is shown


def wilson(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % score interval, in closed form."""
    z, p = 1.959963984540054, k / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return centre - half, centre + half


def test_the_table_has_rates_with_wilsons_interval(greedy: tuple[LoadedRun, str]) -> None:
    run_, text = greedy
    reached = sum(e.outcome is Outcome.SUCCESS for e in run_.episodes)
    low, high = wilson(reached, EPISODES)
    (line,) = [line for line in text.splitlines() if line.startswith(" success rate")]
    assert f"{100 * reached / EPISODES:.0f} %" in line
    assert f"{100 * low:.0f} … {100 * high:.0f}" in line
    assert line.split()[-1] == str(EPISODES)
    assert f"{reached} goal reached" in text
    for measure in ("flight time", "distance", "energy, vehicle"):
        (line,) = [line for line in text.splitlines() if line.strip().startswith(measure)]
        assert "…" in line


class Page(HTMLParser):
    """The words and pictures of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words, self.images = "", 0
        self.feed(text)

    def handle_data(self, data: str) -> None:
        self.words += " " + " ".join(data.split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += tag == "img"


def test_the_page_says_what_is_modelled_and_shows_no_real_time(
    greedy: tuple[LoadedRun, str],
) -> None:
    run_, text = greedy
    page = Page((run_.path / "report.html").read_text(encoding="utf-8"))
    assert "Level gym measures no time" in page.words
    assert "Evaluation report" in page.words
    assert "modelled, n =" in page.words
    for absent in ("Real time", "tick lateness", "setpoints never accepted", "MAVSDK"):
        assert absent not in page.words
        assert absent not in text
    # The four stages that vary from decision to decision and their timeline, energy, all flights;
    # a map for each flight that is pictured.
    assert run_report.MAX_PICTURED < EPISODES
    assert page.images == 3 + 3 + run_report.MAX_PICTURED
    assert f"Pictures of {run_report.MAX_PICTURED} of {EPISODES} flights" in page.words
    pictured = {int(p.name[7:10]) for p in run_.path.glob("flight-*-map.png")}
    assert pictured <= {e.index for e in run_.episodes if e.outcome is not Outcome.SUCCESS}


@pytest.mark.nightly
def test_a_page_alone_loads_what_draws(tmp_path: Path) -> None:
    program = """
import sys
from airl_mav.cli.options import carry_out
words = ["--arena", "no-obstacles", "--episodes", "4", "--require", "success >= 50 %"]
command = "airl_mav.cli.evaluate_command"
assert carry_out("airl evaluate", command, ["greedy", *words, "--out", "run"]) == 0
known = {"matplotlib", "plotly", "jinja2", "scipy.stats", "scipy.optimize", "pybullet", "mavsdk"}
known |= {"torch", "gymnasium"}
print("loaded:", *sorted(known & set(sys.modules)))
assert carry_out("airl report", "airl_mav.cli.report_command", ["run"]) == 0
print("loaded:", *sorted({"matplotlib", "jinja2"} & set(sys.modules)))
"""
    done = run_alone(program, tmp_path)
    assert done.returncode == 0, done.stderr
    loaded = re.findall("^loaded:(.*)$", done.stdout, re.MULTILINE)
    assert loaded == ["", " jinja2 matplotlib"]


@pytest.mark.nightly
def test_a_long_table_is_cut_short_and_says_so(
    greedy: tuple[LoadedRun, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_, text = greedy
    assert f"25 of {EPISODES} flights, those that failed first; all: episodes.jsonl." in text
    monkeypatch.setattr(run_tables, "MAX_FLIGHTS", 5)
    monkeypatch.setattr(run_report, "MAX_PICTURED", 1)
    shutil.copytree(run_.path, tmp_path / "copy")
    path = write_report(tmp_path / "copy")
    page = Page(path.read_text(encoding="utf-8"))
    assert f"5 of {EPISODES} flights, those that failed first; all: episodes.jsonl." in page.words
    failed = sum(e.outcome is not Outcome.SUCCESS for e in run_.episodes)
    assert page.words.count("m from the goal") <= 5
    assert page.words.count("hit static") >= min(failed, 5)


def test_the_picture_of_all_flights(greedy: tuple[LoadedRun, str]) -> None:
    """The picture is red at failed flights and green along most paths."""
    run_, _ = greedy
    with Image.open(run_.path / "trajectories.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    floor = np.abs(pixels - (248, 247, 244)).sum(axis=2) < 12
    rows, columns = np.flatnonzero(floor.mean(axis=1) > 0.3), np.flatnonzero(floor.mean(0) > 0.3)
    # 50 m by 50 m, the start 3 m from the southern wall.
    scale = (columns[-1] - columns[0] + 1) / 50.0
    red = np.abs(pixels - (192, 38, 28)).sum(axis=2) < 40
    crashed = [e for e in run_.episodes if e.outcome is Outcome.COLLISION]
    assert crashed
    for episode in crashed:
        north, east = run_.trajectories[episode.index].position[-1, :2]
        x = columns[0] + (east + 25.0) * scale
        y = rows[-1] - (north + 3.0) * scale
        near = red[round(y) - 5 : round(y) + 6, round(x) - 5 : round(x) + 6]
        assert near.mean() > 0.2
    green = (pixels[..., 1] > pixels[..., 0] + 20) & (pixels[..., 1] > pixels[..., 2] + 20)
    assert green.sum() > 5 * red.sum()


@pytest.mark.nightly
def test_obstacles_are_drawn_where_all_flights_share_them(
    greedy: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    run_, _ = greedy
    evaluate("greedy", episodes=1, seed=4, out=tmp_path / "one")
    write_report(tmp_path / "one")

    def share(folder: Path) -> float:
        with Image.open(folder / "trajectories.png") as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        return float((np.abs(pixels - (0x5B, 0x66, 0x70)).sum(axis=2) < 12).mean())

    assert share(tmp_path / "one") > 0.0015 > 4.0 * share(run_.path)


# --- what it survives


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> LoadedRun:
    """40 flights without any trouble."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert evaluate("greedy", arena=("no-obstacles",), episodes=40, out=out)[0] == 0
    return load(out)


SCRIPT = """
import sys
from airl_mav.experiments import campaign
campaign.INTERVAL_S, campaign.MAX_WAITING = 60.0, 5
from airl_mav.cli.main import main
main()
"""


def start(out: Path) -> subprocess.Popen[str]:
    words = ["evaluate", "greedy", "--arena", "no-obstacles", "--episodes", "40", "--slots", "4"]
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *words, "--out", str(out)],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGKILL,
        pytest.param(signal.SIGINT, marks=pytest.mark.nightly),
        pytest.param(signal.SIGTERM, marks=pytest.mark.nightly),
    ],
)
def test_an_interrupted_run_goes_on_and_ends_as_if_nothing_had_been(
    number: signal.Signals, reference: LoadedRun, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    process = start(out)
    lines = out / "episodes.jsonl"

    def some() -> bool:
        assert process.poll() is None, process.communicate()
        return lines.exists() and lines.read_bytes().count(b"\n") >= 10

    wait_until(some, "the first episodes")
    process.send_signal(number)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == (-9 if number is signal.SIGKILL else 130), text
    if number is not signal.SIGKILL:
        assert "interrupted: finished flights are kept" in text
        assert "success rate" in text
    flown = load(out).episodes
    assert 10 <= len(flown) < 40
    code, text = evaluate("greedy", arena=("no-obstacles",), episodes=40, out=out)
    assert code == 0
    assert f"{len(flown)} of 40 episodes are there" in text
    assert same_runs(load(out), reference)
    assert lines.read_bytes().count(b"\n") == 40
    assert not list(out.glob("*.partial"))


def test_a_crash_between_arrays_and_lines_doubles_nothing(
    reference: LoadedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    options: dict[str, Any] = {"arena": ("no-obstacles",), "episodes": 40, "out": out}
    monkeypatch.setattr(campaign, "INTERVAL_S", 60.0)
    monkeypatch.setattr(campaign, "MAX_WAITING", 10)
    real, calls = RunFolder.save_episodes, []

    def save(folder: RunFolder, episodes: Sequence[FlownEpisode]) -> None:
        calls.append(len(episodes))
        if len(calls) > 1:
            # The arrays get onto the disk, the lines do not.
            monkeypatch.setattr(run_folder, "EPISODES_FILE", "lost")
        real(folder, episodes)
        if len(calls) > 1:
            raise OSError("the machine is gone")

    with monkeypatch.context() as patched:
        patched.setattr(RunFolder, "save_episodes", save)
        patched.setattr(RunFolder, "close", lambda folder: None)
        with pytest.raises(OSError, match="the machine is gone"):
            evaluate("greedy", **options)
    monkeypatch.setattr(run_folder, "EPISODES_FILE", "episodes.jsonl")
    assert len(read_groups(out / "trajectories.npz", {f"{i:03d}" for i in range(40)})) == 20
    lines = (out / "episodes.jsonl").read_bytes()
    # Nor does half a line matter.
    (out / "episodes.jsonl").write_bytes(lines[: lines.rfind(b"\n", 0, -1) + 30])
    held = load(out)
    assert len(held.episodes) == 9
    assert evaluate("greedy", **options)[0] == 0
    assert same_runs(load(out), reference)


@pytest.mark.nightly
def test_what_is_finished_is_shown_again_and_not_flown(
    greedy: tuple[LoadedRun, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_, text = greedy
    monkeypatch.setattr(gym_flier, "fly_seeds", None)
    before = {p.name: p.read_bytes() for p in run_.path.iterdir()}
    code, again = evaluate("greedy", slots=3, out=run_.path, **DENSE)
    assert code == 0
    tables, end = again.replace("drawing the report\n", "").rsplit("report  ", 1)
    assert tables.endswith(text.replace("drawing the report\n", "").rsplit("report  ", 1)[0])
    # There is a page: it is drawn again.
    assert end.startswith(f"{run_.path / 'report.html'}\n\ngreedy on workstation")
    after = {p.name: p.read_bytes() for p in run_.path.iterdir()}
    assert before == after


@pytest.mark.nightly
def test_a_page_says_what_was_required_last(
    greedy: tuple[LoadedRun, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_report, "MAX_PICTURED", 0)
    shutil.copytree(greedy[0].path, tmp_path / "run")
    code, _ = evaluate("greedy", require="success >= 99 %", out=tmp_path / "run", **DENSE)
    assert code == 3
    page = Page((tmp_path / "run" / "report.html").read_text(encoding="utf-8"))
    assert "does not meet: success >= 99 %" in page.words


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 21}, "seed = 20, not 21"),
        ({"episodes": 29}, "episodes = 30, not 29"),
        ({"goal_radius_m": 2.0}, "goal_radius_m = 3.0, not 2.0"),
        ({"arena": ("no-obstacles",)}, "arena = 'dense-obstacles', not 'no-obstacles'"),
        ({"computer": "ras-pi-4"}, "computer = 'workstation', not 'ras-pi-4'"),
    ],
)
def test_another_run_is_not_mixed_in(
    greedy: tuple[LoadedRun, str], change: dict[str, Any], named: str
) -> None:
    run_, _ = greedy
    with pytest.raises(UsageError, match=re.escape(named)):
        evaluate("greedy", out=run_.path, **(DENSE | change))
    assert same_runs(load(run_.path), run_)


def test_a_run_grows_by_more_episodes(greedy: tuple[LoadedRun, str], tmp_path: Path) -> None:
    whole, _ = greedy
    for episodes in (4, 9):
        evaluate("greedy", out=tmp_path, **(DENSE | {"episodes": episodes}))
        held = load(tmp_path)
        assert held.info.seeds == whole.info.seeds[:episodes]
        assert held.episodes == whole.episodes[:episodes]


def test_results_go_onto_the_card_when_all_has_been_flown(tmp_path: Path) -> None:
    folder = write_linear(tmp_path / "policy")
    for episodes, latency in ((3, None), (5, None), (3, "150ms")):
        out = tmp_path / f"{episodes}-{latency}"
        evaluate(folder, episodes=episodes, latency=latency, on_card=True, out=out)
    found = [(r.arena, r.level, r.latency, r.episodes) for r in load_card(folder).results]
    # In place of an earlier one of the same arena, level and latency.
    assert sorted(found, key=str) == [
        ("no-obstacles", "gym", "150ms", 3),
        ("no-obstacles", "gym", None, 5),
    ]


def test_a_retrained_policy_is_another_run(tmp_path: Path) -> None:
    folder = write_linear(tmp_path / "policy")
    evaluate(folder, episodes=1, out=tmp_path / "run")
    write_linear(folder, offset=1.0)
    with pytest.raises(UsageError, match="policy_sha256"):
        evaluate(folder, episodes=1, out=tmp_path / "run")


def test_a_changed_arena_file_is_another_run(tmp_path: Path) -> None:
    arena = tmp_path / "mine.toml"
    text = (profiles_dir() / "arenas" / "no-obstacles.toml").read_text(encoding="utf-8")
    arena.write_text(text, encoding="utf-8")
    evaluate("greedy", arena=(str(arena),), episodes=1, out=tmp_path / "run")
    arena.write_text(text.replace("min_distance_m = 7.0", "min_distance_m = 9.0"))
    with pytest.raises(UsageError, match=re.escape("profiles_sha256.arena")):
        evaluate("greedy", arena=(str(arena),), episodes=1, out=tmp_path / "run")


# --- what it refuses


@pytest.mark.parametrize(
    ("policies", "options", "named"),
    [
        ((), {}, "POLICIES: accepted: one or more"),
        (("telepathy",), {}, "telepathy"),
        (("greedy", "telepathy"), {}, "telepathy"),
        (("greedy",), {"arena": "moon"}, "moon"),
        (("greedy",), {"arena": ("no-obstacles", "moon")}, "moon"),
        (("greedy",), {"vehicle": "zeppelin"}, "zeppelin"),
        (("greedy",), {"computer": "abacus"}, "abacus"),
        (("greedy",), {"workload": "chess"}, "chess"),
        (("greedy",), {"workload": "estimate", "computer": "ras-pi-4"}, "estimate"),
        (("greedy",), {"ablate": "depth"}, "--ablate depth"),
        (("greedy",), {"ablate": "depth", "level": "sitl"}, "--ablate depth"),
        (("greedy",), {"episodes": 0}, "--episodes 0"),
        (("greedy",), {"seed": -1}, "--seed -1"),
        (("greedy",), {"slots": 0}, "--slots 0"),
        (("greedy",), {"hold_s": 0.01}, "--hold-s 0.01"),
        (("greedy",), {"time_limit_s": math.nan}, "--time-limit-s nan"),
        (("greedy", "greedy"), {}, "greedy: accepted: each name once"),
        (("greedy",), {"arena": ("no-obstacles",) * 2}, "no-obstacles: accepted: each name once"),
        (("greedy",), {"level": "sitl", "speed": 100.0}, "--speed 100"),
        (("greedy",), {"level": "sitl", "workers": 2}, "--workers 2"),
        (("greedy",), {"tlogs": True}, "--tlogs"),
        (("greedy",), {"workers": 0} | LOCKSTEP, "--workers 0: accepted: 1 <= value <= 256"),
        (("greedy",), {"workers": 257} | LOCKSTEP, "--workers 257"),
        (("greedy",), {"speed": 0.001} | LOCKSTEP, "--speed 0.001: accepted: 0.01"),
        (("greedy",), {"speed": 2000.0} | LOCKSTEP, "--speed 2000"),
        (("greedy",), {"ablate": "depth"} | LOCKSTEP, "--ablate depth"),
        (("greedy",), {"arena": "moon"} | LOCKSTEP, "moon"),
        (("greedy",), {"hold_s": 11.0} | LOCKSTEP, "--hold-s 11"),
        (("greedy",), {"time_limit_s": 0.5} | LOCKSTEP, "--time-limit-s 0.5"),
        (("greedy",), {"zone": 3}, "--zone 3: accepted: 0 <= value <= 2 (zones_m [16, 32, 48] m)"),
        (("greedy",), {"zone": -1}, "--zone -1: accepted: 0 <= value"),
        (("static-obstacles",), {"on_card": True, "zone": 0}, "--zone 0: accepted: without on-c"),
        (("greedy",), {"on_card": True}, "greedy has no card"),
        (("static-obstacles",), {"on_card": True, "hold_s": 0.7}, "--hold-s 0.7"),
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_flies(
    policies: tuple[str, ...], options: dict[str, Any], named: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=re.escape(named)) as error:
        evaluate(*policies, out=tmp_path / "run", **options)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_a_camera_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    narrow = SPEC.model_copy(update={"horizontal_fov_deg": 60.0})
    folder = write_linear(tmp_path / "narrow", observation=narrow)
    with pytest.raises(UsageError, match="does not fit vehicle quad: camera with a horiz"):
        evaluate(folder, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_network_that_gives_no_numbers_ends_in_one_line(tmp_path: Path) -> None:
    folder = write_linear(tmp_path / "broken", offset=math.nan)
    with pytest.raises(UsageError, match=r"policy.onnx: its output is not a number"):
        evaluate(folder, episodes=2, out=tmp_path / "run")


def test_seeds_of_the_training_are_pointed_out(tmp_path: Path) -> None:
    training = {"arena": "no-obstacles", "first_arena_seed": 5, "last_arena_seed": 9}
    folder = write_linear(tmp_path / "policy", training=training)
    for seed, known in ((1, False), (4, True), (9, True), (10, False)):
        _, text = evaluate(folder, episodes=2, seed=seed, out=tmp_path / f"{seed}")
        assert ("was trained on seeds from 5 on" in text) == known


# --- policies x arenas


def test_a_table_of_policies_and_arenas(
    linear: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_report, "MAX_PICTURED", 0)
    out, arenas = tmp_path / "matrix", ("no-obstacles", "static-obstacles")
    code, text = evaluate("greedy", linear, arena=arenas, episodes=8, seed=3, page=True, out=out)
    assert code == 0
    told = json.loads((out / "matrix.json").read_text(encoding="utf-8"))
    facts = told["facts"]
    assert (told["schema"], facts["level"], facts["episodes"], facts["seed"]) == (3, "gym", 8, 3)
    cells = [{**run["entry"], **run["quality"]} for run in told["runs"]]
    assert [(c["label"], c["group"]) for c in cells] == [
        ("greedy", "no-obstacles"),
        ("greedy", "static-obstacles"),
        ("linear", "no-obstacles"),
        ("linear", "static-obstacles"),
    ]
    markdown = (out / "matrix.md").read_text(encoding="utf-8")
    for cell in cells:
        run_ = load(out / cell["folder"])
        assert [e.seed for e in run_.episodes] == list(range(3, 11))
        reached = sum(e.outcome is Outcome.SUCCESS for e in run_.episodes)
        low, high = wilson(reached, 8)
        assert cell["success_rate"]["value"] == reached / 8
        assert cell["success_rate"]["low"] == pytest.approx(low)
        shown = f"{100 * reached / 8:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
        star = " *" if (cell["label"], cell["group"]) == ("linear", "no-obstacles") else ""
        assert shown in text
        assert shown.replace("[", "\\[").replace("]", "\\]") + star.replace("*", "\\*") in markdown
    # A cell equals the same evaluation run alone.
    evaluate("greedy", arena=("static-obstacles",), episodes=8, seed=3, out=tmp_path / "one")
    assert same_runs(load(out / "greedy-static-obstacles"), load(tmp_path / "one"))
    assert "goal radius 2.5 m, hold 0.4 s" in markdown


def test_a_table_goes_on_where_it_was_left(
    linear: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "matrix"
    options: dict[str, Any] = {
        "arena": ("no-obstacles", "static-obstacles"),
        "episodes": 5,
        "out": out,
    }
    flights = []
    real = EpisodeSaver.add

    def interrupted(saver: EpisodeSaver, episode: FlownEpisode) -> None:
        real(saver, episode)
        flights.append(episode)
        if len(flights) == 8:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(EpisodeSaver, "add", interrupted)
        code, text = evaluate("greedy", linear, slots=2, **options)
    assert code == 130
    assert "interrupted" in text
    told = json.loads((out / "matrix.json").read_text(encoding="utf-8"))
    assert len(told["runs"]) == 2
    assert evaluate("greedy", linear, **options)[0] == 0
    told = json.loads((out / "matrix.json").read_text(encoding="utf-8"))
    assert [r["quality"]["success_rate"]["n"] for r in told["runs"]] == [5, 5, 5, 5]


def test_arenas_are_those_of_the_trainings(linear: Path, tmp_path: Path) -> None:
    evaluate(linear, "greedy", episodes=1, out=tmp_path / "matrix")
    names = {p.name for p in (tmp_path / "matrix").iterdir() if p.is_dir()}
    arenas = ("no-obstacles", "static-obstacles")
    assert names == {f"{p}-{a}" for p in ("linear", "greedy") for a in arenas}
    evaluate(linear, episodes=1, out=tmp_path / "one")
    assert load(tmp_path / "one").info.setup.arena.name == "no-obstacles"


def test_a_table_and_a_run_do_not_share_a_folder(
    greedy: tuple[LoadedRun, str], tmp_path: Path
) -> None:
    run_, _ = greedy
    with pytest.raises(UsageError, match="holds a single run"):
        evaluate("greedy", arena=("no-obstacles", "crowded"), out=run_.path)
    assert not (run_.path / "campaign.json").exists()
    folder = tmp_path / "campaign"
    folder.mkdir()
    (folder / "campaign.json").write_text("{}")
    with pytest.raises(UsageError, match="holds a campaign; accepted: another folder"):
        evaluate("greedy", out=folder)
    assert [path.name for path in folder.iterdir()] == ["campaign.json"]


# --- level sitl


def test_every_level_flies_by_the_rules_of_the_card(tmp_path: Path) -> None:
    folder = write_linear(tmp_path / "policy", hover_after_s=0.06)
    for level in ("gym", "lockstep", "sitl"):
        asked = resolve(Scenario(policy=str(folder), arena="no-obstacles", level=level))
        assert asked.watchdog.hover_after_s == 0.06
        assert asked.rules.startswith("goal radius 2.5 m, hold 0.4 s, height 2 m")
        own = asked.scenario.model_copy(update={"goal_radius_m": 4.0, "hold_s": 0.7})
        assert resolve(own).rules.startswith("goal radius 4 m, hold 0.7 s, height 2 m")


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
@pytest.mark.timeout(300)
def test_level_sitl_flies(linear: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_pace, "host_problem", lambda speed: f"busy at speed {speed:g}")
    ports = vars(choose_ports())
    options: dict[str, Any] = {f"{name}_port": port for name, port in ports.items()}
    options |= {"arena": "no-obstacles", "level": "sitl", "speed": 4.0}
    out = tmp_path / "run"
    code, text = evaluate(linear, episodes=1, seed=10, out=out, **options)
    assert "warning: flights may be invalid, as this host does not keep real time: busy" in text
    assert code in {0, EXIT_INVALID}
    assert "success rate" in text
    (episode,) = load(out).episodes
    assert (episode.seed, episode.outcome) == (10, Outcome.SUCCESS)
    # The same seed at level gym has the same arena, and nearly the same flight.
    evaluate(linear, arena=("no-obstacles",), episodes=1, seed=10, out=tmp_path / "gym")
    (twin,) = load(tmp_path / "gym").episodes
    assert twin.goal == episode.goal
    assert twin.quality is not None
    assert episode.quality is not None
    assert twin.quality.distance_m == pytest.approx(episode.quality.distance_m, rel=0.15)
    with pytest.raises(UsageError, match="seed = 10, not 12"):
        evaluate(linear, episodes=1, seed=12, out=out, **options)
