"""Fast streams: packed from one table in compiled code, many ticks at a time.

Each message of telemetry.toml lists a source per field, in order; offsets and wire types
are pymavlink's. Sources are computed once per tick in which a message is due. Units and "unknown"
values: MAVLink common.xml and PX4 src/modules/mavlink/streams/*.hpp.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from itertools import accumulate
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from airl_mav.core.clock import NS_PER_US
from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import HOME, Geodetic, Vector, geodetic_to_local, local_to_geodetic
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.profiles.loading import read_table
from airl_mav.vehicle import atmosphere
from airl_mav.vehicle.rotation import rotate, yaw_of
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot_state import Arming
from firmware_sim.autopilot.failsafes import detectors
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.engine.record import FLOWN_TICK, POSITION, TRAJECTORY, Fields, Record
from firmware_sim.mavlink.codec import COMPONENT_ID, dialect, message_id
from firmware_sim.mavlink.streams import units
from firmware_sim.mavlink.streams.sensors import clearance
from firmware_sim.mavlink.streams.status import sensor_bits

register_jitable(detectors.current_a)

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

_TABLES = read_table(__file__)
_SOURCES: Final = tuple(_TABLES["sources"].split())
_AT: Final = {name: place for place, name in enumerate(_SOURCES)}

# One bit per group of sources, see `_PART_OF`.
_PLACED, _WANTED, _GOAL_PART, _FIX_PART, _ESC_PART, _HEALTH = (1 << bit for bit in range(6))
_PART_OF: Final = {
    _PLACED: ("located", "lat_e7", "lon_e7", "alt_mm", "above_home_mm", "hud_alt", "amsl", "up"),
    _WANTED: ("sp_qw", "sp_mask", "sp_vx", "sp_thrust", "throttle", "pwm_1"),
    _WANTED | _GOAL_PART: ("goal_known",),
    _FIX_PART: ("fix_known",),
    _ESC_PART: ("esc_cdeg_1", "rpm_1"),
    _HEALTH: ("parts_present",),
}
"""Groups of sources that are computed only if a message uses one of them."""

FIELDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {name: tuple(sources.split()) for name, sources in _TABLES["fields"].items()}
)
"""Messages and the sources of their fields."""

_IMU_FIELDS = 0b1_1011_1111_1111
"""HIGHRES_IMU_UPDATED_FLAGS: all except differential pressure."""

_PWM_DISARMED, _PWM_MIN, _PWM_SPAN = 900, 1_000, 1_000
"""Pulse widths [µs] of PX4's simulated outputs (src/modules/simulation/pwm_out_sim)."""

_FLOAT, _SIZES = 0, {"f": 4, "i": 4, "I": 4, "h": 2, "H": 2, "b": 1, "B": 1, "q": 8, "Q": 8}
_FIELD_FORMAT = re.compile(r"(\d*)([a-zA-Z])")

_LARGEST = 280
"""Size of the largest MAVLink 2 frame [bytes]."""

_NEVER: int = np.iinfo(np.int64).max


class _Table(NamedTuple):
    """Messages as arrays: m messages, f fields in total."""

    ids: Ints  # (m,)
    extras: Ints  # (m,) seed of the checksum
    sizes: Ints  # (m,) bytes of the payload
    needs: Ints  # (m,) source that must not be 0
    parts: Ints  # (m,) bits of the parts of the sources that it needs
    first: Ints  # (m + 1,) of the fields
    sources: Ints  # (f,)
    offsets: Ints  # (f,) in the payload
    kinds: Ints  # (f,) 0 = float32, else bytes of an integer, negative if not aligned


