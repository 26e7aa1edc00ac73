"""What the sensors and outputs say: IMU, pressure, GPS, battery, motors, vibration."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.core.constants import GRAVITY_M_S2
from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.autopilot.port import ParameterStore
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams import units

_NO_AIRSPEED = 0.0
"""Differential pressure: there is no such sensor."""

_NO_CELL_VOLTAGES = (units.UINT16_MAX,) * 9
"""BATTERY_STATUS.voltages[1:]."""

_CHARGE_WARNINGS = (
    ("BAT_LOW_THR", dialect.MAV_BATTERY_CHARGE_STATE_LOW),
    ("BAT_CRIT_THR", dialect.MAV_BATTERY_CHARGE_STATE_CRITICAL),
    ("BAT_EMERGEN_THR", dialect.MAV_BATTERY_CHARGE_STATE_EMERGENCY),
)
"""Threshold parameters, from the highest to the lowest."""


def scaled_imu(state: AutopilotState) -> Values:
    """Newest IMU sample, biases removed [mG, mrad/s], and magnetic field [mGauss]."""
    estimate = state.estimate
    return (
        units.boot_ms(state.time_us),
        *(
            units.int16(a * 1e3 / GRAVITY_M_S2)
            for a in (state.accel - estimate.accel_bias).tolist()
        ),
        *(units.int16(w * 1e3) for w in (state.gyro - estimate.gyro_bias).tolist()),
        *(units.int16(m * 1e3) for m in state.mag.tolist()),
        units.int16(state.temperature_c * 100.0),
    )


def scaled_pressure(state: AutopilotState) -> Values:
    """Static pressure [hPa] and temperature [0.01 °C]."""
    temperature = units.int16(state.temperature_c * 100.0)
    return units.boot_ms(state.time_us), state.pressure_hpa, _NO_AIRSPEED, temperature


def mag_cal_report(value: Callable[[str], float]) -> Values | None:
    """Calibration of the compass [gauss], of the parameters. Nothing while it has none."""
    if not value("CAL_MAG0_ID"):
        return None
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
    """Battery 0: pack voltage in the first slot (cells are not measured), current, charge."""
    battery = state.battery
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
    """Return the MAV_BATTERY_CHARGE_STATE of a charge 0..1, by PX4's warning thresholds."""
    state: int = dialect.MAV_BATTERY_CHARGE_STATE_OK
    for name, warning in _CHARGE_WARNINGS:
        threshold = parameters.by_name(name)
        if threshold is None:
            return int(dialect.MAV_BATTERY_CHARGE_STATE_UNDEFINED)
        if remaining < threshold.value:
            state = warning
    return state


def percent(share: float) -> int:
    """Return a share 0..1 as percent for an int8 field, -1 when unknown."""
    return units.saturate(share * 100.0, 0, 100, -1)
