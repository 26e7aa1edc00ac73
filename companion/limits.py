"""Plausibility limits of telemetry, camera and mode, and limits of the flight.

A learned policy acts on any input: with a frozen position it overshoots the goal, with a frozen
image it hits obstacles. The first broken rule ends the flight (`offboard_mission`). The bounds
are wide; sensor quality is the estimator's task.

Position, velocity, attitude and body rates must agree with each other and with gravity. This finds
a single false value, and no error that all of them share (`scripts/telemetry_lies.py`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import Goal, goal_height_m, quat_yaw, wrap_pi
from airl_mav.policy.actions import KINDS
from airl_mav.policy.observation import Kinematics
from airl_mav.scenario.model import LimitSettings, PilotSettings
from companion.frame_source import ReceivedFrame
from companion.link_interface import FRAMES_LATE, TELEMETRY_FROZEN, VehicleStatus

TAKEN_OVER = "taken over"
"""A pilot has control: the mode is no longer offboard. The companion stops sending."""

DISARMED = "disarmed"
"""The motors were stopped externally. The companion stops sending."""

TELEMETRY_WRONG = "telemetry wrong"
CAMERA_FROZEN = "camera frozen"
CAMERA_WRONG = "camera wrong"
BATTERY_LOW = "battery low"
OUT_OF_BOUNDS = "out of bounds"
OUT_OF_TIME = "out of time"

NOT_OURS = (TAKEN_OVER, DISARMED)
"""Reasons to end a flight after which no commands may be sent."""

REASONS = (
    *(*NOT_OURS, TELEMETRY_FROZEN, TELEMETRY_WRONG, CAMERA_FROZEN, CAMERA_WRONG),
    *(FRAMES_LATE, BATTERY_LOW, OUT_OF_BOUNDS, OUT_OF_TIME),
)

MODE_KNOWN_S = 3.0
"""Maximum latency of the report of a mode change [s]: three heartbeats of 1 Hz."""

SELDOM_M = 6.0
"""Maximum difference of position and integrated velocity, leaking with `DRIFT_S` [m], with seldom
checks; `LimitSettings.drift_m` with frequent ones. A velocity that changes by 1 g and back adds
g dt^2 / 4. Honest flights: 0.4 m at 2 Hz, 4.7 m at 1 Hz; PX4's SIH: 2.4 m at 30 Hz."""

SELDOM_S = 0.7
"""Time between two checks that are seldom [s]: the tilt has changed unseen."""

DRIFT_S = 5.0

HEADING_RAD, HEADING_RAD_S = math.radians(15.0), math.radians(80.0)
"""Maximum difference of heading and integrated yaw rate, leaking with `SWAY_S` [rad]. It grows
with the time between two checks [rad/s]. Honest flights: 2 deg at 30 Hz, 46 deg at 2 Hz."""

PUSH_M_S, PUSH_M_S2 = 10.0, 7.0
"""Maximum difference of level velocity and integrated thrust, leaking with `SWAY_S` [m/s]. It grows
with the time between two checks [m/s2]. Drag in 8 m/s of wind leaves 5 m/s."""

SWAY_S = 2.0

STEEP = 0.25
"""Minimum cosine of the tilt for tan(tilt)."""

FLIP_S = 0.5
"""Maximum time upside down [s]. Policies of body rates brake so for 0.2 s."""

UNWATCHED_S = 2.0
"""Time between two checks after which the sums begin again [s]. Lockstep skips the take-off."""

TURN_RAD_S = 4.0 * math.pi
"""Maximum body rate [rad/s]: three times PX4's limit (MC_ROLLRATE_MAX 220 deg/s)."""

TAKEOFF_M, TAKEOFF_RAD = 2.0, math.radians(45.0)
"""Maximum level shift of a take-off, and error of its climb [m]; maximum turn [rad]. Honest
flights in 8 m/s of wind: 0.4 m, 1 deg."""

ORIGIN_M = 5.0
"""Maximum difference of the height after the take-off from the flight altitude [m]."""

CLOCK_S = 30.0
"""Time constant of the vehicle's clock relative to the companion's [s]."""

SPEEDS = 3.0
"""Maximum velocity as a multiple of the fastest action, plus `SPEED_M_S`: wind, overshoot."""