def _table() -> _Table:
    # `heads` has a row per message, `fields` a row per field; `first` delimits the rows.
    heads, fields, first = [], [], [0]
    for name, sources in FIELDS.items():
        kind = dialect.mavlink_map[message_id(name)]
        need = _TABLES["needs"].get(name, "one")
        parts = 0
        # The message needs each group with at least one of its sources.
        for part, marks in _PART_OF.items():
            parts |= part if {need, *sources} & {*marks} else 0
        heads.append((kind.id, kind.crc_extra, kind.unpacker.size, _AT[need], parts))
        formats = _FIELD_FORMAT.findall(kind.unpacker.format)
        counts = [int(count or 1) for count, _ in formats]
        # Wire layout: position of each field in the packed struct, arrays with their count.
        sizes = [count * _SIZES[code] for count, (_, code) in zip(counts, formats, strict=True)]
        starts = accumulate(sizes, initial=0)
        wire = {
            field: (start, code, count)
            for field, start, count, (_, code) in zip(
                kind.ordered_fieldnames, starts, counts, formats, strict=False
            )
        }
        # From wire order back to the order of definition, in which `FIELDS` lists the sources.
        places = [
            (start + i * _SIZES[code], _FLOAT if code == "f" else _SIZES[code])
            for start, code, count in (wire[field] for field in kind.fieldnames)
            for i in range(count)
        ]
        # Extension fields come last; omitted ones are zero.
        fields += [(_AT[source], *place) for source, place in zip(sources, places, strict=False)]
        first.append(len(fields))
    ids, extras, sizes_, needs, parts_ = np.array(heads, np.int64).T
    sources_, offsets, kinds = np.array(fields, np.int64).T
    # MAVLink sorts fields by size, so they are aligned; extensions may not be.
    kinds = np.where((kinds > 0) & (offsets % np.maximum(kinds, 1) != 0), -kinds, kinds)
    columns = (ids, extras, sizes_, needs, parts_, np.array(first), sources_, offsets, kinds)
    return _Table(*(np.ascontiguousarray(column, np.int64) for column in columns))


_TABLE = _table()
NUMBERS: Mapping[str, int] = MappingProxyType({name: i for i, name in enumerate(FIELDS)})
"""Index of each message in the table."""


def _crc_table() -> Ints:
    """Return the CRC-16/MCRF4XX table by byte (MAVLink's X.25 checksum)."""
    table = np.zeros(256, np.int64)
    for byte in range(256):
        crc = byte
        # Reflected polynomial 0x1021, least significant bit first.
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8408 if crc & 1 else crc >> 1
        table[byte] = crc
    return table


_CRC = _crc_table()
# Checksums of a byte with one, two and three bytes of zeros behind it.
_CRC_2 = _CRC >> 8 ^ _CRC[_CRC & 0xFF]
_CRC_3 = _CRC_2 >> 8 ^ _CRC[_CRC_2 & 0xFF]
_CRC_4 = _CRC_3 >> 8 ^ _CRC[_CRC_3 & 0xFF]

# Values that stay constant during compiled ticks.
_LATITUDE, _LONGITUDE, _ORIGIN_M, _HOME_M, _ARMED, _HOVER, _TERRAIN, _CLEARANCE = range(8)
_GOAL, _FIX, _ESCS, PARTS = 8, 11, 15, 19
_UNKNOWN = (math.nan,) * 4


class TickContext:
    """Message values that a tick's log does not contain, cached until one changes."""

    SIZE = 23

    def __init__(self) -> None:
        self._values: tuple[float, ...] = ()
        self._revision: object = None
        self.row = np.zeros(0)
        """Newest values."""

    def of(self, state: AutopilotState) -> Vector:
        """Return the values (23,); NaN = unknown.

        Origin, home altitude, arming, hover thrust, terrain altitude, clearance, target (local
        NED), type, satellites and accuracies of the newest fix, outputs reported by the speed
        controllers, bits of SYS_STATUS, load.
        """
        revision, self._revision = self._revision, state.revision
        # The autopilot changes the revision object whenever a value below may have changed.
        if revision is not None and revision is self._revision:
            return self.row
        origin, home, goal, fix = state.origin, state.home, state.destination, state.gps
        ground = state.clearance
        values = (
            *(_UNKNOWN[:3] if origin is None else origin),
            math.nan if home is None else home.altitude_m,
            state.status.arming is Arming.ARMED,
            state.hover_thrust,
            *(_UNKNOWN[:2] if ground is None else clearance(state, state.estimate.position[2])),
            *(_UNKNOWN[:3] if goal is None or origin is None else goal),
            *(_UNKNOWN if fix is None else (fix.fix_type, fix.satellites, fix.eph_m, fix.epv_m)),
            *(state.esc_outputs or _UNKNOWN),
            *sensor_bits(state),
            units.uint16(state.load * 1e3),
        )
        # An equal tuple keeps the row: its identity shows the server that nothing changed.
        if values != self._values:
            self._values, self.row = values, np.array(values, np.float64)
        return self.row


