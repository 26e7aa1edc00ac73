"""MAV_CMD_INJECT_FAILURE: injects a fault into the simulated part, as a scenario does.

Known units and types, and those without a reply, match PX4 1.16 (SimulatorMavlink,
FailureInjector, BatterySimulator).
"""

from __future__ import annotations

from airl_mav.faults import MOTORS, Fault, Part
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services import Action, Context, VehicleCommand

ENABLED = "SYS_FAILURE_EN"

OK, OFF = dialect.FAILURE_TYPE_OK, dialect.FAILURE_TYPE_OFF
STUCK, WRONG = dialect.FAILURE_TYPE_STUCK, dialect.FAILURE_TYPE_WRONG

SENSORS: dict[int, tuple[Part | None, tuple[int, ...]]] = {
    dialect.FAILURE_UNIT_SENSOR_GYRO: ("gyro", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_ACCEL: ("accel", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_MAG: ("mag", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_BARO: ("baro", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_GPS: ("gps", (OK, OFF)),
    dialect.FAILURE_UNIT_SENSOR_VIO: ("vision", (OK, OFF)),
    # The vehicle has no such sensor, but PX4 accepts the command.
    dialect.FAILURE_UNIT_SENSOR_AIRSPEED: (None, (OK, OFF, WRONG)),
}
"""Part and accepted types of each sensor; other types are UNSUPPORTED."""

WITHOUT_INSTANCE: tuple[Part, ...] = ("baro", "gps", "vision")
"""Sensors that PX4 has once, for any requested instance."""

KINDS = {OFF: "off", STUCK: "stuck"}

GREATEST_MOTOR = 8
"""Maximum number of ESCs in PX4."""


def _inject(command: VehicleCommand, context: Context) -> Result | None:
    """Handle INJECT_FAILURE, parameters: unit, type, instance (0 = all)."""
    enabled = context.port.parameters.by_name(ENABLED)
    # PX4 requires SYS_FAILURE_EN against accidental failures in flight.
    if enabled is None or not enabled.value:
        return Result.DENIED
    unit, kind, instance = command.integer(1), command.integer(2), command.integer(3) or 0
    if unit is None or kind is None:
        return None
    if unit in SENSORS:
        part, known = SENSORS[unit]
        if kind not in known:
            return Result.UNSUPPORTED
        # The vehicle has one of each sensor: another instance has no effect.
        meant = part is not None and (part in WITHOUT_INSTANCE or instance in (0, 1))
        _act(context, (part,) if part is not None and meant else (), kind)
        return Result.ACCEPTED
    if unit == dialect.FAILURE_UNIT_SYSTEM_BATTERY and kind in (OK, OFF):
        if instance:
            return Result.UNSUPPORTED
        _act(context, ("battery",), kind)
        return Result.ACCEPTED
    if unit == dialect.FAILURE_UNIT_SYSTEM_MOTOR:
        return _motor(context, kind, instance)
    return None  # PX4 sends no reply


def _motor(context: Context, kind: int, instance: int) -> Result:
    if kind not in (OK, OFF, WRONG) or (kind == OK and not 0 <= instance <= GREATEST_MOTOR):
        return Result.UNSUPPORTED
    if kind != WRONG:  # WRONG would affect the readings alone
        # Instances start at 1; a number above the motors gives an empty slice.
        motors = MOTORS if instance == 0 else MOTORS[instance - 1 : instance]
        _act(context, motors if instance >= 0 else (), kind)
    return Result.ACCEPTED


def _act(context: Context, parts: tuple[Part, ...], kind: int) -> None:
    failures = context.port.failures
    if failures is None:
        return
    # A new fault replaces the old one of the same part.
    for part in parts:
        failures.clear(part)
        if kind != OK:
            failures.inject(Fault(part=part, kind=KINDS[kind]))


ACTIONS: dict[int, Action] = {dialect.MAV_CMD_INJECT_FAILURE: _inject}
