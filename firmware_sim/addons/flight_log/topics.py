"""Logged uORB topics of PX4 1.17 (`topics.toml`), and the sources of their values.

A topic contains the PX4 fields that apply to the simulator; logs are self-describing, so readers
find fields by name. Sources are arrays: one call logs many ticks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from airl_mav.control import demand, loops
from airl_mav.core import constants, frames
from airl_mav.profiles.loading import read_table
from airl_mav.vehicle import atmosphere
from firmware_sim import sensor_table
from firmware_sim.addons.flight_log.ulog_writer import Topic, Values
from firmware_sim.autopilot import autopilot_state, error_state, flight_modes, snapshot
from firmware_sim.engine import dynamics, record

Rows: TypeAlias = NDArray[Any]

DISARMED, ARMED = 1, 2
"""VehicleStatus.arming_state."""

_MOTORS, _OUTPUTS = 12, 16
"""ActuatorMotors.NUM_CONTROLS, ActuatorOutputs.NUM_ACTUATOR_OUTPUTS; absent motors are NaN."""

_PWM_DISARMED, _PWM_MIN, _PWM_SPAN = 900.0, 1_000.0, 1_000.0
"""Pulse widths [µs] of PX4's simulated outputs (src/modules/simulation/pwm_out_sim)."""

_SETPOINT_TYPES = {"HOLD": 2, "TAKEOFF": 3, "LAND": 4}
"""PositionSetpoint.type by mode; 0 in other modes."""


class Moment(NamedTuple):
    """State of a vehicle and its simulator after some ticks."""

    flown: record.Record
    """(n,) logs of the flight controller's ticks."""
    truths: record.Record
    """(n,) logs of the aircraft's ticks."""
    state: snapshot.AutopilotState
    boot_unix_us: int = 0
    """Calendar time of simulated time 0 [µs since 1970]."""


Source: TypeAlias = Callable[[Moment], Any]
"""Returns an array (n, ...), or a value of all ticks."""


def _part(column: str, part: slice) -> Source:
    return lambda m: m.flown[column][:, part]


def _places(positions: frames.Vector, origin: frames.Geodetic | None) -> Any:
    """Return latitudes, longitudes [deg] and altitudes [m] (n, 3) of local positions NED."""
    if origin is None:
        return np.full((len(positions), 3), math.nan)
    return np.array([frames.local_to_geodetic(each, origin) for each in positions]).reshape(-1, 3)


def _is_placed(m: Moment) -> Any:
    """Return a mask (n,) of ticks with a position setpoint."""
    return np.isin(m.flown["demand_kind"], (record.POSITION, record.TRAJECTORY))


def _trajectory(m: Moment) -> Rows:
    """Return position, velocity, acceleration, yaw and yaw rate setpoints (n, 11), NED."""
    wanted, plain = m.flown["demand"], m.flown["demand_kind"] == record.POSITION
    found = wanted.copy()
    # The two layouts of `demand` hold yaw and yaw rate at different places.
    found[plain, 6:9], found[plain, 9:] = math.nan, wanted[plain, 6:8]
    # A position without a velocity has zero there; PX4 logs NaN.
    speeds = found[:, 3:6]
    speeds[np.isfinite(found[:, :3]) & (speeds == 0.0)] = math.nan
    return found


def _ground(m: Moment) -> Any:
    """Return distance to the ground [m], variance [m²], validity, resets, and 1 for a sensor."""
    ground = m.state.clearance
    if ground is None:
        return np.array((math.nan, math.nan, 0.0, 0.0, 0.0))
    found = ground.dist_bottom_m, ground.variance_m2, ground.valid, ground.resets % 256
    return np.array((*found, ground.by_range), np.float64)


def _motors(m: Moment, count: int, stopped: float, commands: Rows) -> Rows:
    """Return `commands` (n, 4) in `count` columns; `stopped` while disarmed, and in the others."""
    found = np.full((len(m.flown), count), stopped)
    if _is_armed(m):
        found[:, :4] = commands
    return found


def _torque(m: Moment) -> Any:
    """Return the torque setpoint (n, 3) that the motor commands contain, -1..1, FRD."""
    directions = np.array((loops.ROLL, loops.PITCH, loops.YAW)).T
    return m.flown["motors"] @ (directions / (4.0 * np.array((*m.state.mixing, 1.0))))


