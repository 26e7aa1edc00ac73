"""Sensors and outputs: IMU, pressure, battery, motors, vibration, ranges, flow, RC channels."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.autopilot_state import Arming, AutopilotState, Vector
from firmware_sim.autopilot.port import ParameterStore
from firmware_sim.engine.record import Record
from firmware_sim.mavlink.codec import Values, WireMessage, dialect
from firmware_sim.mavlink.streams import units
from firmware_sim.mavlink.streams.status import base_mode
from firmware_sim.mavlink.streams.units import UINT16_MAX, boot_ms, percent

if TYPE_CHECKING:
    from firmware_sim.mavlink.streams import Builder

_NO_AIRSPEED = 0.0
"""Differential pressure: the vehicle has no airspeed sensor."""

_NO_CELL_VOLTAGES = (units.UINT16_MAX,) * 9
"""Unknown values of BATTERY_STATUS.voltages[1:]."""

_CHARGE_WARNINGS = (
    ("BAT_LOW_THR", dialect.MAV_BATTERY_CHARGE_STATE_LOW),
    ("BAT_CRIT_THR", dialect.MAV_BATTERY_CHARGE_STATE_CRITICAL),
    ("BAT_EMERGEN_THR", dialect.MAV_BATTERY_CHARGE_STATE_EMERGENCY),
)
"""Threshold parameters, from the highest to the lowest."""


def scaled_imu(state: AutopilotState) -> Values:
    """Return the newest IMU sample without biases [mG, mrad/s], and magnetic field [mGauss]."""
    estimate = state.estimate
    return (
        units.boot_ms(state.time_us),
        *(
            # m/s² to milli-g, rad/s to mrad/s, gauss to milligauss.
            units.int16(a * 1e3 / GRAVITY_M_S2)
            for a in (state.accel - estimate.accel_bias).tolist()
        ),
        *(units.int16(w * 1e3) for w in (state.gyro - estimate.gyro_bias).tolist()),
        *(units.int16(m * 1e3) for m in state.mag.tolist()),
        units.int16(state.temperature_c * 100.0),
    )


def scaled_pressure(state: AutopilotState) -> Values:
    """Return static pressure [hPa] and temperature [0.01 °C]."""
    temperature = units.int16(state.temperature_c * 100.0)
    return units.boot_ms(state.time_us), state.pressure_hpa, _NO_AIRSPEED, temperature


def mag_cal_report(value: Callable[[str], float]) -> Values | None:
    """Return the compass calibration [gauss] from the parameters; None if uncalibrated."""
    if not value("CAL_MAG0_ID"):
        return None
    # Confidence and scale are constant; the orientation is a parameter.
    number, being_calibrated, autosaved, fitness = 0, 0, 0, 0.0
    confidence, scale, turned = 1.0, 1.0, max(0, int(value("CAL_MAG0_ROT")))
    return (
        number,
        being_calibrated,
        dialect.MAG_CAL_SUCCESS,
        autosaved,
        fitness,
        *(value(f"CAL_MAG0_{axis}{kind}") for kind in ("OFF", "SCALE", "ODIAG") for axis in "XYZ"),
        confidence,
        turned,
        turned,
        scale,
    )


def battery_status(state: AutopilotState, parameters: ParameterStore) -> Values:
    """Return battery 0: pack voltage in the first slot (cells unmeasured), current, charge."""
    battery = state.battery
    # -1 and INT16_MAX are MAVLink's values for unknown.
    number, no_temperature, no_energy, no_time_remaining = 0, units.INT16_MAX, -1, 0
    return (
        number,
        dialect.MAV_BATTERY_FUNCTION_ALL,
        dialect.MAV_BATTERY_TYPE_LIPO,
        no_temperature,
        units.uint16(battery.voltage_v * 1e3),
        *_NO_CELL_VOLTAGES,
        units.int16(battery.current_a * 100.0, unknown=-1),
        units.int32(battery.consumed_mah, unknown=-1),
        no_energy,
        percent(battery.remaining),
        no_time_remaining,
        _charge_state(battery.remaining, parameters),
    )


def _charge_state(remaining: float, parameters: ParameterStore) -> int:
    """Return the MAV_BATTERY_CHARGE_STATE of a charge 0..1, from PX4's warning thresholds."""
    state: int = dialect.MAV_BATTERY_CHARGE_STATE_OK
    # Thresholds descend, so the last match is the most severe state.
    for name, warning in _CHARGE_WARNINGS:
        threshold = parameters.by_name(name)
        if threshold is None:
            return int(dialect.MAV_BATTERY_CHARGE_STATE_UNDEFINED)
        if remaining < threshold.value:
            state = warning
    return state


# --- outputs

_PWM_DISARMED, _PWM_MIN, _PWM_SPAN = 900, 1_000, 1_000
"""Pulse widths [µs] of PX4's simulated outputs (src/modules/simulation/pwm_out_sim)."""

