"""Interface of the autopilot for the MAVLink services."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from airl_mav.control.demand import AttitudeDemand, RateDemand
from airl_mav.core.frames import Geodetic, Vector
from airl_mav.faults.fault import Fault
from airl_mav.faults.kinds import Part
from firmware_sim.autopilot.autopilot_state import (
    UNTOLD,
    AutopilotState,
    OperatorText,
    Result,
    Setpoint,
    Wire,
)
from firmware_sim.autopilot.events.definition import MavlinkEvent
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.inputs import (
    FollowedTarget,
    LandingTarget,
    ModeRequest,
    ObstacleBins,
    Source,
    Sticks,
)
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.interfaces import SensorSample


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """Parameter as stored."""

    name: str
    value: int | float
    """Value: int for INT32 parameters, float for REAL32."""
    index: int


class ParameterStore(Protocol):
    """PX4-named parameters."""

    def __hash__(self) -> int:
        """Return an identity hash: two stores are never equal."""

    @property
    def value(self) -> Callable[[str], float]:
        """Look-up of values clipped for flight. Raises KeyError for an unknown name."""

    @property
    def revision(self) -> int:
        """Number that changes with each change of a value."""

    def __len__(self) -> int:
        """Return the number of parameters."""

    def by_name(self, name: str) -> ParameterValue | None:
        """Return a parameter, or None if the name is unknown."""

    def by_index(self, index: int) -> ParameterValue | None:
        """Return a parameter, or None if the index is out of range."""

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        """Store a value as given; return the stored parameter."""

    def reset(self) -> None:
        """Return to the defaults."""

    def load(self) -> bool:
        """Reload the stored values, if there is a storage; return success."""

    def save(self) -> bool:
        """Store the values that differ from the defaults; return success."""


class Failures(Protocol):
    """Failure injection into the simulated vehicle for client requests."""

    def inject(self, fault: Fault) -> None:
        """Start a fault of a component."""

    def clear(self, part: Part) -> None:
        """End all faults of a component."""


class LogEntry(NamedTuple):
    """Flight log on board."""

    utc_s: int
    """Start or completion time of the log [s since 1970]."""
    size_bytes: int


class OpenLog(NamedTuple):
    """Log currently being written."""

    number: int
    """Index in `LogStore.entries`."""
    head_bytes: int
    """Size of the log header: format, parameters."""
    size_bytes: int
    """Current size, at a message boundary."""


class LogStore(Protocol):
    """Flight logs on board; a log's number is its index in `entries`."""

    def entries(self) -> Sequence[LogEntry]:
        """Return the logs, oldest first."""

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return up to `count` bytes of a log, fewer at its end; none if the log does not exist."""

    def open_log(self) -> OpenLog | None:
        """Return the log currently being written, or None."""


class NoLogs:
    """Empty log store. Implements `LogStore`."""

    def entries(self) -> Sequence[LogEntry]:
        """Return no logs."""
        return ()

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return no data."""
        del number, offset, count
        return b""

    def open_log(self) -> None:
        """Return None."""
        return


class AutopilotPort(Protocol):
    """Commands in, state out. Every call happens between two ticks, on one thread."""

    @property
    def parameters(self) -> ParameterStore:
        """Parameter store."""

    @property
    def plans(self) -> Plans:
        """Mission, geofence and rally points stored on board."""

    @property
    def failures(self) -> Failures | None:
        """Failure injection; None: not supported."""

    @property
    def logs(self) -> LogStore:
        """Flight logs on board."""

    @property
    def sample(self) -> SensorSample | None:
        """Sensors of the newest tick; None before the first. Cheap enough to read in every tick."""

    def state(self) -> AutopilotState:
        """Return the snapshot after the newest tick."""

    @property
    def attitude(self) -> Vector:
        """Estimated attitude quaternion (4,) body -> NED."""
        ...

    def take_messages(self) -> list[OperatorText]:
        """Return texts for the operator since the last call."""

    def take_events(self) -> list[MavlinkEvent]:
        """Return events since the last call: operator texts with events, and reports."""

    def tell_checks(self) -> None:
        """Report all failing pre-arm checks again."""

    def arm(self, *, force: bool) -> Result:
        """Request arming."""

    def disarm(self, *, force: bool) -> Result:
        """Request disarming; force = kill, also in the air."""

    def terminate(self) -> Result:
        """Request permanent motor stop; DENIED while disarmed."""

    def takeoff(self, altitude_m: float | None, place: tuple[float, float] | None = None) -> Result:
        """Request a take-off to a height above home [m] and a place, local NED north, east [m].

        Default height: MIS_TAKEOFF_ALT; default place: straight up.
        """

    def set_mode(
        self, mode: Mode, request: ModeRequest | None = None, *, commanded: bool = False
    ) -> Result:
        """Request a mode.

        Args:
            mode: Requested mode.
            request: Optional arguments of the mode.
            commanded: True for a specific command (NAV_LAND), whose acceptance is reported.
        """

    def change_speed(self, speed_m_s: float) -> None:
        """Set the horizontal speed of the active automatic mode [m/s]."""

    def start_mission(self, index: int) -> Result:
        """Arm and fly the mission from an item; -1 = current item."""

    def look_at(self, place: Geodetic | None) -> None:
        """Turn the nose to a place during a mission; None = cancel."""

    def set_home(self, place: Geodetic | None) -> Result:
        """Move home; None = the current position."""

    def set_origin(self, place: Geodetic) -> Result:
        """Move the geodetic origin of local NED."""

    def offer_setpoint(self, setpoint: Setpoint, time_us: int) -> None:
        """Pass on a valid offboard setpoint, received at `time_us` of simulated time."""

    def offer_attitude(
        self, demand: AttitudeDemand | RateDemand, time_us: int, wire: Wire = UNTOLD
    ) -> None:
        """Pass on an offboard setpoint of attitude or body rates, received at `time_us`.

        `wire` identifies it in latency analysis: roll, pitch, yaw [rad] or their rates [rad/s], and
        thrust.
        """

    def refuse_setpoint(self, reason: str, time_us: int) -> None:
        """Record the reason of a rejected offboard setpoint, which the next failsafe names."""

    def manual_control(self, sticks: Sticks, source: Source, time_us: int) -> None:
        """Pass on the pilot's sticks, received at `time_us` of simulated time."""

    def receive(self, name: str, reading: Any) -> None:
        """Pass on a reading of a client's sensor, received now: odometry, distance or flow."""

    def see_obstacles(self, obstacles: ObstacleBins) -> None:
        """Pass on the distances to obstacles."""

    def follow(self, target: FollowedTarget) -> None:
        """Pass on the position of the Follow target."""

    def landing_target(self, target: LandingTarget) -> None:
        """Pass on the position of the precision landing target."""

    def gcs_heartbeat(self, time_us: int) -> None:
        """Record a heartbeat from a ground station."""