def flown_of(state: AutopilotState) -> Record:
    """Return a snapshot as the log of a tick (1,)."""
    flown, estimate, wanted = np.zeros(1, FLOWN_TICK), state.estimate, state.setpoint
    # The row has the layout of the estimator's state (`es`), as in compiled logs.
    row = flown["state"][0]
    row[es.P : es.V], row[es.V : es.Q] = estimate.position, estimate.velocity
    row[es.Q : es.RATES], row[es.RATES : es.GYRO_BIAS] = (
        estimate.quaternion,
        estimate.angular_velocity,
    )
    row[es.GYRO_BIAS : es.ACCEL_BIAS] = estimate.gyro_bias
    row[es.ACCEL_BIAS : es.BARO_OFFSET] = estimate.accel_bias
    row[es.SIGMA : es.RATIO] = estimate.sigma
    for name, value in (
        ("time_us", state.time_us),
        ("healthy", estimate.healthy),
        ("accel", state.accel),
        ("gyro", state.gyro),
        ("mag", state.mag),
        ("pressure_hpa", state.pressure_hpa),
        ("temperature_c", state.temperature_c),
        ("demand_kind", POSITION),
        ("motors", state.motors),
        ("battery", state.battery),
    ):
        flown[name] = value
    # Fixes are logged in metres from HOME, not in degrees.
    if (fix := state.gps) is not None:
        flown["gps_position"] = geodetic_to_local(fix.position, HOME)
        flown["gps_velocity"] = fix.velocity_ned
    # A snapshot always has a position setpoint; the last columns stay zero.
    flown["demand"][0, :8] = (*wanted.position, *wanted.velocity, wanted.yaw, wanted.yaw_rate)
    flown["output"] = (
        *state.attitude_setpoint,
        *state.rate_setpoint,
        *wanted.velocity,
        state.thrust_setpoint,
    )
    return flown


# --- sources


@kernel
def _put3(v: Vector, at: int, a: float, b: float, c: float) -> None:
    v[at], v[at + 1], v[at + 2] = a, b, c


@kernel
def _estimated(v: Vector, row: Vector) -> None:
    """Write attitude, rates, position, velocity and their variances."""
    w, x, y, z = row[es.Q], row[es.Q + 1], row[es.Q + 2], row[es.Q + 3]
    # ZYX Euler angles; the clamp keeps asin in its domain despite rounding.
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    _put3(v, _ROLL, roll, pitch, yaw_of((w, x, y, z)))
    for i in range(4):
        v[_QW + i] = row[es.Q + i]
    # Variances are the squares of the estimator's standard deviations.
    for i in range(3):
        v[_P + i] = row[es.RATES + i]
        v[_X + i], v[_VX + i] = row[es.P + i], row[es.V + i]
        v[_VAR_X + i] = row[es.SIGMA + i] ** 2
        v[_VAR_ROLL + i] = row[es.SIGMA + 6 + i] ** 2
        v[_VAR_VX + i] = row[es.SIGMA + 3 + i] ** 2
        v[_VX_CM + i] = units.cm_s(row[es.V + i])
    # Centidegrees and whole degrees wrap at 360; rounding can reach 360, hence the second modulo.
    v[_YAW_CDEG] = units.centidegrees(v[_ROLL + 2])
    north, east = row[es.V], row[es.V + 1]
    v[_GROUND_SPEED], v[_CLIMB] = math.hypot(north, east), -row[es.V + 2]
    v[_HEADING_DEG] = units.int16(math.degrees(v[_ROLL + 2]) % 360.0) % 360