def _offboard(m: Moment) -> Any:
    """Return the flags of the newest offboard setpoint (5,), as in offboard_control_mode."""
    newest = m.state.offboard
    kinds = isinstance(newest, demand.AttitudeDemand), isinstance(newest, demand.RateDemand)
    vectors = (
        (newest.position, newest.velocity, newest.acceleration)
        if isinstance(newest, autopilot_state.Setpoint)
        else ((math.nan,),) * 3
    )
    return np.array([*(bool(np.isfinite(each).any()) for each in vectors), *kinds])


def _destination(m: Moment) -> Mapping[str, Any]:
    """Return the current setpoint of position_setpoint_triplet."""
    ((latitude, longitude, altitude),) = _places(np.array([m.state.destination]), m.state.origin)
    kind, now_us = _SETPOINT_TYPES.get(m.state.status.mode.name, 0), m.state.time_us
    place = {"lat": latitude, "lon": longitude, "alt": altitude}
    return {"timestamp": now_us, "valid": True, "type": kind, **place}


def _is_armed(m: Moment) -> bool:
    return m.state.status.arming is autopilot_state.Arming.ARMED


def _thrust(m: Moment) -> Any:
    """Return the thrust setpoint (n, 3), body -1..0."""
    return m.flown["output"][:, 10:] * (0.0, 0.0, -1.0)


_SIGMA = error_state.SIGMA

SOURCES: Mapping[str, Source] = {
    "position": _part("state", slice(error_state.P, error_state.V)),
    "velocity": _part("state", slice(error_state.V, error_state.Q)),
    "q": _part("state", slice(error_state.Q, error_state.RATES)),
    "rates": _part("state", slice(error_state.RATES, error_state.GYRO_BIAS)),
    "acceleration": _part("state", slice(error_state.ACCELERATION, error_state.ACCELERATION + 3)),
    "specific_force": lambda m: (
        m.flown["accel"] - m.flown["state"][:, error_state.ACCEL_BIAS : error_state.BARO_OFFSET]
    ),
    "test_ratios": _part("state", slice(error_state.RATIO, error_state.RATIO + 4)),
    "velocity_ratio": lambda m: m.flown["state"][:, [error_state.RATIO, error_state.RATIO + 3]].max(
        axis=1
    ),
    "heading": lambda m: frames.quats_to_euler(
        m.flown["state"][:, error_state.Q : error_state.RATES]
    )[2],
    # Horizontal and vertical position, horizontal and vertical velocity.
    "accuracy": lambda m: np.hypot(
        m.flown["state"][:, [_SIGMA, _SIGMA + 2, _SIGMA + 3, _SIGMA + 5]],
        m.flown["state"][:, [_SIGMA + 1, _SIGMA + 2, _SIGMA + 4, _SIGMA + 5]] * (1, 0, 1, 0),
    ),
    "origin": lambda m: np.array(m.state.origin or (math.nan,) * 3),
    "located": lambda m: (m.state.origin is not None) & (m.flown["healthy"] != 0),
    "place": lambda m: _places(m.flown["state"][:, error_state.P : error_state.V], m.state.origin),
    "ground": _ground,
    "q_setpoint": _part("output", slice(0, 4)),
    "rates_setpoint": _part("output", slice(4, 7)),
    "thrust_body": _thrust,
    "torque": _torque,
    "control": lambda m: _motors(m, _MOTORS, math.nan, m.flown["motors"]),
    "pulses": lambda m: _motors(
        m, _OUTPUTS, _PWM_DISARMED, np.rint(_PWM_MIN + _PWM_SPAN * m.flown["motors"])
    ),
    "has_trajectory": _is_placed,
    "trajectory": _trajectory,
    # Without a position setpoint, the controller's is the current position.
    "position_setpoint": lambda m: np.where(
        _is_placed(m)[:, None], m.flown["demand"][:, :3], m.flown["state"][:, :3]
    ),
    "yaw_setpoint": lambda m: np.where(
        _is_placed(m)[:, None], _trajectory(m)[:, 9:], (math.nan, 0)
    ),
    "yaw_move_rate": lambda m: np.where(_is_placed(m), np.nan_to_num(_trajectory(m)[:, 10]), 0.0),
    "offboard": _offboard,
    "offboard_us": attrgetter("state.offboard_us"),
    "has_destination": lambda m: m.state.destination if m.state.origin is not None else None,
    "destination": _destination,
    "fix_place": lambda m: _places(m.flown["gps_position"], frames.HOME),
    "fix_speed": lambda m: np.linalg.norm(m.flown["gps_velocity"], axis=1),
    "fix_course": lambda m: np.arctan2(
        m.flown["gps_velocity"][:, 1], m.flown["gps_velocity"][:, 0]
    ),
    "unix_us": lambda m: m.boot_unix_us + m.flown["time_us"],
    "has_pressure": lambda m: np.isfinite(m.flown["pressure_hpa"]),
    "pressure_pa": lambda m: 100.0 * m.flown["pressure_hpa"],
    "baro_altitude": lambda m: [atmosphere.altitude_m(p) for p in m.flown["pressure_hpa"].tolist()],
    "arming_state": lambda m: ARMED if _is_armed(m) else DISARMED,
    "armed": _is_armed,
    "ready": lambda m: m.state.status.arming is not autopilot_state.Arming.BOOT,
    "landed": lambda m: m.state.status.landed is autopilot_state.Landed.ON_GROUND,
    "breached": lambda m: any(m.state.conditions.geofence),
    "true_heading": lambda m: frames.quats_to_euler(m.flown["motion"][:, dynamics.QUATERNION])[2],
}
"""Sources of `topics.toml`. Units: SI, frames: NED and FRD."""