_OUTPUTS = 16
"""Number of outputs in PX4's simulation. Outputs without a motor stay at the disarmed pulse."""

_OUTPUT_FIELDS = 32
"""Number of slots in ACTUATOR_OUTPUT_STATUS."""


def actuator_output_status(state: AutopilotState) -> Values:
    """Return the pulse widths [µs] as an array with 16 active outputs."""
    return state.time_us, _OUTPUTS, *_outputs(state), *(0,) * (_OUTPUT_FIELDS - _OUTPUTS)


def hil_actuator_controls(state: AutopilotState) -> Values:
    """Return motor commands 0..1, zero while disarmed; 16 controls."""
    commands, flags = _commands(state), 0
    unused = (0.0,) * (_OUTPUTS - len(commands))
    return state.time_us, *commands, *unused, base_mode(state.status), flags


def _outputs(state: AutopilotState) -> Values:
    """Return the pulse widths of all outputs [µs]."""
    pulses = _pulses(state)
    return *pulses, *(_PWM_DISARMED,) * (_OUTPUTS - len(pulses))


def _armed(state: AutopilotState) -> bool:
    return state.status.arming is Arming.ARMED


def _commands(state: AutopilotState) -> tuple[float, ...]:
    return state.motors if _armed(state) else (0.0,) * len(state.motors)


def _pulses(state: AutopilotState) -> list[int]:
    if not _armed(state):
        return [_PWM_DISARMED] * len(state.motors)
    return [_PWM_MIN + units.saturate(_PWM_SPAN * u, 0, _PWM_SPAN, 0) for u in state.motors]


# --- vibration

_OLD, _NEW = 0.99, 0.01
"""Filter weights per sample (PX4 VehicleIMU::UpdateAccelVibrationMetrics)."""

_CLIP_M_S2 = 16.0 * GRAVITY_M_S2
"""Range of PX4's simulated accelerometer [m/s²]."""

# Layout of the meter's memory: the four metrics, and the last sample (time, gyro, accel).
_CONING, _GYRO, _ACCEL, _CLIPPED, _LAST_US, _LAST_GYRO, _LAST_ACCEL, _SIZE = 0, 1, 2, 3, 4, 5, 8, 11


class VibrationMeter:
    """Vibration metrics of all IMU samples. PX4's use of the fields differs from the MAVLink text.

    vibration_x: coning, filtered |delta angle x previous delta angle| [rad²]. vibration_y: filtered
    |gyro - previous gyro| [rad/s]. vibration_z: filtered |accel - previous accel| [m/s²].
    clipping_0: samples at the limit of the accelerometer's range.
    """

    def __init__(self) -> None:
        self._memory = np.zeros(_SIZE)
        self._memory[_LAST_US] = math.nan

    def update(self, flown: Record) -> None:
        """Process the samples of ticks (n,), each once (`engine.record.FLOWN_TICK`)."""
        _update(self._memory, flown)

    def message(self, state: AutopilotState) -> Values:
        """Return VIBRATION, for one accelerometer."""
        coning, gyro, accel, clipped = self._memory[: _CLIPPED + 1].tolist()
        clipping_1 = clipping_2 = 0
        return state.time_us, coning, gyro, accel, int(clipped), clipping_1, clipping_2


@kernel
def _update(memory: Vector, flown: Record) -> None:
    """Filter the samples of ticks (n,) into `memory` (11,)."""
    for k in range(len(flown)):
        _filter(memory, flown[k].time_us, flown[k].gyro, flown[k].accel)


@kernel
def _filter(memory: Vector, time_us: int, gyro: Vector, accel: Vector) -> None:
    """Filter one sample into `memory` (11,); gyro (3,) FRD [rad/s], accel (3,) FRD [m/s²]."""
    clipped = False
    last_gyro, last_accel = memory[_LAST_GYRO:_LAST_ACCEL], memory[_LAST_ACCEL:_SIZE]
    # The first sample has no predecessor.
    if not math.isnan(memory[_LAST_US]):
        dt = (time_us - memory[_LAST_US]) / US_PER_S
        # Coning: |delta angle x previous delta angle| grows with dt², see the line after the loop.
        cross, gyro_step, accel_step = 0.0, 0.0, 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            cross += (gyro[j] * last_gyro[k] - gyro[k] * last_gyro[j]) ** 2
            gyro_step += (gyro[i] - last_gyro[i]) ** 2
            accel_step += (accel[i] - last_accel[i]) ** 2
        memory[_CONING] = _OLD * memory[_CONING] + _NEW * dt * dt * math.sqrt(cross)
        memory[_GYRO] = _OLD * memory[_GYRO] + _NEW * math.sqrt(gyro_step)
        memory[_ACCEL] = _OLD * memory[_ACCEL] + _NEW * math.sqrt(accel_step)
    for i in range(3):
        last_gyro[i], last_accel[i] = gyro[i], accel[i]
        clipped = clipped or abs(accel[i]) >= _CLIP_M_S2
    memory[_LAST_US] = time_us
    memory[_CLIPPED] += clipped


