"""Studies: tables equal the data in the run folders, and a kill loses nothing."""

from __future__ import annotations

import importlib
import io
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from rich.console import Console

from airl_mav.cli.options import carry_out
from airl_mav.core.errors import UsageError
from airl_mav.experiments.evaluate import evaluate
from airl_mav.experiments.experiment import load_run
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.report.comparison import show
from airl_mav.scenario.model import Scenario
from tests.support.processes import ROOT

SCRIPTS = ROOT / "scripts" / "studies"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
CONFIGS = {
    "ablation": "AblationConfig",
    "degradation": "DegradationConfig",
    "generalisation": "GeneralisationConfig",
    "held_out_zone": "HeldOutConfig",
    "mitigation": "MitigationConfig",
    "system": "SystemConfig",
}

DEGRADATION = """
episodes = 12
policies = ["greedy"]
arena = "dense-obstacles"
latencies = ["native", "300ms", "lognormal:600ms,30ms"]
one_goal = { arena_seed = 4, episodes = 3 }
"""
LATENCIES = ("native", "300ms", "lognormal-600ms-30ms")


@pytest.fixture(autouse=True, scope="module")
def _scripts_can_be_imported() -> Iterator[None]:
    with patch.object(sys, "path", [str(SCRIPTS), *sys.path]):
        yield


def study(name: str, config: str, out: Path, *words: str) -> tuple[int, str]:
    """Run a study in this process, without drawing its pages; return exit status and output."""
    file = out.parent / f"{name}.toml"
    file.write_text(config)
    console = Console(record=True, width=200, file=io.StringIO())
    words = ("--config", f"{file}", "--out", f"{out}", *words)
    with patch.object(show, "write_document", lambda made, folder: folder / f"{made.name}.html"):
        code = carry_out(f"{name}.py", name, words, console=console)
    return code, console.export_text()


def flights(path: Path) -> dict[int, dict[str, Any]]:
    """Return the episodes of a run by seed, as a reader without this package sees them."""
    episodes = map(json.loads, (path / "episodes.jsonl").read_text().splitlines())
    return {episode["seed"]: episode for episode in episodes}


def reached(episodes: dict[int, dict[str, Any]]) -> float:
    """Return the success rate [%]."""
    return 100.0 * float(np.mean([e["outcome"] == "success" for e in episodes.values()]))


def percent(first: dict[int, Any], second: dict[int, Any], key: str) -> tuple[float, int]:
    """Return the median difference over the common successes [%], and their number."""
    both = [s for s in first if first[s]["outcome"] == second[s]["outcome"] == "success"]
    a, b = (np.array([e[s]["quality"][key] for s in both]) for e in (first, second))
    return float(100.0 * np.median(b / a - 1.0)), len(both)


def comparison(folder: Path, kind: str) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / f"{kind}.json").read_text())
    return data


def check_contrasts(folder: Path, kind: str, pairs: set[tuple[str, str]]) -> None:
    """Check every contrast of a comparison with the flights of its two runs."""
    contrasts = comparison(folder, kind)["contrasts"]
    assert {(c["entry"]["reference"], c["entry"]["target"]) for c in contrasts} == pairs
    for contrast in contrasts:
        names = contrast["entry"]["reference"], contrast["entry"]["target"]
        first, second = (flights(folder / name) for name in names)
        paired = contrast["paired"]
        change = reached(second) - reached(first)
        assert paired["success_rate"]["difference"]["value"] == pytest.approx(change)
        for key in ("flight_time_s", "distance_m", "energy_j"):
            difference = paired[key]["difference"]
            if difference["n"]:
                told = (difference["value"], difference["n"])
                assert told == pytest.approx(percent(first, second, key)), (names, key)