@kernel
def _placed(v: Vector, row: Vector, context: Vector) -> None:
    """Write global position and altitudes."""
    down, origin_m, home_m = row[es.P + 2], context[_ORIGIN_M], context[_HOME_M]
    known = not math.isnan(origin_m)
    v[_LOCATED] = 0.0
    # NaN positions stay unlocated: GLOBAL_POSITION_INT is not sent then.
    if known and math.isfinite(row[es.P]) and math.isfinite(row[es.P + 1]) and math.isfinite(down):
        origin = Geodetic(context[_LATITUDE], context[_LONGITUDE], origin_m)
        here = local_to_geodetic(row[es.P : es.V], origin)
        v[_LOCATED] = 1.0
        v[_LAT_E7] = units.deg_e7(here.latitude_deg)
        v[_LAT_E7 + 1] = units.deg_e7(here.longitude_deg)
        v[_LAT_E7 + 2] = units.mm(here.altitude_m)
        # Before home is set, the height counts from the origin.
        v[_LAT_E7 + 3] = units.mm(here.altitude_m - (origin_m if math.isnan(home_m) else home_m))
    v[_UP] = v[_ABOVE_HOME] = -down
    v[_AMSL] = origin_m - down
    # VFR_HUD falls back to the pressure altitude, as in PX4.
    v[_HUD_ALT] = origin_m - down if known else v[_PRESSURE + 1]
    if known and not math.isnan(home_m):
        v[_ABOVE_HOME] = origin_m - down - home_m
    v[_TERRAIN_AT], v[_TERRAIN_AT + 1] = context[_TERRAIN], context[_CLEARANCE]


@kernel
def _wanted(v: Vector, row: Fields, context: Vector) -> None:
    """Write the setpoints of the control loops and the motor commands.

    Source: PX4 1.16, PositionControl::getLocalPositionSetpoint: the heading, the yaw rate and the
    acceleration are always set. Disarmed, position and velocity are NaN.
    """
    out, d, kind, armed = row.output, row.demand, row.demand_kind, context[_ARMED] != 0.0
    # The attitude and rate setpoints are the first seven outputs of the control loops.
    for i in range(7):
        v[_SP_QW + i] = out[i]
    thrust = out[10]
    v[_SP_THRUST] = thrust
    v[_THROTTLE] = units.saturate(100.0 * thrust if armed else 0.0, 0, units.UINT16_MAX - 1, 0)
    q_sp = (out[0], out[1], out[2], out[3])
    yaw, yaw_rate = math.nan, 0.0
    # The yaw setpoint's index depends on the kind of demand; other kinds have none.
    if kind == POSITION:
        yaw, yaw_rate = d[6], d[7]
    elif kind == TRAJECTORY:
        yaw, yaw_rate = d[9], d[10]
    mask = 0
    for i in range(3):
        # Attitude and rate setpoints report the current position.
        place = d[i] if kind in (POSITION, TRAJECTORY) else row.state[es.P + i]
        speed = out[7 + i]
        if not armed:
            place = speed = math.nan
        v[_SP_X + i], v[_SP_VX + i] = place, speed
        # A NaN component sets its ignore bit in the type mask.
        mask |= 0 if math.isfinite(place) else _X_IGNORE << i
        mask |= 0 if math.isfinite(speed) else _VX_IGNORE << i
    v[_SP_MASK] = mask
    if armed:
        # The acceleration setpoint follows from thrust and attitude: hover thrust means 1 g.
        north, east, down = rotate(q_sp, (0.0, 0.0, thrust / context[_HOVER]))
        g = GRAVITY_M_S2
        _put3(v, _SP_AX, -g * north, -g * east, g * (1.0 - down))
        # Without a yaw setpoint PX4 reports the heading of its attitude setpoint.
        v[_SP_YAW] = yaw if math.isfinite(yaw) else yaw_of(q_sp)
        v[_SP_YAW + 1] = yaw_rate if math.isfinite(yaw_rate) else 0.0
    else:
        # PX4's representation of zero thrust.
        _put3(v, _SP_AX, 0.0, 0.0, 100.0)
        v[_SP_YAW], v[_SP_YAW + 1] = v[_ROLL + 2], 0.0
    for i in range(4):
        # Outputs 0..1 map to 1000..2000 µs.
        pulse = _PWM_MIN + units.saturate(_PWM_SPAN * row.motors[i], 0, _PWM_SPAN, 0)
        v[_PWM_1 + i] = pulse if armed else _PWM_DISARMED


