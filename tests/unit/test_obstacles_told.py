"""OBSTACLE_DISTANCE from depth images, against closed forms and in MAVLink."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from airl_mav.camera.frame import Frame, depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import render
from airl_mav.core.clock import WallClock
from airl_mav.core.errors import FieldError
from airl_mav.policy.observation import Kinematics
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.frame_source import ReceivedFrame, SharedFrames
from companion.program import prepare
from companion.status_reports import UNKNOWN_CM, obstacle_distance, obstacles_told
from firmware_sim.addons.extra_modes.collision_prevention import ObstacleMap
from tests.support import mavlink_clients
from tests.unit.test_scans import posts

CAMERA = Intrinsics.from_fov(256, 192, math.radians(90.0))
RANGE_M = 20.0
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def seen(
    north_m: float, east_m: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> dict[str, Any]:
    """Return the message about one post, seen from (0, 0, 2.5 m) at angles [deg]."""
    arena = posts(np.array([[north_m, east_m]]))
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    attitude = np.roll(turn.as_quat(), 1)
    place = np.array([0.0, 0.0, -2.5])
    depth = render(arena, arena.centers_at(0), CAMERA, RANGE_M, place, attitude)
    return obstacle_distance(depth_to_z16(depth), CAMERA, RANGE_M, attitude, 0.0, 7)


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (12.0, -10.0)])
@pytest.mark.parametrize("bearing_deg", [-32.5, 2.5, 27.5])
def test_a_post_is_told_where_it_is(bearing_deg: float, roll: float, pitch: float) -> None:
    yaw, away_m = 40.0, 8.0
    angle = math.radians(yaw + bearing_deg)
    told = seen(away_m * math.cos(angle), away_m * math.sin(angle), roll, pitch, yaw)
    middle = told["angle_offset"] + told["increment_f"] * np.arange(18)
    nearest = int(np.argmin(told["distances"][:18]))
    assert middle[nearest] == pytest.approx(bearing_deg, abs=0.1)
    # The post has a radius of 0.5 m.
    assert told["distances"][nearest] == pytest.approx(750, abs=8)
    aside = np.abs(middle - bearing_deg) > 10.0
    assert set(np.array(told["distances"][:18])[aside]) == {2001}
    assert set(told["distances"][18:]) == {UNKNOWN_CM}


def test_the_flight_controller_s_map_has_it_there() -> None:
    """Through MAVLink, by name, as the companion's MAVSDK sends it."""
    told = seen(6.0, 0.0, yaw=-30.0)
    rig = mavlink_clients.Rig()
    fields = {**told, "distances": list(told["distances"])}
    rig.client.send(dialect.MAVLink_obstacle_distance_message(**fields))
    rig.bench.tick()
    (heard,) = rig.autopilot.obstacles
    found = ObstacleMap()
    found.take(heard, 1.0)
    known = np.flatnonzero(found.distances_cm < UNKNOWN_CM)
    assert set(known) <= {*range(10), *range(62, 72)}
    # 30 degrees to the right of the nose, on the edge of two bins of the message.
    near = np.flatnonzero(found.distances_cm < 700)
    np.testing.assert_array_equal(near, [5, 6])
    assert found.distances_cm.min() == pytest.approx(550, abs=8)


class Link:
    """Link that records sent messages and reports an attitude."""

    def __init__(self) -> None:
        self.sent: list[Mapping[str, Any]] = []
        self.attitude = LEVEL
        self.told = threading.Event()

    def kinematics(self) -> Kinematics:
        return Kinematics(np.zeros(3), np.zeros(3), self.attitude)

    def send_message(self, name: str, fields: Mapping[str, Any]) -> bool:
        assert name == "OBSTACLE_DISTANCE"
        self.sent.append(fields)
        self.told.set()
        return True


class Frames:
    """Camera with an image of a given reception time."""

    def __init__(self, received_us: int) -> None:
        depth: NDArray[np.uint16] = np.full((192, 256), 3000, np.uint16)
        self.frame = ReceivedFrame(Frame(1, 0, depth, CAMERA), received_us)
        self.users = 0

    def latest(self) -> ReceivedFrame | None:
        self.users += 1
        assert self.users == 1, "one thread at a time"
        self.users -= 1
        return self.frame

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        del timeout_s
        found = self.latest()
        return found if newer_than_sequence != 1 else None


def test_it_tells_for_as_long_as_images_come() -> None:
    clock, link = WallClock(), Link()
    with obstacles_told(link, SharedFrames(Frames(0)), RANGE_M, 0.0, clock):
        assert link.told.wait(10.0)
    assert min(link.sent[0]["distances"]) == pytest.approx(300, abs=1)
    stale, silent = Link(), Link()
    silent.attitude = np.full(4, np.nan)
    with (
        obstacles_told(stale, Frames(-1_000_000), RANGE_M, 0.0, clock),
        obstacles_told(silent, Frames(clock.time_us()), RANGE_M, 0.0, clock),
    ):
        assert not stale.told.wait(0.3)
    assert silent.sent == []


def test_a_shared_camera_is_used_by_one_thread_at_a_time() -> None:
    shared, ended = SharedFrames(Frames(0)), threading.Event()

    def look() -> None:
        while not ended.is_set():
            shared.latest()

    thread = threading.Thread(target=look)
    thread.start()
    for _ in range(50):
        assert shared.wait(-1, 0.1) is not None
    assert shared.wait(1, 0.05) is None
    ended.set()
    thread.join()


def test_only_depth_says_how_far_obstacles_are() -> None:
    asked = StandAloneCompanion(tell_obstacles=True, vehicle="quad-rgb", policy="greedy")
    with pytest.raises(FieldError, match="tell_obstacles"):
        prepare(asked)
