"""Detection of false flight controller and camera data, its delay, and no false alarms.

The correct flight is a closed form: a circle with a gentle climb, seen by a camera over level
ground. Every falsification changes a single reported value from a given time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import US_PER_S
from airl_mav.policy.observation import Kinematics
from airl_mav.profiles.projections import CameraKind
from airl_mav.scenario.model import LimitSettings, PilotSettings
from companion.frame_source import ReceivedFrame
from companion.limits import (
    BATTERY_LOW,
    CAMERA_FROZEN,
    CAMERA_WRONG,
    DISARMED,
    OUT_OF_BOUNDS,
    OUT_OF_TIME,
    TAKEN_OVER,
    TELEMETRY_WRONG,
    Ending,
    Limits,
    VehicleLimits,
    ground_in_view,
)
from companion.link_interface import FRAMES_LATE, TELEMETRY_FROZEN, VehicleStatus

LENS = Intrinsics.from_fov(8, 6, math.radians(90.0))
OURS = VehicleStatus(armed=True, offboard=True, mode="offboard")
SPEED_M_S, RADIUS_M, HEIGHT_M = 4.0, 10.0, 2.5
GOAL = (25.0, 0.0)
PILOT = PilotSettings(altitude_m=HEIGHT_M)
PERIODS_S = (0.1, 0.5, 1.5)
"""Between two looks: a fast policy; hold time 0.5 s; 949 ms late besides."""


@dataclass(frozen=True)
class Told:
    """Data received by the companion at a time."""

    state: Kinematics
    frame: Frame
    received_us: int
    status: VehicleStatus = OURS

    def moved(self, **changes: np.ndarray) -> Told:
        return replace(self, state=replace(self.state, **changes))

    def seen(self, **changes: Any) -> Told:
        return replace(self, frame=replace(self.frame, **changes))


def honest(t_s: float) -> Told:
    """Return correct data: a circle to the right at 4 m/s, and images over level ground."""
    angle = SPEED_M_S / RADIUS_M * t_s
    position = np.array(
        [RADIUS_M * math.sin(angle), RADIUS_M * (1.0 - math.cos(angle)), -HEIGHT_M - 0.01 * t_s]
    )
    velocity = np.array([SPEED_M_S * math.cos(angle), SPEED_M_S * math.sin(angle), -0.01])
    attitude = np.array([math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)])
    rows = np.arange(1, 7, dtype=np.uint16)[:, None] * np.full((1, 8), 700, np.uint16)
    time_us = round(t_s * US_PER_S)
    frame = Frame(round(30 * t_s), time_us, rows + np.uint16(round(10 * t_s) % 500), LENS)
    return Told(Kinematics(position, velocity, attitude), frame, time_us + 5000)


Lie = Callable[[Told, Told, float], Told]
"""Map from correct data, correct data at onset and time since onset [s] to received data."""


def of_state(name: str, change: Callable[[np.ndarray, np.ndarray, float], np.ndarray]) -> Lie:
    def told(now: Told, then: Told, s: float) -> Told:
        values = change(getattr(now.state, name), getattr(then.state, name), s)
        return now.moved(**{name: values})

    return told


def of_depth(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Lie:
    return lambda now, then, s: now.seen(image=change(now.frame.image, then.frame.image))


def later(seconds: Callable[[float], float]) -> Lie:
    """Frames that are older than they should be."""
    return lambda now, then, s: now.seen(
        capture_time_us=now.frame.capture_time_us - round(seconds(s) * US_PER_S)
    )


def mode(name: str) -> Lie:
    return lambda now, then, s: replace(now, status=VehicleStatus(True, False, name))


def one(values: np.ndarray, index: int, value: float) -> np.ndarray:
    out = values.copy()
    out[index] = value
    return out


NORTH = np.array([1.0, 0.0, 0.0])


def as_then(now: np.ndarray, then: np.ndarray, s: float) -> np.ndarray:
    return then


def spoilt(name: str, index: int, value: float) -> Lie:
    return of_state(name, lambda now, then, s: one(now, index, value))


LIES: dict[str, tuple[Lie, str, float]] = {
    **{
        f"{name} {word} {index}": (spoilt(name, index, value), TELEMETRY_WRONG, 0.0)
        for name in ("position", "velocity", "quaternion")
        for word, value in (("nan", math.nan), ("infinite", math.inf))
        for index in (0, 2)
    },
    "position frozen": (of_state("position", as_then), TELEMETRY_FROZEN, 2.0),
    "velocity frozen": (of_state("velocity", as_then), TELEMETRY_FROZEN, 2.0),
    "attitude frozen": (of_state("quaternion", as_then), TELEMETRY_FROZEN, 2.0),
    "all frozen": (lambda now, then, s: replace(now, state=then.state), TELEMETRY_FROZEN, 2.0),
    "position jumps": (of_state("position", lambda n, t, s: n + 20 * NORTH), TELEMETRY_WRONG, 0.0),
    "position far off": (
        of_state("position", lambda n, t, s: n + 1e6 * NORTH),
        TELEMETRY_WRONG,
        0.0,
    ),
    "position runs away": (
        of_state("position", lambda n, t, s: n + 6.0 * s * NORTH),
        TELEMETRY_WRONG,
        8.0,
    ),
    "position mirrored": (of_state("position", lambda n, t, s: -n), TELEMETRY_WRONG, 8.0),
    "position nearly frozen": (
        of_state("position", lambda n, t, s: t + 0.01 * (n - t)),
        TELEMETRY_WRONG,
        15.0,
    ),
    "velocity absurd": (of_state("velocity", lambda n, t, s: 10.0 * n), TELEMETRY_WRONG, 0.0),
    "velocity mirrored": (of_state("velocity", lambda n, t, s: -n), TELEMETRY_WRONG, 8.0),
    "attitude zero": (of_state("quaternion", lambda n, t, s: 0.0 * n), TELEMETRY_WRONG, 0.0),
    "attitude doubled": (of_state("quaternion", lambda n, t, s: 2.0 * n), TELEMETRY_WRONG, 0.0),
    "too high": (
        of_state("position", lambda n, t, s: n - np.array([0, 0, 3 * s])),
        OUT_OF_BOUNDS,
        6.0,
    ),
    "hold": (mode("hold"), TAKEN_OVER, 0.0),
    "return": (mode("return to launch"), TAKEN_OVER, 0.0),
    "land": (mode("land"), TAKEN_OVER, 0.0),
    "sticks": (mode("posctl"), TAKEN_OVER, 0.0),
    "disarmed": (
        lambda now, then, s: replace(now, status=VehicleStatus(False, True, "offboard")),
        DISARMED,
        0.0,
    ),
    "image frozen": (of_depth(lambda now, then: then), CAMERA_FROZEN, 0.5),
    "frame frozen, old stamp": (
        lambda now, then, s: replace(now, frame=replace(then.frame, sequence=now.frame.sequence)),
        CAMERA_FROZEN,
        0.5,
    ),
    "all zero": (of_depth(lambda now, then: 0 * now), CAMERA_WRONG, 2.0),
    "all far": (of_depth(lambda now, then: 0 * now + 65535), CAMERA_WRONG, 2.0),
    "all near": (of_depth(lambda now, then: 0 * now + 300), CAMERA_WRONG, 2.0),
    "stamps years ahead": (later(lambda s: -1e8), CAMERA_WRONG, 0.0),
    "stamps years old": (later(lambda s: 1e8), CAMERA_WRONG, 0.0),
    "stamps of another clock": (later(lambda s: -30.0), CAMERA_WRONG, 0.0),
    "frames ever later": (later(lambda s: 0.5 * s), FRAMES_LATE, 4.5),
    "focal length nan": (
        lambda now, then, s: now.seen(intrinsics=replace(LENS, focal=math.nan)),
        CAMERA_WRONG,
        0.0,
    ),
    "another lens": (
        lambda now, then, s: now.seen(intrinsics=replace(LENS, focal=2.0 * LENS.focal)),
        CAMERA_WRONG,
        0.0,
    ),
    "another size": (
        lambda now, then, s: now.seen(
            intrinsics=Intrinsics.from_fov(4, 3, 1.5), image=np.ones((3, 4), np.uint16)
        ),
        CAMERA_WRONG,
        0.0,
    ),
}
"""Each: the lie, why the flight ends, and how long it may go unnoticed [s], one look apart."""


def fly(
    told: Callable[[float], Told], period_s: float, seconds: float, settings: LimitSettings
) -> tuple[Ending | None, float]:
    """Look until a limit is broken; return it and when [s]."""
    limits = Limits(settings, GOAL, PILOT)
    limits.begin(0)
    steps = round(seconds / period_s)
    for step in range(steps):
        t_s = (step + 1) * period_s
        now = told(t_s)
        seen = ReceivedFrame(now.frame, now.received_us)
        ending = limits.broken(now.status, now.state, seen, now.received_us)
        if ending is not None:
            assert limits.ending is ending
            return ending, t_s
    return None, seconds


@pytest.mark.parametrize(
    ("charge", "detail"),
    [
        (lambda t_s: 0.5 - 0.01 * t_s, "30 %; at least 30 %"),
        (
            lambda t_s: None if t_s > 19.99 else 0.5,
            "the flight controller does not tell its charge",
        ),
    ],
)
def test_the_battery_is_looked_at_where_that_is_asked_for(
    charge: Callable[[float], float | None], detail: str
) -> None:
    def told(t_s: float) -> Told:
        return replace(honest(t_s), status=OURS._replace(battery=charge(t_s)))

    ending, at_s = fly(told, 0.1, 30.0, LimitSettings(battery=0.3))
    assert ending == (BATTERY_LOW, detail)
    assert at_s == pytest.approx(20.05, abs=0.06)
    assert fly(told, 0.1, 30.0, LimitSettings())[0] is None


@pytest.mark.parametrize("period_s", PERIODS_S)
@pytest.mark.parametrize("name", LIES)
def test_a_lie_ends_the_flight_in_time(name: str, period_s: float) -> None:
    lie, reason, within_s = LIES[name]
    for begun_s in (4.0, 7.3, 11.9, 20.2):
        then = honest(begun_s)

        def told(t_s: float, begun_s: float = begun_s, then: Told = then) -> Told:
            now = honest(t_s)
            return now if t_s < begun_s else lie(now, then, t_s - begun_s)

        ending, at_s = fly(told, period_s, 60.0, LimitSettings())
        assert ending is not None
        assert ending.reason == reason, str(ending)
        # A value that stays the same is known to from the look after the one that it began with.
        assert begun_s <= at_s <= begun_s + within_s + 2.0 * period_s + 1e-6


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_an_honest_flight_goes_on(period_s: float) -> None:
    assert fly(honest, period_s, 300.0, LimitSettings()) == (None, 300.0)


def test_noise_resets_and_a_camera_with_another_clock_are_believed() -> None:
    rng = np.random.default_rng(1)

    def told(t_s: float) -> Told:
        now = honest(t_s)
        reset = 3.0 * NORTH if t_s > 20.0 else 0.0
        now = now.moved(
            position=now.state.position + rng.normal(0, 0.3, 3) + reset,
            velocity=now.state.velocity + rng.normal(0, 0.3, 3),
        )
        # Stamped by a clock that began a year ago, up to half a second late.
        stamp = now.frame.capture_time_us - 31_536_000 * US_PER_S
        return now.seen(capture_time_us=stamp - int(rng.integers(0, US_PER_S // 2)))

    assert fly(told, 0.5, 300.0, LimitSettings())[0] is None


def test_a_mode_that_is_reported_late_is_waited_for() -> None:
    """The heartbeat that shows offboard comes up to a second after the switch."""

    def told(t_s: float) -> Told:
        return mode("takeoff")(honest(t_s), honest(t_s), 0.0) if t_s < 1.05 else honest(t_s)

    assert fly(told, 0.1, 20.0, LimitSettings())[0] is None
    never = fly(lambda t_s: mode("hold")(honest(t_s), honest(t_s), 0.0), 0.1, 20.0, LimitSettings())
    assert never[0] == Ending(TAKEN_OVER, "the mode is hold")
    assert never[1] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"radius_m": 15.0}, OUT_OF_BOUNDS),
        ({"height_m": 2.6}, OUT_OF_BOUNDS),
        ({"flight_s": 20.0}, OUT_OF_TIME),
    ],
)
def test_it_flies_no_farther_higher_or_longer_than_asked(
    limits: dict[str, float], reason: str
) -> None:
    ending, _ = fly(honest, 0.5, 60.0, LimitSettings(**limits))
    assert ending is not None
    assert ending.reason == reason


def test_only_what_must_be_ground_is_missed() -> None:
    """An empty sky is no lie, nor is nothing in reach of a camera that looks up or flies high."""
    frame, level = honest(0.0).frame, honest(0.0).state
    down_rad = math.atan2(2.5, LENS.focal)
    assert ground_in_view(frame, level, 0.0)
    assert not ground_in_view(frame, level, down_rad)
    # Pitched up to where the lowest ray is level.
    braking = np.array([math.cos(0.5 * down_rad), 0.0, math.sin(0.5 * down_rad), 0.0])
    assert not ground_in_view(frame, replace(level, quaternion=braking), 0.0)
    assert not ground_in_view(frame, replace(level, position=np.array([0.0, 0.0, -9.9])), 0.0)
    assert ground_in_view(frame, replace(level, position=np.array([0.0, 0.0, -5.0])), 0.0)


# --- colour


def colour(
    kind: CameraKind, shows: Callable[[float], NDArray[np.uint8]]
) -> Callable[[float], Told]:
    """Return an honest flight with a colour camera that shows a picture over time."""
    lens = replace(LENS, kind=kind)
    return lambda t_s: honest(t_s).seen(image=shows(t_s), intrinsics=lens)


def scene(t_s: float, kind: CameraKind = "rgb") -> NDArray[np.uint8]:
    """Return a picture that moves on."""
    lens = replace(LENS, kind=kind)
    pixels = np.arange(math.prod(lens.shape)) + round(30 * t_s)
    return (pixels % 251).astype(np.uint8).reshape(lens.shape)


@pytest.mark.parametrize("kind", ["rgb", "grey"])
@pytest.mark.parametrize(
    ("shows", "ending"),
    [
        (lambda t_s, kind: scene(t_s, kind), None),
        (lambda t_s, kind: scene(min(t_s, 4.0), kind), CAMERA_FROZEN),
        (lambda t_s, kind: np.zeros_like(scene(t_s, kind)), CAMERA_WRONG),
        (lambda t_s, kind: np.full_like(scene(t_s, kind), 255), CAMERA_WRONG),
        # A wall without texture that fills the picture.
        (lambda t_s, kind: np.full_like(scene(t_s, kind), 120), None),
    ],
    ids=["moving", "frozen", "black", "white", "wall"],
)
def test_pictures_of_a_colour_camera(
    kind: CameraKind, shows: Callable[[float, CameraKind], NDArray[np.uint8]], ending: str | None
) -> None:
    found, at_s = fly(colour(kind, lambda t_s: shows(t_s, kind)), 0.1, 12.0, LimitSettings())
    assert (None if found is None else found.reason) == ending
    if found is not None and ending == CAMERA_WRONG:
        assert "of 255, and the ground must be in view" in found.detail
        assert at_s == pytest.approx(2.2, abs=0.15)


def test_another_kind_of_image_is_another_camera() -> None:
    def told(t_s: float) -> Told:
        return honest(t_s) if t_s < 3.0 else colour("rgb", scene)(t_s)

    found, at_s = fly(told, 0.1, 12.0, LimitSettings())
    assert found is not None
    assert found.reason == CAMERA_WRONG
    assert at_s == pytest.approx(3.0, abs=0.11)


def test_a_high_goal_lifts_the_height_limit() -> None:
    """10 m above the altitude that is flown, or above the goal where that is higher."""
    level = VehicleLimits(LimitSettings(), (20.0, 0.0), PILOT)
    low = VehicleLimits(LimitSettings(), (20.0, 0.0, -1.0), PILOT)
    high = VehicleLimits(LimitSettings(), (20.0, 0.0, -14.0), PILOT)
    assert level.height_m == low.height_m == PILOT.altitude_m + 10.0
    assert high.height_m == 24.0
    assert level.radius_m == high.radius_m == 2.0 * 20.0 + 50.0
    asked = VehicleLimits(LimitSettings(height_m=6.0), (20.0, 0.0, -14.0), PILOT)
    assert asked.height_m == 6.0