NEW_US = 200_000
"""Maximum age of a sent measurement [µs]: the longest time that PX4's estimator waits for the next.
PX4 sends a measurement once."""

_CM, _CM2 = 1e2, 1e4
_FIRST = 0
_LASER, _KINDS = 0, (0, 1, 2)
"""MAV_DISTANCE_SENSOR values: laser, ultrasound, infrared. Other types are sent as laser."""
_NO_FIELD_OF_VIEW = (0.0, 0.0)
_NO_QUATERNION = (0.0, 0.0, 0.0, 0.0)
_QUALITY_NOT_TOLD = 0
_TEMPERATURE, _NO_DISTANCE_US, _NO_DISTANCE_M = 0, 0, -1.0


def distance_sensor(state: AutopilotState) -> Values | None:
    """Return the newest distance [cm]; None if outdated. PX4 does not send its quality."""
    told = state.distance
    if told is None or state.time_us - state.distance_us > NEW_US:
        return None
    return (
        units.boot_ms(state.distance_us),
        _whole(told.least_m * _CM),
        _whole(told.greatest_m * _CM),
        _whole(told.distance_m * _CM),
        told.kind if told.kind in _KINDS else _LASER,
        _FIRST,
        told.orientation,
        # The variance [cm²] is one byte on the wire and saturates.
        units.saturate(math.floor(told.variance_m2 * _CM2), 0, 255, 0),
        *_NO_FIELD_OF_VIEW,
        *_NO_QUATERNION,
        _QUALITY_NOT_TOLD,
    )


def clearance(state: AutopilotState, down: float) -> tuple[float, float]:
    """Return the local terrain altitude and the height above it [m]; NaN = unknown."""
    ground = state.clearance
    if ground is None or not ground.valid:
        return math.nan, math.nan
    return -down - ground.dist_bottom_m, ground.dist_bottom_m


def _whole(value: float) -> int:
    """Return a number for a uint16 field, truncated as in C."""
    return units.uint16(math.floor(value + 1e-9), unknown=0)


def optical_flow_rad(state: AutopilotState) -> Values | None:
    """Return the newest flow and rotation [rad]; None if outdated."""
    told = state.flow
    if told is None or state.time_us - state.flow_us > NEW_US:
        return None
    return (
        state.flow_us,
        _FIRST,
        round(told.interval_s * US_PER_S),
        *told.flow.tolist(),
        *told.turned.tolist(),
        _TEMPERATURE,
        told.quality,
        _NO_DISTANCE_US,
        _NO_DISTANCE_M,
    )


# RC_CHANNELS echoes the newest RC_CHANNELS_OVERRIDE. Source: PX4 1.16, streams/RC_CHANNELS.hpp and
# MavlinkReceiver::handle_message_rc_channels_override.

CHANNELS = 18


_ZERO_SAYS_NOTHING = 8
"""First channel for which 0 means unused. UINT16_MAX means unused for all channels."""


_FULL_SIGNAL = 100


class Radio:
    """Channel values of the newest RC_CHANNELS_OVERRIDE, common to all clients."""

    def __init__(self) -> None:
        self._said: tuple[int, ...] = ()
        self._time_us = 0
        self._count = 0
        """Number of RC_CHANNELS_OVERRIDE messages received."""

    def hear(self, message: WireMessage, now_us: int) -> None:
        """Store an RC_CHANNELS_OVERRIDE received at simulated `now_us` [µs]."""
        said = [getattr(message, f"chan{number}_raw") for number in range(1, CHANNELS + 1)]
        # Trailing unused channels do not count: PX4 reports the number of channels up to the last
        # used one.
        while said and _says_nothing(said[-1], len(said) - 1):
            said.pop()
        self._said, self._time_us = tuple(said), now_us
        self._count += 1

    def updates(self) -> Builder:
        """Return a builder of RC_CHANNELS for one link. Sends each update once."""
        # Updates before the link opened are not sent.
        sent = self._count

        def build(_state: AutopilotState) -> Values | None:
            nonlocal sent
            if sent == self._count:
                return None
            sent = self._count
            said = self._said
            # RC_CHANNELS always has 18 values; UINT16_MAX marks the missing ones.
            unused = (UINT16_MAX,) * (CHANNELS - len(said))
            signal = _FULL_SIGNAL if said else 0
            return boot_ms(self._time_us), len(said), *said, *unused, signal

        return build


def _says_nothing(width: int, place: int) -> bool:
    return width == UINT16_MAX or (width == 0 and place >= _ZERO_SAYS_NOTHING)
