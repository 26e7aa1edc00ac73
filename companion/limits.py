"""Plausibility limits of telemetry, camera and mode, and limits of the flight.

A learned policy acts on any input: with a frozen position it overshoots the goal, with a frozen
image it hits obstacles. The first broken rule ends the flight (`offboard_mission`). The bounds
are wide; sensor quality is the estimator's task.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Goal, goal_height_m
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

STEP_M = 5.0
"""Maximum position jump beyond the distance explained by velocity [m]; larger than the resets of an
estimator that regains GPS within its gates."""

DRIFT_M = 8.0
"""Maximum difference of position and integrated velocity, leaking with `DRIFT_S` [m]."""

DRIFT_S = 5.0

SPEEDS = 3.0
"""Maximum velocity as a multiple of the fastest action, plus `SPEED_M_S`: wind, overshoot."""

SPEED_M_S = 10.0

NORM = 0.1
"""Maximum deviation of an attitude quaternion's norm from 1."""

CLEARANCE_M = 50.0
"""Margin for detours in the default radius, which is twice the goal's distance plus this [m]."""

CLIMB_M = 10.0
"""Margin of the default height limit above the flight altitude and the goal's height [m]."""

OWN_CLOCK_S = 1.0
"""Maximum age of a first frame stamped by this clock [s]; else ages count from its arrival."""

GROUND_M = 10.0
"""Distance along a ray within which any depth camera sees the ground [m]."""

GRAZING_RAD = math.radians(10.0)
"""Minimum ray angle below level [rad]; a flatter ray may miss the ground at the start's height."""


TOLD = ("position", "velocity", "attitude")
"""Checked telemetry of the vehicle, in the order of `Kinematics`."""


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
    ) -> None:
        """Prepare a flight to a goal; `mount_rad` are the camera's angles up and right [rad]."""
        self.ending: Ending | None = None
        """Broken rule that has ended the flight; None = no rule broken."""
        self._vehicle = VehicleLimits(settings, goal, pilot)
        self._camera = CameraLimits(settings, mount_rad)

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

    def __init__(self, settings: LimitSettings, goal: Goal, pilot: PilotSettings) -> None:
        self.begun_us = 0
        """Start of navigation [µs]."""
        self._silence_us = round(settings.silence_s * US_PER_S)
        radius_m, height_m = settings.radius_m, settings.height_m
        # The default radius leaves room for detours around obstacles.
        self.radius_m = 2.0 * math.hypot(*goal[:2]) + CLEARANCE_M if radius_m is None else radius_m
        """Maximum horizontal distance from the start [m]."""
        highest_m = max(pilot.altitude_m, goal_height_m(goal) or 0.0)
        self.height_m = highest_m + CLIMB_M if height_m is None else height_m
        """Maximum height above the start [m]."""
        self._flight_s = settings.flight_s
        self._battery = settings.battery
        self._fastest_m_s = SPEEDS * pilot.max_speed_m_s + SPEED_M_S
        self._offboard = self._armed = False
        self._unchanged = [_Unchanged() for _ in TOLD]
        self._before: tuple[Kinematics, int] | None = None
        self._drift_m = np.zeros(2)

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

    def broken(self, status: VehicleStatus, state: Kinematics, now_us: int) -> Ending | None:
        """Return the rule that telemetry breaks; None = telemetry is plausible."""
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
        norm = float(np.linalg.norm(state.quaternion))
        if abs(norm - 1.0) > NORM:
            return Ending(TELEMETRY_WRONG, f"the attitude quaternion has norm {norm:.2f}")
        speed = float(np.linalg.norm(state.velocity))
        if speed > self._fastest_m_s:
            return Ending(
                TELEMETRY_WRONG,
                f"velocity {speed:.1f} m/s; believed: up to {self._fastest_m_s:g} m/s",
            )
        # The order decides the reported reason.
        return self._moved(state, now_us) or self._outside(state, now_us) or self._drained(status)

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

    def _moved(self, state: Kinematics, now_us: int) -> Ending | None:
        if self._before is None:
            self._before = state, now_us
            return None
        last, last_us = self._before
        if (state.position == last.position).all() and (state.velocity == last.velocity).all():
            return None  # without new telemetry; frozen telemetry is detected elsewhere
        self._before = state, now_us
        dt_s = (now_us - last_us) / US_PER_S
        # Trapezoidal integral of velocity between the two samples.
        explained = 0.5 * (last.velocity + state.velocity) * dt_s
        rest = (state.position - last.position - explained)[:2]
        jump_m = float(np.linalg.norm(rest))
        # A vehicle may brake and turn between two checks, which leaves half its speed unexplained.
        speeds = np.linalg.norm(last.velocity), np.linalg.norm(state.velocity)
        if jump_m > STEP_M + max(speeds) * dt_s:
            return Ending(TELEMETRY_WRONG, f"the position jumped by {jump_m:.1f} m")
        # Leaky sum of unexplained motion: a slow drift adds up, single errors decay.
        self._drift_m = self._drift_m * math.exp(-dt_s / DRIFT_S) + rest
        drift_m = float(np.linalg.norm(self._drift_m))
        if drift_m > DRIFT_M:
            return Ending(TELEMETRY_WRONG, f"position and velocity have parted by {drift_m:.1f} m")
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
        flown_s = (now_us - self.begun_us) / US_PER_S
        if self._flight_s is not None and flown_s > self._flight_s:
            return Ending(OUT_OF_TIME, f"{flown_s:.0f} s; at most {self._flight_s:g} s")
        return None


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
