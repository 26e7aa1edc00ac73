"""The studies: what they fly, what they say, and that a kill loses nothing."""

from __future__ import annotations

import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from airl_mav.core.errors import UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import load
from airl_mav.report.comparison import show
from airl_mav.studies.ablation import ABLATION_STUDY, SENSES, AblationConfig
from airl_mav.studies.ablation import cells as ablation_cells
from airl_mav.studies.degradation import DEGRADATION_STUDY, DegradationConfig
from airl_mav.studies.degradation import cells as degradation_cells
from airl_mav.studies.generalisation import GENERALISATION_STUDY
from airl_mav.studies.mitigation import MITIGATION_STUDY
from airl_mav.studies.parts import aside
from airl_mav.studies.study import Study, StudyCommand, load_config, run_study
from airl_mav.studies.system import SYSTEM_STUDY
from tests.report.test_report import Page
from tests.support.processes import ROOT

STUDIES: tuple[Study[Any], ...] = (
    ABLATION_STUDY,
    DEGRADATION_STUDY,
    GENERALISATION_STUDY,
    MITIGATION_STUDY,
    SYSTEM_STUDY,
)
SCRIPTS = ROOT / "scripts" / "studies"

DEGRADATION = """
description = "a test"
episodes = 12
policies = ["greedy"]
arena = "dense-obstacles"
latencies = ["base", "300ms", "lognormal:600ms,30ms"]
fan = { arena_seed = 4, flights = 3 }
"""


def study(which: Study[Any], config: Path, out: Path, **options: Any) -> tuple[int, str]:
    console = Console(record=True, width=120, file=io.StringIO())
    code = run_study(which, StudyCommand(config=config, out=out, **options), config, console)
    return code, console.export_text()


