"""Rules of the companion's limits, at their bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.policy.observation import Kinematics
from airl_mav.scenario.model import LimitSettings, PilotSettings
from companion.frame_source import ReceivedFrame
from companion.limits import (
    BATTERY_LOW,
    CAMERA_WRONG,
    CLIMB_M,
    DISARMED,
    MODE_KNOWN_S,
    OUT_OF_TIME,
    TAKEN_OVER,
    CameraLimits,
    VehicleLimits,
    ground_in_view,
)
from companion.link_interface import FRAMES_LATE, TELEMETRY_FROZEN, VehicleStatus

LENS = Intrinsics.from_fov(8, 6, math.radians(90.0))
SETTINGS = LimitSettings(silence_s=1.0)


def state(*, height_m: float = 2.5, q: Any = (1.0, 0.0, 0.0, 0.0)) -> Kinematics:
    return Kinematics(np.array([0.0, 0.0, -height_m]), np.zeros(3), np.array(q))


def turned(axis: int, rad: float) -> tuple[float, ...]:
    q = [math.cos(0.5 * rad), 0.0, 0.0, 0.0]
    q[1 + axis] = math.sin(0.5 * rad)
    return tuple(q)


class Camera:
    """Camera whose images always change; stamps are given."""

    def __init__(self) -> None:
        self.limits = CameraLimits(SETTINGS, (0.0, 0.0))
        self.sequence = 0

    def see(self, captured_s: float, received_s: float, sequence: int | None = None) -> str | None:
        self.sequence = self.sequence + 1 if sequence is None else sequence
        image = np.full((6, 8), 700, np.uint16)
        image[0, 0] = 100 + self.sequence % 500
        frame = Frame(self.sequence, round(captured_s * US_PER_S), image, LENS)
        received = round(received_s * US_PER_S)
        found = self.limits.broken(ReceivedFrame(frame, received), state(), received)
        return None if found is None else found.reason


def test_frames_of_the_own_clock_are_as_old_as_they_are() -> None:
    camera = Camera()
    assert camera.see(0.0, 0.9) is None
    assert camera.see(0.1, 1.1) is None
    assert camera.see(0.2, 1.3) == FRAMES_LATE


@pytest.mark.parametrize("offset_s", [-1000.0, 1000.0])
def test_frames_of_another_clock_are_as_old_as_the_newest_was(offset_s: float) -> None:
    camera = Camera()
    assert camera.see(offset_s, 0.5) is None
    assert camera.see(offset_s + 0.1, 1.4) is None
    # The least age so far counts: 0.2 s less than at first.
    assert camera.see(offset_s + 1.2, 1.5) is None
    assert camera.see(offset_s + 1.3, 2.5) is None
    assert camera.see(offset_s + 1.4, 2.9) == FRAMES_LATE


def test_a_stamp_that_jumps_is_no_late_frame() -> None:
    camera = Camera()
    assert camera.see(0.0, 0.1) is None
    assert camera.see(5.0, 0.2) == CAMERA_WRONG
    camera = Camera()
    assert camera.see(10.0, 10.1) is None
    assert camera.see(8.0, 10.2) == CAMERA_WRONG


def test_a_camera_that_restarts_has_new_stamps() -> None:
    camera = Camera()
    assert camera.see(0.0, 0.1, sequence=70) is None
    assert camera.see(500.0, 0.2, sequence=0) is None
    assert camera.see(500.1, 0.3, sequence=1) is None
    # The same number again is no restart.
    assert camera.see(900.0, 0.4, sequence=1) == CAMERA_WRONG


def test_one_pixel_makes_an_image_uneven() -> None:
    """A frozen image that is even counts as blank; one other pixel makes it frozen."""
    for pixel in ((0, 0), (0, 1), (1, 0), (1, 1), (5, 7)):
        limits = CameraLimits(LimitSettings(silence_s=1.0, image_s=0.5), (0.0, 0.0))
        image = np.full((6, 8), 700, np.uint16)
        image[pixel] = 701
        reasons = []
        for k in range(9):
            frame = Frame(k, k * 100_000, image, LENS)
            found = limits.broken(ReceivedFrame(frame, k * 100_000), state(), k * 100_000)
            reasons.append(found.reason if found else None)
        assert reasons[:6] == [None] * 6
        assert reasons[6] is not None


def looks_down(**more: Any) -> bool:
    mount = more.pop("mount", (0.0, 0.0))
    return ground_in_view(Frame(0, 0, np.zeros((6, 8), np.uint16), LENS), state(**more), *mount)


def test_ground_is_in_view_of_a_low_camera_that_looks_down() -> None:
    assert looks_down()
    assert not looks_down(height_m=0.0)
    assert not looks_down(height_m=-1.0)
    assert not looks_down(height_m=1000.0)
    # The lens reaches nearly 40 degrees down: the nose up by more, and it sees sky.
    assert not looks_down(q=turned(1, math.radians(50.0)))
    assert looks_down(q=turned(1, math.radians(-20.0)))
    assert not looks_down(mount=(math.radians(50.0), 0.0))
    assert looks_down(mount=(math.radians(-20.0), 0.0))


def test_a_camera_to_the_side_rises_with_the_roll() -> None:
    right, left = math.radians(90.0), math.radians(-90.0)
    # Positive roll: the right side down, the left side up.
    roll = turned(0, math.radians(50.0))
    assert looks_down(q=roll, mount=(0.0, right))
    assert not looks_down(q=roll, mount=(0.0, left))
    back = turned(0, math.radians(-50.0))
    assert not looks_down(q=back, mount=(0.0, right))
    assert looks_down(q=back, mount=(0.0, left))
    # The roll is no pitch of a camera ahead, and a heading changes nothing.
    assert looks_down(q=roll)
    for heading in (0.5, 1.5, 3.0):
        assert looks_down(q=turned(2, heading))
        c, s = math.cos(0.5 * heading), math.sin(0.5 * heading)
        up_c, up_s = math.cos(math.radians(25.0)), math.sin(math.radians(25.0))
        # Heading, then nose up by 50 degrees.
        assert not looks_down(q=(c * up_c, -s * up_s, c * up_s, s * up_c))
        # Heading, then roll to the right by 50 degrees.
        rolled = (c * up_c, c * up_s, s * up_s, s * up_c)
        assert looks_down(q=rolled, mount=(0.0, right))
        assert not looks_down(q=rolled, mount=(0.0, left))


def vehicle(**settings: Any) -> VehicleLimits:
    return VehicleLimits(LimitSettings(**settings), (25.0, 0.0), PilotSettings(altitude_m=2.5))


def test_a_mode_that_was_seen_is_believed_at_once() -> None:
    limits = vehicle()
    ours = VehicleStatus(armed=True, offboard=True, mode="offboard")
    off = VehicleStatus(armed=False, offboard=True, mode="offboard")
    other = VehicleStatus(armed=True, offboard=False, mode="hold")
    # Neither has been reported yet.
    for status in (off, other):
        fresh = vehicle()
        assert fresh.not_ours(status, 100_000) is None
    late_us = round(MODE_KNOWN_S * US_PER_S)
    for status, reason in ((off, DISARMED), (other, TAKEN_OVER)):
        fresh = vehicle()
        assert fresh.not_ours(status, late_us) is None
        found = fresh.not_ours(status, late_us + 1)
        assert found is not None
        assert found.reason == reason
        again = vehicle()
        again.begun_us = 5_000_000
        assert again.not_ours(status, late_us + 5_000_000) is None
    assert limits.not_ours(ours, 0) is None
    for status, reason in ((off, DISARMED), (other, TAKEN_OVER)):
        found = limits.not_ours(status, 1)
        assert found is not None
        assert found.reason == reason


def test_a_charge_at_its_limit_is_enough() -> None:
    settings = {"battery": 0.25}
    for charge, ends in ((0.25, False), (0.2499, True), (None, True), (1.0, False)):
        status = VehicleStatus(True, True, "offboard", battery=charge)
        found = vehicle(**settings).broken(status, state(), 0)
        assert (found is not None) == ends
        assert found is None or found.reason == BATTERY_LOW
    assert vehicle().broken(VehicleStatus(True, True, "offboard"), state(), 0) is None


def test_telemetry_may_be_the_same_for_a_while() -> None:
    limits, status = vehicle(silence_s=1.0), VehicleStatus(True, True, "offboard")
    reasons = []
    for now_us in (0, 200_000, 400_000, 2_100_000):
        found = limits.broken(status, state(), now_us)
        reasons.append(found.reason if found else None)
    assert reasons == [None, None, None, TELEMETRY_FROZEN]


def test_the_time_of_a_flight_counts_from_its_start() -> None:
    limits, status = vehicle(flight_s=10.0), VehicleStatus(True, True, "offboard")
    limits.begun_us = 3_000_000
    reasons = []
    for t_s in np.arange(3.0, 13.9, 0.4):
        # As from an estimator: no value stays the same.
        still, noise = state(), 1e-4 * math.sin(t_s)
        now = Kinematics(still.position + noise, still.velocity + noise, still.quaternion + noise)
        found = limits.broken(status, now, round(t_s * US_PER_S))
        reasons.append(found.reason if found else None)
    assert reasons[:-2] == [None] * (len(reasons) - 2)
    assert reasons[-2:] == [OUT_OF_TIME] * 2


@pytest.mark.parametrize("check_s", [0.1, 1.3])
def test_a_vehicle_that_looks_left_and_right_is_believed(check_s: float) -> None:
    limits, status = vehicle(silence_s=3.0), VehicleStatus(True, True, "offboard")
    for t_s in np.arange(0.0, 20.0, check_s):
        still, noise = state(), 1e-4 * math.sin(7.0 * t_s)
        attitude = np.array(turned(2, 1.5 * math.sin(3.0 * t_s)))
        rates = np.array([noise, -noise, 4.5 * math.cos(3.0 * t_s)])
        now = Kinematics(still.position + noise, still.velocity + noise, attitude, rates)
        assert limits.broken(status, now, round(t_s * US_PER_S)) is None


@pytest.mark.parametrize("braking", [False, True])
def test_an_acceleration_that_the_tilt_explains_is_believed(braking: bool) -> None:
    limits, status, sign = (
        vehicle(),
        VehicleStatus(True, True, "offboard"),
        -1.0 if braking else 1.0,
    )
    acceleration = sign * 3.0
    tilt = np.array(turned(1, -math.atan(acceleration / GRAVITY_M_S2)))
    start_m_s = 4.5 if braking else 0.0
    for t_s in np.arange(0.0, 1.51, 0.1):
        noise = 1e-4 * math.sin(7.0 * t_s)
        north_m = start_m_s * t_s + 0.5 * acceleration * t_s**2
        position = np.array([north_m, 0.0, -2.5]) + noise
        velocity = np.array([start_m_s + acceleration * t_s, 0.0, 0.0]) + noise
        now = Kinematics(position, velocity, tilt + noise, np.full(3, noise))
        assert limits.broken(status, now, round(t_s * US_PER_S)) is None


@pytest.mark.parametrize(
    ("speed", "late_s", "ends"),
    [(1.0, 0.9, 0), (1.0, 1.0, 0), (1.0, 1.000001, 1), (8.0, 1.9, 0)],
)
def test_stamps_may_be_late_by_a_second_of_the_host(speed: float, late_s: float, ends: int) -> None:
    status = VehicleStatus(True, True, "offboard")
    limits = VehicleLimits(LimitSettings(), (25.0, 0.0), PilotSettings(altitude_m=2.5), speed)
    found = None
    for k in range(10):
        now_s = 0.1 * k + (late_s if k == 9 else 0.0)
        still = state()
        noise = 1e-4 * k
        now = Kinematics(still.position + noise, still.velocity + noise, still.quaternion + noise)
        stamped = replace(now, time_us=round(0.1 * k * US_PER_S) + 1)
        found = limits.broken(status, stamped, round(now_s * US_PER_S))
    assert (found is not None) == ends


def test_a_low_flight_has_a_low_ceiling() -> None:
    for altitude_m in (0.6, 2.5):
        pilot = PilotSettings(altitude_m=altitude_m)
        limits = VehicleLimits(LimitSettings(), (25.0, 0.0), pilot)
        assert limits.height_m == pytest.approx(altitude_m + CLIMB_M)
