"""The interface through which the MAVLink services use the autopilot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from airl_mav.control.demand import AttitudeDemand, RateDemand
from airl_mav.core.frames import Geodetic, Vector
from airl_mav.faults.kinds import Part
from airl_mav.faults.model import Fault
from firmware_sim.autopilot.autopilot_state import (
    UNTOLD,
    AutopilotState,
    Message,
    Mode,
    Result,
    Setpoint,
    Wire,
)
from firmware_sim.autopilot.events.definition import Event
from firmware_sim.autopilot.manual_control import Source, Sticks
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.autopilot.requests import FollowedTarget, LandingTarget, Obstacles, Request
from firmware_sim.interfaces import DistanceReading, FlowReading, Odometry, SensorSample


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """One parameter as stored."""

    name: str
    value: int | float
    """int for INT32 parameters, float for REAL32."""
    index: int


class ParameterStore(Protocol):
    """PX4-named parameters."""

    def __hash__(self) -> int:
        """Tell it from others: two stores are never the same."""

    @property
    def value(self) -> Callable[[str], float]:
        """Looks a value up as it is flown: within bounds. Raises KeyError for an unknown name."""

    @property
    def revision(self) -> int:
        """Another number after each change of a value, the same until then."""

    def __len__(self) -> int:
        """Return the number of parameters."""

    def by_name(self, name: str) -> ParameterValue | None:
        """Return a parameter, or None when there is no such name."""

    def by_index(self, index: int) -> ParameterValue | None:
        """Return a parameter, or None when the index is out of range."""

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        """Store a value as given, and return what is stored now."""

    def reset(self) -> None:
        """Return to the defaults."""

    def load(self) -> bool:
        """Return to what is kept, where something is kept; return whether that went well."""

    def save(self) -> bool:
        """Keep what differs from the defaults; return whether that went well."""


class Failures(Protocol):
    """Makes parts of the simulated vehicle fail at a client's word."""

    def inject(self, fault: Fault) -> None:
        """Let a part fail from now on."""

    def clear(self, part: Part) -> None:
        """End all that acts on a part."""


class LogEntry(NamedTuple):
    """One flight log aboard."""

    utc_s: int
    """When it began, or was completed [s since 1970]."""
    size_bytes: int


class OpenLog(NamedTuple):
    """The log that is being written."""

    number: int
    """Its place in `LogStore.entries`."""
    head_bytes: int
    """Size of what describes the log: format, parameters."""
    size_bytes: int
    """Size by now; a message ends here."""


class LogStore(Protocol):
    """The flight logs aboard; a log's number is its place in `entries`."""

    def entries(self) -> Sequence[LogEntry]:
        """Return the logs, oldest first."""

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return up to `count` bytes of a log, fewer at its end; none when there is no such log."""

    def open_log(self) -> OpenLog | None:
        """Return the log that is being written, None when there is none."""


class NoLogs:
    """A vehicle that keeps no logs. Implements `LogStore`."""

    def entries(self) -> Sequence[LogEntry]:
        """Return nothing."""
        return ()

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return nothing."""
        del number, offset, count
        return b""

    def open_log(self) -> None:
        """Return nothing."""
        return


class AutopilotPort(Protocol):
    """Commands in, state out. Every call happens between two ticks, on one thread."""

    @property
    def parameters(self) -> ParameterStore:
        """The parameter store."""

    @property
    def plans(self) -> Plans:
        """The mission, the geofence and the rally points that are stored aboard."""

    @property
    def failures(self) -> Failures | None:
        """What makes parts fail; None: nobody simulates them."""

    @property
    def logs(self) -> LogStore:
        """The flight logs aboard."""

    @property
    def sample(self) -> SensorSample | None:
        """The newest tick's sensors; None before the first. Cheap: may be read every tick."""

    def state(self) -> AutopilotState:
        """Return the snapshot after the newest tick."""

    @property
    def attitude(self) -> Vector:
        """Estimate (4,) body -> NED."""
        ...

    def take_messages(self) -> list[Message]:
        """Return texts for the operator since the last call."""

    def take_events(self) -> list[Event]:
        """Return events since the last call: texts that are events, too, and reports."""

    def tell_checks(self) -> None:
        """Tell all failing pre-arm checks anew."""

    def arm(self, *, force: bool) -> Result:
        """Ask to arm."""

    def disarm(self, *, force: bool) -> Result:
        """Ask to disarm; force = kill, also in the air."""

    def terminate(self) -> Result:
        """Ask to stop the motors for good; DENIED while disarmed."""

    def takeoff(self, altitude_m: float | None, place: tuple[float, float] | None = None) -> Result:
        """Ask to climb to a height above home [m], and to a place, local NED north and east [m].

        No height = MIS_TAKEOFF_ALT; no place = straight up.
        """

    def set_mode(
        self, mode: Mode, request: Request | None = None, *, commanded: bool = False
    ) -> Result:
        """Ask for a mode.

        Args:
            mode: Which one.
            request: What it takes beyond its name.
            commanded: By a command of its own (NAV_LAND), whose grant is told.
        """

    def change_speed(self, speed_m_s: float) -> None:
        """Set the horizontal speed of the present automatic mode [m/s]."""

    def start_mission(self, index: int) -> Result:
        """Arm and fly the mission from an item on; -1 = as it stands."""

    def look_at(self, place: Geodetic | None) -> None:
        """Turn to a place while a mission is flown; None = to none."""

    def set_home(self, place: Geodetic | None) -> Result:
        """Move home; None = to the present place."""

    def set_origin(self, place: Geodetic) -> Result:
        """Let local NED be zero at another place of the globe."""

    def offer_setpoint(self, setpoint: Setpoint, time_us: int) -> None:
        """Hand over a valid offboard setpoint, received at `time_us` of simulated time."""

    def offer_attitude(
        self, demand: AttitudeDemand | RateDemand, time_us: int, wire: Wire = UNTOLD
    ) -> None:
        """Hand over an offboard setpoint of attitude or body rates, received at `time_us`.

        `wire` is what latency analysis recognises it by: roll, pitch, yaw [rad] or their rates
        [rad/s], and the thrust.
        """

    def refuse_setpoint(self, reason: str, time_us: int) -> None:
        """Note why an offboard setpoint was refused: the failsafe that follows names it."""

    def manual_control(self, sticks: Sticks, source: Source, time_us: int) -> None:
        """Hand over the pilot's sticks, received at `time_us` of simulated time."""

    def see(self, odometry: Odometry) -> None:
        """Hand over a pose that something else has estimated, received now."""

    def measure_distance(self, reading: DistanceReading) -> None:
        """Hand over what a client's distance sensor measures, received now."""

    def look_down(self, reading: FlowReading) -> None:
        """Hand over what a client's optical flow sensor measures, received now."""

    def see_obstacles(self, obstacles: Obstacles) -> None:
        """Hand over how far obstacles are."""

    def follow(self, target: FollowedTarget) -> None:
        """Hand over where the target is that Follow follows."""

    def landing_target(self, target: LandingTarget) -> None:
        """Hand over where the target of a precision landing is."""

    def gcs_heartbeat(self, time_us: int) -> None:
        """A ground station was heard."""