SPEED_M_S = 10.0

FREE_M_S = 50.0
"""Maximum velocity of a policy without a speed limit [m/s]: it commands attitudes or body rates."""

NORM = 0.1
"""Maximum deviation of an attitude quaternion's norm from 1."""

CLEARANCE_M = 50.0
"""Margin for detours in the default radius, which is twice the goal's distance plus this [m]."""

CLIMB_M = 10.0
"""Margin of the height limits [m]. The upper one is above the flight altitude and the goal, the
lower one below the start and the goal."""

SLOW, FLIGHT_S = 10.0, 120.0
"""Default time limit: multiple of the time straight to the goal at the maximum speed, and a
constant [s]."""

OWN_CLOCK_S = 1.0
"""Maximum age of a first frame stamped by this clock [s]; else ages count from its arrival."""

GROUND_M = 10.0
"""Distance along a ray within which any depth camera sees the ground [m]."""

GRAZING_RAD = math.radians(10.0)
"""Minimum ray angle below level [rad]; a flatter ray may miss the ground at the start's height."""


TOLD = ("position", "velocity", "attitude")
"""Checked telemetry of the vehicle, in the order of `Kinematics`."""

NUMBERS = (
    *("north position", "east position", "height", "north velocity", "east velocity"),
    *("vertical velocity", "attitude", "heading", "roll rate", "pitch rate", "yaw rate"),
)
"""Numbers that change with every report. The heading is rounded: the attitude's other angles change
its last digits."""

HEADING_DIGITS = 5


def with_time_limit(
    settings: LimitSettings, goal: Goal, pilot: PilotSettings, least_s: float = 0.0
) -> LimitSettings:
    """Return settings with a time limit. The default is at least `least_s` [s]."""
    if settings.flight_s is not None:
        return settings
    flight_s = FLIGHT_S + SLOW * math.hypot(*goal[:2]) / pilot.max_speed_m_s
    return settings.model_copy(update={"flight_s": max(least_s, flight_s)})


class Ending(NamedTuple):
    """Reason to end a flight."""

    reason: str
    """Reason, a constant of this module or of `interfaces`."""
    detail: str

    def __str__(self) -> str:
        """Return the reason and its detail as a note."""
        return f"{self.reason}: {self.detail}"


class _Unchanged:
    """Timer of bit-identical values."""

    def __init__(self) -> None:
        self._last: bytes | None = None
        self._since_us = 0

    def for_us(self, values: NDArray[np.generic], now_us: int) -> int:
        now = values.tobytes()
        if now != self._last:
            self._last, self._since_us = now, now_us
        return now_us - self._since_us


class Limits:
    """All rules of one flight. The first broken rule is final."""

    def __init__(
        self,
        settings: LimitSettings,
        goal: Goal,
        pilot: PilotSettings,
        mount_rad: tuple[float, float] = (0.0, 0.0),
        speed: float = 1.0,
    ) -> None:
        """Prepare a flight to a goal; `mount_rad` are the camera's angles up and right [rad].

        `speed` is the simulated time per wall time: a late host counts that often.
        """
        self.ending: Ending | None = None
        """Broken rule that has ended the flight; None = no rule broken."""
        self._vehicle = VehicleLimits(settings, goal, pilot, speed)
        self._camera = CameraLimits(settings, mount_rad)

    def watch(self, state: Kinematics, now_us: int) -> Ending | None:
        """Return the rule that telemetry breaks before the navigation, at `now_us` [µs]."""
        if self.ending is None:
            self.ending = self._vehicle.watch(state, now_us)
        return self.ending

    def begin(self, now_us: int) -> None:
        """Start navigation at `now_us` [µs]."""
        self._vehicle.begun_us = now_us

    def broken(
        self,
        status: VehicleStatus,
        state: Kinematics,
        seen: ReceivedFrame | None,
        now_us: int,
    ) -> Ending | None:
        """Return the broken limit at `now_us` [µs], or None; `seen` is a new frame, if any."""
        # A vehicle under a pilot's control is not judged: its motion is not the policy's.
        if self.not_ours(status, now_us) is None:
            self.ending = self._vehicle.broken(status, state, now_us)
        if self.ending is None and seen is not None:
            self.ending = self._camera.broken(seen, state, now_us)
        return self.ending

    def not_ours(self, status: VehicleStatus, now_us: int) -> Ending | None:
        """Return the reason if the companion must stop commanding; None = it has control."""
        if self.ending is None:
            self.ending = self._vehicle.not_ours(status, now_us)
        return self.ending


