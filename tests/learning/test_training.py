"""Training from the command line: real learning, kill -9, resume, export, flight."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError
from airl_mav.core.progress import Progress
from airl_mav.envs.evaluation import fly_episodes, success_rate
from airl_mav.envs.sb3 import make_vec_env
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.card import load_card
from airl_mav.policy.layouts import Encoded
from airl_mav.policy.registry import load_learned
from airl_mav.profiles.loading import list_profiles, load_profile
from airl_mav.rehearsal import run_folder
from airl_mav.rehearsal.run_folder import load
from airl_mav.training import training_run
from airl_mav.training.config import TrainingConfig, check_fields
from airl_mav.training.training_folder import (
    Evaluation,
    TrainingFolder,
    TrainingProgress,
    TrainRequest,
)
from airl_mav.training.training_run import nominal
from tests.support.command_line import airl, option_words
from tests.support.flown_here import flown_here
from tests.support.processes import ROOT, SITL_WITHOUT_REPORT, allow_interrupt, wait_until

SHORT = """
description = "a short one"
steps = 3_000
vehicles = 16
checkpoint_every = 500
[environment]
arena = "no-obstacles"
image_width_px = 16
image_height_px = 12
[algorithm]
learning_starts = 300
[selection]
every = 1_000
episodes = 10
"""


def words(config: Path, out: Path, *options: str) -> list[str]:
    return [
        *(sys.executable, "-m", "airl_mav.cli.main", "train", str(config), "--out", str(out)),
        *options,
    ]


def train(config: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        words(config, out, *options), capture_output=True, text=True, cwd=ROOT, check=False
    )


def evaluations(out: Path) -> list[dict[str, Any]]:
    """Return the lines without what depends on the wall clock."""
    lines = (out / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    plain = [json.loads(line) for line in lines]
    for line in plain:
        del line["seconds"], line["crc32"]
    return plain


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "short.toml"
    path.write_text(SHORT, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def straight(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an uninterrupted run."""
    out = tmp_path_factory.mktemp("straight") / "run"
    code, text = airl("train", str(short), "--out", str(out))
    assert code == 0, text
    return out


@pytest.mark.parametrize("name", list_profiles("training"))
def test_shipped_configurations_are_sound(name: str) -> None:
    config = load_profile("training", name, TrainingConfig)
    assert config.selection.every <= config.steps
    check_fields(config.algorithm)