@dataclass(frozen=True)
class Logged:
    """Logged topic."""

    topic: Topic
    interval_us: int = 0
    rows: str = "flown"
    """Log with a row per message: flown or truth; state = the newest state; event = none."""
    changes: bool = False
    """True to log a change immediately; otherwise only the interval applies."""
    when: str = ""
    """Source of a condition: None, or false in a tick = no message."""
    time: str = ""
    """Source of the timestamp of a state."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Sources by field."""
    values: Callable[[snapshot.AutopilotState], Values | None] | None = None
    """Function of the values in place of sources, for a topic of a sensor."""

    def messages(self, moment: Moment) -> Rows | None:
        """Return the messages of a moment (n,); None = nothing to log."""
        if self.values is not None:
            values = self.values(moment.state)
            return None if values is None else self.topic.row(moment.state.time_us, values)
        if self.rows == "truth":
            moment = moment._replace(flown=moment.truths)
        if self.when:
            known = _read(self.when, moment, {})
            if known is None:
                return None
            if isinstance(known, np.ndarray):
                moment = moment._replace(flown=moment.flown[known])
        memo: dict[str, Any] = {}
        columns = {name: _read(source, moment, memo) for name, source in self.sources.items()}
        times: Any = moment.flown["time_us"]
        if self.rows == "state":
            times = [_read(self.time, moment, memo) if self.time else moment.state.time_us]
        return self.topic.rows(times, columns)


def _read(source: str, moment: Moment, memo: dict[str, Any]) -> Any:
    """Return the value of a source; `memo` holds the values of the same moment by name."""
    if source[0] == "@":
        return attrgetter(source[1:])(moment.state)
    name, _, place = source.partition(".")
    if name not in memo:
        memo[name] = SOURCES[name](moment) if name in SOURCES else moment.flown[name]
    if not place:
        return memo[name]
    first, colon, end = place.partition(":")
    return memo[name][..., slice(int(first), int(end)) if colon else int(first)]


def _constant(source: str) -> float | None:
    """Return the value of a constant source; None = not constant."""
    if source.startswith("bits."):
        need = flight_modes.Need[source.removeprefix("bits.")]
        return sum(mode.spec.state_bits for mode in flight_modes.Mode if need in mode.spec.needs)
    try:
        return float(source)
    except ValueError:
        return None


def _load() -> list[Logged]:
    """Return the topics of `topics.toml` and of the sensors."""
    found, topics = [], dict[str, Topic]()
    for name, table in read_table(__file__).items():
        keys = {key: table.pop(key) for key in ("rows", "changes", "when", "time") if key in table}
        interval_us = table.pop("interval_ms", 0) * constants.US_PER_MS
        fields, known = [], {}
        for each, described in table.items():
            kind, _, known[each] = described.partition(" ")
            fields.append(f"{kind} {each}")
        fixed = {each: _constant(source) for each, source in known.items()}
        topics[name] = topic = Topic(
            name,
            tuple(fields),
            {each: value for each, value in fixed.items() if value is not None},
            {kind: topics[kind] for kind in (f.split()[0] for f in fields) if kind in topics},
        )
        sources = {each: s for each, s in known.items() if s and fixed[each] is None}
        if interval_us or keys:
            found.append(Logged(topic, interval_us, **keys, sources=sources))
    for sensor in sensor_table.sensors().values():
        for name, logged in sensor.topics.items():
            groups = (group.split() for group in logged.fields.split("; "))
            described = tuple(f"{kind} {each}" for kind, *names in groups for each in names)
            interval_us = logged.interval_ms * constants.US_PER_MS
            found.append(Logged(Topic(name, described), interval_us, "state", values=logged.values))
    return found


TOPICS = _load()
"""Logged topics, in the order of the log."""
