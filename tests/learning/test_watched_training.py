"""A training that is watched learns the same, and shows the flights that it learns from."""

from __future__ import annotations

import hashlib
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from airl_mav.addons.view.view_messages import (
    CameraImage,
    Decided,
    Episode,
    Flight,
    PhaseStart,
    Said,
    Shown,
    Steering,
    Told,
    Trained,
    VehicleState,
)
from airl_mav.addons.view.viewer import Ends
from airl_mav.addons.view.watched_training import EpisodeReplay, Taped, WatchedTraining
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.profiles.loading import load_profile
from airl_mav.rehearsal.live_view import ViewAddresses
from airl_mav.training import training_run
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_folder import TrainingProgress
from tests.support.browser import CHROMIUM, browser
from tests.support.processes import running, wait_until
from tests.support.scene import has_drawn

SHORT = """
description = "a short one"
steps = 1_000
vehicles = 8
[environment]
arena = "dynamic-obstacles"
[environment.delay]
latency = ["lognormal:150ms,30ms"]
[environment.curriculum]
[algorithm]
learning_starts = 300
[selection]
every = 500
episodes = 4
"""

BUSY = {
    "arena": "dynamic-obstacles",
    "delay": {"computer": "ras-pi-4", "workload": "template-5x32"},
    "episode": {"time_limit_s": 12.0, "goal_radius_m": 5.0, "hover_after_s": 0.06},
    "randomisation": {"mass": 0.2, "depth_noise": 0.02, "extra_delay_ms": [0, 100]},
    "wind": {"random_m_s": 3.0, "gust_m_s": 1.0},
    "frames": 2,
}


class Watchers:
    """A view's end in this process, which wants to see as much as it can."""

    def __init__(self, steering: Steering) -> None:
        self.shown, self.told = Shown(), list[Told]()
        self._steering = steering
        self._ends, self._stop = Ends(), threading.Event()
        self.ends: ViewAddresses = self._ends.ends

    @contextmanager
    def watching(self) -> Iterator[Watchers]:
        thread = threading.Thread(target=self._watch)
        thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            thread.join()
            self._ends.close()

    def _watch(self) -> None:
        while not self._stop.is_set():
            self._ends.ask(self._steering)
            for message, depth_mm in self._ends.take(0.02):
                self.shown.take(message, depth_mm)
                self.told.append(message)


def weights(folder: Path) -> dict[str, str]:
    """Return the digests of a training's weights: the best and all checkpoints."""
    found = {}
    for path in (folder / "best" / "model.zip", *sorted((folder / "checkpoints").rglob("*.zip"))):
        with zipfile.ZipFile(path) as saved:
            for name in ("policy.pth", "policy.optimizer.pth"):
                if name in saved.namelist():
                    key = f"{path.relative_to(folder)}/{name}"
                    found[key] = hashlib.sha256(saved.read(name)).hexdigest()
    return found


@pytest.mark.nightly
def test_a_watched_training_learns_the_same(tmp_path: Path) -> None:
    """Compare weights bit by bit, while a viewer follows at unlimited speed."""
    (tmp_path / "short.toml").write_text(SHORT, encoding="utf-8")
    config = load_profile("training", str(tmp_path / "short.toml"), TrainingConfig)
    training_run.train(config, tmp_path / "alone", name="one")
    with Watchers(Steering(speed=None)).watching() as watchers:
        training_run.train(config, tmp_path / "watched", name="one", view=watchers.ends)
        wait_until(lambda: watchers.shown.trained is not None, "a decision")
    alone = weights(tmp_path / "alone")
    assert len(alone) >= 2
    assert weights(tmp_path / "watched") == alone
    kinds = {type(message) for message in watchers.told}
    assert {Flight, Episode, PhaseStart, VehicleState, CameraImage, Decided, Trained} <= kinds
    trained = watchers.shown.trained
    assert trained is not None
    assert 0 < trained.steps <= config.steps
    assert trained.zone == 0
    assert trained.action.endswith("of 0 to 24")
    assert any(isinstance(m, Said) and "evaluation after" in m.text for m in watchers.told)


class Taping:
    """Keeps all episodes, and where each was seen to end."""

    def __init__(self) -> None:
        self.done: list[Taped] = []
        self._tape = Taped(0, 0, None)

    def begun(self) -> None:
        self._tape = Taped(0, 0, None)

    def decided(
        self, seed: int, zone: int, action: np.ndarray, reward: float, outcome: str | None
    ) -> None:
        tape = self._tape
        tape.seed, tape.zone = seed, None if zone < 0 else zone
        tape.actions.append(np.array(action))
        tape.rewards.append(reward)
        if outcome is not None:
            tape.outcome = outcome
            self.done.append(tape)
            self._tape = Taped(len(self.done), 0, None)