class VehicleLimits:
    """Rules for reports of the flight controller."""

    def __init__(
        self, settings: LimitSettings, goal: Goal, pilot: PilotSettings, speed: float = 1.0
    ) -> None:
        self.begun_us = 0
        """Start of navigation [µs]."""
        self._silence_us = round(settings.silence_s * US_PER_S)
        self._late_us = round(0.5 * max(1.0, speed) * self._silence_us)
        radius_m, height_m = settings.radius_m, settings.height_m
        # The default radius leaves room for detours around obstacles.
        self.radius_m = 2.0 * math.hypot(*goal[:2]) + CLEARANCE_M if radius_m is None else radius_m
        """Maximum horizontal distance from the start [m]."""
        highest_m = max(pilot.altitude_m, goal_height_m(goal) or 0.0)
        self.height_m = highest_m + CLIMB_M if height_m is None else height_m
        """Maximum height above the start [m]."""
        self._depth_m = CLIMB_M - min(0.0, goal_height_m(goal) or 0.0)
        self._altitude_m = pilot.altitude_m
        self._flight_s = with_time_limit(settings, goal, pilot).flight_s
        self._battery = settings.battery
        steady = KINDS[pilot.commands].steady
        self._fastest_m_s = SPEEDS * pilot.max_speed_m_s + SPEED_M_S if steady else FREE_M_S
        self._offboard = self._armed = False
        self._unchanged = [_Unchanged() for _ in TOLD]
        self._motion = MotionMonitor(self._silence_us // 2, settings.drift_m)
        self._stamp_us: int | None = None
        self._usual_us = 0
        self._rest: Kinematics | None = None

    def not_ours(self, status: VehicleStatus, now_us: int) -> Ending | None:
        """Return the reason if the companion must stop commanding; None = it has control."""
        self._offboard |= status.offboard
        self._armed |= status.armed
        # After the acknowledged switch to offboard, the heartbeat that shows it may be delayed.
        # Before the first report of the mode, only a timeout proves a takeover.
        late = now_us - self.begun_us > MODE_KNOWN_S * US_PER_S
        if not status.armed and (self._armed or late):
            return Ending(DISARMED, "the heartbeat says that the motors are off")
        if not status.offboard and (self._offboard or late):
            return Ending(TAKEN_OVER, f"the mode is {status.mode}")
        return None

    def watch(self, state: Kinematics, now_us: int) -> Ending | None:
        """Return the rule that telemetry breaks before the navigation; None = plausible."""
        ending = self._implausible(state, now_us)
        self._rest = self._rest or state
        return ending

    def broken(self, status: VehicleStatus, state: Kinematics, now_us: int) -> Ending | None:
        """Return the rule that telemetry breaks; None = telemetry is plausible."""
        # The order decides the reported reason.
        return (
            self._implausible(state, now_us)
            or self._taken_off(state)
            or self._outside(state, now_us)
            or self._drained(status)
        )

    def _implausible(self, state: Kinematics, now_us: int) -> Ending | None:
        # Frozen telemetry is bit-identical; a real estimator always has noise.
        values = (state.position, state.velocity, state.quaternion)
        for name, unchanged, value in zip(TOLD, self._unchanged, values, strict=True):
            if not np.isfinite(value).all():
                return Ending(TELEMETRY_WRONG, f"{name} is not finite")
            silent_us = unchanged.for_us(value, now_us)
            if silent_us > self._silence_us:
                return Ending(
                    TELEMETRY_FROZEN, f"{name} has not changed for {silent_us / US_PER_S:.1f} s"
                )
        # A wrong quaternion would turn every velocity command.
        norm = math.hypot(*state.quaternion)
        if abs(norm - 1.0) > NORM:
            return Ending(TELEMETRY_WRONG, f"the attitude quaternion has norm {norm:.2f}")
        speed = math.hypot(*state.velocity)
        if speed > self._fastest_m_s:
            return Ending(
                TELEMETRY_WRONG,
                f"velocity {speed:.1f} m/s; believed: up to {self._fastest_m_s:g} m/s",
            )
        wrong = self._late(state.time_us, now_us) or self._motion.contradiction(state, now_us)
        return None if wrong is None else Ending(TELEMETRY_WRONG, wrong)

    def _late(self, stamp_us: int | None, now_us: int) -> str | None:
        """Return the change of telemetry's latency, as text, if it is too large."""
        # Without a new stamp, telemetry pauses: if it lasts, telemetry is frozen.
        if stamp_us is None or stamp_us == self._stamp_us:
            return None
        last_us, self._stamp_us, behind_us = self._stamp_us, stamp_us, now_us - stamp_us
        if last_us is None:
            self._usual_us = behind_us
        changed_us = behind_us - self._usual_us
        if abs(changed_us) > self._late_us:
            return f"its time stamps have moved by {-changed_us / US_PER_S:+.1f} s"
        # The two clocks may drift, and a simulated one may be slow.
        share = 1.0 if last_us is None else (stamp_us - last_us) / (CLOCK_S * US_PER_S)
        self._usual_us += round(min(1.0, max(0.0, share)) * changed_us)
        return None

    def _taken_off(self, state: Kinematics) -> Ending | None:
        """Return the rule that the take-off breaks; it is vertical, and seldom watched."""
        rest, self._rest = self._rest, None
        if rest is None:
            return None
        north_m, east_m, down_m = (state.position - rest.position).tolist()
        turn_rad = wrap_pi(quat_yaw(state.quaternion) - quat_yaw(rest.quaternion))
        takeoff, height_m = f"the take-off to {self._altitude_m:g} m", -float(state.position[2])
        if (shift_m := math.hypot(north_m, east_m)) > TAKEOFF_M:
            return Ending(TELEMETRY_WRONG, f"{takeoff} moved the position by {shift_m:.1f} m")
        if abs(-down_m - self._altitude_m) > TAKEOFF_M:
            return Ending(TELEMETRY_WRONG, f"{takeoff} changed the height by {-down_m:.1f} m")
        if abs(height_m - self._altitude_m) > ORIGIN_M:
            return Ending(TELEMETRY_WRONG, f"{takeoff} ended at a height of {height_m:.1f} m")
        if abs(turn_rad) > TAKEOFF_RAD:
            return Ending(
                TELEMETRY_WRONG, f"{takeoff} turned the nose by {math.degrees(turn_rad):.0f} deg"
            )
        return None

    def _drained(self, status: VehicleStatus) -> Ending | None:
        if self._battery is None:
            return None
        # A limit that cannot be checked ends the flight.
        if status.battery is None:
            return Ending(BATTERY_LOW, "the flight controller does not tell its charge")
        if status.battery < self._battery:
            return Ending(
                BATTERY_LOW, f"{100.0 * status.battery:.0f} %; at least {100.0 * self._battery:g} %"
            )
        return None

    def _outside(self, state: Kinematics, now_us: int) -> Ending | None:
        # NED: height above the start is -down.
        north, east, down = state.position
        away_m = math.hypot(north, east)
        if away_m > self.radius_m:
            return Ending(
                OUT_OF_BOUNDS, f"{away_m:.1f} m from the start; at most {self.radius_m:g} m"
            )
        if -down > self.height_m:
            return Ending(
                OUT_OF_BOUNDS, f"{-down:.1f} m above the start; at most {self.height_m:g} m"
            )
        if down > self._depth_m:
            return Ending(
                OUT_OF_BOUNDS, f"{down:.1f} m below the start; at most {self._depth_m:g} m"
            )
        flown_s = (now_us - self.begun_us) / US_PER_S
        if self._flight_s is not None and flown_s > self._flight_s:
            return Ending(OUT_OF_TIME, f"{flown_s:.0f} s; at most {self._flight_s:g} s")
        return None


class _Sample(NamedTuple):
    """Motion at a check."""

    now_us: int
    numbers: tuple[Any, ...]
    """Values of `NUMBERS`, without rates that are not reported."""
    yaw_rad: float
    yaw_rate_rad_s: float
    lean: tuple[float, float]
    """Level thrust, north and east, as a share of its upward part: tan(tilt)."""
    upright: float
    """Cosine of the tilt."""


class MotionMonitor:
    """Consistency of position, velocity, attitude and body rates over time, and with gravity."""

    def __init__(self, frozen_us: int, drift_m: float) -> None:
        """Set the maximum time for which one number may stay the same [µs], and the drift [m]."""
        self._frozen_us, self._bound_m = frozen_us, drift_m
        self._last: _Sample | None = None
        self._numbers: tuple[Any, ...] = ()
        self._changed_us: list[int] = []
        self._forget()
        self._upright_us = 0
        self._rates = False
        """True once body rates were reported."""

    def _forget(self) -> None:
        self._drift_m = [0.0, 0.0, 0.0]
        self._pause_m = 0.0
        self._turn_rad = 0.0
        self._push_m_s = [0.0, 0.0]
        self._behind = False
        """True if the last position may have been old."""

    def contradiction(self, state: Kinematics, now_us: int) -> str | None:
        """Return the contradiction in finite telemetry, as text; None = consistent."""
        now = self._sample(state, now_us)
        if isinstance(now, str):
            return now
        if (frozen := self._frozen(now)) is not None:
            return frozen
        last = self._last
        # A pause is no contradiction; frozen telemetry is detected elsewhere.
        if last is not None and now.numbers[:6] == last.numbers[:6]:
            return None
        self._last = now
        return None if last is None else self._parted(last, now)

    def _sample(self, state: Kinematics, now_us: int) -> _Sample | str:
        """Return a sample, or its contradiction as text."""
        w, x, y, z = quaternion = tuple(state.quaternion.tolist())
        rates = () if state.rates is None else tuple(state.rates.tolist())
        # Not every flight controller reports body rates: they are NaN then.
        if not all(map(math.isfinite, rates)):
            rates = ()
        if self._rates and not rates:
            return "a body rate is not finite"
        self._rates = bool(rates)
        fastest = max(map(abs, rates), default=0.0)
        if fastest > TURN_RAD_S:
            return f"a body rate of {fastest:.1f} rad/s; believed: up to {TURN_RAD_S:.1f} rad/s"
        # Third column of the rotation: the body's down axis in NED.
        north, east = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)
        down = 1.0 - 2.0 * (x * x + y * y)
        if down > 0.0:
            self._upright_us = now_us
        elif now_us - self._upright_us > FLIP_S * US_PER_S:
            return "the vehicle is upside down"
        yaw, yaw_rate = quat_yaw(state.quaternion), math.nan
        if rates:
            # Rate of the Euler angle: (q sin(roll) + r cos(roll)) / cos(pitch).
            level = max(STEEP**2, 1.0 - 4.0 * (w * y - z * x) ** 2)
            yaw_rate = (2.0 * (y * z + w * x) * rates[1] + down * rates[2]) / level
        lean = -1.0 / max(STEEP, down)
        angles = quaternion, round(yaw, HEADING_DIGITS)
        numbers = (*state.position.tolist(), *state.velocity.tolist(), *angles, *rates)
        return _Sample(now_us, numbers, yaw, yaw_rate, (lean * north, lean * east), down)

    def _frozen(self, now: _Sample) -> str | None:
        """Return the number that stays the same while another one changes."""
        before, self._numbers = self._numbers, now.numbers
        if len(before) != len(now.numbers):
            self._changed_us = [now.now_us] * len(now.numbers)
        frozen = None
        for k, (old, new) in enumerate(zip(before, now.numbers, strict=False)):
            if new != old:
                self._changed_us[k] = now.now_us
            elif frozen is None and now.now_us - self._changed_us[k] > self._frozen_us:
                silent_s = (now.now_us - self._changed_us[k]) / US_PER_S
                frozen = f"only the {NUMBERS[k]} has not changed for {silent_s:.1f} s"
        return frozen if now.now_us in self._changed_us else None

    def _parted(self, last: _Sample, now: _Sample) -> str | None:
        """Return the values that have parted since the last sample.

        The sums are leaky: a slow drift adds up, single errors decay.
        """
        dt_s = (now.now_us - last.now_us) / US_PER_S
        if dt_s > UNWATCHED_S:
            self._forget()
            return None
        mean_s, leak, sway_leak = 0.5 * dt_s, math.exp(-dt_s / DRIFT_S), math.exp(-dt_s / SWAY_S)
        drift_m, push_m_s, a, b = self._drift_m, self._push_m_s, last.numbers, now.numbers
        # Trapezoidal integral of velocity between the two samples.
        for k in range(3):
            rest_m = b[k] - a[k] - mean_s * (a[3 + k] + b[3 + k])
            drift_m[k] = leak * drift_m[k] + rest_m
        parted_m = math.hypot(*drift_m)
        seldom = dt_s > SELDOM_S
        # A pause leaves a drift; its allowance fades with it.
        self._pause_m = SELDOM_M if seldom else leak * self._pause_m
        bound_m = self._pause_m
        if not seldom:
            bound_m += self._bound_m + 0.25 * GRAVITY_M_S2 * dt_s**2
        behind, self._behind = self._behind, parted_m > bound_m
        # After a pause of the link the position is old. The next one decides.
        if parted_m > bound_m and (behind or _beside_m(drift_m, b[3:6], dt_s) > bound_m):
            return f"position and velocity have parted by {parted_m:.1f} m"
        if seldom:
            # Two samples say little about turns and thrust in between.
            self._turn_rad, self._push_m_s = 0.0, [0.0, 0.0]
            return None
        if math.isfinite(last.yaw_rate_rad_s + now.yaw_rate_rad_s):
            turned = mean_s * (last.yaw_rate_rad_s + now.yaw_rate_rad_s)
            # A steep vehicle has no heading.
            weight = max(0.0, min(last.upright, now.upright)) ** 2
            self._turn_rad *= sway_leak
            self._turn_rad += weight * wrap_pi(now.yaw_rad - last.yaw_rad - turned)
            if abs(self._turn_rad) > HEADING_RAD + HEADING_RAD_S * dt_s:
                parted_deg = math.degrees(abs(self._turn_rad))
                return f"heading and yaw rate have parted by {parted_deg:.0f} deg"
        if min(last.upright, now.upright) < STEEP:
            self._push_m_s = [0.0, 0.0]
            return None
        # The thrust along the body's up axis carries the weight and the vertical acceleration.
        up_m_s = 0.5 * (GRAVITY_M_S2 * dt_s - (b[5] - a[5]))
        for k in range(2):
            rest_m_s = b[3 + k] - a[3 + k] - up_m_s * (last.lean[k] + now.lean[k])
            push_m_s[k] = sway_leak * push_m_s[k] + rest_m_s
        pushed_m_s = math.hypot(*push_m_s)
        if pushed_m_s > PUSH_M_S + PUSH_M_S2 * dt_s:
            return f"velocity and tilt have parted by {pushed_m_s:.1f} m/s"
        return None


