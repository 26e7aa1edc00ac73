"""Sensors and outputs: IMU, pressure, battery, motors, vibration, ranges, flow, RC channels."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.autopilot_state import Vector
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.engine.record import Record
from firmware_sim.mavlink.codec import Values, WireMessage, dialect
from firmware_sim.mavlink.streams import units

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


def battery_status(state: AutopilotState, parameters: Parameters) -> Values:
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
        units.percent(battery.remaining),
        no_time_remaining,
        _charge_state(battery.remaining, parameters),
    )


def _charge_state(remaining: float, parameters: Parameters) -> int:
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


def clearance(state: AutopilotState, down: float) -> tuple[float, float]:
    """Return the local terrain altitude and the height above it [m]; NaN = unknown."""
    ground = state.clearance
    if ground is None or not ground.valid:
        return math.nan, math.nan
    return -down - ground.dist_bottom_m, ground.dist_bottom_m


# RC_CHANNELS echoes the newest RC_CHANNELS_OVERRIDE. Source: PX4 1.16, streams/RC_CHANNELS.hpp and
# MavlinkReceiver::handle_message_rc_channels_override.

CHANNELS = 18

_ZERO_SAYS_NOTHING = 8
"""First channel for which 0 means unused. UINT16_MAX means unused for all channels."""

_FULL_SIGNAL = 100


class Radio:
    """Channel values of the newest RC_CHANNELS_OVERRIDE, common to all clients."""

    def __init__(self) -> None:
        self._channels: tuple[int, ...] = ()
        self._time_us = 0
        self._count = 0
        """Number of RC_CHANNELS_OVERRIDE messages received."""

    def receive(self, message: WireMessage, now_us: int) -> None:
        """Store an RC_CHANNELS_OVERRIDE received at simulated `now_us` [µs]."""
        channels = [getattr(message, f"chan{number}_raw") for number in range(1, CHANNELS + 1)]
        # Trailing unused channels do not count: PX4 reports the number of channels up to the last
        # used one.
        while channels and _says_nothing(channels[-1], len(channels) - 1):
            channels.pop()
        self._channels, self._time_us = tuple(channels), now_us
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
            channels = self._channels
            # RC_CHANNELS always has 18 values; UINT16_MAX marks the missing ones.
            unused = (units.UINT16_MAX,) * (CHANNELS - len(channels))
            signal = _FULL_SIGNAL if channels else 0
            return units.boot_ms(self._time_us), len(channels), *channels, *unused, signal

        return build


def _says_nothing(width: int, place: int) -> bool:
    return width == units.UINT16_MAX or (width == 0 and place >= _ZERO_SAYS_NOTHING)
