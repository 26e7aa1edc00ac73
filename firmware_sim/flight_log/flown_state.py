"""The autopilot's state in a tick that was flown, by the log of compiled ticks."""

# ruff: noqa: D102 (what the properties are says `AutopilotState`)

from __future__ import annotations

from typing import Any

from airl_mav.core.frames import Vector
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot_state import AutopilotState, Estimate, Setpoint
from firmware_sim.autopilot.snapshot import setpoint_of
from firmware_sim.engine.kinematics import POSITION, QUATERNION, RATES, VELOCITY
from firmware_sim.interfaces import BatterySample, Truth


def truth_of(tick: Any) -> Truth:
    """Return the true state of a tick of an aircraft (`engine.record.TRUE_TICK`)."""
    row = tick["motion"].copy()
    power_w, charge = float(tick["power_w"]), float(tick["charge"])
    parts = row[POSITION], row[VELOCITY], row[QUATERNION], row[RATES]
    return Truth(int(tick["time_us"]), *parts, power_w, charge)


class FlownState:
    """Implements `AutopilotState`: what changes from tick to tick by its log, the rest by another.

    That other state is of the end of the ticks: status, home, parameters.
    """

    def __init__(self, state: AutopilotState, tick: Any) -> None:
        """Take the state after the ticks, and one of them (`engine.record.FLOWN_TICK`)."""
        self._state, self._tick = state, tick

    def __getattr__(self, name: str) -> Any:
        return getattr(self._state, name)

    @property
    def time_us(self) -> int:
        return int(self._tick["time_us"])

    @property
    def estimate(self) -> Estimate:
        row: Vector = self._tick["state"].copy()
        return Estimate(
            self.time_us,
            row[es.P : es.V],
            row[es.V : es.Q],
            row[es.ACCELERATION : es.SIGMA],
            row[es.Q : es.RATES],
            row[es.RATES : es.GYRO_BIAS],
            row[es.GYRO_BIAS : es.ACCEL_BIAS],
            row[es.ACCEL_BIAS : es.BARO_OFFSET],
            row[es.SIGMA : es.RATIO],
            row[es.RATIO :],
            bool(self._tick["healthy"]),
        )

    @property
    def setpoint(self) -> Setpoint:
        return setpoint_of(self._tick, self._output(7, 10))

    attitude_setpoint = property(lambda self: self._output(0, 4))
    rate_setpoint = property(lambda self: self._output(4, 7))
    thrust_setpoint = property(lambda self: self._tick["output"].item(10))
    accel = property(lambda self: self._tick["accel"].copy())
    gyro = property(lambda self: self._tick["gyro"].copy())
    mag = property(lambda self: self._tick["mag"].copy())
    pressure_hpa = property(lambda self: self._tick["pressure_hpa"].item())
    temperature_c = property(lambda self: self._tick["temperature_c"].item())
    motors = property(lambda self: tuple(self._tick["motors"].tolist()))
    battery = property(lambda self: BatterySample(*self._tick["battery"].tolist()))

    def _output(self, first: int, end: int) -> Vector:
        values: Vector = self._tick["output"][first:end].copy()
        return values
