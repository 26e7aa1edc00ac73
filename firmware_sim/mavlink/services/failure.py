"""MAV_CMD_INJECT_FAILURE: a client makes a part fail.

Which units and types are known, and which get no answer at all, is PX4's (SimulatorMavlink,
FailureInjector, BatterySimulator; 1.16). What fails is the simulated part itself, as in a scenario.
"""

from __future__ import annotations

from airl_mav.faults.kinds import MOTORS, Part
from airl_mav.faults.model import Fault
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services.context import Action, Command, Context

ENABLED = "SYS_FAILURE_EN"

OK, OFF, STUCK, WRONG = (
    dialect.FAILURE_TYPE_OK,
    dialect.FAILURE_TYPE_OFF,
    dialect.FAILURE_TYPE_STUCK,
    dialect.FAILURE_TYPE_WRONG,
)

SENSORS: dict[int, tuple[Part | None, tuple[int, ...]]] = {
    dialect.FAILURE_UNIT_SENSOR_GYRO: ("gyro", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_ACCEL: ("accel", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_MAG: ("mag", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_BARO: ("baro", (OK, OFF, STUCK)),
    dialect.FAILURE_UNIT_SENSOR_GPS: ("gps", (OK, OFF)),
    dialect.FAILURE_UNIT_SENSOR_VIO: ("vision", (OK, OFF)),
    # The vehicle has none; PX4 takes the command all the same.
    dialect.FAILURE_UNIT_SENSOR_AIRSPEED: (None, (OK, OFF, WRONG)),
}
"""Part and accepted types of each sensor; other types are UNSUPPORTED."""

WITHOUT_INSTANCE: tuple[Part, ...] = ("baro", "gps", "vision")
"""Sensors of which PX4 has one, whatever instance is named."""

KINDS = {OFF: "off", STUCK: "stuck"}

GREATEST_MOTOR = 8
"""ESCs that PX4 counts."""


def _inject(command: Command, context: Context) -> Result | None:
    """Parameters: unit, type, instance (0: all)."""
    enabled = context.port.parameters.by_name(ENABLED)
    if enabled is None or not enabled.value:
        return Result.DENIED
    unit, kind, instance = command.integer(1), command.integer(2), command.integer(3) or 0
    if unit is None or kind is None:
        return None
    if unit in SENSORS:
        part, known = SENSORS[unit]
        if kind not in known:
            return Result.UNSUPPORTED
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
    return None  # nobody in PX4 answers


def _motor(context: Context, kind: int, instance: int) -> Result:
    if kind not in (OK, OFF, WRONG) or (kind == OK and not 0 <= instance <= GREATEST_MOTOR):
        return Result.UNSUPPORTED
    if kind != WRONG:  # its readings alone would be wrong
        motors = MOTORS if instance == 0 else MOTORS[instance - 1 : instance]
        _act(context, motors if instance >= 0 else (), kind)
    return Result.ACCEPTED


def _act(context: Context, parts: tuple[Part, ...], kind: int) -> None:
    failures = context.port.failures
    if failures is None:
        return
    for part in parts:
        failures.clear(part)
        if kind != OK:
            failures.inject(Fault(part=part, kind=KINDS[kind]))


ACTIONS: dict[int, Action] = {dialect.MAV_CMD_INJECT_FAILURE: _inject}