@pytest.fixture(scope="module")
def degraded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the folder and output of a small degradation study."""
    root = tmp_path_factory.mktemp("degradation")
    code, text = study("degradation", DEGRADATION, root / "out")
    assert code == 0
    return root / "out", text


# --- configuration


@pytest.mark.parametrize("name", CONFIGS)
def test_every_study_has_a_configuration_and_a_quick_one(name: str) -> None:
    common, module = (__import__(each) for each in ("common", name))
    model, script = getattr(module, CONFIGS[name]), str(SCRIPTS / f"{name}.py")
    with common.study(common.StudyOptions(), model, script) as (full, root):
        assert full.episodes == 1000
        assert full.level == "gym"
        assert root == Path("runs/studies") / name
    with common.study(common.StudyOptions(quick=True), model, script) as (quick, root):
        assert quick.episodes <= 40
        assert root == Path("runs/studies") / f"{name}-quick"
    with common.study(common.StudyOptions(quick=True, episodes=7), model, script) as (few, _):
        assert few.episodes == 7


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("episodes = 12", "episode = 12", "episode: unknown field; did you mean 'episodes'"),
        ("episodes = 12", "episodes = 0", "episodes = 0"),
        ("300ms", "native", "degradation.toml: latencies = "),
        ("300ms", "soon", "--latency soon: accepted: 150ms"),
        ("arena_seed = 4", "arena_seed = -1", "one_goal.arena_seed = -1"),
    ],
)
def test_a_wrong_field_gets_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=message) as raised:
        study("degradation", DEGRADATION.replace(old, new), tmp_path / "out")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out" / "campaign.json").exists()


# --- what is shown


def test_degradation_is_that_of_the_flights(degraded: tuple[Path, str]) -> None:
    out, text = degraded
    runs = [f"greedy-{latency}" for latency in LATENCIES]
    check_contrasts(out, "latency-sweep", {(runs[0], runs[2]), *pairwise(runs)})
    told = {run["entry"]["name"]: run for run in comparison(out, "latency-sweep")["runs"]}
    assert list(told) == runs
    for name, run in told.items():
        value = run["quality"]["success_rate"]["value"]
        assert 100.0 * value == pytest.approx(reached(flights(out / name)))
    t2 = [run["stages"]["t2"]["mean"] for run in told.values()]
    assert t2[:2] == [1000.0, 300_000.0]
    assert t2[2] == pytest.approx(600_000.0, rel=0.02)
    # The paper's flight time at 300 ms.
    assert "47.59" in text


def test_flights_to_one_goal_share_their_arena(degraded: tuple[Path, str]) -> None:
    out, text = degraded
    for latency in LATENCIES:
        one = flights(out / "one-goal" / f"greedy-{latency}")
        assert sorted(one) == [1, 2, 3]
        assert {e["arena_seed"] for e in one.values()} == {4}
        assert len({tuple(e["goal"]) for e in one.values()}) == 1
    many = flights(out / "greedy-300ms")
    assert {seed: e["arena_seed"] for seed, e in many.items()} == {s: s for s in range(1, 13)}
    # How far the flights stray, from the points of their paths: the height of a triangle.
    widest = []
    run = load_run(out / "one-goal" / "greedy-300ms")
    for episode in run.episodes:
        path, goal = run.trajectories[episode.index], np.array([*episode.goal, 0.0])
        assert episode.navigation_us is not None
        flown = (path.time_us >= episode.navigation_us) & (path.time_us <= episode.ended_us)
        points = path.position[flown] * [1.0, 1.0, 0.0]
        areas = np.linalg.norm(np.cross(points, goal), axis=1)
        widest.append(float((areas / np.linalg.norm(goal)).max()))
    (line,) = [x for x in text.splitlines() if "widest aside" in x and "at 300ms" in x]
    assert f"widest aside {np.median(widest):.2f} " in line


@pytest.mark.nightly
def test_generalisation_is_told_from_home(tmp_path: Path) -> None:
    code, text = study(
        "generalisation",
        'episodes = 20\npolicies = ["greedy", "no-obstacles"]\n'
        'arenas = ["no-obstacles", "static-obstacles", "dense-obstacles"]\n',
        tmp_path / "out",
    )
    assert code == 0
    table = text[text.index("Success against the own arena") :].splitlines()
    (row,) = [line.split() for line in table if line.startswith(" no-obstacles")]
    rates = [
        reached(flights(tmp_path / "out" / f"no-obstacles-{arena}"))
        for arena in ("no-obstacles", "static-obstacles", "dense-obstacles")
    ]
    assert min(rates) < rates[0]
    assert row == ["no-obstacles", "no-obstacles", *(f"{r - rates[0]:+.1f}" for r in rates)]
    # It was trained nowhere, so it has no home.
    assert not [line for line in table if "greedy" in line]
    # 91 % at home and 53 % among static obstacles in the paper.
    (paper,) = [line.split() for line in table if "the paper" in line]
    assert paper == ["the", "paper", "+0", "-38", "–"]


def test_system_evaluation_is_the_gap_of_every_arena(tmp_path: Path) -> None:
    code, text = study(
        "system",
        'episodes = 8\ncomputer = "ras-pi-4"\n'
        '[[arenas]]\narena = "no-obstacles"\npolicy = "no-obstacles"\nworkload = "template-5x32"\n'
        '[[arenas]]\narena = "static-obstacles"\npolicy = "greedy"\nworkload = "template-4x48"\n',
        tmp_path / "out",
    )
    assert code == 0
    names = [
        (f"{arena}-reference", f"{arena}-{role}")
        for arena in ("no-obstacles", "static-obstacles")
        for role in ("target", "latency-alone")
    ]
    check_contrasts(tmp_path / "out", "hardware-gap", set(names))
    gap = comparison(tmp_path / "out", "hardware-gap")
    t2_ms = [run["stages"]["t2"]["mean"] / 1e3 for run in gap["runs"]]
    assert t2_ms == pytest.approx([11.0, 396.0, 396.0, 10.0, 542.0, 542.0], rel=0.05)
    policies = [run["setup"]["policy"]["name"] for run in gap["runs"]]
    assert policies == ["no-obstacles"] * 3 + ["greedy"] * 3
    # 37.37 s against 25.29 s, and 34.44 s against 30.258 s in the paper.
    assert "+47.8" in text
    assert "+13.8" in text


def test_compensation_says_what_flies_how(tmp_path: Path) -> None:
    """Compare the right model's rows with `airl evaluate`; rows of wrong models differ."""
    few: dict[str, Any] = {"FACTORS": (0.5,), "LATENCIES": (0.5,), "IMAGES": (1,)}
    with patch.multiple(importlib.import_module("compensation"), **few):
        config = (SCRIPTS / "compensation.toml").read_text()
        code, text = study("compensation", config, tmp_path / "out", "--episodes", "8")
    assert code == 0
    lines = (tmp_path / "out" / "compensation.md").read_text().splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if "|" in line]
    rows = {row[0]: row[1:] for row in cells[2:]}
    assert len(rows) == 3 + 4 + 1 + 1 + 3
    assert all(row in text for row in rows)
    times = {}
    for compensate in (None, False, True):
        asked = Scenario(
            level="gym",
            seed=700_000,
            episodes=8,
            latency="11ms" if compensate is None else "396ms",
            compensate=compensate,
        )
        with patch.object(show, "write_document", lambda _, folder: folder / "matrix.html"):
            evaluate(asked, ["static-obstacles"], out=tmp_path / f"{compensate}")
        (path,) = (tmp_path / f"{compensate}").rglob("episodes.jsonl")
        times[compensate] = {
            seed: flight["quality"]["flight_time_s"]
            for seed, flight in flights(path.parent).items()
            if flight["outcome"] == "success"
        }
    for name, compensate in (("not compensated", False), ("compensated", True)):
        pairs = sorted(times[compensate].keys() & times[None].keys())
        assert rows[name][2] == f"{len(pairs)}"
        here, there = ([times[each][seed] for seed in pairs] for each in (compensate, None))
        change = 100.0 * np.median(np.divide(here, there) - 1.0)
        assert rows[name][1].split(" ")[0] == f"{change:+.1f}"
    wrong = [row for name, row in rows.items() if " x 0.5" in name]
    assert len({tuple(row) for row in (*wrong, rows["compensated"])}) > 3