@pytest.mark.parametrize("decisions", ["sequential", "pipelined"])
def test_what_is_shown_is_what_was_flown(decisions: str) -> None:
    """The flights end alike, after as many decisions, at the same time and distance."""
    knobs = {**BUSY, "decisions": decisions}
    if decisions == "pipelined":
        knobs["episode"] = {"time_limit_s": 12.0, "goal_radius_m": 5.0}
    spec = EnvironmentSpec.model_validate(knobs)
    taping = Taping()
    env = NavigationVecEnv(NavigationVectorEnv(6, spec), taping)
    env.seed(3)
    env.reset()
    rng, ends = np.random.default_rng(1), list[dict[str, Any]]()
    while len(ends) < 3:
        _, _, done, infos = env.step(rng.integers(0, 4, 6))
        if done[0]:
            ends.append(infos[0])
    replay = EpisodeReplay(spec)
    for tape, info in zip(taping.done, ends, strict=True):
        moments = list(replay.moments(tape, 7_000_000))
        times = [moment.time_us for moment in moments]
        assert times == sorted(times)
        episode = info["episode"]
        assert tape.outcome == episode["outcome"]
        fleet = replay.navigation.whole_truth().fleet
        assert fleet.time_us[0] / 1e6 == episode["flight_time_s"]
        assert fleet.distance[0] == episode["distance_m"]
        assert fleet.energy[0] == episode["energy_j"]
        told = [moment.message for moment in moments]
        assert sum(isinstance(message, Decided) for message in told) == episode["l"]
        last = [message for message in told if isinstance(message, Trained)][-1]
        assert last.returned == pytest.approx(episode["r"], abs=1e-5)
        vehicle = [message for message in told if isinstance(message, VehicleState)][-1]
        assert vehicle.time_us == 7_000_000 + fleet.time_us[0]
        assert vehicle.position == tuple(fleet.position[0])
        # The network's image at the end, of bytes, as depths.
        seen = info["terminal_observation"]["depth"]
        assert seen.shape[0] == 2
    image = next(moment.image for moment in moments if isinstance(moment.message, Decided))
    assert image is not None
    assert image.shape == (spec.image_height_px, spec.image_width_px)


def test_a_training_of_body_rates_shows_their_setpoints() -> None:
    spec = EnvironmentSpec.model_validate(
        {"arena": "no-obstacles", "actions": "body-rates", "decisions": "pipelined"}
    )
    action = np.array([0.1, -0.2, 0.3, 0.05], np.float32)
    tape = Taped(0, 5, None, [action] * 2, [0.5, 0.5], "timeout")
    told = [moment.message for moment in EpisodeReplay(spec).moments(tape, 0)]
    decided = [message for message in told if isinstance(message, Decided)]
    assert [message.commands for message in decided] == ["body_rates"] * 2
    # Shares of 180 degrees per second, and -1 to 1 for no thrust to full thrust.
    assert decided[0].setpoint == pytest.approx((*np.deg2rad([18.0, -36.0, 54.0]), 0.525))


def test_a_training_that_goes_on_shows_whole_episodes() -> None:
    """Skip an episode in progress at the resume: its beginning is unknown."""
    ends = Ends()
    watched = WatchedTraining(ends.ends, EnvironmentSpec(), TrainingProgress())
    watched.close()
    action = np.array(3)
    watched.decided(5, -1, action, 0.5, None)
    watched.decided(5, -1, action, 0.5, "collision")
    assert not watched._newest
    watched.decided(6, -1, action, 0.5, None)
    watched.decided(6, -1, action, 0.25, "success")
    (tape,) = watched._newest
    assert (tape.seed, tape.zone, tape.outcome, tape.rewards) == (6, None, "success", [0.5, 0.25])
    ends.close()


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.xdist_group("chromium")
def test_a_browser_shows_the_training(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    (tmp_path / "long.toml").write_text(SHORT.replace("1_000", "10_000_000"), encoding="utf-8")
    words = ["-m", "airl_mav.cli.main", "train", "long.toml", "--view"]
    with browser(tmp_path) as page, running([*words, "--out", "run"], tmp_path) as training:
        page.resize(900, 600)
        page.open(training.wait_for_text(r"view +(http://127\.0\.0\.1:\d+)")[1])
        wait_until(lambda: "of 0 to 24" in page.text(), "a decision on the page")
        text = page.text()
        assert "of the newest episodes" in text
        assert "reward" in text
        assert "Set t2 by hand" not in text
        shot = tmp_path / "page.png"
        # While it flies on: at some moments nothing is near enough to be seen on the image.
        wait_until(lambda: has_drawn(page, shot), "vehicle, trail and image")
        assert page.press("Pause")
        with Image.open(shot) as image:
            assert image.size == (900, 600)