@kernel
def _speed_controllers(v: Vector, row: Fields, context: Vector) -> None:
    """Write the speed controllers' feedback; if unavailable, derive it from the motor commands."""
    armed, told = context[_ARMED] != 0.0, math.isnan(context[_ESCS])
    for i in range(4):
        output = context[_ESCS + i]
        if told:
            # Without feedback the output follows the command; a disarmed motor is off.
            output = row.motors[i] if armed else 0.0
        v[_ESC_CDEG_1 + i] = units.int16((detectors.IDLE_C + detectors.SPAN_C * output) * 100.0)
        v[_RPM_1 + i] = round(detectors.RPM * output)
        # As in PX4, an armed motor draws its idle current, turning or not.
        idle_a = detectors.IDLE_A if told and armed else 0.0
        v[_AMPERE_1 + i] = detectors.current_a(output) if output > 0.0 else idle_a
    v[_VOLT] = row.battery[0]


@kernel
def _goal(v: Vector, context: Vector) -> None:
    """Write the target of an automatic mode."""
    north, east, down = context[_GOAL], context[_GOAL + 1], context[_GOAL + 2]
    v[_GOAL_KNOWN] = 0.0
    # Only automatic modes have a target; it is NaN otherwise.
    if math.isfinite(north) and math.isfinite(east) and math.isfinite(down):
        origin = Geodetic(context[_LATITUDE], context[_LONGITUDE], context[_ORIGIN_M])
        place = local_to_geodetic(context[_GOAL:_FIX], origin)
        v[_GOAL_KNOWN], v[_GOAL_KNOWN + 3] = 1.0, place.altitude_m
        v[_GOAL_KNOWN + 1] = units.deg_e7(place.latitude_deg)
        v[_GOAL_KNOWN + 2] = units.deg_e7(place.longitude_deg)
    v[_GOAL_KNOWN + 4] = v[_SP_YAW]


@kernel
def _fix(v: Vector, row: Fields, context: Vector) -> None:
    """Write the newest GPS fix."""
    v[_FIX_KNOWN] = 0.0
    if math.isnan(context[_FIX]):
        return
    north, east = row.gps_velocity[0], row.gps_velocity[1]
    # Back from metres around HOME to degrees.
    place = local_to_geodetic(row.gps_position, HOME)
    v[_FIX_KNOWN], v[_FIX_KNOWN + 1] = 1.0, context[_FIX]
    v[_FIX_KNOWN + 2] = units.deg_e7(place.latitude_deg)
    v[_FIX_KNOWN + 3] = units.deg_e7(place.longitude_deg)
    v[_FIX_KNOWN + 4] = units.mm(place.altitude_m)
    v[_FIX_KNOWN + 5] = units.uint16(math.hypot(north, east) * 100.0)
    v[_FIX_KNOWN + 6] = units.centidegrees(math.atan2(east, north))
    # GPS_RAW_INT: 255 satellites mean unknown.
    v[_FIX_KNOWN + 7] = units.saturate(context[_FIX + 1], 0, 254, 255)
    v[_FIX_KNOWN + 8] = units.uint32(context[_FIX + 2] * 1e3)
    v[_FIX_KNOWN + 9] = units.uint32(context[_FIX + 3] * 1e3)


