"""Sensor calibration as in PX4 SITL, reported as texts that ground stations parse.

The simulated sensors are always calibrated, so nothing is estimated, but the client sees the usual
texts and durations. A calibration is rejected while the vehicle is armed or another one runs.
Motion of the vehicle makes it fail. A calibration that requires manual rotation waits until it is
cancelled. Source: PX4 1.16, Commander::handle_command and the texts of a running SITL.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Arming, OperatorText, Result, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import Definition
from firmware_sim.interfaces import SensorSample
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services import Action, Context, ServiceState, VehicleCommand

MOVING_RAD_S = 0.2
"""Minimum body rate that counts as motion [rad/s]."""

_REST_S, _AGAIN_S = 1.0, 5.0


class CalibrationText(NamedTuple):
    """Text of a calibration."""

    after_s: float
    """Time after the previous text [s]."""
    message: OperatorText


class RunningCalibration(ServiceState):
    """Calibration in progress of one vehicle, common to all its clients."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Start without a calibration."""
        self.sensor = ""
        self.radio = False
        """True while a ground station calibrates a radio; a cancellation ends it."""
        self._steps: Iterator[CalibrationText] = iter(())
        self._next: CalibrationText | None = None
        self._due_us = 0

    @property
    def forbids_arming(self) -> bool:
        """True if PX4 rejects arming because of the calibration."""
        return self.is_running or self.radio

    @property
    def is_running(self) -> bool:
        """True if steps remain."""
        return self._next is not None

    def start(self, sensor: str, steps: Iterator[CalibrationText], now_us: int) -> None:
        """Start calibrating a sensor. Replaces a running calibration."""
        self.sensor, self._steps, self._due_us = sensor, steps, now_us
        self._plan()

    def due(self, now_us: int) -> list[OperatorText]:
        """Return the messages due at `now_us` [µs], in order."""
        messages: list[OperatorText] = []
        while self._next is not None and self._due_us <= now_us:
            messages.append(self._next.message)
            self._plan()
        return messages

    def _plan(self) -> None:
        self._next = next(self._steps, None)
        if self._next is not None:
            self._due_us += round(self._next.after_s * US_PER_S)


def _info(text: str, after_s: float = 0.0) -> CalibrationText:
    return CalibrationText(after_s, OperatorText(Severity.INFO, text))


def _critical(text: str, after_s: float = 0.0) -> CalibrationText:
    return CalibrationText(after_s, OperatorText(Severity.CRITICAL, text))


def _started(sensor: str) -> CalibrationText:
    return _info(f"[cal] calibration started: 2 {sensor}")


def failed(sensor: str) -> CalibrationText:
    """Return the final step of a failed calibration."""
    return _critical(f"[cal] calibration failed: {sensor}")


def _at_rest(
    context: Context, sensor: str, percents: range, step_s: float
) -> Iterator[CalibrationText]:
    """Return the steps of a calibration that needs no rotation of the vehicle."""
    yield _started(sensor)
    for percent in percents:
        # Motion makes the calibration fail, as in PX4 SITL.
        if _moving(context.port.sample):
            yield _critical("ERROR: Motion during calibration")
            yield failed(sensor)
            return
        yield _info(f"[cal] progress <{percent}>", step_s)
    yield _info(f"[cal] calibration done: {sensor}")


def _moving(sample: SensorSample | None) -> bool:
    return sample is None or float(np.abs(sample.gyro).max()) > MOVING_RAD_S


def _one_side(context: Context, sensor: str) -> Iterator[CalibrationText]:
    """Return the steps of the first of six sides, the one the vehicle rests on."""
    yield _started(sensor)
    yield _info("[cal] pending: back front left right up down")
    yield _info("[cal] hold vehicle still on a pending side")
    if _moving(context.port.sample):
        yield failed(sensor)
        return
    # QGroundControl parses these texts literally.
    yield _info("[cal] detected rest position, hold still...", _REST_S)
    yield _info("[cal] down orientation detected")


def _accelerometer(context: Context) -> Iterator[CalibrationText]:
    yield from _one_side(context, "accel")
    yield _info("[cal] Hold still, measuring down side")
    sample = context.port.sample
    if sample is not None:
        x, y, z = sample.accel.tolist()
        yield _info(f"[cal] down side result: [{x:.3f} {y:.3f} {z:.3f}]", _REST_S)
    yield _info("[cal] progress <17>")
    yield _info("[cal] down side done, rotate to a different side")
    while True:  # the vehicle is never rotated
        yield _info("[cal] pending: back front left right up", _AGAIN_S)
        yield _info("[cal] hold vehicle still on a pending side")


