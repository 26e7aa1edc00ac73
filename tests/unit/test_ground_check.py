"""`airl-companion --check`: detection of faults on the ground."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Kinematics, Observation
from airl_mav.scenario.stand_alone import StandAloneCompanion, check_companion
from companion.frame_source import ReceivedFrame
from companion.program import DECISIONS, CheckResult, check_on_ground, prepare, time_decisions
from tests.support.ports import LOOPBACK, free_ports

OWN = """
import numpy as np
from airl_mav.policy.actions import Action
from companion.addons.cameras.drivers import DepthImage
from companion.addons.cameras.fitting import Lens

class Mine:
    lens = Lens(128, 96, 64.0, 64.0, 63.5, 47.5)
    def __init__(self):
        self.rng = np.random.default_rng(1)
    def read(self, timeout_s):
        return DepthImage(self.rng.integers(900, 1000, (96, 128)).astype(np.uint16), 0)
    def close(self):
        pass

class Frozen(Mine):
    def read(self, timeout_s):
        return DepthImage(np.full((96, 128), 1234, np.uint16), 0)

class Dead(Mine):
    def read(self, timeout_s):
        return None
"""


def found_with(folder: Path, camera: str, **asked: Any) -> list[CheckResult]:
    """Look at a camera where no flight controller is."""
    (folder / "mine.py").write_text(OWN)
    (udp,), _ = free_ports(1, 0)
    words = {
        "connect": f"udpin://{LOOPBACK}:{udp}",
        "camera": f"{folder}/mine.py:{camera}",
        "connect_timeout": 0.1,
        **asked,
    }
    options = StandAloneCompanion.model_validate(words)
    return list(check_on_ground(options, prepare(options), threading.Event()))


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.program.LOOK_S", 0.1)
    monkeypatch.setattr("companion.pilot.FRAME_TIMEOUT_S", 0.2)


def test_a_good_camera_and_no_flight_controller(tmp_path: Path) -> None:
    policy, camera, vehicle = found_with(tmp_path, "Mine")
    assert policy == ("policy", True, "generalist, holds an action 0.1 s")
    assert camera.good
    assert camera.told.startswith("64x48 px, ")
    assert "every image is the same" not in camera.told
    assert not vehicle.good
    assert vehicle.told.startswith("no flight controller heard on udpin://")


def test_a_frozen_camera_is_told(tmp_path: Path) -> None:
    _, camera, _ = found_with(tmp_path, "Frozen")
    assert "every image is the same" in camera.told


def test_a_dead_camera_is_wrong(tmp_path: Path) -> None:
    _, camera, *_ = found_with(tmp_path, "Dead")
    assert camera == ("camera", False, "no frame for 0.2 s")


def test_a_camera_that_does_not_suit_the_policy_is_wrong(tmp_path: Path) -> None:
    """The profile's camera is not the one that the policy was trained with."""
    _, camera, *_ = found_with(tmp_path, "Mine", vehicle="quad-d435")
    assert not camera.good
    assert "camera 64x36 px; accepted: 32x24 px or a whole multiple" in camera.told


class Counts:
    """Decides, and fails at the n-th time."""

    def __init__(self, fails_at: int) -> None:
        self.left = fails_at

    def act(self, _: Observation) -> Action:
        self.left -= 1
        if not self.left:
            raise ValueError("no number")
        return Action(0.0, 0.0, 0.0)


@pytest.mark.parametrize("fails_at", [0, 1, DECISIONS])
def test_the_policy_decides_on_what_is_seen(fails_at: int) -> None:
    options = StandAloneCompanion.model_validate({"policy": "greedy"})
    mission = prepare(options)
    policy = Counts(fails_at)
    object.__setattr__(mission, "policy", policy)
    camera = Intrinsics.from_fov(64, 48, 1.5)
    frame = Frame(0, 0, np.full((48, 64), 9000, np.uint16), camera)
    still = Kinematics(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    finding = time_decisions(mission, ReceivedFrame(frame, 0), still)
    assert finding.good == (not fails_at)
    assert finding.told.startswith(
        "the policy failed: ValueError: no number" if fails_at else "t2 "
    )
    if not fails_at:
        assert policy.left == -1 - DECISIONS


def test_in_lockstep_there_is_no_check() -> None:
    asked = StandAloneCompanion.model_validate({"check": True, "lockstep": True})
    with pytest.raises(FieldError, match="without lockstep"):
        check_companion(asked)