@kernel
def _health(v: Vector, row: Fields, context: Vector) -> None:
    """Write the health of the parts, and the battery."""
    for i in range(4):
        # The context row ends with the three bit fields and the load.
        v[_PARTS_PRESENT + i] = context[PARTS + i]
    v[_PARTS_PRESENT + 4] = _PARACHUTE
    v[_BATTERY_MV] = units.uint16(row.battery[0] * 1e3)
    v[_BATTERY_MV + 1] = units.int16(row.battery[1] * 100.0, -1)
    v[_BATTERY_MV + 2] = units.saturate(row.battery[3] * 100.0, 0, 100, -1)


@large_kernel
def _sources(v: Vector, row: Fields) -> None:
    """Write the sources (len(_SOURCES),) of a tick's log that belong to no part."""
    # Constants come first: several messages share them.
    s = row.state
    v[_ZERO], v[_NAN], v[_ONE], v[_HEALTHY] = 0.0, math.nan, 1.0, row.healthy
    v[_TIME_US], v[_TIME_US + 1] = row.time_us, units.boot_ms(row.time_us)
    v[_TIME_US + 2] = row.time_us * NS_PER_US
    v[_PWM_1 + 4], v[_LOCAL_NED], v[_LOCAL_NED + 1] = _PWM_DISARMED, _FRAME, _AUTOPILOT
    v[_LOCAL_NED + 2], v[_LOCAL_NED + 3], v[_LOCAL_NED + 4] = _GLOBAL_INT, 4.0, _PPM
    v[_LOCAL_NED + 5], v[_LOCAL_NED + 6] = 0b1111, units.UINT16_MAX
    _estimated(v, s)
    # HIGHRES_IMU has bias-corrected values, as in PX4.
    for i in range(3):
        v[_AX + i] = row.accel[i] - s[es.ACCEL_BIAS + i]
        v[_AX + 3 + i] = row.gyro[i] - s[es.GYRO_BIAS + i]
        v[_AX + 6 + i] = row.mag[i]
    # The pressure altitude follows from the standard atmosphere.
    v[_PRESSURE], v[_PRESSURE + 1] = row.pressure_hpa, atmosphere.altitude_m(row.pressure_hpa)
    v[_PRESSURE + 2], v[_PRESSURE + 3] = row.temperature_c, _IMU_FIELDS


@large_kernel
def _parts(v: Vector, row: Fields, context: Vector, parts: int) -> None:
    """Write the sources of some parts, after `_sources`."""
    # Order matters: the target reuses the yaw setpoint written by `_wanted`.
    if parts & _PLACED:
        _placed(v, row.state, context)
    if parts & _WANTED:
        _wanted(v, row, context)
    if parts & _GOAL_PART:
        _goal(v, context)
    if parts & _FIX_PART:
        _fix(v, row, context)
    if parts & _ESC_PART:
        _speed_controllers(v, row, context)
    if parts & _HEALTH:
        _health(v, row, context)


def _indices(names: str) -> list[int]:
    return [_AT[name] for name in names.split()]


_ZERO, _NAN, _ONE, _HEALTHY, _LOCATED, _TIME_US, _ROLL, _QW = _indices(
    "zero nan one healthy located time_us roll qw"
)
_P, _X, _VX, _VAR_X, _VAR_ROLL, _VAR_VX, _LAT_E7, _VX_CM = _indices(
    "p x vx var_x var_roll var_vx lat_e7 vx_cm"
)
_YAW_CDEG, _AX, _PRESSURE, _AMSL, _UP, _ABOVE_HOME, _TERRAIN_AT, _GROUND_SPEED = _indices(
    "yaw_cdeg ax pressure amsl up above_home terrain ground_speed"
)
_HEADING_DEG, _THROTTLE, _HUD_ALT, _CLIMB, _SP_QW, _SP_THRUST, _SP_MASK, _SP_X = _indices(
    "heading_deg throttle hud_alt climb sp_qw sp_thrust sp_mask sp_x"
)
_SP_VX, _SP_AX, _SP_YAW, _PWM_1, _LOCAL_NED, _GOAL_KNOWN, _FIX_KNOWN, _ESC_CDEG_1 = _indices(
    "sp_vx sp_ax sp_yaw pwm_1 local_ned goal_known fix_known esc_cdeg_1"
)
_RPM_1, _VOLT, _AMPERE_1, _PARTS_PRESENT, _BATTERY_MV = _indices(
    "rpm_1 volt ampere_1 parts_present battery_mv"
)
_PARACHUTE: int = dialect.MAV_SYS_STATUS_RECOVERY_SYSTEM
_X_IGNORE: int = dialect.POSITION_TARGET_TYPEMASK_X_IGNORE
_VX_IGNORE: int = dialect.POSITION_TARGET_TYPEMASK_VX_IGNORE
_FRAME: int = dialect.MAV_FRAME_LOCAL_NED
_AUTOPILOT: int = dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT
_GLOBAL_INT: int = dialect.MAV_FRAME_GLOBAL_INT
_PPM: int = dialect.ESC_CONNECTION_TYPE_PPM