def test_a_file_s_field_that_the_algorithm_lacks_is_the_file_s(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('base = "static-obstacles-dagger"\n[algorithm]\ngamma = 0.9\n')
    with pytest.raises(UsageError, match=r"mine\.toml: algorithm\.gamma: 'dagger' has no such"):
        TrainRequest(config=str(path)).configured()


def test_of_another_algorithm_than_its_base_s_nothing_is_left(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('base = "static-obstacles-dagger"\n[algorithm]\nname = "ppo"\ngamma = 0.9\n')
    algorithm = TrainRequest(config=str(path)).configured().algorithm
    assert algorithm.model_fields_set == {"name", "gamma"}


@pytest.mark.nightly
@pytest.mark.slow
def test_a_killed_run_goes_on_as_if_nothing_had_happened(
    short: Path, straight: Path, tmp_path: Path
) -> None:
    """Kill with -9 at any time; evaluations and weights equal those in the uninterrupted run.

    In every test run, tests/learning/test_checkpoint.py kills at every step of saving.
    """
    out = tmp_path / "run"
    with subprocess.Popen(
        words(short, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT
    ) as process:
        wait_until((out / "checkpoints" / "latest").exists, "a checkpoint")
        time.sleep(random.Random().uniform(0.0, 0.8))
        process.kill()
    done = train(short, out, "--resume")
    assert done.returncode == 0, done.stderr
    assert evaluations(out) == evaluations(straight)
    assert (out / "policy" / "policy.onnx").read_bytes() == (
        straight / "policy" / "policy.onnx"
    ).read_bytes()


@pytest.mark.nightly
@pytest.mark.slow
def test_ctrl_c_says_how_to_go_on(short: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with subprocess.Popen(
        words(short, out),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        preexec_fn=allow_interrupt,
    ) as process:
        wait_until((out / "checkpoints" / "latest").exists, "a checkpoint")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "--resume" in output
    assert "Traceback" not in output


@pytest.mark.nightly
@pytest.mark.slow
def test_programs_read_lines(short: Path, tmp_path: Path) -> None:
    config = tmp_path / "brief.toml"
    config.write_text(short.read_text(encoding="utf-8").replace("3_000", "600"), encoding="utf-8")
    out = tmp_path / "run"
    code, text = airl("train", str(config), "--out", str(out), "--json")
    assert code == 0
    lines = [json.loads(line) for line in text.splitlines()]
    assert lines[0]["command"] == "airl train"
    evaluations = [line for line in lines if line["event"] == "evaluation"]
    best = TrainingFolder(out).best()
    assert best is not None
    assert [line["steps"] for line in evaluations if line["best"]][-1] == best.steps
    last = [line for line in lines if line["event"] == "progress"][-1]
    assert (last["work"], last["unit"], last["planned"]) == ("training", "decisions", 600)
    assert last["done"] >= 600
    exported, finished = lines[-2:]
    assert exported == {"event": "policy", "path": str(out / "policy")}
    assert (finished["event"], finished["exit_status"]) == ("finished", 0)
    assert (finished["ended"], finished["path"]) == ("complete", str(out))
    # Trained to the end already: quiet says where the result lies, and nothing else.
    code, text = airl("train", str(config), "--out", str(out), "--resume", "--quiet")
    assert [line.split()[0] for line in text.splitlines()] == ["best", "policy", "folder"]
    # The exported policy flies through MAVSDK; its success is not checked.
    words = option_words(level="lockstep", episodes=1, workers=1, time_limit_s=5.0)
    with flown_here():
        code, _ = airl("evaluate", str(out / "policy"), *words, "--out", str(tmp_path / "flight"))
    assert code == 0
    flown = load(tmp_path / "flight")
    assert flown.episodes[0].notes == ()
    assert (flown.latency[0]["accepted_us"] > 0).sum() >= 4


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("in_training", "told"),
    [(None, ""), (0.5, ""), (0.945, "  (94.5% with training's random actions)")],
)
def test_who_flies_well_by_chance_alone_is_told(in_training: float | None, told: str) -> None:
    notes: list[str] = []

    class Noted(Progress):
        def note(self, text: str, style: str | None = None) -> None:
            notes.append(text)

    evaluation = Evaluation(5_000, 60.0, 300, 0.36, 0.64, 2.4, 15.0, in_training, None)
    TrainingProgress(Noted(), 10_000).evaluated(evaluation, best=False)
    assert notes == [f"      5,000 decisions      60 s  success  36.0%    2.40 s{told}"]


def test_the_reward_of_an_evaluation_is_the_environments() -> None:
    spec = EnvironmentSpec(image_width_px=16, image_height_px=12)
    env = make_vec_env(1, spec)
    env.seed(1)
    env.reset()
    while not (info := env.step(np.array([12]))[3][0]):
        pass
    episode = info["episode"]
    (flown,) = fly_episodes(spec, lambda seen: np.array([12]), [episode["seed"]])
    assert flown.reward == pytest.approx(episode["r"])


@pytest.mark.nightly
def test_folders_are_not_mixed_up(short: Path, straight: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="or resume"):
        airl("train", str(short), "--out", str(straight))
    other = tmp_path / "other.toml"
    other.write_text(SHORT.replace("vehicles = 16", "vehicles = 8"), encoding="utf-8")
    with pytest.raises(UsageError, match="vehicles"):
        airl("train", str(other), "--out", str(straight), "--resume")
    code, text = airl("train", str(short), "--out", str(straight), "--resume")
    assert code == 0, text


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("[environment]\narena = 'nowhere'\n", ["nowhere", "static-obstacles"]),
        ("[environment]\nhold = 1\n", ["environment.hold", "unknown field"]),
        ("[environment.episode]\nhold_s = 0\n", ["hold_s", "0.02"]),
        ("[algorithm]\nname = 'sac'\n", ["sac", "discrete"]),
        ("[network]\nkind = 'template'\n", ["layers"]),
        ("steps = -1\n", ["steps", "value"]),
        ("initial = 'nowhere'\n", ["nowhere", "no training run here"]),
        (
            "[environment]\nreward = 'nope.py:r'\n",
            ["bad.toml: environment.reward = 'nope.py:r': nope.py: no such file"],
        ),
        (
            "[environment]\nactions = 'os:getcwd'\n",
            ["bad.toml: environment.actions = 'os:getcwd': accepted: a class with"],
        ),
        ("[environment.cameras.nose]\n", ["bad.toml: environment.cameras.nose: vehicle quad"]),
        (
            "[algorithm]\nname = 'a2c'\noptions = {n_steps = 'many'}\n",
            ["bad.toml: algorithm.options.n_steps = 'many': accepted: 1 <= value"],
        ),
    ],
)
def test_a_wrong_configuration_gets_one_line(text: str, names: list[str], tmp_path: Path) -> None:
    config = tmp_path / "bad.toml"
    config.write_text('description = "bad"\n' + text, encoding="utf-8")
    steps = () if "steps" in text else ("--steps", "100")
    with pytest.raises(UsageError) as error:
        airl("train", str(config), "--out", str(tmp_path / "run"), *steps)
    told = str(error.value)
    assert "\n" not in told
    for name in names:
        assert name in told
    assert not (tmp_path / "run/train.json").exists(), "the folder is free for a corrected file"


def test_the_curves_of_a_learner_with_rollouts_have_a_point_for_each(tmp_path: Path) -> None:
    """Check the return's curve, too: stable-baselines3 counts rollouts, not episodes."""
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    config = TrainingConfig.model_validate(
        {
            "description": "curves",
            "steps": 1000,
            "vehicles": 8,
            "environment": {"arena": "no-obstacles", "episode": {"time_limit_s": 4.0}},
            "algorithm": {"name": "ppo", "batch_size": 64, "options": {"n_steps": 32}},
            "selection": {"every": 10_000, "episodes": 2},
        }
    )
    done = training_run.train(config, tmp_path / "run", name="curves")
    found = events.EventAccumulator(str(done.folder.tensorboard))
    found.Reload()
    for name in ("rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate"):
        assert [point.step for point in found.Scalars(name)] == [256, 512, 768, 1024]


def test_a_folder_without_a_run_is_said_to_be_none(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no training run here"):
        TrainingFolder(tmp_path).about()


def test_two_do_not_train_in_one_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "WAIT_S", 0.0)
    config = TrainingConfig(description="one")
    with (
        run_folder.locked(tmp_path / "run", lambda _: None),
        pytest.raises(UsageError, match="another run"),
    ):
        training_run.train(config, tmp_path / "run", name="one")


@pytest.mark.nightly  # test_programs_read_lines flies the export of a short training.
@pytest.mark.slow
@pytest.mark.timeout(400)
def test_learns_exports_and_flies(tmp_path: Path) -> None:
    """From nothing to a rehearsal: learns far beyond chance, then flies through MAVSDK."""
    config = tmp_path / "tiny.toml"
    # A small image and a short time limit: random and untrained policies fly for long.
    config.write_text(
        'description = "tiny"\nsteps = 24_000\n'
        '[environment]\narena = "no-obstacles"\nimage_width_px = 16\nimage_height_px = 12\n'
        "[environment.episode]\ntime_limit_s = 40.0\n"
        "[selection]\nevery = 6_000\nepisodes = 30\nstop_at = 0.95\n",
        encoding="utf-8",
    )
    out = tmp_path / "run"
    done = train(config, out)
    assert done.returncode == 0, done.stderr
    card = load_card(out / "policy")
    spec = nominal(load_profile("training", str(config), TrainingConfig).environment)
    policy = load_learned(out / "policy")
    flown = list(fly_episodes(spec, policy.act_batch, range(1, 61)))
    rng = np.random.default_rng(0)

    def at_random(seen: Encoded) -> NDArray[np.int64]:
        return rng.integers(0, 25, len(seen["goal"]))

    chance = list(fly_episodes(spec, at_random, range(1, 61)))
    assert success_rate(flown) > 0.7
    assert success_rate(flown) > success_rate(chance) + 0.4
    sitl = subprocess.run(
        [
            *(sys.executable, *SITL_WITHOUT_REPORT, "--level", "lockstep"),
            *("--policy", str(out / "policy"), "--arena", "no-obstacles", "--episodes", "2"),
            *("--out", str(tmp_path / "flight")),
        ],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert sitl.returncode == 0, sitl.stderr
    lines = (tmp_path / "flight" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    outcomes = [json.loads(line)["outcome"] for line in lines]
    known = {each.seed: each.verdict.name.lower() for each in flown}
    assert outcomes == [known[1], known[2]]
    assert card.name == "tiny"
