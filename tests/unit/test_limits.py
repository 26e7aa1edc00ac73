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
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S, CommandKind
from airl_mav.core.frames import quat_from_euler, quat_to_euler
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
    with_time_limit,
)
from companion.link_interface import FRAMES_LATE, TELEMETRY_FROZEN, VehicleStatus

LENS = Intrinsics.from_fov(8, 6, math.radians(90.0))
OURS = VehicleStatus(armed=True, offboard=True, mode="offboard")
SPEED_M_S, RADIUS_M, HEIGHT_M = 4.0, 10.0, 2.5
BANK_RAD = math.atan(SPEED_M_S**2 / RADIUS_M / GRAVITY_M_S2)
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

    def moved(self, **changes: Any) -> Told:
        return replace(self, state=replace(self.state, **changes))

    def seen(self, **changes: Any) -> Told:
        return replace(self, frame=replace(self.frame, **changes))


def honest(t_s: float) -> Told:
    """Return correct data: a circle to the right at 4 m/s, and images over level ground.

    The bank angle gives the centripetal acceleration; the height sways by 20 cm.
    """
    turn_rad_s = SPEED_M_S / RADIUS_M
    angle = turn_rad_s * t_s
    position = np.array(
        [
            RADIUS_M * math.sin(angle),
            RADIUS_M * (1.0 - math.cos(angle)),
            -HEIGHT_M - 0.2 * math.sin(t_s),
        ]
    )
    velocity = np.array(
        [SPEED_M_S * math.cos(angle), SPEED_M_S * math.sin(angle), -0.2 * math.cos(t_s)]
    )
    attitude, rates = banked(BANK_RAD, angle, turn_rad_s, t_s)
    rows = np.arange(1, 7, dtype=np.uint16)[:, None] * np.full((1, 8), 700, np.uint16)
    time_us = round(t_s * US_PER_S)
    frame = Frame(round(30 * t_s), time_us, rows + np.uint16(round(10 * t_s) % 500), LENS)
    return Told(Kinematics(position, velocity, attitude, rates), frame, time_us + 5000)