def _beside_m(drift_m: list[float], velocity: tuple[float, ...], dt_s: float) -> float:
    """Return the part of a drift that no position of the last `dt_s` explains [m]."""
    speed = math.hypot(*velocity)
    if speed == 0.0:
        return math.hypot(*drift_m)
    behind_m = -sum(d * v for d, v in zip(drift_m, velocity, strict=True)) / speed
    share = min(max(0.0, behind_m), speed * dt_s) / speed
    return math.hypot(*(d + share * v for d, v in zip(drift_m, velocity, strict=True)))


class CameraLimits:
    """Rules for images of the main camera; additional cameras are not checked."""

    def __init__(self, settings: LimitSettings, mount_rad: tuple[float, float]) -> None:
        """Set the limits and the camera's mounting angles, up and to the right of the nose."""
        self._mount_rad = mount_rad
        self._silence_us = round(settings.silence_s * US_PER_S)
        self._same_us = round(settings.image_s * US_PER_S)
        self._first: Frame | None = None
        self._last: ReceivedFrame | None = None
        self._least_us = 0
        self._image = _Unchanged()
        self._blank_since_us: int | None = None

    def broken(self, seen: ReceivedFrame, state: Kinematics, now_us: int) -> Ending | None:
        """Return the rule that a frame breaks; None = the frame is usable."""
        frame = seen.frame
        if self._first is None:
            self._first = frame
        if frame.intrinsics != self._first.intrinsics:
            return Ending(CAMERA_WRONG, f"{frame.intrinsics}; before: {self._first.intrinsics}")
        # A frozen image is a camera fault, late frames may be due to a busy host.
        return self._pictured(frame, state, now_us) or self._stamped(seen)

    def _stamped(self, seen: ReceivedFrame) -> Ending | None:
        last, self._last = self._last, seen
        behind_us = seen.received_us - seen.frame.capture_time_us
        # A lower sequence means that the camera restarted, with new stamps.
        if last is None or last.frame.sequence > seen.frame.sequence:
            # The first frame, or a restart of the camera.
            # Stamps of another clock have an arbitrary offset: later ages are relative to it.
            own = 0 <= behind_us <= OWN_CLOCK_S * US_PER_S
            self._least_us = 0 if own else behind_us
            return None
        # Change of the latency between two frames.
        changed_us = behind_us - (last.received_us - last.frame.capture_time_us)
        if abs(changed_us) > self._silence_us:
            return Ending(CAMERA_WRONG, f"stamps jumped by {-changed_us / US_PER_S:+.1f} s")
        # The smallest latency is the reference for late frames.
        self._least_us = min(self._least_us, behind_us)
        late_us = behind_us - self._least_us
        if late_us > self._silence_us:
            return Ending(FRAMES_LATE, f"{late_us / US_PER_S:.1f} s old")
        return None

    def _pictured(self, frame: Frame, state: Kinematics, now_us: int) -> Ending | None:
        """Return the ending for a frozen image, or a blank image that must show the ground."""
        image = frame.image
        even = bool((image == image[0, 0]).all())
        silent_us = self._image.for_us(image, now_us)
        # An even image cannot show that it is frozen: it counts as blank below.
        if silent_us > self._same_us and not even:
            return Ending(
                CAMERA_FROZEN, f"the image has not changed for {silent_us / US_PER_S:.1f} s"
            )
        blank = even and (frame.intrinsics.kind == "depth" or _dead(image))
        if not blank or not ground_in_view(frame, state, *self._mount_rad):
            self._blank_since_us = None
        elif self._blank_since_us is None:
            # The blank time starts with the first blank image over ground.
            self._blank_since_us = now_us
        elif now_us - self._blank_since_us > self._silence_us:
            return Ending(
                CAMERA_WRONG,
                f"every pixel reads {_reading(frame)}, and the ground must be in view",
            )
        return None