def written(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def data_of(out: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((out / "study.json").read_text())
    return data


def lines(path: Path) -> dict[int, dict[str, Any]]:
    """Return the episodes of a run by seed, as a reader without this package sees them."""
    episodes = map(json.loads, (path / "episodes.jsonl").read_text().splitlines())
    return {episode["seed"]: episode for episode in episodes}


@pytest.fixture(scope="module")
def degraded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A small degradation study: its folder, and what was printed."""
    root = tmp_path_factory.mktemp("degradation")
    code, text = study(DEGRADATION_STUDY, written(root, DEGRADATION), root / "out")
    assert code == 0
    return root / "out", text


# --- what is configured


@pytest.mark.parametrize("which", STUDIES, ids=lambda which: which.key)
def test_every_study_has_a_script_and_a_configuration(which: Study[Any]) -> None:
    path = SCRIPTS / f"{which.key}.toml"
    full = load_config(which, path, {})
    quick = load_config(which, path, which.quick)
    assert full.episodes >= 1000
    assert quick.episodes <= 40
    assert "main(" in (SCRIPTS / f"{which.key}.py").read_text()


def test_a_wrong_field_gets_one_line(tmp_path: Path) -> None:
    path = written(tmp_path, DEGRADATION.replace("episodes", "episode"))
    with pytest.raises(UsageError, match="episode: unknown field; did you mean 'episodes'"):
        load_config(DEGRADATION_STUDY, path, {})
    path = written(tmp_path, DEGRADATION.replace("300ms", "base"))
    with pytest.raises(UsageError, match="latencies: one twice"):
        load_config(DEGRADATION_STUDY, path, {})
    path = written(tmp_path, DEGRADATION)
    with pytest.raises(UsageError, match="episodes = 0"):
        load_config(DEGRADATION_STUDY, path, {"episodes": 0})
    bad = written(tmp_path, DEGRADATION.replace("300ms", "soon"))
    with pytest.raises(UsageError, match="--latency soon"):
        study(DEGRADATION_STUDY, bad, tmp_path / "out")


def test_policies_that_are_not_there_are_passed_over(tmp_path: Path) -> None:
    config = load_config(DEGRADATION_STUDY, written(tmp_path, DEGRADATION), {})
    assert isinstance(config, DegradationConfig)
    also = config.model_copy(update={"also_if_there": ("nobody", "no-obstacles")})
    assert also.flown_policies() == ["greedy", "no-obstacles"]
    keys = [cell.key for cell in degradation_cells(also, tmp_path)]
    assert len(set(keys)) == len(keys) == 2 * 3 * 2


def test_all_episodes_to_one_goal_share_their_arena(degraded: tuple[Path, str]) -> None:
    out, _ = degraded
    one = lines(out / "greedy-300ms-one-goal")
    assert sorted(one) == [1, 2, 3]
    assert {e["arena_seed"] for e in one.values()} == {4}
    assert len({tuple(e["goal"]) for e in one.values()}) == 1
    many = lines(out / "greedy-300ms")
    assert {seed: e["arena_seed"] for seed, e in many.items()} == {s: s for s in range(1, 13)}


# --- what is found


def test_degradation_is_that_of_the_files(degraded: tuple[Path, str]) -> None:
    out, _ = degraded
    (policy,) = data_of(out)["policies"]
    flown = [lines(out / cell["folder"]) for cell in policy["cells"]]
    for cell, episodes in zip(policy["cells"], flown, strict=True):
        good = [e["quality"] for e in episodes.values() if e["outcome"] == "success"]
        assert cell["success_rate"]["value"] == pytest.approx(len(good) / 12)
        assert cell["distance_m"]["value"] == pytest.approx(
            np.mean([q["distance_m"] for q in good])
        )
    t2 = [cell["t2_mean_us"] for cell in policy["cells"]]
    assert t2[:2] == [1000.0, 300_000.0]
    assert t2[2] == pytest.approx(600_000.0, rel=0.02)
    against = [(flown[0], other) for other in flown[1:]]
    for pairs, key in ((against, "against_first"), (list(pairwise(flown)), "steps")):
        for (first, second), gap in zip(pairs, policy[key], strict=True):
            common = [s for s in first if first[s]["outcome"] == second[s]["outcome"] == "success"]
            a, b = (
                np.mean([e[s]["quality"]["flight_time_s"] for s in common]) for e in (first, second)
            )
            change = gap["flight_time_s"]
            assert change["difference"]["value"] == pytest.approx(100.0 * (b / a - 1.0))
            assert change["difference"]["n"] == len(common)


def test_it_says_whether_it_is_monotone(degraded: tuple[Path, str]) -> None:
    out, text = degraded
    (policy,) = data_of(out)["policies"]
    rates = [cell["success_rate"]["value"] for cell in policy["cells"]]
    assert ("success never rises" in text) == all(b <= a for a, b in pairwise(rates))
    steps = [gap["flight_time_s"]["difference"] for gap in policy["steps"]]
    few = [step for step in steps if step["n"] < 10]
    (line,) = [x for x in (out / "study.md").read_text().splitlines() if "flight time:" in x]
    assert ("ewer than 10 pairs" in line) == bool(few)
    if not few:
        assert ("not monotone" in line) == any(step["value"] <= 0.0 for step in steps)


@pytest.mark.parametrize(
    ("goal", "expected"), [((30.0, 0.0), 4.0), ((0.0, 30.0), 9.0), ((20.0, 20.0), 9 / 2**0.5)]
)
def test_how_far_aside(goal: tuple[float, float], expected: float, tmp_path: Path) -> None:
    # Before navigation and after the verdict it does not count.
    time_us = np.arange(5) * 10**6
    position = np.array([[0, 50, 0], [0, 0, -2], [9, 0, -2], [9, 4, -2], [0, 70, -2]], float)
    path = Trajectory(
        time_us, position, np.zeros((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1)), np.zeros(5)
    )
    episode = EpisodeRecord(
        index=0,
        seed=1,
        arena="a",
        arena_seed=1,
        outcome=Outcome.SUCCESS,
        reason="",
        goal=goal,
        goal_radius_m=3.0,
        time_limit_s=9.0,
        started_us=0,
        navigation_us=1_000_000,
        ended_us=3_000_000,
        wall_s=None,
        slipped_us=0,
        battery_remaining=None,
        quality=None,
    )
    assert aside(path, episode) == pytest.approx(expected)
    turned = replace(episode, goal=(-goal[0], -goal[1]))
    assert math.isclose(aside(path, turned), expected)


def test_what_it_leaves_behind(degraded: tuple[Path, str]) -> None:
    out, text = degraded
    page = Page((out / "study.html").read_text(encoding="utf-8"))
    assert all(ref.startswith("data:image/svg+xml;base64,") for ref in page.references)
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert all(image["alt"] for image in page.images)
    assert len(page.images) == 4 + 3
    for name in ("degradation-success", "degradation-distance", "fan-greedy"):
        with Image.open(out / f"{name}.png") as image:
            assert min(image.size) > 200
    table = (out / "study.md").read_text()
    assert "| 300 ms | 300 |" in table
    # The paper's flight times, in its table.
    assert "47.59" in table
    assert "47.59" in text
    assert str(out / "study.html") in text
    assert not list(out.rglob("*.partial"))


# --- going on


def test_the_same_command_shows_it_again_and_flies_nothing(degraded: tuple[Path, str]) -> None:
    out, _ = degraded
    before = data_of(out)
    code, text = study(DEGRADATION_STUDY, out.parent / "study.toml", out)
    assert code == 0
    assert text.count("(flown before)") == 6
    assert {k: v for k, v in data_of(out).items() if k != "command"} == {
        k: v for k, v in before.items() if k != "command"
    }


def test_another_number_of_episodes_is_another_study(degraded: tuple[Path, str]) -> None:
    out, _ = degraded
    with pytest.raises(UsageError, match="holds a run with episodes = 12, not 13"):
        study(DEGRADATION_STUDY, out.parent / "study.toml", out, episodes=13)


def test_another_study_does_not_go_into_its_folder(degraded: tuple[Path, str]) -> None:
    out, _ = degraded
    with pytest.raises(UsageError, match="holds the study 'degradation'"):
        study(GENERALISATION_STUDY, SCRIPTS / "generalisation.toml", out)


@pytest.mark.slow
def test_a_killed_study_goes_on_and_finds_the_same(
    degraded: tuple[Path, str], tmp_path: Path
) -> None:
    whole, _ = degraded
    config, out = written(tmp_path, DEGRADATION), tmp_path / "out"
    words = [sys.executable, str(SCRIPTS / "degradation.py")]
    words += ["--config", str(config), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        words, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        # In the middle: the second cell is there, the last is not.
        while process.poll() is None and not (out / "greedy-300ms" / "run.json").exists():
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert not (out / "study.json").exists()
    done = subprocess.run(
        words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "(flown before)" in done.stdout
    found, expected = data_of(out), data_of(whole)
    for data in (found, expected):
        del data["command"], data["crc32"]
    assert found == expected
    for cell in expected["policies"][0]["cells"]:
        assert len(load(out / cell["folder"]).episodes) == 12


# --- the other studies


def test_generalisation(tmp_path: Path) -> None:
    config = written(
        tmp_path,
        'description = "a test"\nepisodes = 6\npolicies = ["greedy", "no-obstacles"]\n'
        'arenas = ["no-obstacles", "dense-obstacles"]\n',
    )
    code, text = study(GENERALISATION_STUDY, config, tmp_path / "out")
    assert code == 0
    cells = data_of(tmp_path / "out")["cells"]
    for cell in cells:
        episodes = lines(tmp_path / "out" / cell["folder"]).values()
        good = sum(e["outcome"] == "success" for e in episodes)
        assert cell["success_rate"]["value"] == pytest.approx(good / 6)
    assert [c["trained_in"] for c in cells] == [None, None, "no-obstacles", "no-obstacles"]
    assert "at home in no-obstacles; points from there in harder: dense-obstacles" in text
    # The paper's own table beside it.
    assert "0.61" not in text
    assert "61" in text


def test_system_evaluation(tmp_path: Path) -> None:
    config = written(
        tmp_path,
        'description = "a test"\nepisodes = 8\n[[arenas]]\narena = "no-obstacles"\n'
        'policy = "no-obstacles"\nworkload = "template-5x32"\n'
        "fan = { arena_seed = 4, flights = 2 }\n",
    )
    code, text = study(SYSTEM_STUDY, config, tmp_path / "out")
    assert code == 0
    (arena,) = data_of(tmp_path / "out")["arenas"]
    assert arena["t2_mean_us"][0] == pytest.approx(11e3, rel=0.02)
    assert arena["t2_mean_us"][1] == pytest.approx(396e3, rel=0.05)
    first, second = (
        lines(tmp_path / "out" / f"no-obstacles-{name}") for name in ("workstation", "ras-pi-4")
    )
    common = [s for s in first if first[s]["outcome"] == second[s]["outcome"] == "success"]
    a, b = (np.mean([e[s]["quality"]["energy_j"] for s in common]) for e in (first, second))
    found = arena["gap"]["energy_j"]["difference"]
    assert found["value"] == pytest.approx(100.0 * (b / a - 1.0))
    # 37.37 s against 25.29 s in the paper.
    assert "+47.8 %" in text


def test_ablation_flies_every_sense_in_every_layout(tmp_path: Path) -> None:
    config = load_config(ABLATION_STUDY, SCRIPTS / "ablation.toml", {})
    assert isinstance(config, AblationConfig)
    planned = ablation_cells(config, tmp_path)
    assert len(planned) == len(config.policies) * len(SENSES)
    assert {cell.command.ablate for cell in planned} == {None, "velocity", "goal", "depth"}
    assert {each.layout for each in config.policies} == {"body", "paper"}
    trained = [each for each in config.policies if each.training is not None]
    assert all(each.found(tmp_path).startswith(str(tmp_path)) for each in trained)


@pytest.mark.slow
def test_ablation_trains_what_is_not_there(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    # Untrained it hovers until the time limit, in every episode of a selection.
    training = tmp_path / "short.toml"
    training.write_text(
        'base = "paper-layout-no-obstacles"\n[environment.episode]\ntime_limit_s = 5.0\n'
        "[selection]\nepisodes = 2\n"
    )
    config = written(
        tmp_path,
        'description = "a test"\nepisodes = 4\n[[policies]]\nlayout = "paper"\n'
        f'arena = "no-obstacles"\ntraining = "{training}"\nsteps = 300\n',
    )
    out = tmp_path / "out"
    code, text = study(ABLATION_STUDY, config, out)
    assert code == 0
    card = json.loads((out / "train-paper-no-obstacles" / "policy" / "card.json").read_text())
    assert card["observation"]["layout"] == "paper"
    assert f"airl train {training}" in json.dumps(card)
    (policy,) = data_of(out)["policies"]
    flown = {sense: load(out / f"paper-no-obstacles-{sense}").info.config for sense in SENSES}
    assert {sense: config["ablate"] for sense, config in flown.items()} == {
        "none": None,
        "velocity": "velocity",
        "goal": "goal",
        "depth": "depth",
    }
    assert policy["policy_sha256"]
    assert "no depth" in text
    # The second time nothing is trained.
    before = (out / "train-paper-no-obstacles" / "policy" / "policy.onnx").stat().st_mtime_ns
    assert study(ABLATION_STUDY, config, out)[0] == 0
    after = (out / "train-paper-no-obstacles" / "policy" / "policy.onnx").stat().st_mtime_ns
    assert before == after


@pytest.mark.slow
def test_mitigation(tmp_path: Path) -> None:
    # Two policies that are there; which of them was trained for what is not under test.
    config = written(
        tmp_path,
        'description = "a test"\nepisodes = 6\npolicy = "greedy"\n'
        'mitigated = "static-obstacles-ppo"\nfan = { arena_seed = 4, flights = 2 }\n',
    )
    # The page of the gap takes longer than the flights.
    with patch.object(show, "write_document", lambda _, folder: folder / "gap.html"):
        code, text = study(MITIGATION_STUDY, config, tmp_path / "out")
    assert code == 0
    assert (tmp_path / "out" / "gap" / "gap.json").exists()
    names = [each["name"] for each in data_of(tmp_path / "out")["one_goal"]]
    assert names[:2] == ["greedy on workstation", "greedy on ras-pi-4"]
    assert "Flights to one goal" in text