def test_expected_latencies_of_the_study() -> None:
    compensation = importlib.import_module("compensation")
    rng = np.random.default_rng(1)
    measured = rng.integers(100_000, 900_000, 40)
    high, half = compensation.Quantile(1), compensation.Scaled(1, 0.5)
    assert high.expected_us() == half.expected_us() == 0
    for k, each in enumerate(measured, start=1):
        newest = measured[max(0, k - 32) : k]
        for latency in (high, half):
            latency.measure(np.array([0]), np.array([each]))
        assert high.expected_us()[0] == int(np.quantile(newest, 0.9))
        assert half.expected_us()[0] == pytest.approx(0.5 * newest.mean(), abs=1.0)


@pytest.mark.parametrize(
    ("line", "field"),
    [
        ("seed = 899_990\nepisodes = 11", "seed = 899990"),
        ("arena_seed = 900_001", "arena_seed = 900001"),
        ("[one_goal]\narena_seed = 900_000", "one_goal.arena_seed = 900000"),
    ],
)
def test_seeds_of_the_final_evaluation_are_rejected(line: str, field: str, tmp_path: Path) -> None:
    config = f'policies = ["greedy"]\nlatencies = ["1ms"]\n{line}\n'
    message = (
        rf"degradation.toml: {field}: accepted: 0 to \d+; choose a lower one: seeds from 900000"
    )
    with pytest.raises(UsageError, match=message):
        study("degradation", config, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_arena_twice_gets_one_line(tmp_path: Path) -> None:
    arena = '[[arenas]]\narena = "no-obstacles"\npolicy = "greedy"\nworkload = "template-5x32"\n'
    with pytest.raises(UsageError, match="accepted: each arena once"):
        study("system", f'computer = "ras-pi-4"\n{arena}{arena}', tmp_path / "out")


@pytest.mark.nightly
def test_mitigation_is_the_gap_of_two_policies(tmp_path: Path) -> None:
    # Two existing policies; their training conditions are not under test.
    code, _ = study(
        "mitigation",
        'episodes = 6\npolicy = "greedy"\nmitigated = "static-obstacles-ppo"\n'
        'computer = "ras-pi-4"\nworkload = "template-5x32"\n',
        tmp_path / "out",
    )
    assert code == 0
    a = "static-obstacles"
    pairs = {
        (f"{a}-reference", f"{a}-target"),
        (f"{a}-reference", f"{a}-mitigated"),
        (f"{a}-target", f"{a}-mitigated"),
        (f"{a}-reference", f"{a}-mitigated-reference"),
    }
    held = comparison(tmp_path / "out", "hardware-gap")["contrasts"]
    found = {(c["entry"]["reference"], c["entry"]["target"]) for c in held}
    assert pairs <= found
    check_contrasts(tmp_path / "out", "hardware-gap", found)
    assert not list((tmp_path / "out").glob("train-*"))


@pytest.mark.nightly
def test_ablation_zeroes_one_input_after_the_other(tmp_path: Path) -> None:
    code, text = study(
        "ablation",
        'episodes = 10\n[[policies]]\narena = "no-obstacles"\npolicy = "no-obstacles"\n',
        tmp_path / "out",
    )
    assert code == 0
    folder = tmp_path / "out" / "no-obstacles-in-no-obstacles"
    zeroed = ("none", "velocity", "goal", "depth")
    check_contrasts(folder, "compare", {("none", name) for name in zeroed[1:]})
    asked = {name: load_run(folder / name).info.config.get("ablate") for name in zeroed}
    assert asked == {"none": None, "velocity": "velocity", "goal": "goal", "depth": "depth"}
    table = text[text.index("Success without one input") :].splitlines()
    rows = [line.split() for line in table if line.startswith(" no-obstacles")]
    rates = [reached(flights(folder / name)) for name in zeroed]
    assert min(rates) < max(rates)
    assert rows[0] == ["no-obstacles", "body", *(f"{rate:.0f}" for rate in rates)]
    assert rows[1] == ["no-obstacles", "the", "paper", "91.0", "53.0", "42.0", "7.0"]


@pytest.mark.nightly
@pytest.mark.slow
def test_the_held_out_zone_is_neither_learned_nor_mixed(tmp_path: Path) -> None:
    """Goals lie within and beyond the radius; the policy was trained with the former alone."""
    pytest.importorskip("torch")
    training = tmp_path / "short.toml"
    training.write_text(
        'base = "static-obstacles"\n[environment.episode]\ntime_limit_s = 5.0\n'
        "[selection]\nepisodes = 2\n"
    )
    config = (
        'episodes = 6\ntime_limit_s = 3.0\narena = "static-obstacles"\nradius_m = 20.0\n'
        f'steps = 300\npolicy = "no-obstacles"\ntraining = "{training}"\n'
    )
    out = tmp_path / "out"
    code, text = study("held_out_zone", config, out)
    assert code == 0
    away = {
        zone: [math.hypot(*each["goal"]) for each in flights(out / zone / "near").values()]
        for zone in ("within", "beyond")
    }
    assert max(away["within"]) <= 20.0 < min(away["beyond"])
    assert max(away["beyond"]) <= 48.0
    card = json.loads((out / "train-held-out-zone" / "policy" / "card.json").read_text())
    arena = Path(card["training"]["arena"])
    assert load_profile("arenas", str(arena), ArenaSpec).zones_m == (20.0,)
    lines = text[text.index("Goals farther off") :].splitlines()
    assert len([line for line in lines if "learned within 20 m" in line]) == 2


@pytest.mark.slow
def test_a_policy_that_is_not_there_is_trained_once(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    # Untrained it hovers until the time limit, in every episode of a selection.
    training = tmp_path / "short.toml"
    training.write_text(
        'base = "paper-layout-no-obstacles"\n[environment.episode]\ntime_limit_s = 5.0\n'
        "[selection]\nepisodes = 2\n"
    )
    config = (
        'episodes = 2\ntime_limit_s = 5.0\n[[policies]]\narena = "no-obstacles"\npolicy = "mine"\n'
        f'training = "{training}"\nsteps = 300\n'
    )
    out = tmp_path / "out"
    code, text = study("ablation", config, out)
    assert code == 0
    policy = out / "train-mine" / "policy"
    card = json.loads((policy / "card.json").read_text())
    assert card["name"] == "mine"
    assert f"airl train {training} --name mine --steps 300" in json.dumps(card)
    # The layout is read from the card.
    assert card["observation"]["layout"] == "paper"
    assert [line for line in text.splitlines() if line.split()[:2] == ["no-obstacles", "paper"]]
    assert load_run(out / "mine-in-no-obstacles" / "none").info.config["policy"] == str(policy)
    before = (policy / "policy.onnx").stat().st_mtime_ns
    assert study("ablation", config, out)[0] == 0
    assert (policy / "policy.onnx").stat().st_mtime_ns == before


def test_a_policy_that_nothing_trains_gets_one_line(tmp_path: Path) -> None:
    policy = 'policy = "nobody"\nmitigated = "greedy"\n'
    with pytest.raises(UsageError, match="'nobody': no such policy"):
        study("mitigation", policy, tmp_path / "out")


# --- going on


def test_the_same_command_flies_nothing_more(degraded: tuple[Path, str]) -> None:
    out, text = degraded
    files = [*out.rglob("episodes.jsonl")]
    before = {file: file.stat().st_mtime_ns for file in files}
    held = comparison(out, "latency-sweep")
    code, again = study("degradation", DEGRADATION, out)
    assert code == 0
    assert again.count("(flown before)") == len(files) == 6
    assert "(flown before)" not in text
    assert {file: file.stat().st_mtime_ns for file in files} == before
    assert comparison(out, "latency-sweep") == held


def test_fewer_episodes_or_another_kind_are_another_study(degraded: tuple[Path, str]) -> None:
    out, _ = degraded
    with pytest.raises(UsageError, match="episodes = 12, not 11"):
        study("degradation", DEGRADATION, out, "--episodes", "11")
    with pytest.raises(UsageError, match="kind = 'latency-sweep', not 'matrix'"):
        config = 'policies = ["greedy"]\narenas = ["no-obstacles"]\n'
        study("generalisation", config, out)


@pytest.mark.slow
def test_what_cannot_be_used_gets_one_line(tmp_path: Path) -> None:
    words = [sys.executable, str(SCRIPTS / "degradation.py"), "--out", "out"]
    wrong = subprocess.run(
        [*words, "--episodes", "0"],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert wrong.returncode == 2
    assert wrong.stderr.splitlines()[0].startswith("error: --episodes 0")
