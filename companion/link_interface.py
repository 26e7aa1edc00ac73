"""Interface between pilot and flight controller, as plain data and a protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeAlias

from airl_mav.policy.actions import Attitude, BodyRates
from airl_mav.policy.observation import Kinematics

LINK_LOST = "link lost"
"""End of a mission: the flight controller was no longer received."""

CAMERA_SILENT = "camera silent"
"""End of a mission: the watchdog found that no frame arrived."""


TELEMETRY_FROZEN = "telemetry frozen"
"""End of a mission: telemetry did not change."""

FRAMES_LATE = "frames late"
"""End of a mission: frames arrived long after their capture."""


class LinkError(Exception):
    """The flight controller rejected a request, or the link is lost."""


class VehicleStatus(NamedTuple):
    """Armed state, mode and charge from the newest heartbeat (latency up to 1 s)."""

    armed: bool
    offboard: bool
    """True if the vehicle flies the companion's setpoints; GUIDED on ArduPilot."""
    mode: str
    battery: float | None = None
    """Remaining charge, 1 to 0; None = not reported."""


class BatteryState(NamedTuple):
    """Battery state reported by the flight controller; None = not reported."""

    voltage_v: float | None
    current_a: float | None
    remaining: float | None
    """Remaining charge, 1 to 0."""


class BodyVelocity(NamedTuple):
    """Velocity setpoint in the heading frame, with a yaw rate, in wire order."""

    forward_m_s: float
    right_m_s: float
    down_m_s: float
    yaw_rate_rad_s: float


STOP = BodyVelocity(0.0, 0.0, 0.0, 0.0)

Due: TypeAlias = "Callable[[Sequence[bytes]], bool]"
"""Function that returns True if a condition must be checked, given the flight controller's MAVLink
frames that MAVSDK has not received yet."""
Quiet: TypeAlias = "Callable[[Sequence[bytes]], float]"
"""Function that returns the minimum time for which a condition continues to fail [µs], given the
newest frames; inf = until the next heartbeat."""

Setpoint: TypeAlias = "BodyVelocity | Attitude | BodyRates"
"""Setpoint types, with four numbers each."""


class PilotLink(Protocol):
    """Link of the pilot to a flight controller. Calls raise LinkError if rejected."""

    @property
    def connected(self) -> bool:
        """True while the flight controller is received."""
        ...

    def kinematics(self) -> Kinematics:
        """Return the newest telemetry."""
        ...

    def status(self) -> VehicleStatus:
        """Return armed state, flight mode and charge."""
        ...

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Send a setpoint; it is repeated until the next setpoint of any kind."""
        ...

    def release(self) -> None:
        """Stop sending setpoints without a mode change: the pilot has control."""
        ...

    def leave_offboard(self) -> None:
        """Switch to Hold."""
        ...