def banked(
    roll: float, yaw: float, turn_rad_s: float, t_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return attitude and body rates of a level turn, with a sway of a milliradian."""
    roll += 1e-3 * math.sin(3.0 * t_s)
    rates = np.array([3e-3 * math.cos(3.0 * t_s), math.sin(roll), math.cos(roll)])
    return quat_from_euler(roll, 0.0, yaw), rates * np.array([1.0, turn_rad_s, turn_rad_s])


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
    """Frames with an additional delay."""
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


def held(name: str, index: int) -> Lie:
    return of_state(name, lambda now, then, s: one(now, index, then[index]))


def shifted(name: str, index: int, by: Callable[[float], float]) -> Lie:
    return of_state(name, lambda now, then, s: one(now, index, now[index] + by(s)))


def creep(s: float) -> float:
    return s


TEN_TURNS = 20.0 * math.pi


def turned(by: Callable[[float], tuple[float, float, float]]) -> Lie:
    """An attitude that is turned by roll, pitch and yaw [rad]."""

    def change(now: np.ndarray, then: np.ndarray, s: float) -> np.ndarray:
        return quat_from_euler(*(np.array(quat_to_euler(now)) + by(s)))

    return of_state("quaternion", change)


def heading_held(now: Told, then: Told, s: float) -> Told:
    """Roll and pitch continue; the heading stays."""
    roll, pitch, _ = quat_to_euler(now.state.quaternion)
    heading = quat_to_euler(then.state.quaternion).yaw
    return now.moved(quaternion=quat_from_euler(roll, pitch, heading))


def climbing(down_m_s: float) -> Lie:
    """A climb in position and velocity."""

    def told(now: Told, then: Told, s: float) -> Told:
        down = np.array([0.0, 0.0, down_m_s])
        return now.moved(position=now.state.position + s * down, velocity=now.state.velocity + down)

    return told


LIES: dict[str, tuple[Lie, str, float]] = {
    **{
        f"{name} {word} {index}": (spoilt(name, index, value), TELEMETRY_WRONG, 0.0)
        for name in ("position", "velocity", "quaternion")
        for word, value in (("nan", math.nan), ("infinite", math.inf))
        for index in (0, 2)
    },
    **{
        f"only {name} frozen": (of_state(name, as_then), TELEMETRY_WRONG, 1.0)
        for name in ("position", "velocity", "quaternion", "rates")
    },
    **{
        f"only {name} {index} frozen": (held(name, index), TELEMETRY_WRONG, 1.0)
        for name in ("position", "velocity", "rates")
        for index in range(3)
    },
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
        0.5,
    ),
    **{
        f"position {index} creeps 1 m/s": (shifted("position", index, creep), TELEMETRY_WRONG, 4.6)
        for index in range(3)
    },
    "position mirrored": (of_state("position", lambda n, t, s: -n), TELEMETRY_WRONG, 0.5),
    "height 100 m up": (shifted("position", 2, lambda s: -100.0), TELEMETRY_WRONG, 0.0),
    "height 100 m down": (shifted("position", 2, lambda s: 100.0), TELEMETRY_WRONG, 0.0),
    "climb without vertical velocity": (
        shifted("position", 2, lambda s: -3.0 * s),
        TELEMETRY_WRONG,
        0.5,
    ),
    "vertical velocity without climb": (
        shifted("velocity", 2, lambda s: -3.0),
        TELEMETRY_WRONG,
        3.0,
    ),
    "upside down": (turned(lambda s: (math.pi, 0.0, 0.0)), TELEMETRY_WRONG, 0.5),
    "ten turns a second": (shifted("rates", 2, lambda s: TEN_TURNS), TELEMETRY_WRONG, 0.0),
    "body rate nan": (spoilt("rates", 0, math.nan), TELEMETRY_WRONG, 0.0),
    "position nearly frozen": (
        of_state("position", lambda n, t, s: t + 0.01 * (n - t)),
        TELEMETRY_WRONG,
        5.0,
    ),
    "velocity absurd": (of_state("velocity", lambda n, t, s: 10.0 * n), TELEMETRY_WRONG, 0.0),
    "velocity mirrored": (of_state("velocity", lambda n, t, s: -n), TELEMETRY_WRONG, 0.5),
    "attitude zero": (of_state("quaternion", lambda n, t, s: 0.0 * n), TELEMETRY_WRONG, 0.0),
    "attitude doubled": (of_state("quaternion", lambda n, t, s: 2.0 * n), TELEMETRY_WRONG, 0.0),
    "too high": (climbing(-3.0), OUT_OF_BOUNDS, 4.0),
    "too low": (climbing(3.0), OUT_OF_BOUNDS, 5.0),
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
"""False telemetry, reason of the ending, and maximum time to detection [s], plus one check."""


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
    if "creeps" in name and period_s > 1.0:
        pytest.skip("checks at less than 1.4 Hz have wider bounds")
    for begun_s in (4.0, 7.3, 11.9, 20.2):
        then = honest(begun_s)

        def told(t_s: float, begun_s: float = begun_s, then: Told = then) -> Told:
            now = honest(t_s)
            return now if t_s < begun_s else lie(now, then, t_s - begun_s)

        ending, at_s = fly(told, period_s, 60.0, LimitSettings())
        assert ending is not None
        assert ending.reason == reason, str(ending)
        # A constant value counts from the second check with it.
        assert begun_s <= at_s <= begun_s + within_s + 2.0 * period_s + 1e-6


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_an_honest_flight_goes_on(period_s: float) -> None:
    assert fly(honest, period_s, 300.0, LimitSettings(flight_s=301.0)) == (None, 300.0)


def test_noise_resets_and_a_camera_with_another_clock_are_believed() -> None:
    rng = np.random.default_rng(1)

    def told(t_s: float) -> Told:
        now = honest(t_s)
        reset = 0.8 * NORTH if t_s > 20.0 else 0.0
        now = now.moved(
            position=now.state.position + rng.normal(0, 0.1, 3) + reset,
            velocity=now.state.velocity + rng.normal(0, 0.1, 3),
        )
        # Stamped by a clock that began a year ago, up to half a second late.
        stamp = now.frame.capture_time_us - 31_536_000 * US_PER_S
        return now.seen(capture_time_us=stamp - int(rng.integers(0, US_PER_S // 2)))

    assert fly(told, 0.5, 300.0, LimitSettings(flight_s=301.0))[0] is None


def contradiction(lie: Lie, period_s: float, seconds: float) -> tuple[str, float]:
    """Return the detail of the ending by a lie from 4 s on, and its time [s]."""
    then = honest(4.0)
    told = lambda t_s: honest(t_s) if t_s < 4.0 else lie(honest(t_s), then, t_s - 4.0)  # noqa: E731
    ending, at_s = fly(told, period_s, 4.0 + seconds, LimitSettings())
    assert ending is not None
    assert ending.reason == TELEMETRY_WRONG
    return ending.detail, at_s - 4.0


def bank(angle: float) -> Callable[[float], tuple[float, float, float]]:
    return lambda s: (angle, 0.0, 0.0)


@pytest.mark.parametrize(
    ("lie", "detail", "within_s"),
    [
        (shifted("position", 2, lambda s: -100.0), "position and velocity have parted by 100", 0.1),
        (shifted("position", 0, creep), "position and velocity have parted by 1.", 1.4),
        (shifted("velocity", 2, lambda s: 1.0), "position and velocity have parted by 1.", 1.4),
        (turned(lambda s: (0.0, 0.0, 1.5)), "heading and yaw rate have parted by 8", 0.1),
        (turned(lambda s: (0.0, 0.0, 0.8 * s)), "heading and yaw rate have parted by 2", 0.7),
        (shifted("rates", 2, lambda s: 0.8), "heading and yaw rate have parted by 2", 0.7),
        (turned(bank(math.radians(50.0))), "velocity and tilt have parted by 1", 1.6),
        (turned(bank(math.pi)), "the vehicle is upside down", 0.7),
        (shifted("rates", 0, lambda s: -TEN_TURNS), "a body rate of 62.8 rad/s", 0.1),
        (held("position", 2), "only the height has not changed for 1.", 1.2),
        (held("rates", 1), "only the pitch rate has not changed for 1.", 1.2),
        (heading_held, "only the heading has not changed for 1.", 1.2),
    ],
)
def test_each_contradiction_is_named(lie: Lie, detail: str, within_s: float) -> None:
    found, after_s = contradiction(lie, 0.1, 5.0)
    assert found.startswith(detail)
    assert after_s <= within_s


def test_telemetry_without_body_rates_is_believed() -> None:
    """Not every flight controller reports them: None, or NaN from the start."""
    for rates in (None, np.full(3, math.nan)):
        told = lambda t_s, rates=rates: replace(  # noqa: E731
            honest(t_s), state=replace(honest(t_s).state, rates=rates)
        )
        assert fly(told, 0.5, 60.0, LimitSettings())[0] is None


@pytest.mark.parametrize(("commands", "believed"), [("velocity", False), ("body_rates", True)])
def test_only_velocity_commands_limit_the_speed(commands: CommandKind, believed: bool) -> None:
    """Policies of body rates fly at 25 m/s; 3 x 5 + 10 m/s is the bound of the others."""
    pilot = PilotSettings(altitude_m=HEIGHT_M, commands=commands)
    limits = VehicleLimits(LimitSettings(radius_m=1000.0), GOAL, pilot)
    state = replace(honest(1.0).state, velocity=np.array([25.5, 0.0, 0.0]))
    ending = limits.broken(OURS, state, US_PER_S)
    assert (ending is None) == believed


# --- before the navigation


def standing(t_s: float, down_m: float = 0.0, north_m: float = 0.0, yaw: float = 0.0) -> Kinematics:
    """Return the state of a vehicle on the ground, with millimetres of noise."""
    noise = 1e-3 * np.sin(np.arange(1.0, 4.0) * 37.0 * t_s)
    attitude = quat_from_euler(0.0, 0.0, yaw + noise[0])
    return Kinematics(np.array([north_m, 0.0, down_m]) + noise, noise, attitude, noise)


def take_off(before: dict[str, float], after: dict[str, float]) -> Ending | None:
    """Stand for a second, climb unwatched for ten seconds, and look once in the air."""
    limits = Limits(LimitSettings(), GOAL, PILOT)
    for k in range(10):
        now_s = 0.1 * k
        if (ending := limits.watch(standing(now_s, **before), round(now_s * US_PER_S))) is not None:
            return ending
    limits.begin(11 * US_PER_S)
    return limits.broken(OURS, standing(11.0, **after), None, 11 * US_PER_S)


@pytest.mark.parametrize(
    ("before", "after", "detail"),
    [
        ({}, {"down_m": -HEIGHT_M}, None),
        ({"north_m": 30.0}, {"down_m": -HEIGHT_M, "north_m": 30.4}, None),
        (
            {},
            {"down_m": -HEIGHT_M, "north_m": 3.0},
            "the take-off to 2.5 m moved the position by 3.0 m",
        ),
        ({}, {"down_m": -8.0}, "the take-off to 2.5 m changed the height by 8.0 m"),
        (
            {"down_m": 100.0},
            {"down_m": 97.5},
            "the take-off to 2.5 m ended at a height of -97.5 m",
        ),
        (
            {},
            {"down_m": -HEIGHT_M, "yaw": 1.0},
            "the take-off to 2.5 m turned the nose by 57 deg",
        ),
    ],
)
def test_a_take_off_is_vertical(
    before: dict[str, float], after: dict[str, float], detail: str | None
) -> None:
    ending = take_off(before, after)
    assert (None if ending is None else ending.detail) == detail
    assert ending is None or ending.reason == TELEMETRY_WRONG


def test_a_jump_on_the_ground_is_found_before_the_take_off() -> None:
    limits = Limits(LimitSettings(), GOAL, PILOT)
    assert limits.watch(standing(0.0), 0) is None
    ending = limits.watch(standing(0.1, north_m=10.0), US_PER_S // 10)
    assert ending is not None
    assert limits.ending is ending
    assert ending.detail == "position and velocity have parted by 10.0 m"


def test_every_flight_has_a_time_limit() -> None:
    """The default is 120 s, and ten times the direct flight to the goal at the maximum speed."""
    asked = with_time_limit(LimitSettings(), (30.0, 40.0), PilotSettings(max_speed_m_s=5.0))
    assert asked.flight_s == 220.0
    assert with_time_limit(LimitSettings(), GOAL, PILOT, 3610.0).flight_s == 3610.0
    assert with_time_limit(LimitSettings(flight_s=9.0), GOAL, PILOT, 3610.0).flight_s == 9.0
    ending, at_s = fly(honest, 0.5, 200.0, LimitSettings())
    assert ending == Ending(OUT_OF_TIME, "170 s; at most 170 s")
    assert at_s == 170.0


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
