"""The pilot's view of a flight controller, as plain data and a protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeAlias

from airl_mav.policy.actions import Attitude, BodyRates
from airl_mav.policy.observation import Kinematics

LINK_LOST = "link lost"
"""Why a mission ended: the flight controller was no longer heard."""

CAMERA_SILENT = "camera silent"
"""Why a mission ended: the watchdog saw that no frame came."""


TELEMETRY_FROZEN = "telemetry frozen"
"""Why a mission ended: telemetry did not change."""

FRAMES_LATE = "frames late"
"""Why a mission ended: frames came, but long after they were taken."""


class LinkError(Exception):
    """The flight controller refused, or is gone."""


class VehicleStatus(NamedTuple):
    """Who flies, by the newest heartbeat (known up to 1 s late)."""

    armed: bool
    offboard: bool
    """Whether it flies our setpoints; on ArduPilot GUIDED."""
    mode: str
    battery: float | None = None
    """Charge that is left, 1 to 0; None: not told."""


class BatteryState(NamedTuple):
    """The battery, as the flight controller tells it; None: it does not."""

    voltage_v: float | None
    current_a: float | None
    remaining: float | None
    """1 to 0."""


class BodyVelocity(NamedTuple):
    """A velocity setpoint in the heading frame, with a yaw rate, in the order on the wire."""

    forward_m_s: float
    right_m_s: float
    down_m_s: float
    yaw_rate_rad_s: float


STOP = BodyVelocity(0.0, 0.0, 0.0, 0.0)

Due: TypeAlias = "Callable[[Sequence[bytes]], bool]"
Quiet: TypeAlias = "Callable[[Sequence[bytes]], float]"
"""Returns by the newest frames for how long at least a condition fails on [µs]; inf = until the
next heartbeat."""
"""Returns whether a condition has to be checked, given the MAVLink frames of the flight controller
that MAVSDK has not received yet."""

Setpoint: TypeAlias = "BodyVelocity | Attitude | BodyRates"
"""Setpoints of four numbers each."""


class Link(Protocol):
    """The pilot's view of a flight controller. Calls raise LinkError when refused."""

    @property
    def connected(self) -> bool:
        """Whether the flight controller is heard."""
        ...

    def kinematics(self) -> Kinematics:
        """Return the newest telemetry."""
        ...

    def status(self) -> VehicleStatus:
        """Return who flies."""
        ...

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Send a setpoint; it is repeated until the next one, of whatever kind."""
        ...

    def release(self) -> None:
        """Send nothing more: somebody else flies."""
        ...

    def leave_offboard(self) -> None:
        """Switch to Hold."""
        ...