def _dead(image: NDArray[Any]) -> bool:
    """Return True if a uniform image is black or white (covered camera), not a plain wall."""
    return bool((image[0, 0] == image.flat[0]).all()) and int(image.flat[0]) in (0, 255)


def _reading(frame: Frame) -> str:
    numbers = ", ".join(str(int(number)) for number in np.ravel(frame.image[0, 0]))
    return f"{numbers} mm" if frame.intrinsics.kind == "depth" else f"{numbers} of 255"


def ground_in_view(
    frame: Frame, state: Kinematics, mount_pitch_up_rad: float, mount_yaw_rad: float = 0.0
) -> bool:
    """Return True if flat ground must be in view: the lowest middle ray hits within `GROUND_M`."""
    lens = frame.intrinsics
    # Angle below the optical axis of the lowest middle pixel.
    below_rad = lens.model.angle_at(lens, lens.height - 1 - lens.cy)
    w, x, y, z = state.quaternion
    # Rise of the body direction below the optical axis; for a camera ahead, the pitch.
    ahead, aside = 2.0 * (w * y - z * x), -2.0 * (y * z + w * x)
    rise = ahead * math.cos(mount_yaw_rad) + aside * math.sin(mount_yaw_rad)
    pitch_rad = math.asin(min(1.0, max(-1.0, rise)))
    # Angle below the horizon of that ray: camera mount and vehicle pitch raise it.
    down_rad = below_rad - pitch_rad - mount_pitch_up_rad
    height_m = -float(state.position[2])
    # The ray's length to flat ground is height / sin(angle).
    return down_rad > GRAZING_RAD and 0.0 < height_m < GROUND_M * math.sin(down_rad)