def _magnetometer(context: Context) -> Iterator[CalibrationText]:
    yield from _one_side(context, "mag")
    yield _info("[cal] Rotate vehicle")
    while True:
        yield _info("[cal] Rotate vehicle", _AGAIN_S)


def _airspeed(_context: Context) -> Iterator[CalibrationText]:
    yield _started("airspeed")
    yield _critical("[cal] Ensure sensor is not measuring wind")
    yield _critical("[cal] calibration failed: airspeed", _AGAIN_S)  # no airspeed sensor


Routine = Callable[[Context], Iterator[CalibrationText]]


def _one_event(event: Definition, text: str | None = None) -> Routine:
    """Return the routine that announces one event."""
    message = OperatorText.of(Severity.INFO, event, text=text)
    return lambda _context: iter((CalibrationText(0.0, message),))


_rc_begins = _one_event(events.RC_CALIBRATION)

ROUTINES: dict[tuple[int, int], tuple[str, Routine]] = {
    (1, 1): ("gyro", partial(_at_rest, sensor="gyro", percents=range(0, 101, 10), step_s=0.15)),
    (2, 1): ("mag", _magnetometer),
    (3, 1): ("baro", partial(_at_rest, sensor="baro", percents=range(0), step_s=0.5)),
    (4, 1): ("rc", _rc_begins),
    (4, 2): ("trim", _one_event(events.TRIMMED, "trim cal done")),
    (5, 1): ("accel", _accelerometer),
    (5, 2): ("level", partial(_at_rest, sensor="level", percents=range(0, 101, 20), step_s=0.5)),
    (5, 4): ("quick", lambda _context: iter(())),
    (6, 1): ("airspeed", _airspeed),
    (6, 2): ("airspeed", _airspeed),
}
"""Sensor and routine by parameter number and value, in PX4's order of evaluation."""

_ESC = 7


def _calibrate(command: VehicleCommand, context: Context) -> Result:
    """Handle PREFLIGHT_CALIBRATION: one parameter selects the sensor; all zero cancels."""
    running = context.vehicle_state(RunningCalibration)
    # NaN counts as 0: the parameter is not set.
    values = {number: command.integer(number) or 0 for number in range(1, 8)}
    if context.port.state().status.arming is Arming.ARMED:
        return Result.TEMPORARILY_REJECTED
    if running.is_running:
        # A second calibration request does not replace the running one.
        if any(values.values()):
            return Result.TEMPORARILY_REJECTED
        # Cancelling replaces the running steps with the two final texts.
        cancelled = (_critical("[cal] calibration cancelled"), failed(running.sensor))
        running.start(running.sensor, iter(cancelled), context.now_us)
        return Result.ACCEPTED
    # The first match wins: PX4 evaluates the parameters in this order.
    for (number, value), (sensor, routine) in ROUTINES.items():
        if values[number] == value:
            running.start(sensor, routine(context), context.now_us)
            running.radio = running.radio or routine is _rc_begins
            return Result.ACCEPTED
    if values[_ESC] == 1:
        text = "[cal] calibration failed: Disconnect battery and try again"
        context.announce(OperatorText(Severity.CRITICAL, text))
        return Result.DENIED
    if command.integer(4) != 0:
        return Result.UNSUPPORTED  # NaN does not cancel
    # Parameter 4 = 0 ends a radio calibration, which never ends automatically.
    if running.radio:
        running.radio = False
        context.announce(OperatorText.of(Severity.INFO, events.RC_CALIBRATED))
    return Result.ACCEPTED


def _quick_magnetometer(command: VehicleCommand, context: Context) -> Result:
    """Handle FIXED_MAG_CAL_YAW, parameter 1: heading [deg]."""
    if (
        context.vehicle_state(RunningCalibration).is_running
        or context.port.state().status.arming is Arming.ARMED
    ):
        return Result.TEMPORARILY_REJECTED
    heading = command.integer(1) or 0
    for text in (
        f"Assuming vehicle is facing heading {heading:.1f} degrees",
        "Mag quick calibration finished",
    ):
        context.announce(OperatorText(Severity.INFO, text))
    return Result.ACCEPTED


def send_pending(context: Context) -> None:
    """Announce the due texts of a running calibration; call once per tick."""
    running = context.vehicle_states.get(RunningCalibration)
    if running is not None and running.is_running:
        for message in running.due(context.now_us):
            context.announce(message)


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_PREFLIGHT_CALIBRATION: _calibrate,
    dialect.MAV_CMD_FIXED_MAG_CAL_YAW: _quick_magnetometer,
}