# --- frames


@large_kernel
def _frame(number: int, v: Vector, system: int, seq: int, out: Bytes, at: int, stage: Any) -> int:
    """Write the MAVLink 2 frame of message `number` at `at`; return its end."""
    # Views of one payload as float32, uint8, uint16, uint32 and int64.
    table, (floats, bytes_1, bytes_2, bytes_4, bytes_8) = _TABLE, stage
    size, start = table.sizes[number], at + 10
    # Omitted extension fields must be zero.
    for i in range((size >> 3) + 1):
        bytes_8[i] = 0
    for f in range(table.first[number], table.first[number + 1]):
        value, kind, offset = v[table.sources[f]], table.kinds[f], table.offsets[f]
        # Negative integers wrap to two's complement in the narrower views.
        if kind == 0:
            floats[offset >> 2] = value
        elif kind == 1:
            bytes_1[offset] = np.int64(value) & 0xFF
        elif kind == 2:
            bytes_2[offset >> 1] = np.int64(value) & 0xFFFF
        elif kind == 4:
            bytes_4[offset >> 2] = np.int64(value) & 0xFFFF_FFFF
        elif kind == 8:
            bytes_8[offset >> 3] = np.int64(value)
        else:
            for i in range(-kind):
                bytes_1[offset + i] = np.int64(value) >> 8 * i & 0xFF
    # MAVLink 2 omits trailing zeros.
    while size > 1 and bytes_1[size - 1] == 0:
        size -= 1
    for i in range(size):
        out[start + i] = bytes_1[i]
    identity = table.ids[number]
    # Header: marker, length, two flag bytes, sequence, sender, 24-bit message id.
    out[at], out[at + 1], out[at + 2], out[at + 3] = 0xFD, size, 0, 0
    out[at + 4], out[at + 5], out[at + 6] = seq, system, COMPONENT_ID
    out[at + 7], out[at + 8], out[at + 9] = identity & 0xFF, identity >> 8 & 0xFF, identity >> 16
    # X.25 over everything after the marker, then CRC_EXTRA.
    crc, i, end = 0xFFFF, at + 1, start + size
    # Four bytes at a time: the look-ups do not wait for each other.
    while i + 3 < end:
        first = crc ^ (out[i] | out[i + 1] << 8)
        crc = _CRC_4[first & 0xFF] ^ _CRC_3[first >> 8] ^ _CRC_2[out[i + 2]] ^ _CRC[out[i + 3]]
        i += 4
    for k in range(i, end):
        crc = crc >> 8 ^ _CRC[(crc ^ out[k]) & 0xFF]
    crc = crc >> 8 ^ _CRC[(crc ^ table.extras[number]) & 0xFF]
    out[start + size], out[start + size + 1] = crc & 0xFF, crc >> 8
    return start + size + 2


@large_kernel
def _pack(
    flown: Record,
    after_us: int,
    context: Vector,
    numbers: Ints,
    due_us: Ints,
    interval_us: Ints,
    system: int,
    seq: int,
    most: int,
    out: Bytes,
    ends: Ints,
) -> tuple[int, int]:
    """Pack the frames due after each tick; return their number and the next due time [µs].

    Args:
        flown: (n,) logs of ticks.
        after_us: Time from the log of a tick to its end [µs].
        context: Values of `TickContext.of`.
        numbers: (s,) index of each stream in the table; -1 = not in the table.
        due_us: (s,) due time of each stream [µs], updated.
        interval_us: (s,) interval of each stream [µs]; 0 = off.
        system: System id of the sender.
        seq: First sequence number.
        most: Maximum number of frames.
        out: Output: consecutive frames.
        ends: (most,) Output: end of each frame.
    """
    v, words = np.empty(len(_SOURCES)), np.empty(_LARGEST // 8 + 1, np.int64)
    views = words.view(np.uint8), words.view(np.uint16), words.view(np.uint32), words
    stage = (words.view(np.float32), *views)
    at, n, next_us = 0, 0, _NEVER
    # Ticks in order, and streams in table order within a tick.
    for k in range(len(flown)):
        row, made, parts = flown[k], False, 0
        now_us = row.time_us + after_us
        for s in range(len(numbers)):
            # A full output leaves the due time as it is: the stream comes in the next call.
            if numbers[s] < 0 or interval_us[s] == 0 or due_us[s] > now_us or n == most:
                continue
            late_us = now_us - due_us[s]
            # Missed times are skipped; the phase stays.
            due_us[s] += interval_us[s] * (1 + late_us // interval_us[s])
            # Sources and parts are computed once per tick, and only for ticks with a due message.
            if not made:
                _sources(v, row)
                made = True
            missing = _TABLE.parts[numbers[s]] & ~parts
            if missing != 0:
                _parts(v, row, context, missing)
                parts |= missing
            # A message without content uses no sequence number.
            if v[_TABLE.needs[numbers[s]]] != 0.0:
                at = _frame(numbers[s], v, system, seq + n & 0xFF, out, at, stage)
                ends[n] = at
                n += 1
    # Earliest due time of all enabled fast streams.
    for s in range(len(numbers)):
        if numbers[s] >= 0 and interval_us[s] != 0:
            next_us = min(next_us, due_us[s])
    return n, next_us


class Packer:
    """Packer of the fast streams of one link."""

    def __init__(self) -> None:
        self._out = np.zeros(0, np.uint8)
        self._ends = np.zeros(0, np.int64)

    def pack(
        self,
        flown: Record,
        after_us: int,
        context: Vector,
        numbers: Ints,
        due_us: Ints,
        interval_us: Ints,
        system: int,
        seq: int,
        most: int,
    ) -> tuple[list[bytes], int]:
        """Return the frames due after each of n ticks, and the next due time [µs].

        See `_pack`; `most` is the maximum number of frames per tick.
        """
        # The limit is per tick; the buffers hold all ticks of a call and are reused.
        most *= len(flown)
        if len(self._ends) < most:
            self._ends = np.empty(most, np.int64)
            self._out = np.empty(most * _LARGEST, np.uint8)
        n, next_us = _pack(
            *(flown, after_us, context, numbers, due_us, interval_us, system, seq, most),
            *(self._out, self._ends),
        )
        if n == 0:
            return [], next_us
        ends = self._ends[:n].tolist()
        data = self._out[: ends[-1]].tobytes()
        # Split the consecutive frames at their ends.
        return list(map(data.__getitem__, map(slice, [0, *ends], ends))), next_us


def payload(name: str, state: AutopilotState) -> bytes | None:
    """Return the payload of a message, without trailing zeros; None = no content."""
    # Due time 0 and interval 1 make exactly this message due.
    number, once = np.array([NUMBERS[name]]), np.ones(1, np.int64)
    frames, _ = Packer().pack(
        flown_of(state), 0, TickContext().of(state), number, np.zeros(1, np.int64), once, 1, 0, 1
    )
    # Strip header and checksum.
    return frames[0][10:-2] if frames else None
